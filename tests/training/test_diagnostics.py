"""What a run tells of itself, against loops."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import train
from aser import build
from aser.agents.sac import Info
from aser.noise import Stream, at_step, lane_keys, uniform_double
from aser.scores import roc_auc
from aser.training import diagnostics
from aser.training.learning import Update


@given(st.lists(st.tuples(st.integers(0, 6), st.booleans()), max_size=30))
def test_roc_auc_is_the_share_of_pairs_in_the_right_order(points):
    score = np.array([value for value, _ in points], np.float32)
    positive = np.array([label for _, label in points], np.float32)
    pairs = [(a, b) for a in score[positive == 1] for b in score[positive == 0]]
    found = roc_auc(score, positive)
    if pairs:
        assert found == pytest.approx(
            np.mean([1.0 if a > b else 0.5 if a == b else 0.0 for a, b in pairs])
        )
    else:
        assert np.isnan(found)


def test_roc_auc_is_mann_whitneys_u_over_the_pairs_and_by_hand():
    rng = np.random.default_rng(3)
    score, positive = rng.integers(0, 40, 70) / 40, rng.random(70) < 0.3
    u = stats.mannwhitneyu(score[positive], score[~positive]).statistic
    pairs = positive.sum() * (~positive).sum()
    assert roc_auc(score, positive) == pytest.approx(u / pairs, abs=1e-12)
    score = np.array([1.0, 2.0, 3.0])
    assert roc_auc(score, [0, 0, 1]) == 1.0 and roc_auc(score, [1, 0, 0]) == 0.0
    assert roc_auc(np.ones(3), [1, 0, 0]) == 0.5


def test_roc_auc_of_what_is_no_number_is_none():
    assert np.isnan(roc_auc(np.array([0.2, np.nan, 0.4]), np.array([0, 1, 1])))
    assert roc_auc(np.array([0.2, 0.3, np.inf]), np.array([0, 1, 1])) == 1.0


def training(*overrides, steps=60):
    own = [
        "compile=false",
        "seeds=[3,8]",
        "batch=7",
        "env=maze",
        "env.layout=toy",
        "learning_starts=20",
    ]
    config = train.settings([*own, f"steps={steps}", "eval.every=null", *overrides])
    run = build.build(config, train.CONF, train.CONF.parent / "results")
    run.run()
    return run


@pytest.mark.parametrize(
    ("sampler", "extra"),
    [
        ("aser", "buffer=41"),
        ("uniform", "buffer=60"),
        ("rank", "buffer=60"),
        ("recent", "buffer=41"),
    ],
)
def test_what_is_told_of_an_update(sampler, extra):
    buffer = (run := training(f"sampler={sampler}", extra)).setup.buffer
    lanes, batch, size = 2, 5, buffer.storage.size
    draw = np.random.default_rng(3)
    q, target = draw.normal(size=(lanes, 2, batch)), draw.normal(size=(lanes, batch))
    n, index = draw.integers(1, 9, (lanes, batch)), draw.integers(0, size, (lanes, batch))
    numbers = {
        name: draw.normal(size=lanes)
        for name in ("critic_loss", "actor_loss", "temperature", "entropy")
    }
    b = draw.normal(size=lanes)
    info = Info(torch.tensor(q), torch.tensor(target), *(torch.tensor(v) for v in numbers.values()))
    clock = buffer.storage.clock(60, 60)
    update = Update(None, None, info, torch.tensor(n), torch.tensor(b), None, (), ())
    found = diagnostics.of_update(update, torch.tensor(index), buffer, clock, run.hyper)
    newest = 59 % buffer.storage.capacity
    for lane in range(lanes):
        errors = [abs(target[lane, i] - min(q[lane, 0, i], q[lane, 1, i])) for i in range(batch)]
        ages = [
            newest - i if i <= newest else newest - i + buffer.storage.capacity for i in index[lane]
        ]
        expected = {name: values[lane] for name, values in numbers.items()} | {
            "td_error": np.mean(errors),
            "unroll_mean": np.mean(n[lane]),
            "unroll_max": max(n[lane]),
            "age_mean": np.mean(ages),
            "never_drawn": np.mean(
                [count == 0 for count in buffer.storage.draw_count[lane, :size]]
            ),
            "threshold": b[lane],
        }
        mass = np.ones(size)
        if sampler == "aser":
            mass = buffer.priorities.mass[lane, :size].numpy()
        elif sampler == "rank":
            mass = np.arange(1, size + 1.0) ** -float(run.hyper["alpha"][lane])
        elif sampler == "recent":
            mass = 0.999 ** np.arange(size)  # by age
        p = mass / mass.sum()
        expected["effective_sample_size"] = 1 / (p**2).sum() / size
        expected["draw_entropy"] = -sum(p * np.log(p)) / np.log(size)
        assert {name: values[lane] for name, values in found.items()} == pytest.approx(
            expected, rel=1e-6
        )
        assert 0 < expected["never_drawn"] < 1
    assert all(values.dtype == np.float64 and values.shape == (lanes,) for values in found.values())
    assert run.step == 60


def looked_at(run, clock):
    """The states (L, K, O) that the diagnostics look at."""
    rows = run.setup.buffer.storage.rows
    chosen = []
    for lane, keys in enumerate(lane_keys(run.setup.seeds)):
        u = uniform_double(at_step(keys[Stream.PROBE], clock.step), (diagnostics.PROBED,))
        chosen.append(rows[lane, (u * clock.size).long(), :4])
    return torch.stack(chosen)


def test_the_criterions_auc_is_that_of_its_values_at_states_of_the_buffer():
    run = training(
        "sampler=aser_q", "bootstrap.criterion.name=mode_prob", "bootstrap.criterion.squashed=false"
    )
    clock = run.setup.buffer.storage.clock(run.step, 60)
    found = run._roc_auc(run.state, run.setup.buffer, clock)
    states = looked_at(run, clock)
    for lane in range(2):
        actor = [(layer.weight[lane], layer.bias[lane]) for layer in run.state.agent.actor]
        hidden = torch.relu(states[lane] @ actor[0][0].T + actor[0][1])
        _, log_std = (hidden @ actor[1][0].T + actor[1][1]).chunk(2, 1)
        density = torch.distributions.Normal(0.0, log_std.exp()).log_prob(torch.zeros(())).sum(1)
        decision = run.setup.envs.oracle(states[lane].numpy())
        assert found[lane] == pytest.approx(roc_auc(density.numpy(), decision), abs=1e-3)
    assert found[0] != found[1] and ((found > 0) & (found < 1)).all()


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["sampler=oracle"], 1.0),
        (["sampler=oracle_no_bootstrap"], 1.0),
        (["sampler=uniform"], np.nan),
        (["sampler=per"], np.nan),
        (["sampler=aser", "bootstrap.criterion.name=oracle"], 1.0),  # the threshold's comes first
        (["sampler=oracle", "bootstrap.criterion.name=td_error"], np.nan),
    ],
)
def test_which_criterion_is_judged(overrides, expected):
    run = training(*overrides, steps=25)
    clock = run.setup.buffer.storage.clock(run.step, 60)
    np.testing.assert_array_equal(run._roc_auc(run.state, run.setup.buffer, clock), [expected] * 2)


def test_without_an_oracle_there_is_nothing_to_judge_by():
    auc = diagnostics.criterion_auc(training("sampler=aser").setup.buffer.sampler, None)
    assert np.isnan(auc(None, SimpleNamespace(keys=torch.zeros(3, 2)), None)).tolist() == [True] * 3
