"""A first call of functions of one's own, so that a wrong one ends in one line.

Training maps these functions over lanes and compiles them, once. What they keep between calls would
be frozen there without a word, and what goes wrong would be said in torch's words. So each is
called on small inputs before anything is written or compiled.
"""

from __future__ import annotations

import inspect
import sysconfig
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import torch
from torch import Tensor

from aser import noise
from aser.agents import Agent
from aser.errors import ConfigError, one_line
from aser.lanes import batched
from aser.noise import Stream
from aser.replay import hidden
from aser.replay.bootstrap import Path as UnrollPath
from aser.replay.facts import Facts
from aser.replay.kinds import Transitions
from aser.replay.storage import Window
from aser.trees import contiguous, tree_leaves

LANES, BATCH, OTHER_BATCH, STEPS = 2, 3, 7, 5  # all sizes that meet differ

A_CRITERION = "(state, obs (O, B), outputs) -> p (B,), a float tensor, at least 0"
A_PRIORITISATION = (
    "(facts) -> mass (N,), or (p (B,), hyper) -> mass (B,) elementwise; a float tensor, at least 0"
)
A_RULE = "(path) -> bool (H-1, B), of its argument alone"
A_CLASS = (
    "a class that is made without arguments, with init(key, obs_dim, action_dim) -> own, "
    "update(own, transitions, state, hyper, noise) -> own and p(own, state, obs, outputs) -> p (B,)"
)
POINTER = "a criterion that learns is a class with init, update and p (LearnedRule)"
NUMBERS = "wanted(action_dim, batch) -> {Stream.CRITERION: (noise.normal, (batch,))}"

# What torch says of a fault, and what that means here.
MEANINGS = {
    "data-dependent control flow": "it branches on the value of a tensor; torch.where does not",
    ".item()": "it reads the value of a tensor, by .item(), float(), int() or bool()",
    "random operation": "it draws random numbers by itself",
    "data pointer": "it hands a tensor to numpy; only torch's functions work",
    "numpy.ndarray": "it mixes tensors and numpy; only torch's functions work",
    "dynamic shape": "it makes a tensor whose shape depends on values; torch.where does not",
}


class Trial(NamedTuple):
    """What criteria are tried on, with two lanes in front."""

    agent: Agent
    state: Any  # the agent's, every leaf (2, ...)
    keys: Tensor  # (2, streams, 2)
    obs: Tensor  # (2, O, 7) observations that the environment has given
    action_dim: int
    hyper: dict[str, Tensor]  # each (2,)


def trial(
    agent: Agent,
    init: Callable,
    first: Tensor,
    action_dim: int,
    hyper: dict[str, Tensor],
    kept: bool = False,
) -> Trial:
    """A trial with fresh agents in the observations `first` (L, O).

    `init` makes a state from a key (2,). With `kept`, a state is what a frozen agent keeps of it.
    """
    keys = noise.lane_keys(range(LANES)).to(first.device)
    state = contiguous(batched(init)(keys[:, Stream.INIT]))
    place = torch.arange(LANES * OTHER_BATCH).reshape(LANES, OTHER_BATCH) % len(first)
    obs = first[place].mT.contiguous()
    return Trial(agent, agent.kept(state) if kept else state, keys, obs, action_dim, hyper)


class Wrong(Exception):
    """What is wrong with a result."""


@dataclass(frozen=True)
class Named:
    """A function of one's own, by its key and name in the settings, and what it must be."""

    key: str
    name: str
    allowed: str

    def refuse(self, what: str, allowed: str = "") -> NoReturn:
        raise ConfigError(f"{self.key}={self.name}: {what}; allowed: {allowed or self.allowed}")

    @contextmanager
    def guard(self) -> Iterator[None]:
        """Whatever is raised inside becomes one line."""
        try:
            with torch.no_grad(), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                yield
        except (KeyboardInterrupt, ConfigError):
            raise
        except Wrong as error:
            self.refuse(str(error))
        except BaseException as error:
            self.refuse(_meaning(error) + _place(error))


def criterion(key: str, name: str, function: Callable, trial: Trial) -> None:
    """Try a criterion of one's own, a function or a class that learns.

    Raises ConfigError, a line that begins with `key`, where it breaks its promise.
    """
    if isinstance(function, type):
        return _learned(Named(key, name, A_CLASS), function, trial)
    named = Named(key, name, A_CRITERION)

    def p(state: Any, obs: Tensor, outputs: Any) -> Tensor:
        return _vector(function(state, obs, outputs), obs.shape[1])

    _judge_p(named, *_call(named, function, p, _states(trial)))


def takes_facts(function: Callable) -> bool:
    """Whether a prioritisation of one's own is one of `Facts`: whether it needs one argument."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # it does not tell
        return False
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    needed = [one for one in parameters if one.kind in positional and one.default is one.empty]
    return len(needed) == 1


def of_facts(key: str, name: str, function: Callable, hyper: Mapping[str, Tensor]) -> set[str]:
    """Try a prioritisation `(facts) -> mass (N,)` of one's own, as `prioritisation` does.

    Returns the names of the facts that it reads.
    """
    named, read = Named(key, name, A_PRIORITISATION), set[str]()
    device = next(iter(hyper.values())).device

    def mass(facts: Facts) -> Tensor:
        return _vector(function(_noting(Facts, read)(*facts)), len(facts.p), "N")

    def inputs(nothing: float) -> tuple[Facts]:
        """Facts where all but BATCH items are places with `nothing` but a number."""
        number = torch.arange(LANES * OTHER_BATCH, device=device).reshape(LANES, OTHER_BATCH)
        number, there = number.double(), number % OTHER_BATCH < BATCH
        facts = Facts(
            p=number % 5 * 0.5,
            td_error=number % 4 * 0.25,
            reward=number % 3 - 1.0,
            age=BATCH - 1.0 - number % OTHER_BATCH,
            terminated=number % 7 == 1,
            truncated=number % 7 == 2,
            there=there,
            hyper=dict(hyper),
        )
        p, td_error, reward, age = (torch.where(there, fact, nothing) for fact in facts[:4])
        return (facts._replace(p=p, td_error=td_error, reward=reward, age=age),)

    first, other = _call(named, function, mass, [inputs(0.0), inputs(9.0)])
    first, other = first[:, :BATCH], other[:, :BATCH]
    _judge(named, "a mass", first)
    if not _alike(first, other):
        named.refuse("a mass depends on places without an item; facts.there is false at these")
    return read


def prioritisation(key: str, name: str, function: Callable, hyper: Mapping[str, Tensor]) -> None:
    """Try one `(p, hyper) -> mass` of one's own; `hyper` are (2,). Raises as `criterion` does."""
    named = Named(key, name, A_PRIORITISATION)
    device = next(iter(hyper.values())).device
    many = torch.arange(LANES * OTHER_BATCH, device=device).reshape(LANES, OTHER_BATCH) % 5 * 0.5
    few = many[:, :BATCH].contiguous()

    def mass(p: Tensor, hyper: dict[str, Tensor]) -> Tensor:
        return _vector(function(p, hyper), len(p))

    first, other = _call(named, function, mass, [(few, dict(hyper)), (many, dict(hyper))])
    _judge(named, "a mass", first)
    with named.guard():
        across = _vector(function(few[:, 0], dict(hyper)), LANES)  # as for new items, one of a lane
    if not (_alike(other[:, :BATCH], first) and _alike(across, first[:, 0])):
        named.refuse("the mass of an item depends on the other items")


def rule(
    key: str, name: str, function: Callable, hyper: Mapping[str, Tensor], reads_criterion: bool
) -> set[str]:
    """Try a bootstrap rule of one's own; `hyper` are numbers (2,). Raises as `criterion` does.

    Returns the names of the parts of its path that it reads.
    """
    named, read = Named(key, name, A_RULE), set[str]()
    device = next(iter(hyper.values())).device

    def passes(path: UnrollPath) -> Tensor:
        found, shape = function(_noting(UnrollPath, read)(*path)), path.p.shape
        if not isinstance(found, Tensor):
            raise Wrong(f"it returns {_kind(found)}")
        if found.dtype != torch.bool or found.shape != shape:
            raise Wrong(
                f"it returns {_described(found)} where H-1 is {shape[0]} and B is {shape[1]}"
            )
        return found

    def inputs(batch: int, criterion: bool) -> tuple[UnrollPath]:
        shape = (LANES, STEPS, batch)
        number = torch.arange(LANES * STEPS * batch, device=device).reshape(shape)
        terminated = number % 7 == 6
        truncated = number % 13 == 12
        last = terminated | truncated | (number % 11 == 10)
        window = Window(number % 50, number % 3 - 1.0, terminated, last)
        p = (number[:, 1:] % 5) * 0.5
        b = torch.ones(LANES, device=device)
        if not criterion:
            p, b = torch.zeros_like(p), torch.full_like(b, torch.nan)
        u = (number[:, 0] + 0.5) / (number.max() + 1.0)
        age, td_error = 50.0 - number, number % 4 * 0.25
        return (UnrollPath(window, dict(hyper), u, p, b, truncated, age, td_error),)

    def passed(criterion: bool) -> Tensor:
        batches = [inputs(batch, criterion) for batch in (BATCH, OTHER_BATCH)]
        return _call(named, function, passes, batches)[1]

    if not passed(reads_criterion).equal(passed(True)):
        named.refuse("it depends on p or b, which a rule without a criterion does not have")
    return read


def _noting(kind: type, read: set[str]) -> type:
    """The same NamedTuple, which notes the names of the parts that are read of it."""

    class Noting(kind):
        def __getattribute__(self, name: str) -> Any:
            if name in kind._fields:  # type: ignore[attr-defined]
                read.add(name)
            return super().__getattribute__(name)

        def __getitem__(self, place: Any) -> Any:
            read.update(kind._fields)  # type: ignore[attr-defined]
            return super().__getitem__(place)

        def __iter__(self) -> Iterator[Any]:
            read.update(kind._fields)  # type: ignore[attr-defined]
            return super().__iter__()

    Noting.__name__ = kind.__name__
    return Noting


def _learned(named: Named, made: type, trial: Trial) -> None:
    """Try a class that learns: make it, and run its functions as an update does."""
    lacking = [name for name in ("init", "update", "p") if not callable(getattr(made, name, None))]
    if lacking:
        named.refuse(f"the class has no {', '.join(lacking)}")
    before = hidden.generators()
    with named.guard():
        learner = made()
        wanted = _wanted(learner, trial.action_dim)
        numbers = batched(lambda keys: noise.numbers(keys, wanted))(trial.keys)
    if hidden.generators() != before:
        named.refuse(f"it draws random numbers by itself; {NUMBERS} gives them in `noise`")
    obs_dim = trial.obs.shape[1]
    shapes: list[list[str]] = []

    def init(key: Tensor) -> Any:
        own = learner.init(key, obs_dim, trial.action_dim)
        shapes.append(_shapes(own))
        return own

    def update(own: Any, transitions: Transitions, state: Any, hyper: Any, numbers: Any) -> Any:
        new = learner.update(own, transitions, state, hyper, numbers)
        if (after := _shapes(new)) != shapes[0]:
            pairs = [*zip(shapes[0], after, strict=False), (len(shapes[0]), len(after))]
            one, other = next(pair for pair in pairs if pair[0] != pair[1])
            raise Wrong(f"update changes the form of its state from {one} to {other}")
        return new

    def p(own: Any, state: Any, obs: Tensor, outputs: Any) -> Tensor:
        return _vector(learner.p(own, state, obs, outputs), obs.shape[1])

    (own, _) = _call(named, learner, init, [(trial.keys[:, Stream.CRITERION],)] * 2)
    _judge_p(named, *_call(named, learner, p, [(own, *inputs) for inputs in _states(trial)]))
    number = torch.arange(LANES * BATCH, device=trial.obs.device).reshape(LANES, BATCH)
    transitions = Transitions(
        obs=trial.obs[:, :, :BATCH],
        action=(number % 3 - 1.0)[:, None].repeat(1, trial.action_dim, 1),
        reward=number % 4 * 0.5,
        next_obs=trial.obs[:, :, 1 : 1 + BATCH],
        terminated=number % 5 == 4,
        truncated=number % 7 == 3,
        scale=torch.full_like(trial.obs[:, :, 0], 0.5),
    )
    arguments = (transitions, trial.state, trial.hyper, numbers)
    after, _ = _call(named, learner, update, [(own, *arguments)] * 2)
    after, _ = _call(named, learner, update, [(after, *arguments)] * 2)
    _judge_p(named, *_call(named, learner, p, [(after, *inputs) for inputs in _states(trial)]))


def _wanted(learner: Any, action_dim: int) -> noise.Wanted:
    """The random numbers that a class that learns asks for."""
    wanted: Any = getattr(learner, "wanted", lambda action_dim, batch: {})(action_dim, BATCH)
    if not isinstance(wanted, dict) or not set(wanted) <= {Stream.CRITERION}:
        raise Wrong(f"wanted asks for other numbers than {NUMBERS}")
    return wanted


def _states(trial: Trial) -> list[tuple[Any, Tensor, Any]]:
    """Arguments of a criterion, for two numbers of states."""
    found = []
    for batch in (BATCH, OTHER_BATCH):
        obs = trial.obs[:, :, :batch].contiguous()
        with torch.no_grad():
            outputs = batched(trial.agent.outputs)(trial.state, obs)
        found.append((trial.state, obs, outputs))
    return found


def _call(
    named: Named, thing: Callable, function: Callable, batches: Sequence[tuple]
) -> tuple[Any, Any]:
    """The results of `function` in all lanes for two tuples of arguments; it is `thing` inside.

    The first is asked for twice. It is refused if it keeps state, draws random numbers or changes
    its arguments.
    """
    before, generators = hidden.kept(thing), hidden.generators()
    results = []
    for arguments in (*batches, batches[0]):
        with named.guard():
            given = contiguous(arguments)
            results.append(batched(function)(*given))
        if not _alike(given, arguments):
            named.refuse("it changes its arguments in place")
    if hidden.generators() != generators:
        named.refuse("it draws random numbers by itself")
    name = hidden.changed(before, hidden.kept(thing))
    if name is not None:
        named.refuse(f"it keeps state, `{name}` has changed in a call", POINTER)
    if not _alike(results[0], results[2]):
        named.refuse("it gives other values the second time, so it keeps state", POINTER)
    return results[0], results[1]


def _vector(found: Any, count: int, size: str = "B") -> Tensor:
    """The result, if it is a float tensor (count,), whose size the line names."""
    if not isinstance(found, Tensor):
        raise Wrong(f"it returns {_kind(found)}")
    if found.shape != (count,):
        raise Wrong(f"it returns {_described(found)} where {size} is {count}")
    if found.dtype not in (torch.float32, torch.float64):
        raise Wrong(f"it returns {_described(found)}; .float() makes it float32")
    return found


def _judge_p(named: Named, few: Tensor, many: Tensor) -> None:
    """Refuse p of a few states and of more, which begin with these, where it cannot be right."""
    _judge(named, "p", many)
    apart = (few - many[:, :BATCH]).abs().amax()
    if apart > 0.001 * many.abs().amax():  # rounding differs with the number of states
        named.refuse("p of a state depends on the other states")


def _judge(named: Named, what: str, values: Tensor) -> None:
    """Refuse values that no priority can be."""
    if values.isnan().any():
        named.refuse(f"{what} is not a number (NaN)")
    if (values < 0).any():
        named.refuse(f"{what} is negative ({values.min().item():.3g})")


def _shapes(tree: Any, name: str = "own") -> list[str]:
    """The form of a state: the place, type and shape of each tensor."""
    if isinstance(tree, Tensor):
        return [f"{name} {_described(tree)}"]
    if isinstance(tree, dict):
        parts = [(f"[{key!r}]", part) for key, part in tree.items()]
    elif isinstance(tree, tuple | list):
        parts = [(f"[{place}]", part) for place, part in enumerate(tree)]
    else:
        raise Wrong(f"{name} is {_kind(tree)}, where a state is a tree of tensors")
    return [line for place, part in parts for line in _shapes(part, name + place)]


def _alike(one: Any, other: Any) -> bool:
    """Whether two trees of tensors hold the same values, apart from rounding."""
    pairs = zip(tree_leaves(one), tree_leaves(other), strict=True)
    return all(
        x.equal(y) or torch.allclose(x.double(), y.double(), rtol=1e-5, atol=1e-7, equal_nan=True)
        for x, y in pairs
    )


def _described(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {tuple(tensor.shape)}"


def _kind(value: Any) -> str:
    return "None" if value is None else f"a {type(value).__name__} and no tensor"


def _meaning(error: BaseException) -> str:
    text = one_line(str(error))
    for part, meaning in MEANINGS.items():
        if part in text:
            return meaning
    if isinstance(error, AttributeError) and isinstance(error.obj, Facts | UnrollPath):
        return f"there is no {error.name}; there are {', '.join(error.obj._fields)}"
    return f"{type(error).__name__}: {text}"


def _place(error: BaseException) -> str:
    """Where in the user's files the error was raised; empty where it was not in them."""
    ours, pythons = Path(__file__).parents[1], Path(sysconfig.get_paths()["stdlib"])
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        file = Path(frame.filename)
        foreign = hidden.INSTALLED & set(file.parts) or file.is_relative_to(pythons)
        if file.is_file() and not foreign and not file.is_relative_to(ours):
            return f" ({file.name}, line {frame.lineno})"
    return ""
