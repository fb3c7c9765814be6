"""The first call of functions of one's own: what is right passes, what is wrong is one line."""

import functools
import random
import time

import numpy as np
import pytest
import torch

from aser import noise
from aser.agents import sac
from aser.errors import ConfigError
from aser.noise import Stream
from aser.replay import criteria, own
from aser.settings.agent import SacConfig

OBS, ACT = 4, 2
HYPER = {name: torch.tensor([0.5, 0.5]) for name in ("alpha", "epsilon", "gamma", "h")}
FIRST = torch.rand(6, OBS, generator=torch.Generator().manual_seed(1))  # at least 0, as promised


def a_trial(kept=False):
    init = functools.partial(
        sac.init,
        obs_dim=OBS,
        action_dim=ACT,
        hidden=(8,),
        options=SacConfig("sac", "prioritised", "min"),
    )
    return own.trial(sac, init, FIRST, ACT, HYPER, kept)


TRIAL = a_trial()


def said(function, *arguments, **more):
    """What is wrong, without what is allowed; None where nothing is."""
    try:
        function(*arguments, **more)
    except ConfigError as error:
        assert "\n" not in str(error) and len(str(error)) < 500
        key, what, allowed = str(error).split(": ", 1)[0], *str(error).rsplit("; allowed: ", 1)
        assert key.endswith("=toys.own") and allowed
        return what.removeprefix(f"{key}: ")
    return None


def of_criterion(function, trial=TRIAL):
    return said(own.criterion, "criterion", "toys.own", function, trial)


# Criteria.


@pytest.mark.parametrize("name", sorted(set(criteria.FUNCTIONS) - {"q_dropoff"}))
@pytest.mark.parametrize("kept", [False, True])
def test_what_is_shipped_would_pass(name, kept):
    assert of_criterion(criteria.FUNCTIONS[name], a_trial(kept)) is None


class Scaled:
    """A function with a setting, which never changes."""

    def __init__(self, scale):
        self.scale = scale
        self.grid = torch.arange(3.0)

    def __call__(self, state, obs, gaussian):
        return self.scale * obs[:3].mul(self.grid[:, None]).sum(0) + _constant(2)


@functools.cache
def _constant(number):
    return torch.tensor(float(number))


RIGHT = {
    "of the state": lambda state, obs, gaussian: gaussian.log_std.exp().sum(0),
    "float64": lambda state, obs, gaussian: obs[0].double().abs(),
    "the same everywhere": lambda state, obs, gaussian: torch.ones(obs.shape[1]),
    "infinite": lambda state, obs, gaussian: obs[0] / torch.zeros(1),
    "an object": Scaled(2.0),
    "a method": Scaled(1.0).__call__,
    "a part": functools.partial(criteria.mode_log_prob, squashed=False),
    "a module": torch.nn.Sequential(),  # replaced below
}


class Net(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(OBS, 1)

    def forward(self, state, obs, gaussian):
        return self.layer(obs.T)[:, 0].abs()


RIGHT["a module"] = Net()


@pytest.mark.parametrize("name", RIGHT)
def test_a_right_criterion_passes(name):
    assert of_criterion(RIGHT[name]) is None


def branch(state, obs, gaussian):
    p = obs[0]
    return p if p.sum() > 0 else -p


def in_place(state, obs, gaussian):
    return obs.mul_(2.0)[0].abs()


def in_place_of_outputs(state, obs, gaussian):
    return gaussian.mean.abs_().sum(0)


WRONG = {
    "None": (lambda state, obs, gaussian: None, "it returns None"),
    "a number": (lambda state, obs, gaussian: 1.0, "it returns a float and no tensor"),
    "an array": (lambda *_: np.ones(3), "it returns a ndarray and no tensor"),
    "()": (lambda state, obs, gaussian: obs.sum(), "it returns float32 () where B is 3"),
    "(1, B)": (lambda state, obs, gaussian: obs[:1], "it returns float32 (1, 3) where B is 3"),
    "(O, B)": (lambda state, obs, gaussian: obs, "it returns float32 (4, 3) where B is 3"),
    "(O,)": (lambda state, obs, gaussian: obs[:, 0], "it returns float32 (4,) where B is 3"),
    "only three": (lambda state, obs, gaussian: obs[0, :3], "it returns float32 (3,) where B is 7"),
    "int": (
        lambda state, obs, gaussian: obs[0].long(),
        "it returns int64 (3,); .float() makes it float32",
    ),
    "bool": (
        lambda state, obs, gaussian: obs[0] > 0,
        "it returns bool (3,); .float() makes it float32",
    ),
    "half": (lambda state, obs, gaussian: obs[0].bfloat16(), "it returns bfloat16 (3,); .float() "),
    "negative": (lambda state, obs, gaussian: obs[0] * 0 - 0.25, "p is negative (-0.25)"),
    "minus infinity": (lambda state, obs, gaussian: obs[0].mul(0).log(), "p is negative (-inf)"),
    "NaN": (lambda state, obs, gaussian: (-1 - obs[0]).sqrt(), "p is not a number (NaN)"),
    "branch": (branch, "it branches on the value of a tensor; torch.where does not (test_own.py, "),
    "max": (lambda state, obs, gaussian: max(obs[0]).expand(3), "it branches on the value"),
    "item": (lambda state, obs, gaussian: obs[0] * obs.max().item(), "it reads the value of a ten"),
    "float": (lambda state, obs, gaussian: obs[0] * float(obs.max()), "it reads the value of a te"),
    "numpy": (lambda state, obs, gaussian: torch.tensor(obs[0].numpy()), "it hands a tensor to n"),
    "np.exp": (lambda state, obs, gaussian: torch.tensor(np.exp(obs[0])), "it hands a tensor to n"),
    "nonzero": (lambda state, obs, gaussian: obs[0][obs[0] > 0], "it makes a tensor whose shape d"),
    "torch.rand": (lambda state, obs, gaussian: torch.rand(3), "it draws random numbers by itself"),
    "np.random": (
        lambda state, obs, gaussian: obs[0].abs() + np.random.rand(),
        "it draws random numbers by itself",
    ),
    "random": (
        lambda state, obs, gaussian: obs[0].abs() * random.random(),
        "it draws random numbers by itself",
    ),
    "two arguments": (lambda state, obs: obs[0], "TypeError: "),
    "four arguments": (lambda state, obs, gaussian, hyper: obs[0], "TypeError: "),
    "an index": (lambda state, obs, gaussian: obs[9], "IndexError: index 9 is out of bounds"),
    "no such thing": (lambda state, obs, gaussian: gaussian.median[0], "AttributeError: "),
    "exit": (lambda state, obs, gaussian: exit(3), "SystemExit: 3"),
    "in place": (in_place, "it changes its arguments in place"),
    "outputs in place": (in_place_of_outputs, "it changes its arguments in place"),
}


WRONG["the batch"] = (
    lambda state, obs, gaussian: obs[0].abs() / obs[0].abs().max(),
    "p of a state depends on the other states",
)


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_criterion_is_one_line(name):
    function, expected = WRONG[name]
    assert of_criterion(function).startswith(expected)


def test_the_line_says_where_and_what_is_allowed():
    with pytest.raises(ConfigError) as caught:
        own.criterion("bootstrap.criterion", "toys.branch", branch, TRIAL)
    line = branch.__code__.co_firstlineno + 2
    assert str(caught.value) == (
        "bootstrap.criterion=toys.branch: it branches on the value of a tensor; torch.where does "
        f"not (test_own.py, line {line}); "
        "allowed: (state, obs (O, B), outputs) -> p (B,), a float tensor, at least 0"
    )


def test_an_interrupt_is_none_of_it():
    def interrupted(state, obs, gaussian):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        of_criterion(interrupted)


# State.

CALLS, SEEN = 0, []


class Counting:
    def __init__(self):
        self.calls = 0

    def __call__(self, state, obs, gaussian):
        self.calls += 1
        return obs[0]


class Running:
    """Its tensor changes in place."""

    def __init__(self):
        self.inner = {"most": [torch.zeros(())]}

    def __call__(self, state, obs, gaussian):
        self.inner["most"][0].add_(1.0)
        return obs[0]


class First:
    """It keeps what it sees first."""

    mean = None

    def __call__(self, state, obs, gaussian):
        if self.mean is None:
            self.mean = obs.mean()
        return obs[0]


class OfTheClass:
    calls = 0

    def __call__(self, state, obs, gaussian):
        OfTheClass.calls += 1
        return obs[0]


def of_a_global(state, obs, gaussian):
    global CALLS
    CALLS += 1
    return obs[0]


def of_a_global_list(state, obs, gaussian):
    _note(obs.shape)
    return obs[0]


def _note(what):
    SEEN.append(what)


def of_a_closure():
    calls = 0

    def criterion(state, obs, gaussian):
        nonlocal calls
        calls += 1
        return obs[0]

    return criterion


def of_a_default(state, obs, gaussian, seen=[]):  # noqa: B006
    seen.append(1)
    return obs[0]


def of_itself(state, obs, gaussian):
    of_itself.calls = getattr(of_itself, "calls", 0) + 1
    return obs[0]


KEEPING = {
    "attribute": (Counting(), "calls"),
    "method": (Counting().__call__, "calls"),
    "part": (functools.partial(Counting()), "calls"),
    "tensor": (Running(), "inner.'most'.0"),
    "first": (First(), "mean"),
    "class": (OfTheClass(), "calls"),
    "global": (of_a_global, "CALLS"),
    "global of a helper": (of_a_global_list, "_note.SEEN.0"),
    "closure": (of_a_closure(), "calls"),
    "default": (of_a_default, "0"),
    "function": (of_itself, "calls"),
}


@pytest.mark.parametrize("name", KEEPING)
def test_a_criterion_that_keeps_state_is_refused_with_a_pointer(name):
    function, part = KEEPING[name]
    with pytest.raises(ConfigError) as caught:
        own.criterion("criterion.of", "toys.own", function, TRIAL)
    assert str(caught.value) == (
        f"criterion.of=toys.own: it keeps state, `{part}` has changed in a call; allowed: "
        "a criterion that learns is a class with init, update and p (LearnedRule)"
    )


@pytest.mark.parametrize("keeps", ["generator", "iterator", "clock"])
def test_hidden_state_shows_in_other_values(keeps):
    source = {
        "generator": np.random.default_rng(0).random,
        "iterator": iter(range(9)).__next__,
        "clock": lambda: time.perf_counter_ns() % 1000,
    }[keeps]
    function = lambda state, obs, gaussian: obs[0] + source()  # noqa: E731
    assert of_criterion(function) == "it gives other values the second time, so it keeps state"


# Classes that learn.


class Mean:
    """The distance from the mean observation so far."""

    def init(self, key, obs_dim, action_dim):
        return {"sum": torch.zeros(obs_dim), "count": torch.zeros((), dtype=torch.int64)}

    def update(self, own, transitions, state, hyper, noise):
        total = own["sum"] + hyper["gamma"] * transitions.obs.sum(1)
        return {"sum": total, "count": own["count"] + transitions.reward.numel()}

    def p(self, own, state, obs, outputs):
        return (obs - (own["sum"] / own["count"].clamp(min=1))[:, None]).square().sum(0)


class Noisy(Mean):
    def wanted(self, action_dim, batch):
        return {Stream.CRITERION: (noise.normal, (action_dim, batch))}

    def init(self, key, obs_dim, action_dim):
        return (noise.normal(key, (obs_dim,)), [torch.zeros(2)])

    def update(self, own, transitions, state, hyper, noise):
        shift = noise[Stream.CRITERION].mean() + transitions.action.mean()
        return (own[0] + shift, own[1])

    def p(self, own, state, obs, outputs):
        return (own[0] @ obs).abs()


@pytest.mark.parametrize("made", [Mean, Noisy])
def test_a_right_class_passes(made):
    assert of_criterion(made) is None


def variant(**functions):
    """`Mean` with other functions."""
    return type("Variant", (Mean,), functions)


def counting_update(self, own, transitions, state, hyper, noise):
    self.calls = getattr(self, "calls", 0) + 1
    return own


def update_in_place(self, own, transitions, state, hyper, noise):
    own["count"] += 1
    return own


class Constructor(Mean):
    def __init__(self, scale):
        pass


class Half:
    def init(self, key, obs_dim, action_dim):
        return {}


class Drawing(Mean):
    def __init__(self):
        self.weight = torch.randn(4)


def zeros(*shape, **kind):
    return lambda self, key, obs_dim, action_dim: torch.zeros(*shape, **kind)


def plain(result):
    return lambda self, own, transitions, state, hyper, noise: result(own)


P = {"p": lambda self, own, state, obs, outputs: obs[0]}
WRONG_CLASSES = {
    "no update": (Half, "the class has no update, p"),
    "arguments": (Constructor, "TypeError: "),
    "drawing": (Drawing, "it draws random numbers by itself; wanted(action_dim, batch) -> "),
    "init draws": (
        variant(init=lambda self, key, o, a: torch.randn(o)),
        "it draws random numbers by itself (test_own.py, line ",
    ),
    "update draws": (
        variant(update=plain(lambda own: {**own, "sum": torch.randn(OBS)})),
        "it draws random numbers by itself (test_own.py, line ",
    ),
    "a list of numbers": (
        variant(init=lambda self, key, o, a: [1.0, 2.0]),
        "own[0] is a float and no tensor, where a state is a tree of tensors",
    ),
    "None": (variant(update=plain(lambda own: None)), "own is None, where a state is a tree of t"),
    "arguments of update": (variant(update=lambda self, own: own), "TypeError: "),
    "dtype": (
        variant(init=zeros(3), update=plain(lambda own: own.double()), **P),
        "update changes the form of its state from own float32 (3,) to own float64 (3,)",
    ),
    "shape": (
        variant(init=zeros(3), update=plain(lambda own: own[:2]), **P),
        "update changes the form of its state from own float32 (3,) to own float32 (2,)",
    ),
    "keys": (
        variant(update=plain(lambda own: {"total": own["sum"], "count": own["count"]})),
        "update changes the form of its state from own['sum'] float32 (4,) to own['total'] float3",
    ),
    "order": (
        variant(update=plain(lambda own: {"count": own["count"], "sum": own["sum"]})),
        "update changes the form of its state from own['sum'] float32 (4,) to own['count'] int64 (",
    ),
    "more": (
        variant(init=zeros(3), update=plain(lambda own: (own, own)), **P),
        "update changes the form of its state from own float32 (3,) to own[0] float32 (3,)",
    ),
    "in place": (variant(update=update_in_place), "it changes its arguments in place"),
    "keeps state": (
        variant(update=counting_update),
        "it keeps state, `calls` has changed in a call",
    ),
    "negative": (
        variant(p=lambda self, own, state, obs, outputs: obs[0] - 5.0),
        "p is negative (-",
    ),
    "NaN at first": (
        variant(p=lambda self, own, state, obs, outputs: obs[0] * own["count"] / own["count"]),
        "p is not a number (NaN)",
    ),
    "shape of p": (
        variant(p=lambda self, own, state, obs, outputs: own["sum"]),
        "it returns float32 (4,) where B is 3",
    ),
    "another stream": (
        variant(wanted=lambda self, action_dim, batch: {Stream.DRAW: (noise.normal, (batch,))}),
        "wanted asks for other numbers than wanted(action_dim, batch) -> {Stream.CRITERION: ",
    ),
    "numbers not wanted": (
        variant(update=lambda self, own, t, s, h, noise: noise[Stream.CRITERION] and own),
        "KeyError: ",
    ),
}


WRONG_CLASSES["NaN later"] = (
    variant(
        init=lambda self, key, obs_dim, action_dim: {"count": torch.zeros(())},
        update=lambda self, own, transitions, state, hyper, noise: {"count": own["count"] + 1},
        p=lambda self, own, state, obs, outputs: (0.5 - own["count"]).sqrt() + 0 * obs[0],
    ),
    "p is not a number (NaN)",
)


@pytest.mark.parametrize("name", WRONG_CLASSES)
def test_a_wrong_class_is_one_line(name):
    made, expected = WRONG_CLASSES[name]
    assert of_criterion(made).startswith(expected)


# Prioritisations and rules.


def of_prioritisation(function):
    return said(own.prioritisation, "prioritisation", "toys.own", function, HYPER)


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda p, hyper: p.double() ** hyper["alpha"], None),
        (lambda p, hyper: (p > 1).float() + hyper["epsilon"], None),
        (lambda p, hyper: 1.0 / p, None),  # infinite at 0, which is bounded
        (lambda p, hyper: p - 1.0, "a mass is negative (-1)"),
        (lambda p, hyper: p.log(), "a mass is negative (-inf)"),
        (lambda p, hyper: p / p.sum(), "the mass of an item depends on the other items"),
        (lambda p, hyper: 1.0 / (1.0 + p.argsort()), "the mass of an item depends on the other "),
        (lambda p, hyper: p / p, "a mass is not a number (NaN)"),
        (lambda p, hyper: p.sum(), "it returns float32 () where B is 3"),
        (lambda p, hyper: p > 1, "it returns bool (3,); .float() makes it float32"),
        (lambda p, hyper: p ** hyper["alfa"], "KeyError: 'alfa'"),
        (lambda p, hyper: p * torch.rand_like(p), "it draws random numbers by itself"),
        (lambda p, hyper, more: p, "TypeError: "),
        (lambda p, hyper: p.mul_(2.0), "it changes its arguments in place"),
        (lambda p, hyper: p if p.max() > 1 else p + 1, "it branches on the value of a tensor"),
    ],
)
def test_prioritisations(function, expected):
    found = of_prioritisation(function)
    assert found is None if expected is None else found.startswith(expected)


def of_facts(function):
    assert own.takes_facts(function)
    return said(own.of_facts, "prioritisation", "toys.own", function, HYPER)


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda facts: facts.reward.abs() + 1e-3, None),
        (lambda facts, scale=2.0: scale * facts.p ** facts.hyper["alpha"], None),
        (lambda facts: 1.0 / (1.0 + (facts.age * facts.there).argsort()), None),
        (lambda facts: facts.td_error / (facts.td_error * facts.there).max(), None),
        (lambda facts: torch.where(facts.terminated | facts.truncated, 2.0, 1.0), None),
        (lambda facts: facts.reward, "a mass is negative (-1)"),
        (lambda facts: facts.p / facts.p, "a mass is not a number (NaN)"),
        (
            lambda facts: facts.p / facts.p.sum(),
            "a mass depends on places without an item; facts.there is false at these",
        ),
        (lambda facts: facts.p.sum(), "it returns float64 () where N is 7"),
        (lambda facts: facts.p[:3], "it returns float64 (3,) where N is 7"),
        (lambda facts: facts.there, "it returns bool (7,); .float() makes it float32"),
        (lambda facts: facts.age.long(), "it returns int64 (7,); .float() makes it float32"),
        (lambda facts: facts, "it returns a Facts and no tensor"),
        (lambda facts: facts.rewards, "there is no rewards; there are p, td_error, reward, age, "),
        (lambda facts: facts.hyper["alfa"], "KeyError: 'alfa'"),
        (lambda facts: facts.p * torch.rand_like(facts.p), "it draws random numbers by itself"),
        (lambda facts: facts.p.add_(1.0), "it changes its arguments in place"),
        (lambda facts: facts.p if facts.p.max() > 1 else facts.age, "it branches on the value"),
        (lambda facts: facts.p * facts.reward.max().item(), "it reads the value of a tensor"),
        (lambda facts: [SEEN.append(1), facts.p][1], "it keeps state, `SEEN."),
        (Scaled, "it returns a Scaled and no tensor"),
    ],
)
def test_prioritisations_by_facts(function, expected):
    found = of_facts(function)
    assert found is None if expected is None else found.startswith(expected)


def test_a_function_of_two_arguments_is_not_told_the_facts():
    two = [lambda p, hyper: p, lambda *both: both[0], lambda: 1, functools.partial, max]
    assert not any(own.takes_facts(function) for function in two)


def test_what_is_read_is_noted():
    """So what costs something is kept only for a function that reads it."""
    tried = ("prioritisation", "toys.own")
    for read, function in (
        ({"reward"}, lambda facts: facts.reward.abs()),
        ({"td_error", "hyper"}, lambda facts: facts.td_error * facts.hyper["alpha"]),
        (set(own.Facts._fields), lambda facts: facts[1]),
        (set(own.Facts._fields), lambda facts: next(iter(facts))),
    ):
        assert own.of_facts(*tried, function, HYPER) == read
    rule = lambda path: (path.age[1:] < 9) & (path.td_error[1:] > 0.2) & path.truncated[1:]  # noqa: E731
    read = own.rule("bootstrap", "toys.own", rule, HYPER, False)
    assert read == {"age", "td_error", "truncated"}
    assert own.rule("bootstrap", "toys.own", lambda path: path.p < path.b, HYPER, True) == {*"pb"}


def test_a_prioritisation_that_keeps_state_is_refused():
    class Largest:
        def __init__(self):
            self.largest = 0.0

        def __call__(self, p, hyper):
            self.largest += 1.0
            return p

    assert of_prioritisation(Largest()) == "it keeps state, `largest` has changed in a call"


def test_a_lane_that_meets_another_lane_is_refused():
    """It is elementwise in a batch of one lane, but not for the new items of all lanes."""
    function = lambda p, hyper: p + (hyper["alpha"].sum() if hyper["alpha"].ndim else 0.5)  # noqa: E731
    assert of_prioritisation(function) == "the mass of an item depends on the other items"


def of_rule(function, reads_criterion=True):
    return said(own.rule, "bootstrap", "toys.own", function, HYPER, reads_criterion)


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda path: torch.ones_like(path.p, dtype=torch.bool), None),
        (lambda path: (path.window.reward[:-1] == 0) & (path.u < path.hyper["gamma"]), None),
        (lambda path: path.p < path.b.item(), "it reads the value of a tensor"),
        (lambda path: path.p, "it returns float32 (4, 3) where H-1 is 4 and B is 3"),
        (lambda path: path.u < 0.5, "it returns bool (3,) where H-1 is 4 and B is 3"),
        (lambda path: path.td_error[1:] < path.age[1:], None),
        (lambda path: path.td_error < 1, "it returns bool (5, 3) where H-1 is 4 and B is 3"),
        (lambda path: path.window.last, "it returns bool (5, 3) where H-1 is 4 and B is 3"),
        (lambda path: True, "it returns a bool and no tensor"),
        (lambda path: path.p < path.hyper["lam"], "KeyError: 'lam'"),
        (lambda path: torch.rand_like(path.p) < 0.5, "it draws random numbers by itself"),
        (lambda path, p: p < 1, "TypeError: "),
        (
            lambda path: path.p < path.threshold,
            "there is no threshold; there are window, ",
        ),
        (lambda path: path.p.sub_(1.0) < path.b, "it changes its arguments in place"),
        (lambda path: path.p < path.b if path.b > 0 else path.p < 1, "it branches on the value "),
    ],
)
@pytest.mark.parametrize("reads_criterion", [True, False])
def test_rules(function, expected, reads_criterion):
    found = of_rule(function, reads_criterion)
    assert found is None if expected is None else found.startswith(expected)


@pytest.mark.parametrize("rule", [lambda path: path.p < path.b, lambda path: path.p > 0.5])
def test_a_rule_that_depends_on_p_needs_a_criterion(rule):
    assert of_rule(rule, reads_criterion=True) is None
    assert of_rule(rule, reads_criterion=False).startswith("it depends on p or b")


def test_a_rule_that_keeps_state_is_refused():
    assert of_rule(lambda path: [SEEN.append(1), path.p < path.b][1]).startswith(
        "it keeps state, `SEEN."
    )


def test_the_first_call_takes_a_moment():
    of_criterion(Noisy)
    began = time.perf_counter()
    for made in (branch, Noisy, RIGHT["an object"]):
        of_criterion(made)
    assert time.perf_counter() - began < 1.0
