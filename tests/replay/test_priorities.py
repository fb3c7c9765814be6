"""Flat and tree priorities against plain lists, closed-form frequencies, and cpprb."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from aser import native
from aser.replay import priorities
from aser.replay.priorities import FlatPriorities, TreePriorities

L = 2


def mass_of(p, alpha, epsilon):
    return priorities.proportional(p, {"alpha": alpha, "epsilon": epsilon})


class PlainTree(TreePriorities):
    """The tree as it is walked where nothing can be compiled."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.native = False


ALL = [FlatPriorities, PlainTree] + ([TreePriorities] if native.library() is not None else [])
KINDS = pytest.mark.parametrize("kind", ALL)


class Twin:
    """One lane's masses in a list. They are whole numbers and u is a multiple of 1/64, so sums are
    exact.
    """

    def __init__(self, capacity):
        self.mass = [0.0] * capacity

    def draw(self, u):
        place, passed = u * sum(self.mass), 0.0
        for index, mass in enumerate(self.mass):
            passed += mass
            if place < passed:
                return index
        raise AssertionError("u is below 1, so some item holds the place")

    def smallest(self):
        return min((mass for mass in self.mass if mass > 0), default=math.inf)


def agree(store, twins):
    assert store.mass.tolist() == [twin.mass for twin in twins]
    assert store.total().tolist() == [sum(twin.mass) for twin in twins]
    assert store.largest().tolist() == [max(twin.mass) for twin in twins]
    assert store.smallest().tolist() == [twin.smallest() for twin in twins]
    if all(max(twin.mass) > 0 for twin in twins):
        u = torch.arange(64, dtype=torch.float64).repeat(len(twins), 1) / 64
        index, mass = store.draw(u)
        assert index.tolist() == [[twin.draw(x) for x in u[0].tolist()] for twin in twins]
        assert mass.tolist() == [
            [twin.mass[i] for i in row] for twin, row in zip(twins, index.tolist(), strict=True)
        ]


def play(store, capacity, rng, operations):
    twins = [Twin(capacity) for _ in range(L)]
    for _ in range(operations):
        if rng.random() < 0.5:
            index, mass = int(rng.integers(capacity)), rng.integers(0, 6, L).astype(float)
            store.append(index, torch.from_numpy(mass))
            for lane, twin in enumerate(twins):
                twin.mass[index] = mass[lane]
        else:  # an item drawn twice has one state, so it is written twice with the same mass
            fresh = rng.choice([0.0, 1.0, 1.0, 2.0, 7.0, 64.0], (L, capacity))
            index = rng.integers(0, capacity, (L, 5))
            store.write(
                torch.from_numpy(index), torch.from_numpy(np.take_along_axis(fresh, index, 1))
            )
            for lane, twin in enumerate(twins):
                for i in index[lane]:
                    twin.mass[i] = fresh[lane, i]
        agree(store, twins)
    return twins


def narrow(kind, patch, fanout=4):
    """Small families, where that is not compiled in, so that few items make several levels."""
    if kind is not TreePriorities:
        patch.setattr(kind, "fanout", fanout)
        patch.setattr(kind, "top", fanout, raising=False)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_random_operations_as_the_twin(data):
    kind = data.draw(st.sampled_from(ALL), "kind")
    fanout = data.draw(st.sampled_from([2, 3, 4]), "fanout")
    capacity = data.draw(st.integers(1, 40), "capacity")
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32), "seed"))
    with pytest.MonkeyPatch.context() as patch:
        narrow(kind, patch, fanout)
        play(kind(L, capacity), capacity, rng, 12)


@KINDS
@pytest.mark.parametrize("capacity", [63, 64, 65, 128, 4097, 5000])
def test_sizes_around_a_family_as_the_twin(kind, capacity):
    play(kind(L, capacity), capacity, np.random.default_rng(capacity), 8)


def test_large_buffers_get_the_tree_and_one_that_is_loaded_goes_on_alike(monkeypatch):
    for name in ("FLAT_BESIDE_NATIVE", "FLAT_BESIDE_TREE"):
        monkeypatch.setattr(priorities, name, 100)
    for capacity, kind in [(100, FlatPriorities), (101, PlainTree), (4097, TreePriorities)]:
        if kind not in ALL:
            continue
        monkeypatch.setattr(native, "serves", lambda x, kind=kind: kind is TreePriorities)
        store, other = priorities.make(L, capacity), priorities.make(L, capacity)
        assert type(store) is (FlatPriorities if capacity == 100 else TreePriorities)
        twins = play(store, capacity, np.random.default_rng(1), 30)
        play(other, capacity, np.random.default_rng(2), 30)
        other.load_state_dict({name: value.clone() for name, value in store.state_dict().items()})
        agree(other, twins)
        store.append(0, torch.tensor([5.0, 6.0]).double())
        agree(other, twins)  # nothing is shared


def test_a_tree_of_a_million_items_is_loaded_within_reason(monkeypatch):
    saved = torch.ones(1, 1_000_000, dtype=torch.float64)
    store = TreePriorities(1, 1_000_000)
    store.native = False  # the plain lines can be watched
    gathered = []
    family = store._family
    monkeypatch.setattr(
        store, "_family", lambda level, at: gathered.append(at.numel()) or family(level, at)
    )
    store.load_state_dict({"mass": saved})
    assert store.total() == 1_000_000 and store.smallest() == 1
    # `fanout` numbers each: no more than the leaves.
    assert max(gathered) <= 1_000_000 / store.fanout


def frequencies(store, draws, seed=5):
    """How often each item of each lane was drawn, (L, N)."""
    u = torch.rand(L, draws, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    index, mass = store.draw(u)
    assert mass.equal(store.mass.gather(1, index))
    return np.stack([np.bincount(row, minlength=store.mass.shape[1]) for row in index.numpy()])


@KINDS
@pytest.mark.parametrize("alpha", [0.0, 0.6, 1.0, 1.7])
def test_items_are_drawn_as_often_as_equation_1_says(kind, alpha, monkeypatch):
    narrow(kind, monkeypatch)
    capacity, draws, epsilon = 23, 40_000, 0.01
    p = np.random.default_rng(3).exponential(size=(L, capacity))
    p[:, 4] = 0.0  # drawn nevertheless, thanks to epsilon
    store = kind(L, capacity)
    tensors = [torch.tensor(x) for x in (p, alpha, epsilon)]
    store.write(torch.arange(capacity).repeat(L, 1), mass_of(*tensors))
    expected = (p + epsilon) ** alpha
    expected /= expected.sum(1, keepdims=True)
    for counts, share in zip(frequencies(store, draws), expected, strict=True):
        assert stats.chisquare(counts, draws * share).pvalue > 1e-3


def test_mass_applies_alpha_to_p_plus_epsilon_in_float64():
    p = torch.tensor([0.0, 0.5, 2.0])
    found = mass_of(p, torch.tensor(0.5), torch.tensor(0.25))
    assert found.dtype == torch.float64
    assert found.tolist() == pytest.approx([0.5, 0.75**0.5, 1.5], rel=1e-9)
    assert mass_of(p, torch.tensor(1.0), torch.tensor(0.0)).tolist() == [0, 0.5, 2]
    wild = mass_of(
        torch.tensor([torch.nan, -1.0, torch.inf]), torch.tensor(1.0), torch.tensor(0.25)
    )
    assert wild[:2].tolist() == [0.25, 0.25] and wild.isfinite().all() and wild[2] > 1e20


@KINDS
def test_nothing_drifts_over_a_million_updates(kind):
    capacity, rng = 5000, np.random.default_rng(0)
    store = kind(L, capacity)
    everything = torch.arange(capacity).repeat(L, 1)
    for _ in range(100):
        wide = 10.0 ** rng.uniform(-9, 9, (L, capacity))
        order = np.stack([rng.permutation(capacity) for _ in range(L)])
        store.write(torch.from_numpy(order), torch.from_numpy(wide))
    store.write(everything[:, 1:], torch.from_numpy(rng.random((L, capacity))[:, 1:]))
    store.append(0, torch.full((L,), 0.3, dtype=torch.float64))
    exact = [math.fsum(row) for row in store.mass.tolist()]
    assert store.total().tolist() == pytest.approx(exact, rel=1e-13)
    assert store.largest().equal(store.mass.amax(1)) and store.smallest().equal(store.mass.amin(1))
    # The middle of each item.
    u = (store.mass.cumsum(1) - store.mass / 2) / store.mass.sum(1, keepdim=True)
    assert store.draw(u)[0].equal(everything)


@KINDS
def test_items_without_mass_are_never_drawn(kind, monkeypatch):
    narrow(kind, monkeypatch)
    rng = np.random.default_rng(8)
    # And the ends of u's range.
    border = torch.tensor([2.0**-33, 0.5, 1 - 2.0**-33], dtype=torch.float64)
    u = torch.cat([border, torch.from_numpy(rng.random(2000))]).repeat(L, 1)
    for trial in range(40):
        capacity = int(rng.integers(3, 90))
        mass = 10.0 ** rng.uniform(-12, 12 * (trial % 2), (L, capacity))  # sums that round
        mass[rng.random((L, capacity)) < 0.5] = 0.0
        mass[:, -1] = 0.0
        mass[:, capacity // 2] = 1e-12
        store = kind(L, capacity)
        store.write(torch.arange(capacity).repeat(L, 1), torch.from_numpy(mass))
        assert (store.draw(u)[1] > 0).all()
        assert frequencies(store, 500, trial)[mass == 0].sum() == 0


@KINDS
def test_a_lane_does_not_feel_its_neighbour(kind):
    u = torch.rand(L, 50, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    mass = torch.rand(L, 70, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    both, alone = kind(L, 70), kind(1, 70)
    both.write(torch.arange(70).repeat(L, 1), mass)
    alone.write(torch.arange(70)[None], mass[1:])
    assert both.draw(u)[0][1:].equal(alone.draw(u[1:])[0])


@KINDS
def test_the_effective_sample_size_is_the_share_that_counts(kind):
    store = kind(L, 8)
    store.write(
        torch.arange(4).repeat(L, 1), torch.tensor([[2.0] * 4, [1.0, 0.0, 0.0, 1.0]]).double()
    )
    assert priorities.effective_sample_size(store.mass, 4).tolist() == [1.0, 0.5]


def test_the_entropy_of_draws_by_hand():
    """Of chances 1/2, 1/4, 1/8, 1/8 it is 7/4 log 2, and log 4 = 2 log 2."""
    mass = torch.tensor([[4.0, 2.0, 1.0, 1.0, 0.0], [3.0] * 4 + [0.0], [0.0] * 5]).double()
    assert priorities.entropy(mass, 4).tolist() == pytest.approx([7 / 8, 1.0, 0.0])
    assert priorities.entropy(mass * 1e-200, 4).tolist() == pytest.approx([7 / 8, 1.0, 0.0])


def hyper_of(alpha, epsilon):
    return {"alpha": torch.tensor(alpha), "epsilon": torch.tensor(epsilon)}


def test_what_is_written_is_finite_and_its_faults_are_marked():
    nan, inf = torch.nan, torch.inf
    p = torch.tensor([0.5, nan, inf, -inf, -1.0, -0.0, 3.0])
    found = priorities.masses(priorities.proportional, p, hyper_of(2.0, 0.5))
    assert found[[0, 1, 3, 5, 6]].tolist() == [1.0, 0.25, 0.25, 0.25, 12.25]
    assert found[2].isfinite() and found[2] > 1e50 and found[4] == priorities.NEGATIVE_P

    def own(p, hyper):
        return torch.tensor([1.5, nan, inf, -inf, 2.0, -0.25, -1e300])  # float32

    found = priorities.masses(own, p, {})
    assert found.dtype == torch.float64
    assert found.tolist() == [1.5, 0.0, priorities.LARGEST, 0.0, -2.0, -1.0, 0.0]
    ordinary = torch.rand(50)
    both = [of(ordinary, hyper_of(0.6, 0.01)) for of in (priorities.proportional, bounded)]
    assert both[0].equal(both[1])  # to the bit


def bounded(p, hyper):
    return priorities.masses(priorities.proportional, p, hyper)


@KINDS
@pytest.mark.parametrize("alpha", [1e4, 50.0])
def test_a_mass_that_overflows_stays_in_its_lane(kind, alpha):
    lanes, items = 3, 700
    p = torch.rand(lanes, items, generator=torch.Generator().manual_seed(4)) + 1e3
    hyper = {"alpha": torch.tensor([[0.6], [alpha], [0.6]]), "epsilon": torch.tensor(0.01)}
    u = torch.rand(lanes, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    wild, calm = kind(lanes, items), kind(lanes, items)
    for store, exponent in ((wild, alpha), (calm, 0.6)):
        hyper["alpha"][1] = exponent
        store.write(torch.arange(items).repeat(lanes, 1), bounded(p, hyper))
    results = []
    for store in (wild, calm):
        index, mass = store.draw(u)
        weight = priorities.importance_weights(mass, store.smallest(), torch.full((lanes, 1), 0.5))
        share = priorities.effective_sample_size(store.mass, items)
        assert (index >= 0).all() and (index < items).all() and (mass > 0).all()
        assert weight.isfinite().all() and ((share > 0) & (share <= 1 + 1e-9)).all()
        results.append((index, mass, weight, share, store.total(), store.largest()))
    for one, other in zip(*results, strict=True):
        assert one[[0, 2]].equal(other[[0, 2]]) and one[1].isfinite().all()
    if alpha == 1e4:  # all are at the bound, so all count alike
        assert results[0][3][1] == pytest.approx(1.0)


@KINDS
def test_masses_that_underflow_are_counted_or_are_none(kind):
    store, items = kind(L, 40), torch.arange(4).repeat(L, 1)
    store.write(items, torch.tensor([[1e-200] * 4, [0.0] * 4], dtype=torch.float64))
    share = priorities.effective_sample_size(store.mass, 4)
    assert share.tolist() == pytest.approx([1.0, 0.0])
    index, mass = store.draw(torch.tensor([[0.1, 0.6, 0.9]] * L).double())
    assert index.tolist() == [[0, 2, 3], [0, 0, 0]]
    weight = priorities.importance_weights(mass, store.smallest(), torch.full((L, 1), 0.5))
    assert weight.eq(1).all()  # also where nothing has a mass


@KINDS
@pytest.mark.parametrize(("alpha", "beta"), [(0.6, 0.4), (1.0, 1.0), (0.3, 0.7), (0.8, 0.0)])
def test_importance_weights_are_cpprbs(kind, alpha, beta):
    cpprb = pytest.importorskip("cpprb", reason="cpprb has no wheels for Python 3.13 and later")
    items, epsilon = 37, 0.02
    p = np.random.default_rng(4).exponential(size=items) + 0.05
    reference = cpprb.PrioritizedReplayBuffer(64, {"obs": {"shape": 1}}, alpha=alpha, eps=epsilon)
    reference.add(obs=np.arange(items), priorities=p)
    store = kind(L, 64)
    mass = mass_of(torch.from_numpy(p), torch.tensor(alpha), torch.tensor(epsilon)).repeat(L, 1)
    mass[0] *= 7.0  # weights do not depend on the unit of the masses
    store.write(torch.arange(items).repeat(L, 1), mass)
    chances = items * mass[1].numpy() / mass[1].sum().item()
    by_hand = chances**-beta / (chances**-beta).max()  # Schaul et al. 2016, section 3.4
    largest = []
    for _ in range(30):
        theirs = reference.sample(4, beta=beta)
        drawn = store.mass[:, torch.from_numpy(theirs["indexes"].astype(int))]
        ours = priorities.importance_weights(drawn, store.smallest(), torch.full((L, 1), beta))
        assert ours.dtype == torch.float32 and ours.shape == (L, 4)
        for lane in ours.numpy():
            np.testing.assert_allclose(lane, theirs["weights"], rtol=2e-5)
            np.testing.assert_allclose(lane, by_hand[theirs["indexes"].astype(int)], rtol=2e-5)
        largest.append(ours.max().item())
    assert beta == 0 or min(largest) < 0.95  # the largest is that of the buffer, not of the draw


def test_lap_by_hand():
    """max(p, 1)^alpha, with an alpha of each lane; what is no number counts as 0, so as 1."""
    p = torch.tensor([[0.0, 1.0, 4.0], [float("nan"), 0.999, 16.0]])
    found = priorities.lap(p, {"alpha": torch.tensor([[0.5], [0.25]])})
    assert found.dtype == torch.float64 and found.tolist() == [[1.0, 1.0, 2.0], [1.0, 1.0, 2.0]]


def test_reliability_by_hand():
    """The ring holds, from the oldest on: 1 | 2 2 | 3 1 4, with ends at |; the last goes on.

    Its sum is 8, the largest there is.
    """
    stored = torch.tensor([[1.0, 4.0, 1.0, 2.0, 2.0, 3.0, 9.0, 9.0]]).double()
    ends = torch.tensor([[False, False, True, False, True, False]])
    hyper = {"alpha": torch.tensor([1.0]), "omega": torch.tensor([0.5])}
    found = priorities.by_reliability(stored, ends, torch.tensor(6), torch.tensor(1), hyper)
    expected = [1 * (4 / 8) ** 0.5, 4.0, 1.0, 2 * 0.5**0.5, 2.0, 3 * (3 / 8) ** 0.5, 0, 0]
    assert found[0].tolist() == pytest.approx(expected)
    # The same before the ring is full: 1 4 1 | 2 and room for more; 4 items, the newest is 3.
    found = priorities.by_reliability(stored, ends, torch.tensor(4), torch.tensor(3), hyper)
    expected = [1 * (1 / 6) ** 0.5, 4 * (5 / 6) ** 0.5, 1.0, 2 * (2 / 6) ** 0.5, 0, 0, 0, 0]
    assert found[0].tolist() == pytest.approx(expected)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 9), st.integers(0, 20))
def test_reliability_as_the_twin(seed, capacity, later):
    """Episodes as lists; R is 1 minus the share of what comes after."""
    rng, stored_so_far = np.random.default_rng(seed), 1 + later
    size, newest = min(stored_so_far, capacity), (stored_so_far - 1) % capacity
    d = rng.integers(0, 4, (L, capacity + 3)).astype(float)
    ends, hyper = rng.random((L, capacity)) < 0.3, rng.uniform(0, 2, (2, L))
    given = {"alpha": torch.from_numpy(hyper[0]), "omega": torch.from_numpy(hyper[1])}
    found = priorities.by_reliability(
        torch.from_numpy(d), torch.from_numpy(ends), torch.tensor(size), torch.tensor(newest), given
    )
    for lane in range(L):
        order = [(newest - age) % capacity for age in reversed(range(size))]
        episodes = [[]]
        for i in order:
            episodes[-1].append(i)
            if ends[lane, i]:
                episodes.append([])
        sums = [sum(d[lane, i] for i in episode) for episode in episodes]
        expected = np.zeros(capacity + 3)
        for number, episode in enumerate(episodes):
            goes_on = number == len(episodes) - 1
            whole = max(sums) if goes_on else sums[number]
            upto = 0.0
            for i in episode:
                upto += d[lane, i]
                reliability = 1 - (whole - upto) / whole if whole > 0 else 1.0
                expected[i] = d[lane, i] ** hyper[0, lane] * reliability ** hyper[1, lane]
        np.testing.assert_allclose(found[lane], expected, rtol=1e-9, atol=1e-12)


def test_inverse_masses_are_the_authors():
    """LA3P's sample_actor: the sum over each priority; the last two are not stored yet."""
    mass = torch.tensor([[1.0, 4.0, 2.5, 0.0, 0.0], [3.0, 3.0, 6.0, 0.0, 0.0]]).double()
    found = priorities.inverse(mass, torch.tensor(3))
    for lane in range(2):
        tree = mass[lane].numpy()
        expected = tree.sum() / (tree[:3] + 1e-6)
        assert found[lane].tolist() == pytest.approx([*expected, 0.0, 0.0])


def test_masses_by_rank_by_hand():
    """The last two are not stored yet; of the equal ones the first has the better rank."""
    stored = torch.tensor([[3.0, 0.0, 7.0, 3.0, 9.0, 0.0]] * 2, dtype=torch.float64)
    alpha = {"alpha": torch.tensor([1.0, 0.5])}
    found = priorities.by_rank(stored, stored > 9, torch.tensor(4), torch.tensor(3), alpha)
    assert found[0].tolist() == [1 / 2, 1 / 4, 1.0, 1 / 3, 0.0, 0.0]
    assert found[1].tolist() == pytest.approx([2**-0.5, 0.5, 1.0, 3**-0.5, 0.0, 0.0])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 9))
def test_masses_by_rank_as_the_twin(seed, size):
    rng, capacity = np.random.default_rng(seed), 9
    stored, alpha = rng.integers(0, 5, (L, capacity)).astype(float), rng.uniform(0, 2, L)
    items, given = torch.from_numpy(stored), {"alpha": torch.from_numpy(alpha)}
    found = priorities.by_rank(items, items > 9, torch.tensor(size), torch.tensor(0), given)
    for lane in range(L):
        order = sorted(range(size), key=lambda i: -stored[lane, i])
        expected = [(order.index(i) + 1) ** -alpha[lane] for i in range(size)]
        assert found[lane].tolist() == pytest.approx(expected + [0.0] * (capacity - size))
