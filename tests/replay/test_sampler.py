"""Sampler.assemble against the thesis' Algorithm 1, written with Python loops over episodes in
lists.
"""

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from aser import noise
from aser.agents import sac
from aser.agents.networks import policy
from aser.lanes import batched
from aser.noise import Stream
from aser.replay import bootstrap, criteria, kinds
from aser.replay.kinds import Constant, Frozen, Learned, Live, PerItem
from aser.replay.priorities import proportional
from aser.replay.sampler import Drawn, Sampler, State
from aser.replay.storage import LANES_OF_MEMORY, Layout, Memory, Storage
from aser.replay.unroll import Unroll
from aser.trees import take

L, OBS, ACT, B = 2, 3, 2, 5
KEYS = noise.lane_keys([6, 7])
TEMPERATURE = torch.tensor([0.3, 0.7])
AGENTS = batched(lambda key: sac.init(key, OBS, ACT, [6]))(KEYS[:, Stream.INIT])
AGENTS = AGENTS._replace(log_temperature=TEMPERATURE.log())
# A criterion whose values the twin knows to the bit, known now.
FEATURE = Live("feature", lambda state, obs, gaussian: obs[0].abs())


@dataclass
class Transition:
    obs: list
    action: list
    reward: float
    next_obs: list
    terminated: bool
    truncated: bool
    p_next: float  # stored, for frozen criteria
    td_error: float
    index: int  # where the ring holds it


@dataclass
class Case:
    """What one lane's twin needs to know."""

    trajectory: list[Transition]  # in the order of storing
    actor: list
    temperature: float
    hyper: dict[str, float]
    path_noise: list = field(default_factory=list)  # (B, A)
    u: list = field(default_factory=list)  # of the geometric rule


def gaussian(actor, obs):
    """Mean and standard deviation of each action dimension, in double precision."""
    x = np.array(obs)
    for weight, bias in actor[:-1]:
        x = np.maximum(weight @ x + bias, 0.0)
    weight, bias = actor[-1]
    mean, log_std = np.split(weight @ x + bias, 2)
    return mean, np.exp(np.clip(log_std, -20, 2))


def log_prob(mean, std, u):
    """Of tanh(u)."""
    normal = -0.5 * ((u - mean) / std) ** 2 - np.log(std) - 0.5 * math.log(2 * math.pi)
    return float((normal - np.log(1 - np.tanh(u) ** 2)).sum())


def path_entropy(case, sampler, item, t):
    """What is added to the reward of t, the transition at a skipped state."""
    mean, std = gaussian(case.actor, t.obs)
    if sampler.unroll.path_entropy == "none":
        return 0.0
    u = (
        mean + std * case.path_noise[item]
        if sampler.unroll.path_entropy == "fresh"
        else np.arctanh(t.action)
    )
    return -case.temperature * log_prob(mean, std, u)


def p_of_next(case, sampler, place):
    """p(s') of the transition at `place` in the trajectory; None where it is not known."""
    t = case.trajectory[place]
    if isinstance(sampler.unroll.criterion, Constant):
        return 1.0
    if isinstance(sampler.unroll.criterion, Frozen):
        return t.p_next
    if isinstance(sampler.unroll.criterion, PerItem):
        if t.terminated or t.truncated or place + 1 == len(case.trajectory):
            return None
        return case.trajectory[place + 1].td_error
    if sampler.unroll.criterion is FEATURE:
        return abs(t.next_obs[0])
    mean, std = gaussian(case.actor, t.next_obs)
    return math.log1p(math.exp(log_prob(mean, std, mean)))  # log(1 + pi(abar | s))


def algorithm_1(case, sampler, place, item, b):
    """Lines 4 to 11 for the transition at `place`: (n, reward, discount, the state bootstrapped
    from).

    Or None where the twin's double precision cannot tell p(s') from b.
    """
    t = case.trajectory[place]
    gamma, h = case.hyper["gamma"], case.hyper["h"]
    reward, n = t.reward, 1
    while n < h and sampler.unroll.rule is not None:
        if t.terminated or t.truncated or place + n == len(case.trajectory):
            break
        if sampler.unroll.rule is bootstrap.threshold:
            p = p_of_next(case, sampler, place + n - 1)
            if sampler.unroll.criterion.key in criteria.FUNCTIONS and p != b and abs(p - b) < 1e-5:
                return None  # this state set b itself: rounding decides
            if not p < b:
                break
        if sampler.unroll.rule is bootstrap.geometric and not case.u[item] < case.hyper["lam"] ** n:
            break
        t = case.trajectory[place + n]
        reward += gamma**n * (t.reward + path_entropy(case, sampler, item, t))
        n += 1
    return n, reward, 0.0 if t.terminated else gamma**n, t.next_obs


def threshold(case, sampler, places, step):
    """Line 3: the k-quantile of p(s') of the transitions at `places`."""
    known = [p for p in (p_of_next(case, sampler, place) for place in places) if p is not None]
    k = min(case.hyper["k_m"], step * case.hyper["k_s"])
    return np.quantile(known, min(k, 1.0)) if known else -math.inf


def play(rng, capacity, stored, ends):
    """A ring of random episodes, and the same as lists. `ends` (L, stored): 1 terminated, 2
    truncated.
    """
    storage = Storage(Layout(OBS, ACT, ("p_next", "td_error")), L, capacity)
    trajectories = [[] for _ in range(L)]
    obs = rng.normal(size=(L, OBS)).astype(np.float32)
    for number in range(stored):
        next_obs = rng.normal(size=(L, OBS)).astype(np.float32)
        rows = []
        for lane in range(L):
            action = rng.uniform(-0.95, 0.95, ACT).astype(np.float32)
            scalars = rng.exponential(size=2).astype(np.float32).tolist()
            reward = float(np.float32(rng.normal()))
            end = ends[lane][number]
            facts = [
                obs[lane].tolist(),
                action.tolist(),
                reward,
                next_obs[lane].tolist(),
                end == 1,
                end == 2,
            ]
            t = Transition(*facts, *scalars, number % capacity)
            trajectories[lane].append(t)
            flat = [t.reward, *t.next_obs, t.terminated, t.truncated, t.p_next, t.td_error]
            rows.append([*t.obs, *t.action, *flat])
        assert storage.append(torch.tensor(rows, dtype=torch.float32)) == number % capacity
        obs = np.where(np.array(ends)[:, number, None] > 0, rng.normal(size=(L, OBS)), next_obs)
        obs = obs.astype(np.float32)
    return storage, [trajectory[-storage.size :] for trajectory in trajectories]


def hypers(h, gamma=(0.9, 0.8), k_m=(0.8, 0.5), k_s=(0.013, 0.021), lam=(0.7, 0.9)):
    values = {"h": h, "gamma": gamma, "k_m": k_m, "k_s": k_s, "lam": lam}
    return {name: torch.tensor(value, dtype=torch.float32) for name, value in values.items()}


def assembled(sampler, storage, index, hyper, clock, seed=0):
    """The batch and (n, b) of all lanes at once, and the numbers that were used."""
    numbers, g = {}, torch.Generator().manual_seed(seed)
    for stream, (draw, shape) in sampler.wanted(ACT).items():
        make = torch.randn if draw is noise.normal else torch.rand
        kind = torch.float64 if draw is noise.uniform_double else torch.float32
        numbers[stream] = make(L, *shape, dtype=kind, generator=g)
    memory = Memory(storage.rows, torch.zeros(L, OBS, 1), KEYS, clock)
    weight = torch.arange(L * B).reshape(L, B) / 7
    assemble = batched(sampler.assemble, (0, LANES_OF_MEMORY, 0, 0, 0))
    found = assemble(State(AGENTS, {}), memory, Drawn(index, weight), hyper, numbers)
    assert found[0].weight.equal(weight)
    return found, numbers


def check(sampler, storage, trajectories, index, hyper, step, seed=0):
    """Compare all that comes out of `assemble` with the twins; returns n (L, B) and b (L,)."""
    clock = storage.clock(step, 1000)
    (batch, (n, b)), numbers = assembled(sampler, storage, index, hyper, clock, seed)
    for lane, trajectory in enumerate(trajectories):
        place_of = {t.index: place for place, t in enumerate(trajectory)}
        places = [place_of[i] for i in index[lane].tolist()]
        actor = [(w.double().numpy(), c.double().numpy()) for w, c in take(AGENTS.actor, lane)]
        values = {name: value[lane].item() for name, value in hyper.items()}
        case = Case(trajectory, actor, TEMPERATURE[lane].item(), values)
        if Stream.PATH in numbers:
            case.path_noise = numbers[Stream.PATH][lane].double().T.numpy()
        if Stream.UNROLL in numbers:
            case.u = numbers[Stream.UNROLL][lane].tolist()
        uniform = places
        if Stream.UNIFORM in numbers:
            chosen = (numbers[Stream.UNIFORM][lane] * len(trajectory)).floor().tolist()
            uniform = [place_of[int(i)] for i in chosen]
        limit = b[lane].item()
        if sampler.unroll.rule is not bootstrap.threshold or sampler.unroll.window == 1:
            assert math.isnan(limit)
        elif sampler.unroll.threshold is not None:
            assert limit == pytest.approx(sampler.unroll.threshold)
        else:
            judged = uniform if sampler.unroll.threshold_batch == "uniform" else places
            assert limit == pytest.approx(
                threshold(case, sampler, judged, step), rel=1e-5, abs=1e-6
            )
        acting = uniform if sampler.actor_batch == "uniform" else places
        for item, place in enumerate(places):
            if (expected := algorithm_1(case, sampler, place, item, limit)) is None:
                continue
            steps, reward, discount, boot_obs = expected
            assert n[lane, item] == steps
            assert batch.reward[lane, item].item() == pytest.approx(reward, rel=1e-4, abs=1e-4)
            assert batch.discount[lane, item].item() == pytest.approx(discount, rel=1e-5)
            assert batch.boot_obs[lane, :, item].tolist() == boot_obs
            assert batch.obs[lane, :, item].tolist() == trajectory[place].obs
            assert batch.action[lane, :, item].tolist() == trajectory[place].action
            assert batch.actor_obs[lane, :, item].tolist() == trajectory[acting[item]].obs
    assert batch.obs.shape == batch.boot_obs.shape == batch.actor_obs.shape == (L, OBS, B)
    assert batch.action.shape == (L, ACT, B) and batch.reward.shape == batch.discount.shape == (
        L,
        B,
    )
    return n, b


def make_sampler(
    stopping=FEATURE, rule="threshold", window=4, actor_batch="prioritised", **options
):
    unroll = Unroll(
        None if rule == "one_step" else bootstrap.RULES[rule],
        stopping if rule == "threshold" else None,
        window,
        uses_random=rule == "geometric",
        **options,
    )
    return Sampler(
        sac,
        Layout(OBS, ACT, ("p_next", "td_error")),
        B,
        Constant("uniform"),
        unroll,
        actor_batch=actor_batch,
    )


def never(obs):
    raise AssertionError("what is frozen is not asked again: it is kept beside the transition")


STOPPING = [FEATURE, Frozen("frozen", never), kinds.make("td_error")]


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_assemble_is_algorithm_1(data):
    capacity = data.draw(st.integers(2, 12), "capacity")
    stored = data.draw(st.integers(1, 30), "stored")
    end = st.sampled_from([0, 0, 0, 0, 1, 2])
    ends = data.draw(
        st.lists(st.lists(end, min_size=stored, max_size=stored), min_size=L, max_size=L), "ends"
    )
    window = data.draw(st.integers(1, min(6, capacity)), "window")
    h = data.draw(st.tuples(*[st.integers(1, window)] * L), "h")
    rules = ["threshold", "threshold", "fixed", "geometric"]
    rule = data.draw(st.sampled_from(rules if window > 1 else [*rules, "one_step"]), "rule")
    sampler = make_sampler(
        data.draw(st.sampled_from(STOPPING), "stopping"),
        rule,
        window,
        threshold=data.draw(st.sampled_from([None, None, 0.6]), "threshold"),
        threshold_batch=data.draw(st.sampled_from(["uniform", "prioritised"]), "threshold_batch"),
        path_entropy=data.draw(st.sampled_from(["fresh", "stored", "none"]), "path_entropy"),
        actor_batch=data.draw(st.sampled_from(["uniform", "prioritised"]), "actor_batch"),
    )
    step = data.draw(st.integers(0, 60), "step")
    seed = data.draw(st.integers(0, 1000), "seed")
    rng = np.random.default_rng(seed)
    storage, trajectories = play(rng, capacity, stored, ends)
    index = torch.from_numpy(rng.integers(0, storage.size, (L, B)))
    check(sampler, storage, trajectories, index, hypers(h), step, seed)


def long_episodes(seed=0, stored=40, capacity=23, length=9):
    """Every ninth transition ends an episode, in the second lane four later."""
    rng = np.random.default_rng(seed)
    ends = [
        [
            1 + (i // length) % 2 if (i + 4 * lane) % length == length - 1 else 0
            for i in range(stored)
        ]
        for lane in range(L)
    ]
    storage, trajectories = play(rng, capacity, stored, ends)
    return storage, trajectories, torch.from_numpy(rng.integers(0, storage.size, (L, B)))


@pytest.mark.parametrize("batch", ["uniform", "prioritised"])
@pytest.mark.parametrize("name", ["mode_log_prob", "uniform"])
def test_assemble_is_algorithm_1_with_the_thesis_criterion(name, batch):
    unrolled = set()
    for seed in range(8):
        storage, trajectories, index = long_episodes(seed)
        sampler = make_sampler(kinds.make(name), threshold_batch=batch)
        hyper = hypers((4, 3), k_m=(0.83, 0.71), k_s=(0.5, 0.5))
        n, b = check(sampler, storage, trajectories, index, hyper, 50, seed)
        unrolled |= set(n.flatten().tolist())
        # Nothing is below the quantile of a constant.
        assert name != "uniform" or b.tolist() == [
            1,
            1,
        ]
    assert unrolled == ({1} if name == "uniform" else {1, 2, 3, 4})


def test_the_quantile_is_torchs_and_grows_until_k_m():
    storage, trajectories, _ = long_episodes()
    index = 4 * torch.arange(B) + torch.arange(L)[:, None]  # no item twice
    sampler, found = make_sampler(threshold_batch="prioritised"), []
    for step in (0, 20, 40, 60, 100):
        _, b = check(sampler, storage, trajectories, index, hypers((4, 4)), step)
        for lane in range(L):
            p = storage.rows[lane, index[lane], storage.layout.columns["next_obs"].start].abs()
            k = min((0.8, 0.5)[lane], step * (0.013, 0.021)[lane])
            assert b[lane].item() == pytest.approx(p.quantile(k).item(), rel=1e-5)
        found.append(b)
    found = torch.stack(found)  # (steps, L)
    assert (found.diff(dim=0) >= 0).all()
    assert found[1, 1] < found[2, 1] == found[4, 1]  # k reached k_m after 24 steps
    assert found[2, 0] < found[3, 0] < found[4, 0]  # and here after 62


def test_a_threshold_never_crossed_is_fixed_n_and_one_crossed_at_once_is_one_step():
    storage, _, index = long_episodes()
    clock, hyper = storage.clock(50, 1000), hypers((4, 3))

    def batch_of(**kwargs):
        return assembled(make_sampler(**kwargs), storage, index, hyper, clock)[0]

    def equal(one, other):
        (batch, unrolled), (another, others) = one, other
        same = all(torch.equal(x, y) for x, y in zip(batch[:-1], another[:-1], strict=True))
        return same and unrolled.n.equal(others.n)

    fixed, one_step = batch_of(rule="fixed"), batch_of(rule="one_step", window=1)
    assert fixed[1].n.amax(1).tolist() == [4, 3] and one_step[1].n.eq(1).all()
    assert equal(batch_of(threshold=1e9), fixed)
    assert equal(batch_of(threshold=0.0), one_step)
    assert not equal(fixed, one_step)


def test_a_lane_without_any_successor_leaves_the_td_quantile_empty():
    rng = np.random.default_rng(0)
    storage, trajectories = play(rng, 7, 7, [[1] * 7, [0] * 7])
    index = torch.from_numpy(rng.integers(0, 7, (L, B)))
    n, b = check(make_sampler(STOPPING[2]), storage, trajectories, index, hypers((4, 4)), 50)
    assert b[0] == -math.inf and n[0].eq(1).all() and b[1] > 0


def test_the_skipped_states_of_an_item_share_one_epsilon_and_items_do_not():
    storage, _, _ = long_episodes()
    sampler = make_sampler(rule="fixed")
    assert sampler.wanted(ACT)[Stream.PATH] == (noise.normal, (ACT, B))
    # No end within.
    start = next(i for i in range(23) if storage.rows[0, i : i + 4, -4:-2].sum() == 0)
    (batch, (n, _)), _ = assembled(
        sampler, storage, torch.full((L, B), start), hypers((4, 4)), storage.clock(50, 1000)
    )
    assert n[0].eq(4).all() and batch.reward[0].unique().numel() == B


def test_wanted_names_the_numbers_in_use():
    def streams(**kwargs):
        return set(make_sampler(**kwargs).wanted(ACT))

    assert streams(rule="one_step", window=1) == {Stream.DRAW}
    assert streams(rule="fixed") == {Stream.DRAW, Stream.PATH}
    assert streams(rule="fixed", path_entropy="stored") == {Stream.DRAW}
    assert streams(rule="geometric", path_entropy="none") == {Stream.DRAW, Stream.UNROLL}
    assert streams() == {Stream.DRAW, Stream.UNIFORM, Stream.PATH}
    assert (
        streams(threshold=0.5)
        == streams(threshold_batch="prioritised")
        == {Stream.DRAW, Stream.PATH}
    )
    assert streams(rule="one_step", window=1, actor_batch="uniform") == {
        Stream.DRAW,
        Stream.UNIFORM,
    }
    assert make_sampler().wanted(ACT)[Stream.DRAW] == (noise.uniform_double, (B,))


def test_the_mass_of_drawn_items_is_the_criterion_of_the_agent_it_is_given():
    state, obs = take(AGENTS, 0), torch.randn(OBS, B, generator=torch.Generator().manual_seed(0))
    hyper = {"alpha": torch.tensor(0.6), "epsilon": torch.tensor(0.01)}
    memory = Memory(torch.zeros(1, 1), obs + 1, KEYS[0], None)
    error = torch.arange(B) / 3.0
    for name in ("mode_log_prob", "q_std", "shuffled", "td_error", "uniform"):
        sampler = Sampler(sac, Layout(OBS, ACT), B, kinds.make(name), mass=proportional)
        if name == "td_error":
            p = error
        elif name == "shuffled":
            code = noise.hash_columns(KEYS[0, Stream.SHUFFLE], obs) & 0x7FFFFFFF
            other = memory.warm_up[:, [x % B for x in code.tolist()]]
            p = criteria.mode_log_prob(state, other, policy(state.actor, other))
        else:
            p = criteria.FUNCTIONS[name](state, obs, policy(state.actor, obs))
        found = sampler.mass_of_drawn(State(state, {}), memory, obs, error, hyper)
        assert found.dtype == torch.float64
        torch.testing.assert_close(found, (p.double() + 0.01) ** 0.6, rtol=1e-6, atol=0)


def test_a_prioritisation_of_ones_own_is_handed_p_and_the_lanes_numbers():
    def mass(p, hyper):
        return p.double() * hyper["slope"]

    sampler = Sampler(sac, Layout(OBS, ACT), B, PerItem("td_error"), mass=mass)
    memory, error = Memory(torch.zeros(1, 1), None, KEYS[0], None), torch.arange(B) / 3.0
    hyper = {"slope": torch.tensor(6.0)}
    found = sampler.mass_of_drawn(State(take(AGENTS, 0), {}), memory, error[None], error, hyper)
    assert found.tolist() == pytest.approx([0, 2, 4, 6, 8])


@pytest.mark.parametrize(
    ("drawing", "rewrites"),
    [
        (Constant("uniform"), False),
        (Frozen("frozen", never), False),
        (PerItem("td_error"), True),
        (FEATURE, True),
        (kinds.make("shuffled"), True),
    ],
)
def test_drawn_items_get_a_new_mass_where_the_drawing_criterion_moves(drawing, rewrites):
    layout = Layout(OBS, ACT)
    assert Sampler(sac, layout, B, drawing, mass=proportional).rewrites is rewrites
    assert Sampler(sac, layout, B, drawing).rewrites is False  # nothing has a mass


def test_which_criteria_are_read_and_which_is_judged():
    one, two = Live("one", criteria.q_std), Live("two", criteria.q_range)

    def read(drawing, stopping, mass=None):
        unroll = Unroll(bootstrap.threshold, stopping, 4) if stopping else Unroll()
        sampler = Sampler(sac, Layout(OBS, ACT), B, drawing, unroll, mass)
        return sampler.criteria, sampler.diagnosed

    assert read(one, None) == ([], one)
    assert read(one, None, proportional) == ([one], one)
    assert read(one, two) == ([two], two)
    assert read(one, two, proportional) == ([one, two], two)
    assert read(one, one, proportional) == ([one], one)


class Counter:
    """A criterion that counts its updates, and sums what it saw and the noise it asked for."""

    def init(self, key, obs_dim, action_dim):
        assert (obs_dim, action_dim) == (OBS, ACT) and key.shape == (2,)
        return {"updates": torch.zeros(()), "seen": torch.zeros(()), "noise": torch.zeros(())}

    def update(self, own, transitions, state, hyper, noise):
        return {
            "updates": own["updates"] + 1.0,
            "seen": own["seen"] + hyper["gamma"] * transitions.reward.sum() + state.updates,
            "noise": noise[Stream.CRITERION].sum(),
        }

    def p(self, own, state, obs, gaussian):
        return obs[0].abs() + own["updates"]

    def wanted(self, action_dim, batch):
        return {Stream.CRITERION: (noise.normal, (action_dim, batch, 3))}


def test_a_criterion_that_learns_is_kept_in_the_state_and_updated_once():
    counter = Learned("counter", Counter())
    layout = Layout(OBS, ACT)
    unroll = Unroll(bootstrap.threshold, counter, window=4)
    sampler = Sampler(sac, layout, B, counter, unroll, proportional)
    wanted = sampler.wanted(ACT)
    assert wanted[Stream.CRITERION] == (noise.normal, (ACT, B, 3))
    numbers = batched(lambda keys: noise.numbers(keys, wanted))(KEYS)
    states = batched(sampler.init)(KEYS[:, Stream.CRITERION])
    assert list(states) == ["counter"] and states["counter"]["updates"].tolist() == [0, 0]

    storage, _, index = long_episodes()
    memory = Memory(storage.rows, torch.zeros(L, OBS, 1), KEYS, storage.clock(50, 1000))
    agents = AGENTS._replace(updates=torch.tensor([7.0, 8.0]))
    learn = batched(sampler.learn, (0, LANES_OF_MEMORY, 0, 0, 0))
    state, hyper = State(agents, states), hypers((4, 3))
    for count in (1, 2):
        state = learn(state, memory, index, hyper, numbers)
        assert state.criteria["counter"]["updates"].tolist() == [count] * L
    assert state.agent.updates.tolist() == [7, 8]
    rewards = storage.layout.read(storage.rows, "reward").gather(1, index).sum(1)
    expected = 2 * (hyper["gamma"] * rewards + agents.updates)
    torch.testing.assert_close(state.criteria["counter"]["seen"], expected)
    own = numbers[Stream.CRITERION].sum((1, 2, 3))
    torch.testing.assert_close(state.criteria["counter"]["noise"], own)

    obs = torch.randn(OBS, B, generator=torch.Generator().manual_seed(0))
    plain = {"alpha": torch.tensor(1.0), "epsilon": torch.tensor(0.0)}
    lane = Memory(storage.rows[0], None, KEYS[0], None)
    found = sampler.mass_of_drawn(take(state, 0), lane, obs, torch.zeros(B), plain)
    torch.testing.assert_close(found, (obs[0].abs() + 2.0).double())


class Slower(Counter):
    """Another one."""


def test_two_shuffled_criteria_that_learn_keep_a_state_each():
    names = [f"{__name__}.{kind.__name__}" for kind in (Counter, Slower)]
    drawing, stopping = (kinds.make("shuffled", name) for name in names)
    unroll = Unroll(bootstrap.threshold, stopping, window=4)
    sampler = Sampler(sac, Layout(OBS, ACT), B, drawing, unroll, proportional)
    assert sampler.criteria == [drawing, stopping]
    assert list(sampler.init(KEYS[0, Stream.CRITERION])) == names


def test_a_sampler_that_does_not_read_a_learning_criterion_keeps_no_state_of_it():
    counter = Learned("counter", Counter())
    sampler = Sampler(sac, Layout(OBS, ACT), B, counter)
    assert sampler.init(KEYS[0, Stream.CRITERION]) == {}
    assert set(sampler.wanted(ACT)) == {Stream.DRAW}
    start = State(take(AGENTS, 0), {})
    assert sampler.learn(start, None, torch.zeros(B, dtype=torch.long), {}, {}) == start
