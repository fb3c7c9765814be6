"""Criteria against torch.distributions, Monte Carlo, loops, and functions whose answer is known."""

import importlib
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy import stats
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

import train
from aser import build, envs, noise
from aser.agents import sac
from aser.agents.networks import Gaussian, policy, q_values
from aser.compiled import compiled, why_not_compiled
from aser.errors import ConfigError
from aser.lanes import batched
from aser.replay import criteria, kinds
from aser.replay.storage import Clock, Layout, Memory
from aser.scores import roc_auc
from aser.training import frozen
from aser.training.diagnostics import criterion_auc
from aser.training.frozen import Agents
from aser.trees import take

OBS, B = 5, 7
CONF = Path(__file__).resolve().parents[2] / "conf"


def agent(action_dim=2, seed=0):
    return sac.init(noise.lane_keys([seed])[0, noise.Stream.INIT], OBS, action_dim, [24])


def observations(seed=0, count=B):
    return torch.randn(OBS, count, generator=torch.Generator().manual_seed(seed))


def gaussians(action_dim, wide=1.0):
    g = torch.Generator().manual_seed(action_dim)
    return Gaussian(
        wide * torch.randn(action_dim, B, generator=g), torch.randn(action_dim, B, generator=g)
    )


def evaluate(name, state, obs, gaussian=None, **kwargs):
    gaussian = policy(state.actor, obs) if gaussian is None else gaussian
    lane = kinds.Lane(sac, Layout(OBS, 2), state, {}, None)
    return kinds.make(name, **kwargs).p(lane, obs, gaussian)


@pytest.mark.parametrize("action_dim", [1, 2, 3])
def test_mode_log_prob_and_mode_prob_are_those_of_torchs_distributions(action_dim):
    gaussian = gaussians(action_dim)
    normal = Normal(gaussian.mean.T.double(), gaussian.log_std.T.double().exp())  # (B, A)
    squashed = Independent(TransformedDistribution(normal, TanhTransform()), 1)
    plain = Independent(normal, 1)
    for kwargs, density in [
        ({}, squashed.log_prob(torch.tanh(normal.mean))),
        ({"squashed": True}, squashed.log_prob(torch.tanh(normal.mean))),
        ({"squashed": False}, plain.log_prob(normal.mean)),
    ]:
        found = evaluate("mode_log_prob", None, None, gaussian, **kwargs)
        torch.testing.assert_close(found.double(), torch.log1p(density.exp()), rtol=1e-4, atol=1e-5)
        found = evaluate("mode_prob", None, None, gaussian, **kwargs)
        torch.testing.assert_close(found.double(), density.exp(), rtol=1e-4, atol=1e-6)


def test_mode_log_prob_of_a_saturated_policy_is_finite_and_right():
    mean, log_std = [30.0, -30.0, 0.0], [-20.0, 2.0, -20.0]
    found = evaluate(
        "mode_log_prob", None, None, Gaussian(torch.tensor([mean]), torch.tensor([log_std]))
    )
    # 1 - tanh(u)^2 = 4 exp(-2|u|) for large |u|, so log pi = -log std - log(2 pi) / 2 - log 4 + 2 |u|
    constant = -0.5 * math.log(2 * math.pi)
    logs = [20 + constant - math.log(4) + 60, -2 + constant - math.log(4) + 60, 20 + constant]
    assert found.tolist() == pytest.approx(logs, rel=1e-5)  # softplus(x) = x there


@pytest.mark.parametrize(
    ("sigma", "allowed"), [(0.05, 0.01), (0.5, 0.01), (1, 0.01), (2, 0.01), (7.4, 0.3)]
)
def test_entropy_is_the_monte_carlo_estimate(sigma, allowed):
    rng = np.random.default_rng(1)
    means = [-2.0, -0.7, 0.0, 1.1, 2.0]
    epsilon = rng.standard_normal(1_000_000)
    exact = []
    for mean in means:
        u = mean + sigma * epsilon
        log_prob = stats.norm.logpdf(epsilon) - math.log(sigma)
        log_slope = 2 * (
            math.log(2) - np.abs(u) - np.log1p(np.exp(-2 * np.abs(u)))
        )  # log(1 - tanh(u)^2)
        exact.append(-(log_prob - log_slope).mean())
    one = Gaussian(torch.tensor([means]), torch.full((1, len(means)), math.log(sigma)))
    found = criteria.squashed_entropy(one)
    assert found.tolist() == pytest.approx(exact, abs=allowed)
    p = evaluate("entropy", None, None, one)
    assert p.tolist() == pytest.approx(np.log1p(np.exp(-found.numpy())), rel=1e-5)
    # Dimensions are independent, so their entropies add up.
    two = Gaussian(torch.cat([one.mean, one.mean.flip(1)]), one.log_std.repeat(2, 1))
    torch.testing.assert_close(
        criteria.squashed_entropy(two), found + found.flip(0), rtol=0, atol=1e-4
    )


@pytest.mark.parametrize("action_dim", [1, 2, 3])
def test_curvature_of_a_quadratic_is_the_norm_of_its_hessian(action_dim, monkeypatch):
    g = torch.Generator().manual_seed(3)
    root = torch.randn(B, action_dim, action_dim, generator=g).double()
    hessian = root + root.mT  # another one in every state
    slope = torch.randn(B, action_dim, generator=g).double()
    asked = []

    def quadratic(critics, obs, actions):
        asked.append(actions)
        assert critics == "the critics" and actions.shape[::2] == (action_dim, B)
        square = torch.einsum("akb,bac,ckb->kb", actions, hessian, actions)
        return 0.5 * square + torch.einsum("ba,akb->kb", slope, actions) + obs[0]

    monkeypatch.setattr(criteria, "q_grid", quadratic)
    gaussian = Gaussian(*(x.double() for x in gaussians(action_dim, wide=4.0)))
    assert gaussian.mean.tanh().abs().max() > 0.95
    found = evaluate(
        "curvature", SimpleNamespace(critics="the critics"), observations().double(), gaussian
    )
    assert found.tolist() == pytest.approx(torch.linalg.matrix_norm(hessian).tolist(), rel=1e-6)
    assert asked[0].abs().max() <= 1.0 + 1e-6  # no action outside the box


def test_curvature_is_taken_at_the_greedy_action_within_the_border(monkeypatch):
    # The second differences of sum a_i^3 / 6 are exact: the diagonal matrix of a.
    monkeypatch.setattr(criteria, "q_grid", lambda critics, obs, actions: (actions**3 / 6).sum(0))
    mean = torch.tensor([[0.3, -0.2, 5.0, 0.0], [0.5, -9.0, 5.0, 0.0]], dtype=torch.float64)
    found = evaluate(
        "curvature", SimpleNamespace(critics=None), None, Gaussian(mean, torch.zeros_like(mean))
    )
    centre = mean.tanh().clamp(-0.9, 0.9)
    assert found.tolist() == pytest.approx(centre.norm(dim=0).tolist(), rel=1e-6, abs=1e-9)


def test_curvature_sees_a_relu_critic():
    state = agent()
    found = evaluate("curvature", state, observations(count=200))
    assert found.isfinite().all() and (found >= 0).all()
    assert (found > 1e-3).double().mean() > 0.5  # its exact Hessian is zero almost everywhere


@pytest.mark.parametrize("action_dim", [1, 2, 3])
def test_q_range_and_q_std_are_those_of_a_loop_over_the_actions(action_dim):
    state, obs = agent(action_dim), observations()
    actions = criteria.grid_actions(policy(state.actor, obs).mean)
    assert actions.shape == (action_dim, criteria.GRID_ACTIONS) and criteria.GRID_ACTIONS == 16
    q = []
    for action in actions.T:
        q.append(q_values(state.critics, obs, action[:, None].expand(-1, B)).min(0).values.tolist())
    assert evaluate("q_range", state, obs).tolist() == pytest.approx(
        np.ptp(q, axis=0), rel=1e-4, abs=1e-6
    )
    assert evaluate("q_std", state, obs).tolist() == pytest.approx(
        np.std(q, axis=0), rel=1e-4, abs=1e-6
    )


@pytest.mark.parametrize("action_dim", [1, 2, 6])
def test_the_grid_is_sobols_and_fills_the_box(action_dim):
    reference = stats.qmc.Sobol(action_dim, scramble=False).random(16)
    found = criteria.grid_actions(torch.zeros(action_dim, 3)).T
    np.testing.assert_allclose(found, 2 * reference - 1, atol=1e-6)
    assert len(found.unique(dim=0)) == 16
    for dimension in found.T:  # each sixteenth of each side holds one
        assert torch.floor((dimension + 1) * 8).unique().numel() == 16


@pytest.mark.skipif(why_not_compiled() is not None, reason="nothing can be compiled here")
@pytest.mark.parametrize("action_dim", [1, 2])
@pytest.mark.parametrize("name", [name for name in criteria.FUNCTIONS if name != "q_dropoff"])
def test_compiled_before_anything_else_it_is_the_same(name, action_dim, monkeypatch):
    """A trace is the first to ask for what a criterion keeps: it must not become a part of one graph alone."""
    criteria._sobol.cache_clear()
    state = batched(lambda key: sac.init(key, OBS, action_dim, [24]))(
        noise.lane_keys([3, 5, 8])[:, noise.Stream.INIT]
    )
    obs = torch.randn(3, OBS, B, generator=torch.Generator().manual_seed(1))

    def lane(state, obs):
        return criteria.function(name)(state, obs, policy(state.actor, obs))

    first = compiled(batched(lane), True)(state, obs)
    torch.testing.assert_close(first, batched(lane)(state, obs), rtol=1e-3, atol=1e-3)
    assert first.isfinite().all()


def test_uniform_is_one_everywhere():
    obs = observations()
    assert criteria.uniform(None, obs, None).tolist() == [1.0] * B
    assert kinds.make("uniform").p_next(None, None, obs, None).tolist() == [1.0] * B


@pytest.mark.parametrize("how", ["min", "mean", "max"])
def test_td_error_by_hand(how):
    q = torch.tensor([[1.0, 5.0, -2.0], [3.0, 2.0, -2.0]])
    target = torch.tensor([2.5, 4.0, -3.0])
    expected = {"min": [1.5, 2.0, 1.0], "mean": [1.0, 1.5, 1.0], "max": [1.5, 2.0, 1.0]}
    assert criteria.td_error(q, target, how).tolist() == expected[how]
    # where the smaller Q is nearer to the target, the two largest differ
    q, target = torch.tensor([[1.0], [4.0]]), torch.tensor([2.0])
    assert criteria.td_error(q, target, how).tolist() == [
        {"min": 1.0, "mean": 1.5, "max": 2.0}[how]
    ]


def test_what_is_known_when():
    kind = {name: type(kinds.make(name)) for name in [*criteria.FUNCTIONS, "td_error", "shuffled"]}
    assert kind.pop("uniform") is kinds.Constant
    assert kind.pop("td_error") is kinds.PerItem
    assert kind.pop("shuffled") is kinds.Shuffled
    assert set(kind.values()) == {kinds.Live} and len(kind) == 7


ROWS = Layout(2, 1, ("p_next", "td_error"))


def memory_of(p_next, td_error, truncated, newest):
    """One lane's memory of len(p_next) items, as far as criteria read it."""
    rows = torch.zeros(len(p_next), ROWS.width)
    facts = {"p_next": p_next, "td_error": td_error, "truncated": truncated}
    for name, values in facts.items():
        rows[:, ROWS.columns[name].start] = torch.tensor(values)
    size = torch.tensor(len(p_next))
    clock = Clock(torch.tensor(9), torch.tensor(newest), size, torch.tensor(0.5))
    return Memory(rows, torch.zeros(2, 3), torch.zeros(12, 2, dtype=torch.int32), clock)


def test_a_constant_criterion_needs_nothing():
    constant, obs = kinds.make("uniform"), torch.zeros(3, 2)
    assert constant.columns == () and not constant.rewrites
    assert constant.on_arrival(obs) is None and constant.new_columns(obs, None, ROWS) == {}
    assert constant.anywhere(sac, None, {}, None, obs) is None
    assert constant.knows_next(None, torch.tensor([4, 0])).tolist() == [True, True]


def test_a_frozen_criterion_is_known_on_arrival_and_kept():
    frozen = kinds.Frozen("sum", lambda obs: obs.sum(1))
    obs = torch.tensor([[1.0, 2.0], [3.0, 5.0], [0.5, 0.25]])  # (L, O)
    assert frozen.columns == ("p_next",) and not frozen.rewrites
    assert frozen.on_arrival(obs).tolist() == [3.0, 8.0, 0.75]
    assert frozen.new_columns(obs, None, ROWS)["p_next"].tolist() == [3.0, 8.0, 0.75]
    memory = memory_of([7.0, 8.0, 9.0, 6.0], [0.0] * 4, [0.0] * 4, newest=3)
    lane = kinds.Lane(sac, ROWS, None, {}, memory)
    index = torch.tensor([2, 0, 2])
    assert frozen.p_next(lane, index, None, None).tolist() == [9.0, 7.0, 9.0]
    assert frozen.knows_next(lane, index).all()
    assert frozen.anywhere(sac, None, {}, memory, obs[..., None]).tolist() == [[3.0], [8.0], [0.75]]


def test_the_td_error_is_known_of_items_that_start_at_a_state():
    per_item = kinds.make("td_error")
    assert per_item.columns == ("td_error",) and per_item.rewrites
    assert per_item.on_arrival(torch.zeros(3, 2)) is None
    errors = torch.tensor([[1.0, 4.0], [3.0, 2.0], [0.5, 0.0]])  # (L, N)
    rows = torch.zeros(3, 2, ROWS.width)
    rows[..., ROWS.columns["td_error"].start] = errors
    assert per_item.new_columns(None, rows, ROWS)["td_error"].tolist() == [4.0, 3.0, 0.5]
    assert per_item.drawn_columns(errors)["td_error"] is errors
    assert per_item.p_drawn(None, None, errors) is errors
    # The item after each, over the end of the ring; none after the newest, nor after a cut.
    memory = memory_of([0.0] * 4, [5.0, 6.0, 7.0, 8.0], [0.0, 1.0, 0.0, 0.0], newest=2)
    lane, index = kinds.Lane(sac, ROWS, None, {}, memory), torch.tensor([0, 1, 2, 3])
    assert per_item.p_next(lane, index, None, None).tolist() == [6.0, 7.0, 8.0, 5.0]
    assert per_item.knows_next(lane, index).tolist() == [True, False, False, True]
    assert per_item.anywhere(sac, None, {}, memory, torch.zeros(3, 2, 1)) is None


@pytest.mark.parametrize("of", ["mode_prob", "entropy", "curvature"])
def test_pretrained_is_what_it_is_of(of):
    keys = noise.lane_keys([3, 5, 8])[:, noise.Stream.INIT]
    states = batched(lambda key: sac.init(key, OBS, 2, [24]))(keys)
    agents = Agents(sac, sac.kept(states), {"obs": OBS, "action": 2})
    lane, obs = torch.tensor([2, 0, 4, 1, 2]), torch.randn(5, OBS, 7)
    pretrained = frozen.criterion("criterion", agents, lane, of, None, compile=False)
    found = pretrained.function(obs)  # (5, 7)
    for i, number in enumerate([2, 0, 1, 1, 2]):  # lane 4 of three agents is number 1
        alone = evaluate(of, take(sac.kept(states), number), obs[i])
        torch.testing.assert_close(found[i], alone, rtol=1e-3, atol=1e-4)


def test_pretrained_takes_the_density_that_is_asked_for():
    states = batched(lambda key: sac.init(key, OBS, 2, [24]))(
        noise.lane_keys([3])[:, noise.Stream.INIT]
    )
    agents, obs = Agents(sac, sac.kept(states), {}), torch.randn(1, OBS, 7)
    found = frozen.criterion("c", agents, torch.tensor([0]), "mode_log_prob", False, False)
    alone = evaluate("mode_log_prob", take(sac.kept(states), 0), obs[0], squashed=False)
    torch.testing.assert_close(found.function(obs)[0], alone)


def test_a_function_of_ones_own(tmp_path, monkeypatch):
    (tmp_path / "own_criteria.py").write_text(
        "def first(state, obs, gaussian):\n    return obs[0].abs()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    state, obs = agent(), observations()
    assert evaluate("own_criteria.first", state, obs).equal(obs[0].abs())
    assert type(kinds.make("own_criteria.first")) is kinds.Live
    assert evaluate("aser.replay.criteria.q_std", state, obs).equal(evaluate("q_std", state, obs))


@pytest.mark.parametrize(
    "name",
    [
        "entropi",
        "math.entropi",
        "no_such_module.entropy",
        ".entropy",
        "..x.y",
        "entropy.",
        "math.pi",
    ],
)
def test_a_wrong_name_is_one_line(name):
    with pytest.raises(ConfigError, match="mode_log_prob") as caught:
        kinds.make(name)
    assert f"criterion={name}:" in str(caught.value) and "\n" not in str(caught.value)


L, WARM = 3, 11


def shuffled_lanes(obs, of="mode_log_prob"):
    """In three lanes: p (L, B) of `shuffled`, and the criterion itself at the warm-up states (L, S)."""
    keys = noise.lane_keys([4, 5, 6])
    states = batched(lambda key: sac.init(key, OBS, 2, [24]))(keys[:, noise.Stream.INIT])
    warm_up = torch.randn(L, OBS, WARM, generator=torch.Generator().manual_seed(2))
    shuffled, criterion = kinds.make("shuffled", of), kinds.make(of)

    def one(state, keys, warm_up):
        lane = kinds.Lane(sac, Layout(OBS, 2), state, {}, Memory(None, warm_up, keys, None))
        found = shuffled.p(lane, obs, policy(state.actor, obs))
        return found, criterion.p(lane, warm_up, policy(state.actor, warm_up))

    return batched(one)(states, keys, warm_up)


@pytest.mark.parametrize("of", ["mode_log_prob", "q_range"])
def test_shuffled_takes_the_value_of_one_warm_up_state(of):
    found, own = shuffled_lanes(observations(count=2000), of)
    distance = (found[:, :, None] - own[:, None, :]).abs()  # (L, B, S)
    chosen = distance.argmin(2)
    assert distance.amin(2).max() < 1e-5
    for lane in chosen.numpy():  # every warm-up state stands for its share
        assert stats.chisquare(np.bincount(lane, minlength=WARM)).pvalue > 1e-5
    for one, other in [(0, 1), (0, 2), (1, 2)]:  # no two lanes agree more than by chance
        assert (chosen[one] == chosen[other]).double().mean() < 2 / WARM


def test_shuffled_is_fixed_for_a_state():
    obs = observations(count=2 * B)
    whole, _ = shuffled_lanes(obs)
    part, _ = shuffled_lanes(obs[:, B:].flip(1))
    torch.testing.assert_close(part, whole[:, B:].flip(1), rtol=1e-5, atol=1e-6)
    minus_zero = obs.clone()
    obs[2], minus_zero[2] = 0.0, -0.0
    torch.testing.assert_close(shuffled_lanes(obs)[0], shuffled_lanes(minus_zero)[0])


@pytest.fixture(scope="module")
def trained():
    """ASER with `shuffled`, 16 lanes in the toy maze, whose states are all seen soon."""
    overrides = ["env=maze", "env.layout=toy", "sampler=aser_shuffled", "hyper=thesis"]
    config = train.settings(
        [*overrides, "seeds=16", "steps=300", "batch=64", "compile=false", "eval.every=null"]
    )
    training = build.build(config, CONF, CONF.parent / "results")
    training.run()
    return training


def test_shuffled_does_not_know_the_decision_points_of_the_large_maze():
    states = envs.make("aser/Maze-v0", 1).states
    obs = torch.from_numpy(states.observation).T  # (4, states)
    keys = noise.lane_keys(range(64))
    warm_up = torch.stack(
        [
            obs[:, torch.from_numpy(np.random.default_rng(i).integers(0, len(states), 100))]
            for i in range(64)
        ]
    )
    shuffled, agents = kinds.make("shuffled"), batched(lambda key: sac.init(key, 4, 2, [24]))

    def one(state, keys, warm_up):
        lane = kinds.Lane(sac, Layout(4, 2), state, {}, Memory(None, warm_up, keys, None))
        return shuffled.p(lane, obs, policy(state.actor, obs))

    p = batched(one)(agents(keys[:, noise.Stream.INIT]), keys, warm_up)
    aucs = [roc_auc(lane, states.decision) for lane in p.numpy()]
    assert np.mean(aucs) == pytest.approx(0.5, abs=0.025) and 0.02 < np.std(aucs) < 0.1


def test_shuffled_does_not_know_the_decision_points_in_training(trained):
    buffer, clock = trained.setup.buffer, trained._clock
    aucs = criterion_auc(buffer.sampler, trained.setup.envs.oracle)(trained.state, buffer, clock)
    assert aucs.shape == (16,) and len(set(aucs)) == 16
    assert abs(aucs.mean() - 0.5) < 0.05
    assert aucs.std() > 0.01  # it is uneven by chance in each lane
    # ... while the same measure is 1 for a criterion that knows.
    oracle = trained.setup.envs.oracle

    def knowing(obs):
        return torch.from_numpy(oracle(obs.mT.numpy()))

    sampler = replace(buffer.sampler, stopping=kinds.Frozen("oracle", knowing))
    aucs = criterion_auc(sampler, oracle)(trained.state, buffer, clock)
    assert aucs.tolist() == [1.0] * 16


def test_shuffled_in_training_takes_warm_up_states(trained):
    buffer = trained.setup.buffer
    warm_up = buffer.warm_up
    assert warm_up.shape == (16, 4, 100)
    assert warm_up.equal(
        buffer.sampler.layout.read_vector(buffer.storage.rows[:, :100], "obs").movedim(0, 1)
    )
    for criterion in ("uniform", "td_error"):
        sampler = replace(buffer.sampler, stopping=kinds.make(criterion))
        auc = criterion_auc(sampler, trained.setup.envs.oracle)
        found = auc(trained.state, buffer, trained._clock)
        assert np.isnan(found).all()


@pytest.mark.parametrize("values", [3, 40, 10_000])
def test_roc_auc_is_the_share_of_ordered_pairs(values):
    rng = np.random.default_rng(values)
    score, positive = rng.integers(0, values, 70) / values, rng.random(70) < 0.3
    pairs = [(a > b) + 0.5 * (a == b) for a in score[positive] for b in score[~positive]]
    assert roc_auc(score, positive) == pytest.approx(np.mean(pairs), abs=1e-12)
    u = stats.mannwhitneyu(score[positive], score[~positive]).statistic
    assert roc_auc(score, positive) == pytest.approx(u / len(pairs), abs=1e-12)
    assert roc_auc(score, positive.astype(np.float32)) == roc_auc(
        score, positive
    )  # the oracle's 0 and 1


def test_roc_auc_at_its_borders():
    score = np.array([1.0, 2.0, 3.0])
    assert roc_auc(score, [0, 0, 1]) == 1.0 and roc_auc(score, [1, 0, 0]) == 0.0
    assert roc_auc(np.ones(3), [1, 0, 0]) == 0.5
    assert math.isnan(roc_auc(score, [0, 0, 0])) and math.isnan(roc_auc(score, [1, 1, 1]))
    assert math.isnan(roc_auc(np.array([1.0, np.nan, 3.0]), [0, 1, 1]))
