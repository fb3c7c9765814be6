"""Criteria against torch.distributions, Monte Carlo, loops, and functions whose answer is known."""

import importlib
import math
from dataclasses import replace
from functools import partial
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
from aser.noise import Stream
from aser.replay import criteria, kinds
from aser.replay.kinds import Constant, Frozen, Lane, Learned, Live, PerItem, Shuffled, Transitions
from aser.replay.storage import LANES_OF_MEMORY, Layout, Memory, Storage
from aser.scores import roc_auc
from aser.training import frozen
from aser.training.diagnostics import criterion_auc
from aser.trees import take, tree_map

OBS, B = 5, 7


def agent(action_dim=2, seed=0):
    return sac.init(noise.lane_keys([seed])[0, Stream.INIT], OBS, action_dim, [24])


def observations(seed=0, count=B):
    return torch.randn(OBS, count, generator=torch.Generator().manual_seed(seed))


def gaussians(action_dim, wide=1.0):
    g = torch.Generator().manual_seed(action_dim)
    return Gaussian(
        wide * torch.randn(action_dim, B, generator=g), torch.randn(action_dim, B, generator=g)
    )


def evaluate(name, state, obs, gaussian=None, **kwargs):
    gaussian = policy(state.actor, obs) if gaussian is None else gaussian
    return kinds.make(name, **kwargs).function(state, obs, gaussian)


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
    # 1 - tanh(u)^2 = 4 exp(-2|u|) for large |u|, so log pi = -log std - log(2 pi) / 2 - log 4 + 2
    # |u|
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
        # log(1 - tanh(u)^2)
        log_slope = 2 * (math.log(2) - np.abs(u) - np.log1p(np.exp(-2 * np.abs(u))))
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
@pytest.mark.parametrize("action_dim", [pytest.param(1, marks=pytest.mark.slow), 2])
@pytest.mark.parametrize("name", [name for name in criteria.FUNCTIONS if name != "q_dropoff"])
def test_compiled_before_anything_else_it_is_the_same(name, action_dim, monkeypatch):
    """A trace is the first to ask for what a criterion keeps: it must not become a part of one
    graph alone.
    """
    criteria._sobol.cache_clear()
    state = batched(lambda key: sac.init(key, OBS, action_dim, [24]))(
        noise.lane_keys([3, 5, 8])[:, Stream.INIT]
    )
    obs = torch.randn(3, OBS, B, generator=torch.Generator().manual_seed(1))

    def lane(state, obs):
        return criteria.function(name)(state, obs, policy(state.actor, obs))

    first = compiled(batched(lane), True)(state, obs)
    torch.testing.assert_close(first, batched(lane)(state, obs), rtol=1e-3, atol=1e-3)
    assert first.isfinite().all()


def test_uniform_is_one_everywhere():
    state, obs = agent(), observations()
    assert criteria.uniform(state, obs, policy(state.actor, obs)).tolist() == [1.0] * B
    lane, index = Lane(sac, Layout(OBS, 2), state, {}, None), torch.arange(B)
    criterion = kinds.make("uniform")
    assert criterion.p_next(lane, index, obs, None).tolist() == [1.0] * B
    assert criterion.p_drawn(lane, obs, torch.arange(B) / 3).tolist() == [1.0] * B


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


# When a criterion is known.

L, ACT, N, WARM = 3, 2, 9, 11
KEYS = noise.lane_keys([4, 5, 6])
AGENTS = batched(lambda key: sac.init(key, OBS, ACT, [24]))(KEYS[:, Stream.INIT])
LAYOUT = Layout(OBS, ACT, ("p_next", "td_error"))
FEATURE = Live("feature", lambda state, obs, gaussian: obs[0].abs())


def memories(stored=13, ends=()):
    """Three lanes' memories: every number differs; the transitions `ends` of all that were stored
    end an episode.
    """
    storage, generator = Storage(LAYOUT, L, N), torch.Generator().manual_seed(2)
    for number in range(stored):
        row = torch.rand(L, LAYOUT.width, generator=generator)
        row[:, LAYOUT.columns["terminated"]] = float(number in ends and number % 2)
        row[:, LAYOUT.columns["truncated"]] = float(number in ends and not number % 2)
        storage.append(row)
    warm_up = torch.randn(L, OBS, WARM, generator=generator)
    return Memory(storage.rows, warm_up, KEYS, storage.clock(stored, 50))


def a_lane(number, memory, learned=None):
    rows, warm_up, keys, clock = memory
    own = Memory(rows[number], warm_up[number], keys[number], clock)
    return Lane(sac, LAYOUT, take(AGENTS, number), learned or {}, own)


def test_the_kinds_of_the_criteria_that_have_names():
    names = (*criteria.FUNCTIONS, "td_error", "reducible_loss")
    kind = {name: type(kinds.make(name)) for name in names}
    assert kind.pop("uniform") is Constant
    assert kind.pop("td_error") is PerItem
    assert kind.pop("reducible_loss") is kinds.ReducibleLoss
    assert set(kind.values()) == {Live} and len(kind) == 7
    shuffled = kinds.make("shuffled", "q_std")
    assert type(shuffled) is Shuffled and type(shuffled.function) is Live
    assert shuffled.function.function is criteria.q_std
    assert kinds.make("shuffled").function.function is criteria.mode_log_prob
    for name in ("oracle", "pretrained"):  # their numbers come with the environment or with agents
        with pytest.raises(ConfigError, match=f"^criterion={name}: "):
            kinds.make(name)


@pytest.mark.parametrize(
    ("criterion", "columns", "rewrites"),
    [
        (kinds.make("uniform"), (), False),
        (FEATURE, (), True),
        (kinds.make("shuffled"), (), True),
        (Frozen("frozen", lambda obs: obs[:, 0]), ("p_next",), False),
        (kinds.make("td_error"), ("td_error",), True),
        (kinds.make("reducible_loss"), ("reducible_loss",), True),
    ],
    ids=lambda x: getattr(x, "key", None),
)
def test_what_a_criterion_keeps_and_whether_it_moves(criterion, columns, rewrites):
    assert (criterion.columns, criterion.rewrites) == (columns, rewrites)
    layout = Layout(OBS, ACT, tuple({"p_next", "td_error", *columns}))
    rows, error = torch.rand(L, N, layout.width), torch.rand(L, B)
    next_obs = torch.randn(L, OBS)
    assert criterion.measure == (columns[0] if "reducible_loss" in columns else "td_error")
    assert tuple(criterion.new_columns(next_obs, rows, layout)) == columns
    drawn = criterion.drawn_columns(error)
    assert set(drawn) == set(columns) - {"p_next"}  # what is frozen does not change
    assert (criterion.on_arrival(next_obs) is None) == (columns != ("p_next",))
    assert (criterion.init(KEYS[0, 0], OBS, ACT), criterion.wanted(ACT, B)) == ({}, {})
    assert criterion.update(None, torch.arange(B), {}, {}) == {}


def test_a_live_criterion_is_that_of_the_agent_now():
    criterion, memory = kinds.make("q_std"), memories(ends=(10,))
    obs, index = observations(), torch.arange(B)
    for number in range(L):
        lane = a_lane(number, memory)
        expected = criteria.q_std(lane.state, obs, policy(lane.state.actor, obs))
        assert criterion.p_drawn(lane, obs, torch.zeros(B)).equal(expected)
        assert criterion.p_next(lane, index, obs, policy(lane.state.actor, obs)).equal(expected)
    told = Live("told", lambda state, obs, outputs: outputs)  # the networks are not asked again
    assert told.p_next(a_lane(0, memory), index, obs, "the outputs") == "the outputs"
    assert criterion.knows_next(a_lane(0, memory), torch.arange(N)).tolist() == [True] * N


@pytest.mark.parametrize("name", ["mode_log_prob", "q_range", "shuffled"])
def test_a_live_criterion_is_known_anywhere(name):
    criterion, memory = kinds.make(name), memories()
    obs = torch.randn(L, OBS, B, generator=torch.Generator().manual_seed(3))
    found = criterion.anywhere(sac, AGENTS, {}, memory, obs)
    assert found.shape == (L, B)
    for number in range(L):
        lane = a_lane(number, memory)
        expected = criterion.p(lane, obs[number], sac.outputs(lane.state, obs[number]))
        torch.testing.assert_close(found[number], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ["uniform", "td_error"])
def test_what_tells_states_apart_nowhere_or_not_anywhere_says_so(name):
    found = kinds.make(name).anywhere(sac, AGENTS, {}, memories(), torch.randn(L, OBS, B))
    assert found is None


def test_a_frozen_criterion_is_known_on_arrival_and_its_next_p_is_kept():
    slope = torch.tensor([1.0, 10.0, 100.0])[:, None]
    criterion, memory = Frozen("frozen", lambda obs: slope * obs[:, 1]), memories(ends=(10,))
    obs = torch.randn(L, OBS, generator=torch.Generator().manual_seed(3))
    assert criterion.on_arrival(obs).equal(slope[:, 0] * obs[:, 1])
    found = criterion.new_columns(obs, memory.rows, LAYOUT)
    assert found["p_next"].equal(slope[:, 0] * obs[:, 1])
    many = torch.randn(L, OBS, B, generator=torch.Generator().manual_seed(4))
    assert criterion.anywhere(sac, AGENTS, {}, memory, many).equal(slope * many[:, 1])
    index = torch.tensor([3, 8, 0, 3])
    for number in range(L):  # it is read, not computed, whatever the state
        lane = a_lane(number, memory)
        found = criterion.p_next(lane, index, None, None)
        assert found.equal(memory.rows[number, index, LAYOUT.columns["p_next"].start])
        assert criterion.knows_next(lane, torch.arange(N)).tolist() == [True] * N


def test_a_td_error_is_known_for_drawn_items_and_that_of_the_next_state_is_the_next_items():
    # Indices hold the transitions 9 10 11 12 4 5 6 7 8; the newest is 12, at index 3.
    criterion, memory = kinds.make("td_error"), memories(stored=13, ends=(6, 11))
    errors = LAYOUT.read(memory.rows, "td_error")  # (L, N)
    new = criterion.new_columns(torch.randn(L, OBS), memory.rows, LAYOUT)["td_error"]
    assert new.tolist() == [max(lane) for lane in errors.tolist()]
    error = torch.rand(L, B)
    assert criterion.drawn_columns(error)["td_error"] is error
    index = torch.arange(N)
    for number in range(L):
        lane = a_lane(number, memory)
        assert criterion.p_drawn(lane, None, error[0]).equal(error[0])
        followers = [*errors[number, 1:].tolist(), errors[number, 0].item()]  # the ring comes round
        assert criterion.p_next(lane, index, None, None).tolist() == followers
        known = [True, True, False, False, True, True, False, True, True]
        assert criterion.knows_next(lane, index).tolist() == known


class Averager:
    """A criterion with a state of its own: how far a state lies from the mean of all rewards that
    it saw.
    """

    def init(self, key, obs_dim, action_dim):
        return {"sum": noise.uniform(key, (obs_dim, action_dim)).sum(), "count": torch.ones(())}

    def update(self, own, transitions, state, hyper, noise):
        summed = own["sum"] + hyper["gain"] * transitions.reward.sum()
        return {"sum": summed, "count": own["count"] + len(transitions.reward)}

    def p(self, own, state, obs, gaussian):
        return (obs[0] - own["sum"] / own["count"]).abs() + gaussian.mean[0].abs()


LEARNED = Learned("averager", Averager())


def test_a_criterion_that_learns_has_a_state_that_every_lane_updates_by_what_it_drew():
    memory, drawn = memories(ends=(10,)), torch.tensor([[0, 5, 5, 7], [1, 2, 3, 8], [4, 4, 4, 6]])
    states = batched(lambda key: LEARNED.init(key, OBS, ACT))(KEYS[:, Stream.CRITERION])
    assert list(states) == ["averager"] and states["averager"]["sum"].unique().numel() == L
    assert LEARNED.rewrites and LEARNED.columns == () and LEARNED.wanted(ACT, B) == {}

    def update(state, learned, memory, drawn):
        lane = Lane(sac, LAYOUT, state, learned, memory)
        return LEARNED.update(lane, drawn, {"gain": torch.tensor(2.0)}, {})

    found = batched(update, (0, 0, LANES_OF_MEMORY, 0))(AGENTS, states, memory, drawn)
    rewards = LAYOUT.read(memory.rows, "reward").gather(1, drawn).sum(1)
    torch.testing.assert_close(found["averager"]["sum"], states["averager"]["sum"] + 2 * rewards)
    assert found["averager"]["count"].tolist() == [5.0] * L

    obs = torch.randn(L, OBS, B, generator=torch.Generator().manual_seed(3))
    everywhere = LEARNED.anywhere(sac, AGENTS, found, memory, obs)
    for number in range(L):
        lane = a_lane(number, memory, take(found, number))
        own, outputs = lane.learned["averager"], policy(lane.state.actor, obs[number])
        expected = (obs[number, 0] - own["sum"] / 5).abs() + outputs.mean[0].abs()
        for p in (
            LEARNED.p_drawn(lane, obs[number], torch.zeros(B)),
            LEARNED.p_next(lane, torch.arange(B), obs[number], outputs),
            everywhere[number],
        ):
            torch.testing.assert_close(p, expected, rtol=1e-5, atol=1e-6)


def test_a_criterion_that_learns_sees_the_one_step_facts():
    seen = []

    class Watcher(Averager):
        def update(self, own, transitions, state, hyper, noise):
            seen.append((own, transitions, state, hyper, noise))
            return own

    memory, drawn = memories(ends=(5, 6, 10, 11)), torch.tensor([1, 2, 8, 5, 6, 1])
    lane = a_lane(2, memory, {"watcher": "its own state", "other": "another's"})
    found = Learned("watcher", Watcher()).update(lane, drawn, "the numbers", "the noise")
    assert found == {"watcher": "its own state"}
    ((own, transitions, *rest),) = seen
    assert (own, rest) == ("its own state", [lane.state, "the numbers", "the noise"])
    rows = memory.rows[2, drawn]
    assert isinstance(transitions, Transitions)
    assert transitions.obs.equal(rows[:, :OBS].T)
    assert transitions.action.equal(rows[:, OBS : OBS + ACT].T)
    assert transitions.reward.equal(rows[:, OBS + ACT])
    assert transitions.next_obs.equal(rows[:, OBS + ACT + 1 : 2 * OBS + ACT + 1].T)
    # Indices hold the transitions 9 10 11 12 4 5 6 7 8; even ones were truncated, odd ones
    # terminated.
    assert transitions.terminated.tolist() == [False, True, False, True, False, False]
    assert transitions.truncated.tolist() == [True, False, False, False, True, True]


def test_shuffled_of_a_criterion_that_learns_lets_it_learn():
    criterion = Shuffled("shuffled", LEARNED)
    states = criterion.init(KEYS[0, Stream.CRITERION], OBS, ACT)
    assert list(states) == ["averager"] and criterion.wanted(ACT, B) == {}
    memory, drawn = memories(), torch.tensor([3, 1])
    lane, hyper = a_lane(0, memory, states), {"gain": torch.tensor(0.5)}
    found = criterion.learner.update(lane, drawn, hyper, {})
    expected = LEARNED.update(lane, drawn, hyper, {})
    assert found["averager"]["sum"].equal(expected["averager"]["sum"])
    lane, obs = lane._replace(learned=found), observations()
    known = LEARNED.p_drawn(lane, memory.warm_up[0], torch.zeros(WARM))
    for p in criterion.p_drawn(lane, obs, torch.zeros(B)).tolist():
        assert min(abs(p - other) for other in known.tolist()) < 1e-5


def lent(of, states, squashed=None):
    """The criterion `pretrained` of agents (n, ...) that every lane of three asks."""
    agents = frozen.Agents(sac, sac.kept(states), {"obs": OBS, "action": ACT})
    return frozen.criterion("pretrained", agents, torch.arange(L), of, squashed, False)


def test_pretrained_is_what_it_is_of():
    states, obs = tree_map(lambda x: x[None], agent()), observations().expand(L, OBS, B)
    for of, squashed in [
        ("mode_prob", None),
        ("entropy", None),
        ("curvature", None),
        ("mode_log_prob", True),
        ("mode_log_prob", False),
    ]:
        itself = batched(partial(evaluate, of, squashed=squashed))
        found = lent(of, states, squashed).function(obs)
        assert found.equal(itself(take(states, [0] * L), obs))
    assert isinstance(lent("q_std", states), Frozen)
    with pytest.raises(
        ConfigError, match=r"^pretrained\.of=.*Averager: learns while training[^\n]*$"
    ):
        lent(f"{__name__}.Averager", states)


def test_a_function_of_ones_own(tmp_path, monkeypatch):
    (tmp_path / "own_criteria.py").write_text(
        "def first(state, obs, gaussian):\n    return obs[0].abs()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    state, obs = agent(), observations()
    assert evaluate("own_criteria.first", state, obs).equal(obs[0].abs())
    pretrained = lent("own_criteria.first", tree_map(lambda x: x[None], state))
    assert pretrained.function(obs.expand(L, OBS, B)).equal(obs[0].abs().expand(L, B))
    assert type(kinds.make("own_criteria.first")) is Live
    assert evaluate("aser.replay.criteria.q_std", state, obs).equal(evaluate("q_std", state, obs))


def test_a_class_of_ones_own_learns():
    criterion = kinds.make(f"{__name__}.Averager")
    assert type(criterion) is Learned and isinstance(criterion.function, Averager)
    assert criterion.key == f"{__name__}.Averager"
    shuffled = kinds.make("shuffled", f"{__name__}.Averager")
    assert type(shuffled) is Shuffled and type(shuffled.function) is Learned


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


def test_a_wrong_name_is_told_all_names_of_conf():
    shipped = {path.stem for path in (train.CONF / "criterion").glob("[!_]*.yaml")} - {"auto"}
    assert shipped == {*criteria.FUNCTIONS, *criteria.OTHERS}


def test_criteria_of_different_densities_are_told_apart():
    squashed, gaussian = (kinds.make("mode_log_prob", squashed=flag) for flag in (True, False))
    assert squashed.key == kinds.make("mode_log_prob").key != gaussian.key


# The control.


def shuffled_lanes(obs, of="mode_log_prob"):
    """In three lanes: p (L, B) of `shuffled`, and the criterion itself at the warm-up states (L,
    S).
    """
    warm_up = torch.randn(L, OBS, WARM, generator=torch.Generator().manual_seed(2))
    shuffled, own = kinds.make("shuffled", of), kinds.make(of)

    def one(state, memory):
        lane = Lane(sac, LAYOUT, state, {}, memory)
        found = shuffled.p(lane, obs, policy(state.actor, obs))
        return found, own.p(lane, memory.warm_up, policy(state.actor, memory.warm_up))

    memory = Memory(torch.zeros(L, 1, 1), warm_up, KEYS, None)
    return batched(one, (0, LANES_OF_MEMORY))(AGENTS, memory)


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
    training = build.build(config, train.CONF, train.CONF.parent / "results")
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
    agents = batched(lambda key: sac.init(key, 4, 2, [24]))(keys[:, Stream.INIT])
    memory = Memory(torch.zeros(64, 1, 1), warm_up, keys, None)
    everywhere = partial(kinds.make("shuffled").anywhere, sac, agents, {}, memory)
    p = everywhere(obs.expand(64, -1, -1))
    aucs = [roc_auc(lane, states.decision) for lane in p.numpy()]
    assert np.mean(aucs) == pytest.approx(0.5, abs=0.025) and 0.02 < np.std(aucs) < 0.1


@pytest.mark.slow
def test_shuffled_does_not_know_the_decision_points_in_training(trained):
    buffer, clock = trained.setup.buffer, trained._clock
    oracle = trained.setup.envs.oracle
    aucs = criterion_auc(buffer.sampler, oracle)(trained.state, buffer, clock)
    assert aucs.shape == (16,) and len(set(aucs)) == 16
    assert abs(aucs.mean() - 0.5) < 0.05
    assert aucs.std() > 0.01  # it is uneven by chance in each lane
    # ... while the same measure is 1 for a criterion that knows.
    knowing = Frozen("oracle", lambda obs: torch.from_numpy(oracle(obs.mT.numpy())))
    sampler = replace(buffer.sampler, stopping=knowing)
    aucs = criterion_auc(sampler, oracle)(trained.state, buffer, clock)
    assert aucs.tolist() == [1.0] * 16


def test_the_warm_up_states_are_the_first_ones(trained):
    buffer = trained.setup.buffer
    warm_up = buffer.warm_up
    assert warm_up.shape == (16, 4, 100)
    assert warm_up.equal(
        buffer.sampler.layout.read_vector(buffer.storage.rows[:, :100], "obs").movedim(0, 1)
    )
