"""Lanes: many runs in one program, none of which can tell that the others are there."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml

import train
from aser import build, checkpoint, lanes, noise, trees
from aser import compiled as compiling
from aser.noise import Stream
from aser.trees import tree_leaves

SAMPLERS = sorted(path.stem for path in (train.CONF / "sampler").glob("*.yaml"))
FEW = ("aser", "per", "laber", "la3p", "outcome_spread", "nstep_geometric")
EACH = [s if s in FEW else pytest.param(s, marks=pytest.mark.slow) for s in SAMPLERS]
STARTS = 20  # learning starts: the first update is at step 21
TOY = ["env.layout=toy", "batch=17", "steps=200", f"learning_starts={STARTS}", "eval.every=null"]
needs_compiler = pytest.mark.skipif(
    compiling.why_not_compiled() is not None, reason="no C++ compiler or no Python.h"
)


def built(config):
    return build.build(config, train.CONF, train.CONF.parent / "results")


def a_training(seeds, sampler, *settings, compile=False):
    overrides = [*TOY, f"sampler={sampler}", f"seeds={seeds}", f"compile={compile}", *settings]
    return built(train.settings(overrides))


def advance(training, steps):
    with torch.no_grad():
        for _ in range(steps):
            training.advance()
    return training


def everything(training):
    """All that a training's future depends on, and its last update; every leaf (L, ...)."""
    buffer = training.setup.buffer
    update = training._update
    found = {
        "state": training.state,
        "rows": buffer.storage.rows,
        "draw_count": buffer.storage.draw_count,
        "unroll_sum": buffer.storage.unroll_sum,
        "warm_up": buffer.warm_up,
        "masses": [] if buffer.priorities is None else buffer.priorities.mass,
        "actions": training._actions,
        "update": (update.info, update.n, update.b, training._drawn),
        "environment": {
            k: torch.from_numpy(v) for k, v in training.setup.envs.state_dict().items()
        },
    }
    return {name: [leaf.clone() for leaf in tree_leaves(tree)] for name, tree in found.items()}


def assert_equal(one, two, of_one, of_two):
    """Lanes `of_one` of one training are lanes `of_two` of another, to the bit."""
    for name in one:
        for x, y in zip(one[name], two[name], strict=True):
            assert torch.equal(x[of_one].nan_to_num(1e9), y[of_two].nan_to_num(1e9)), name


@pytest.fixture(scope="module")
def frozen(tmp_path_factory):
    """A run folder with two agents, for the sampler `pretrained`."""
    folder = tmp_path_factory.mktemp("frozen")
    config = train.settings([*TOY, "sampler=uniform", "seeds=[30,31]", "compile=false"])
    run = built(config)
    (folder / "config.yaml").write_text(yaml.safe_dump(config.to_dict()))
    content = {"agent": checkpoint.leaves(run.state.agent), "sizes": run.sizes}
    checkpoint.save(folder / checkpoint.NAME, content)
    return f"criterion.checkpoint={folder}"


def extra(sampler, frozen):
    return [frozen] if sampler == "pretrained" else []


# Among how many does not matter.


def vary_hyper_parameters(training):
    """Each lane gets values of its own, the same wherever the lane is k-th."""
    for name, values in training.hyper.items():
        lane = torch.arange(len(values))
        values.copy_((values - lane).clamp(min=2) if name == "h" else values * (1.0 - 0.1 * lane))


@pytest.mark.parametrize("sampler", EACH)
def test_a_lane_among_three_is_that_lane_among_five(sampler, frozen):
    # A batch of 16 fills whole vectors, so that one state has one p wherever it stands: else a
    # state that ties with the
    # threshold, which is a quantile of these p, may fall on either side of it.
    settings = ["batch=16", *extra(sampler, frozen)]
    three, five = (a_training(seeds, sampler, *settings) for seeds in ([4, 0, 9], [4, 0, 9, 2, 7]))
    for training in (three, five):
        vary_hyper_parameters(training)
        advance(training, STARTS + 1)
    few, many = everything(three), everything(five)
    for name in few:
        for x, y in zip(few[name], many[name], strict=True):
            assert len(x) == 3 and len(y) == 5
            torch.testing.assert_close(x, y[:3], rtol=1e-4, atol=1e-6, equal_nan=True)
    gradient_steps = 2.0 if sampler == "la3p" else 1.0  # in one update
    assert three.state.agent.updates.tolist() == [gradient_steps] * 3
    weight = three.state.agent.actor[0].weight
    assert not torch.allclose(weight[0], weight[1]) and not torch.allclose(weight[1], weight[2])


def test_numbers_do_not_depend_on_the_other_lanes_nor_on_the_sampler():
    """To the bit: a lane alone, among others, and under another sampler (common random numbers)."""
    among, alone, per = (
        a_training(*of) for of in (([4, 0, 9], "aser"), ([0], "aser"), ([3, 0], "per"))
    )
    assert torch.equal(among._actions[1], alone._actions[0])
    assert torch.equal(among._actions[1], per._actions[1])
    for x, y, z in zip(*(tree_leaves(t.state) for t in (among, alone, per)), strict=True):
        assert torch.equal(x[1], y[0]) and torch.equal(x[1], z[1])
    for step in (20, 21, 47, 5000):
        mine, his, other = among._numbers(step), alone._numbers(step), per._numbers(step)
        assert set(other) < set(mine) == set(his)
        assert all(torch.equal(mine[stream][1], his[stream][0]) for stream in mine)
        assert all(torch.equal(mine[stream][1], other[stream][1]) for stream in other)


def test_numbers_are_those_of_the_step():
    """Whatever the block that they are made in, and in whatever order they are asked for."""
    training = a_training([4, 9], "uniform")
    for step in (21, 22, 40, 21):
        found = training._numbers(step)
        keys = noise.at_step(noise.lane_keys([4, 9]), torch.tensor(step, dtype=torch.int32))
        for lane in range(2):
            assert torch.equal(
                found[Stream.TARGET][lane], noise.normal(keys[lane, Stream.TARGET], (2, 17))
            )
            assert torch.equal(
                found[Stream.DRAW][lane], noise.uniform_double(keys[lane, Stream.DRAW], (17,))
            )


def test_two_seeds_differ_in_everything():
    """In init, warm-up actions, draws, and the noise of update and action."""
    training = a_training([3, 7], "uniform")
    for layers in (training.state.agent.actor, training.state.agent.critics):
        for leaf in tree_leaves(layers):
            assert (leaf[0] != leaf[1]).all()
    warm_up = training._actions
    assert warm_up.shape == (2, STARTS, 2) and (warm_up[0] != warm_up[1]).all()
    assert (
        warm_up.abs().max() < 1
        and (warm_up.amin((1, 2)) < -0.8).all()
        and (warm_up.amax((1, 2)) > 0.8).all()
    )
    for values in training._numbers(STARTS + 1).values():
        assert (values[0] != values[1]).all()
    advance(training, STARTS + 1)
    index = training._drawn
    assert (index[0] == index[1]).double().mean() < 0.5 and (
        training._actions[0] != training._actions[1]
    ).all()


# A lane that goes wrong harms nobody.


class Exploding:
    """An environment whose lane 1 gives a reward of 1e30 from step `first` on, later NaN."""

    def __init__(self, envs, first):
        self._envs, self._first, self._count = envs, first, 0

    def __getattr__(self, name):
        return getattr(self._envs, name)

    def step(self, action):
        self._count += 1
        obs, reward, *rest = self._envs.step(action)
        if self._count >= self._first:
            reward = np.array(reward, np.float64)
            reward[1] = 1e30 if self._count < self._first + 4 else np.nan
        return obs, reward, *rest


def explode(training, first):
    envs = Exploding(training.setup.envs, first)
    training.setup = replace(training.setup, envs=envs)
    return training


def assert_harmless(sound, harmed):
    assert_equal(sound, harmed, [0, 2], [0, 2])
    assert not all(leaf[1].isfinite().all() for leaf in harmed["state"]), (
        "lane 1 did not diverge: this shows nothing"
    )


@pytest.mark.parametrize("sampler", EACH)
def test_an_exploding_lane_changes_nothing_in_its_neighbours(sampler, frozen):
    sound, harmed = (a_training([0, 1, 2], sampler, *extra(sampler, frozen)) for _ in range(2))
    explode(harmed, STARTS - 2)
    assert_harmless(*(everything(advance(training, STARTS + 10)) for training in (sound, harmed)))


# Compiled. One program serves all these: its graphs are made once a process.


COMPILED = ["eval.every=7", "buffer=40"]  # the ring is full after 40 steps


@pytest.fixture(scope="module")
def compiled():
    """A compiled run of three lanes over 50 updates, with how many graphs had been made after each
    step, and what each compiled function was called with.
    """
    graphs, made, calls = [], [], {}

    def compile(*args, original=torch._inductor.compile, **options):
        made.append(args)
        return original(*args, **options)

    def call(self, *args, original=compiling.Compiled.__call__):
        of = [(leaf.shape, leaf.stride(), leaf.dtype, leaf.device) for leaf in tree_leaves(args)]
        calls.setdefault(id(self), []).append(of)
        return original(self, *args)

    def count(training):
        graphs.append(len(made))
        return training.step == STARTS + 50

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch._inductor, "compile", compile)
        patch.setattr(compiling.Compiled, "__call__", call)
        training = a_training([0, 1, 2], "aser", *COMPILED, compile=True)
        assert not training.run(after_step=count)
    found = everything(training), training.history.returns, graphs, list(calls.values())
    return SimpleNamespace(
        **dict(zip(("everything", "returns", "graphs", "calls"), found, strict=True))
    )


@needs_compiler
@pytest.mark.xdist_group("compiled")
def test_a_run_compiles_a_fixed_number_of_graphs(compiled):
    """The greedy policy (at the first evaluation), the random numbers, the update; and nothing ever
    again, though episodes end, the ring fills and wraps, and blocks of numbers run out.
    """
    first_update = STARTS + 1
    assert compiled.graphs[7 - 2] == 0 and compiled.graphs[7 - 1] == 1
    assert compiled.graphs[first_update - 1 :] == [3] * 50


@needs_compiler
@pytest.mark.xdist_group("compiled")
def test_a_graph_is_only_called_with_what_it_was_made_for(compiled):
    """Nothing guards a graph, so shapes, strides and types must be those of the first call for
    ever.
    """
    # Blocks of numbers, updates; evaluations.
    assert sorted(len(calls) for calls in compiled.calls)[:2] == [
        4,
        50,
    ]
    for calls in compiled.calls:
        assert all(of == calls[0] for of in calls)


@needs_compiler
@pytest.mark.xdist_group("compiled")
def test_permuting_lanes_permutes_the_results_to_the_bit(compiled):
    order = [2, 0, 1]
    permuted = a_training(order, "aser", *COMPILED, compile=True)
    permuted.run(after_step=lambda training: training.step == STARTS + 50)
    assert_equal(compiled.everything, everything(permuted), order, [0, 1, 2])
    for (step, returns), (other_step, others) in zip(
        compiled.returns, permuted.history.returns, strict=True
    ):
        assert step == other_step and returns[order].tolist() == others.tolist()
    assert compiled.everything["state"][-1].tolist() == [50.0] * 3


@needs_compiler
@pytest.mark.xdist_group("compiled")
def test_an_exploding_lane_changes_nothing_in_its_neighbours_compiled(compiled):
    harmed = explode(a_training([0, 1, 2], "aser", *COMPILED, compile=True), STARTS + 15)
    harmed.run(after_step=lambda training: training.step == STARTS + 50)
    assert_harmless(compiled.everything, everything(harmed))
    assert list(harmed.history.diverged) == [1]


@needs_compiler
@pytest.mark.xdist_group("compiled")
def test_the_compiled_update_is_the_eager_one(compiled):
    """To float tolerance, over the first update; at a batch without a rest, since a criterion that
    ties with the threshold (the same state drawn twice) may be on either side of it by the last bit
    of a scalar tail.
    """
    runs = [
        a_training([0, 1, 2], "aser", *COMPILED, "batch=16", compile=on) for on in (True, False)
    ]
    fast, slow = (everything(advance(training, STARTS + 1)) for training in runs)
    for name in fast:
        for x, y in zip(fast[name], slow[name], strict=True):
            torch.testing.assert_close(x, y, rtol=1e-4, atol=1e-6, equal_nan=True)


@needs_compiler
def test_a_compiled_function_follows_every_argument():
    """Whatever of its arguments changes, and in whatever tree they come."""

    def function(one, two):
        return {"sum": one[0] + two["b"], "product": (one[1] * two["b"], one[0])}

    fast = compiling.compiled(function)
    for k in range(3):
        args = ([torch.full((3,), float(k)), torch.tensor(k + 1)], {"b": torch.arange(3.0) + k})
        mine, expected = fast(*args), function(*args)
        assert str(mine) == str(expected)


# The helpers.


def test_take_picks_lanes():
    many = {"a": torch.arange(12.0).reshape(4, 3), "b": [torch.arange(4)]}
    assert trees.take(many, 2)["a"].tolist() == [6.0, 7.0, 8.0]
    assert trees.take(many, [3, 0])["b"][0].tolist() == [3, 0]


def test_batched_shares_what_it_is_told_to_share():
    found = lanes.batched(lambda x, y: x * y, (0, None))(
        torch.tensor([1.0, 2.0, 3.0]), torch.tensor([4.0, 5.0])
    )
    assert found.tolist() == [[4.0, 5.0], [8.0, 10.0], [12.0, 15.0]]


def test_contiguous_gives_each_leaf_a_memory_of_its_own():
    shared = torch.zeros(1).expand(3, 2)
    one, two = trees.contiguous([shared, shared])
    one[0, 0] = 1.0
    assert one.sum() == 1.0 and two.sum() == 0.0


def test_what_cannot_be_compiled_is_not():
    function = len
    assert compiling.compiled(function, on=False) is function


def test_a_run_without_a_compiler_says_so_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr(build, "why_not_compiled", lambda: "no C++ compiler")
    assert not build.should_compile(train.settings(["compile=auto"]))
    said = capsys.readouterr().out
    assert said.count("\n") == 1 and "no C++ compiler" in said
    with pytest.raises(
        ValueError, match="^compile=true: no C\\+\\+ compiler here; allowed: compile=auto or false$"
    ):
        build.should_compile(train.settings(["compile=true"]))
    assert (
        not build.should_compile(train.settings(["compile=false"]))
        and capsys.readouterr().out == ""
    )
