"""Bootstrap rules: rewards are 1 and observations tell their number, so returns can be read off by
hand.
"""

import numpy as np
import pytest
import torch
from scipy import stats

from aser.lanes import batched
from aser.replay import bootstrap
from aser.replay.bootstrap import Path
from aser.replay.storage import Layout, Storage, read_window

END, CUT = 1, 2  # terminated, truncated
GAMMA = 0.5


def ring(capacity, stored, ends=None):
    """Transition i goes from observation i to i + 1, or to i + 0.5 where its episode ends; rewards
    are 1.
    """
    storage = Storage(Layout(1, 1), 1, capacity)
    for i in range(stored):
        end = (ends or {}).get(i, 0)
        row = {"obs": i, "reward": 1, "next_obs": i + (0.5 if end else 1)}
        row |= {"terminated": end == END, "truncated": end == CUT}
        storage.append(torch.tensor([[float(row.get(name, 0)) for name in storage.layout.columns]]))
    return storage


def windows(storage, index, width):
    return read_window(
        storage.rows[0], storage.layout, torch.tensor(index), width, storage.clock(0, 1).newest
    )


def path_of(window, **known):
    """What a rule is handed: zeros for what it does not read, and no threshold, unless `known` says
    otherwise.
    """
    first, skipped = window.reward[0], window.reward[1:]
    whole = Path(
        window, {}, torch.zeros_like(first), torch.zeros_like(skipped), torch.tensor(torch.nan)
    )
    return whole._replace(**known)


def unrolled(storage, index, rule, h, width=None):
    """(n, R, discount, the state bootstrapped from) of each item, as lists."""
    window = windows(storage, index, width or h)
    n = bootstrap.unroll_lengths(rule(path_of(window)), window.last, torch.tensor(float(h)))
    entropy = torch.zeros_like(window.reward[1:])
    reward, discount, final = bootstrap.fold(window, n, torch.tensor(GAMMA), entropy)
    state = storage.layout.read(storage.rows[0, final], "next_obs")
    return [x.tolist() for x in (n, reward, discount, state)]


def test_fixed_inside_an_episode():
    assert unrolled(ring(9, 9), [0, 4], bootstrap.fixed, 3) == [
        [3, 3],
        [1.75, 1.75],
        [0.125, 0.125],
        [3, 7],
    ]


def test_a_terminal_ends_the_unroll_and_has_no_value():
    found = unrolled(ring(9, 9, {4: END}), [4, 3, 2, 1, 5], bootstrap.fixed, 3)
    assert found == [
        [1, 2, 3, 3, 3],
        [1, 1.5, 1.75, 1.75, 1.75],
        [0, 0, 0, 0.125, 0.125],
        [4.5, 4.5, 4.5, 4, 8],
    ]


def test_a_truncation_ends_the_unroll_and_bootstraps_from_the_final_observation():
    found = unrolled(ring(9, 9, {4: CUT}), [4, 3, 2, 1, 5], bootstrap.fixed, 3)
    assert found == [
        [1, 2, 3, 3, 3],
        [1, 1.5, 1.75, 1.75, 1.75],
        [0.5, 0.25, 0.125, 0.125, 0.125],
        [4.5, 4.5, 4.5, 4, 8],
    ]


def test_no_unroll_passes_the_newest_item():
    found = unrolled(ring(9, 6), [5, 4, 3, 2], bootstrap.fixed, 3)
    assert found == [[1, 2, 3, 3], [1, 1.5, 1.75, 1.75], [0.5, 0.25, 0.125, 0.125], [6, 6, 6, 5]]


def test_an_unroll_goes_over_the_end_of_the_ring_but_not_over_its_seam():
    storage = ring(7, 10)  # indices hold transitions 7 8 9 3 4 5 6; the newest is 9, at index 2
    found = unrolled(storage, [5, 6, 0, 1, 2, 3], bootstrap.fixed, 4)
    assert found[0] == [4, 4, 3, 2, 1, 4]
    assert found[3] == [9, 10, 10, 10, 10, 7]


def test_a_window_as_wide_as_the_ring_holds_every_item_once():
    assert unrolled(ring(3, 4), [1, 2, 0], bootstrap.fixed, 3)[0] == [3, 2, 1]


def test_one_step_is_plain():
    storage = ring(7, 10, {8: END, 5: CUT})
    index = list(range(7))
    for width in (1, 5):  # a wider window with h = 1 is the same
        n, reward, discount, state = unrolled(storage, index, bootstrap.fixed, 1, width)
        rows = storage.rows[0]
        assert n == [1] * 7 and reward == storage.layout.read(rows, "reward").tolist()
        assert discount == [
            GAMMA * (1 - x) for x in storage.layout.read(rows, "terminated").tolist()
        ]
        assert state == storage.layout.read(rows, "next_obs").tolist()


def test_h_may_be_smaller_than_the_window():
    storage, index = ring(11, 14, {6: END, 9: CUT}), list(range(11))
    for h in range(1, 6):
        assert unrolled(storage, index, bootstrap.fixed, h, 5) == unrolled(
            storage, index, bootstrap.fixed, h
        )


def below(p, b):
    """The threshold rule with p(s_1) ... and b given: p (H-1, B), or a function of the path."""
    return lambda path: bootstrap.threshold(
        path._replace(p=p(path) if callable(p) else torch.tensor(p), b=torch.tensor(b))
    )


def test_a_threshold_never_crossed_is_fixed_n_and_one_crossed_at_once_is_one_step():
    storage, index = ring(11, 14, {6: END, 9: CUT}), list(range(11))

    def threshold(b):
        obs = storage.layout.read(storage.rows[0], "obs")
        return below(lambda path: obs[path.window.at[:-1]], b)

    never, at_once = threshold(99.0), threshold(0.0)
    assert unrolled(storage, index, never, 4) == unrolled(storage, index, bootstrap.fixed, 4)
    assert unrolled(storage, index, at_once, 4) == unrolled(storage, index, bootstrap.fixed, 1)


def test_a_threshold_stops_at_the_first_state_that_reaches_it():
    # p(s_1), p(s_2), p(s_3) of four items in columns, against b = 2: only what is below is passed
    rule = below([[1.0, 2.0, 1.9, 1.0], [1.0, 0.0, 2.1, 2.0], [1.0, 0.0, 0.0, 9.0]], 2.0)
    assert unrolled(ring(9, 9), [0, 1, 2, 3], rule, 4)[0] == [4, 1, 2, 2]


def test_where_the_threshold_is_zero_a_criterion_of_zero_may_be_passed():
    p, b = torch.tensor([[0.0, 0.0, 0.3], [0.0, 0.2, 0.0], [0.0, 0.0, 0.0]]), torch.tensor(0.0)

    def lengths(rule):
        return unrolled(ring(9, 9), [0, 1, 2], lambda path: rule(path._replace(p=p, b=b)), 4)[0]

    assert lengths(bootstrap.threshold) == [1, 1, 1]
    assert lengths(bootstrap.threshold_or_zero) == [4, 2, 1]


def test_a_criterion_that_is_not_a_number_stops_the_unroll():
    rule = below([[torch.nan, 1.0], [1.0, 1.0]], 2.0)
    assert unrolled(ring(9, 9), [0, 1], rule, 3)[0] == [1, 3]


def test_where_there_is_no_threshold_nothing_passes_it():
    path = path_of(windows(ring(9, 9), [0, 1], 3))
    assert path.b.isnan() and not bootstrap.threshold(path).any()


def test_the_rules_are_found_by_the_names_of_the_settings():
    rules = ["fixed", "threshold", "threshold_or_zero", "geometric", "cumulative"]
    assert list(bootstrap.RULES) == rules
    assert list(bootstrap.MIXTURES) == ["averaged", "preferential"]
    every = bootstrap.RULES | bootstrap.MIXTURES
    assert all(rule is getattr(bootstrap, name) for name, rule in every.items())


def summed(p, h, ends=None, index=(0, 1, 2), stored=9):
    """n of the rule `cumulative` for items of a ring, where p (H-1, B) are the criterion's values.

    The windows are as wide as p, and h may be shorter.
    """
    window = windows(ring(stored, stored, ends), list(index), len(p) + 1)
    hyper = {"h": torch.tensor(float(h))}
    go_on = bootstrap.cumulative(path_of(window, p=torch.tensor(p), hyper=hyper))
    return bootstrap.unroll_lengths(go_on, window.last, hyper["h"]).tolist()


def test_cumulative_by_hand():
    """The largest p is 4, so 1 and 2 count as quarters of it."""
    p = [[1.0, 2.0, 4.0], [2.0, 2.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    assert summed(p, 5) == [3, 2, 1]
    assert summed(p, 2) == [2, 2, 1]
    # Where no p is positive, nothing stops the unroll.
    assert summed([[0.0] * 3] * 4, 5) == [5, 5, 5]


def test_what_no_unroll_can_reach_sets_no_scale():
    beyond = [[1.0, 1.0, 1.0], [1.0, 1.0, 8.0], [1.0, 8.0, 8.0]]
    # The episode ends with item 2: item 1 has two steps, and item 2 has one.
    assert summed(beyond, 4, ends={2: END}) == [1, 1, 1]
    # p beyond h of this lane is of no account either: here 1 is the largest.
    assert summed([[0.5, 0.5, 0.25], [1.0, 0.5, 0.5], [8.0, 8.0, 8.0]], 3) == [2, 2, 3]


def test_cumulative_as_the_twin():
    rng = np.random.default_rng(8)
    for _ in range(60):
        h, stored = int(rng.integers(1, 7)), 30
        ends = {int(i): int(rng.choice([END, CUT])) for i in rng.integers(0, stored, 4)}
        index = rng.integers(0, stored, 11).tolist()
        p = rng.choice([0.0, 0.125, 0.25, 0.5, 2.0], (6, 11)).astype(np.float32)
        most, reach = 0.0, []  # how many steps each item may take
        for start in index:
            n = 1
            while n < h and start + n < stored and start + n - 1 not in ends:
                n += 1
            reach.append(n)
        for column, n in enumerate(reach):
            most = max([most, *p[: n - 1, column].tolist()])
        expected = []
        for column, longest in enumerate(reach):
            n, total = 1, p[0, column]
            while n < longest and (most == 0 or total < most):
                total += p[n, column] if n < len(p) else 0.0
                n += 1
            expected.append(n)
        assert summed(p.tolist(), h, ends, index, stored) == expected


def mixed(storage, index, rule, h, values, width=None, p=None):
    """The targets and the mean steps of a mixture, where V(observation x) is `values(x)`."""
    window = windows(storage, index, width or h)
    hyper, entropy = {"h": torch.tensor(float(h))}, torch.zeros_like(window.reward[1:])
    p = entropy if p is None else torch.tensor(p)
    share = rule(path_of(window, hyper=hyper, p=p))
    gamma = torch.tensor(GAMMA)
    reach = bootstrap.reach(window, share, hyper["h"])
    reward, discount = bootstrap.mix(window, reach, gamma, entropy)
    value = values(storage.layout.read(storage.rows[0, window.at], "next_obs"))
    return (reward + (discount * value).sum(0)).tolist(), reach.sum(0).tolist()


def value_of(x):
    return 3.0 + torch.sin(x)


def test_averaged_is_the_mean_of_the_n_step_targets():
    """Of fixed n = 1 ... h; h is below the width of the window, too, and episodes end."""
    storage, index = ring(30, 30, {4: END, 11: CUT, 12: END}), [0, 2, 4, 9, 10, 12, 20, 27, 29]
    for h, width in ((1, 1), (2, 2), (5, 5), (3, 6)):
        targets, steps = [], []
        for n in range(1, h + 1):
            taken, reward, discount, state = unrolled(storage, index, bootstrap.fixed, n)
            value = value_of(torch.tensor(state))
            targets.append(torch.tensor(reward) + torch.tensor(discount) * value)
            steps.append(taken)
        found, n = mixed(storage, index, bootstrap.averaged, h, value_of, width)
        assert found == pytest.approx(torch.stack(targets).mean(0).tolist(), rel=1e-5)
        assert n == pytest.approx(np.mean(steps, 0))


def test_preferential_by_its_recursion():
    """G = r + gamma (b V(s') + (1 - b) G'), from the end of each window backwards."""
    rng, ends = np.random.default_rng(3), {4: END, 11: CUT, 12: END}
    storage, index, h = ring(30, 30, ends), [0, 2, 4, 9, 10, 12, 20, 27, 29], 5
    p = rng.choice([0.0, 0.5, 1.0, 2.0], (h - 1, len(index))).astype(np.float32)
    p[0, 0] = 2.0  # the largest, where it counts: b is p / 2

    def g(start, column, step):
        i = start + step
        value = 0.0 if ends.get(i) == END else value_of(torch.tensor(i + (0.5 if i in ends else 1)))
        if i in ends or i == 29 or step == h - 1:
            return 1 + GAMMA * value
        b = p[step, column] / 2
        return 1 + GAMMA * (b * value + (1 - b) * g(start, column, step + 1))

    found, n = mixed(storage, index, bootstrap.preferential, h, value_of, p=p)
    expected = [float(g(start, column, 0)) for column, start in enumerate(index)]
    assert found == pytest.approx(expected, rel=1e-5)
    assert n[0] == 1 and n[2] == n[5] == n[8] == 1 and max(n) <= h


def test_preferential_is_the_recursion_of_td_errors_of_its_paper():
    """error(s) = delta + gamma (1 - b(s')) error(s'), as preferential TD sums its gated trace
    (Anand & Precup, 2021): the target is V(s) + error(s).
    """
    h, last, b = 5, 8, np.random.default_rng(5).random(4).astype(np.float32)
    b[0] = 1.0  # the largest of the first item, which bootstraps at once
    p = np.stack([b, np.roll(b, 2)], 1)  # (h - 1, items)
    value = [float(value_of(torch.tensor(float(i)))) for i in range(last + 1)]
    delta = [1 + GAMMA * value[i + 1] - value[i] for i in range(last)]
    expected = []
    for start in (0, 3):
        error = delta[start + h - 1]
        for step in reversed(range(h - 1)):
            error = delta[start + step] + GAMMA * (1 - p[step, start // 3]) * error
        expected.append(value[start] + error)
    found, _ = mixed(ring(30, 20), [0, 3], bootstrap.preferential, h, value_of, p=p)
    assert found == pytest.approx(expected, rel=1e-5)


def test_a_preference_of_0_or_1_is_a_rule():
    """Where b is 0 or 1, the target is that of the threshold rule: ASER's oracle."""
    storage, index = ring(30, 30, {4: END, 17: CUT}), list(range(0, 30, 3))
    p = (np.random.default_rng(4).random((5, len(index))) < 0.4).astype(np.float32)
    p[0, 1] = 1.0
    window = windows(storage, index, 6)
    below = bootstrap.threshold(path_of(window, p=torch.tensor(p), b=torch.tensor(0.5)))
    n = bootstrap.unroll_lengths(below, window.last, torch.tensor(6.0))
    entropy = torch.zeros_like(window.reward[1:])
    reward, discount, final = bootstrap.fold(window, n, torch.tensor(GAMMA), entropy)
    expected = reward + discount * value_of(storage.layout.read(storage.rows[0, final], "next_obs"))
    found, mean = mixed(storage, index, bootstrap.preferential, 6, value_of, p=p)
    assert found == pytest.approx(expected.tolist(), rel=1e-6) and mean == n.tolist()
    assert bootstrap.preferential(path_of(window, hyper={"h": torch.tensor(6.0)})).eq(1).all()


def test_what_lies_beyond_an_end_is_never_felt_by_a_mixture_and_entropy_has_its_share():
    storage = ring(9, 9, {1: END})
    storage.rows[0, 2:5, storage.layout.columns["reward"]] = torch.inf
    window, h = windows(storage, [0], 4), torch.tensor(4.0)
    entropy = torch.tensor([[8.0], [torch.nan], [torch.nan]])
    share = torch.tensor([[0.25], [0.5], [0.5]])
    reach = bootstrap.reach(window, share, h)
    reward, discount = bootstrap.mix(window, reach, torch.tensor(GAMMA), entropy)
    assert reward.tolist() == [1 + 0.25 * GAMMA * 9] and reach.sum(0).tolist() == [1.25]
    assert discount[:, 0].tolist() == [0.75 * GAMMA, 0.0, 0.0, 0.0]


def test_fold_adds_the_path_entropy_at_skipped_states_only():
    storage = ring(9, 9, {6: END})
    window = windows(storage, [0, 2, 4, 5], 4)
    n = torch.tensor([1, 4, 3, 2])
    entropy = torch.tensor([[8.0] * 4, [16.0] * 4, [32.0] * 4])
    reward, discount, final = bootstrap.fold(window, n, torch.tensor(GAMMA), entropy)
    # the reward of each step is 1; 8/2 at s_1, 16/4 at s_2, 32/8 at s_3
    assert reward.tolist() == [1, 1.875 + 4 + 4 + 4, 1.75 + 4 + 4, 1.5 + 4]
    assert discount.tolist() == [0.5, 0.0625, 0, 0] and final.tolist() == [0, 5, 6, 6]


def test_what_lies_beyond_an_end_is_never_felt():
    storage = ring(9, 9, {4: END})
    storage.rows[0, 5:, storage.layout.columns["reward"]] = torch.nan
    storage.rows[0, 5:, storage.layout.columns["terminated"]] = torch.nan
    window = windows(storage, [2, 3], 6)
    go_on = bootstrap.fixed(path_of(window))
    n = bootstrap.unroll_lengths(go_on, window.last, torch.tensor(6.0))
    wild = torch.full((5, 2), 1.0)
    wild[2:] = torch.inf
    reward, discount, final = bootstrap.fold(window, n, torch.tensor(GAMMA), wild * 2)
    assert reward.tolist() == [1 + 1.5 + 0.75, 1 + 1.5] and discount.tolist() == [0, 0]


@pytest.mark.parametrize("lam", [0.3, 0.8])
def test_geometric_lengths_have_their_distribution(lam):
    h, width, drawn = 5, 7, 40_000
    u = torch.rand(drawn, generator=torch.Generator().manual_seed(11))
    storage = ring(20, 20)
    window = windows(storage, [2] * drawn, width)
    go_on = bootstrap.geometric(path_of(window, hyper={"lam": torch.tensor(lam)}, u=u))
    n = bootstrap.unroll_lengths(go_on, window.last, torch.tensor(float(h)))
    counts = np.bincount(n.numpy(), minlength=h + 1)
    assert len(counts) == h + 1 and counts[0] == 0
    expected = [(1 - lam) * lam ** (j - 1) for j in range(1, h)] + [lam ** (h - 1)]
    assert stats.chisquare(counts[1:], drawn * np.array(expected)).pvalue > 1e-3


def test_geometric_at_its_borders():
    window = windows(ring(9, 9), [0, 1, 2], 4)
    u = torch.tensor([0.0001, 0.5, 0.9999])
    for lam, passes in [(0.0, False), (1.0, True)]:
        path = path_of(window, hyper={"lam": torch.tensor(lam)}, u=u)
        assert bootstrap.geometric(path).tolist() == [[passes] * 3] * 3


@pytest.mark.parametrize("k", [0.0, 0.137, 0.25, 0.5, 0.8531, 1.0])
@pytest.mark.parametrize("count", [1, 2, 5, 12, 13])
def test_quantile_is_numpys_and_torchs(k, count):
    rng = np.random.default_rng(count)
    values = rng.normal(size=13).astype(np.float32)
    values[rng.random(13) < 0.3] = 0.7  # ties
    valid = np.zeros(13, bool)
    valid[rng.permutation(13)[:count]] = True
    found = bootstrap.quantile(torch.from_numpy(values), torch.from_numpy(valid), torch.tensor(k))
    assert found.dtype == torch.float32
    assert found.item() == pytest.approx(np.quantile(values[valid], k), abs=1e-6)
    assert found.item() == pytest.approx(
        torch.from_numpy(values[valid]).quantile(k).item(), abs=1e-6
    )


def test_quantile_of_nothing_lets_nothing_pass_and_k_stays_within_its_bounds():
    values, all_of_them = torch.tensor([3.0, 1.0, 2.0]), torch.ones(3, dtype=torch.bool)
    b = bootstrap.quantile(values, ~all_of_them, torch.tensor(0.5))
    path = path_of(windows(ring(9, 9), [0, 1, 2], 2), p=values[None], b=b)
    assert b == -torch.inf and not bootstrap.threshold(path).any()
    assert bootstrap.quantile(values, all_of_them, torch.tensor(1.7)) == 3.0
    assert bootstrap.quantile(values, all_of_them, torch.tensor(-0.2)) == 1.0


def test_quantile_of_many_lanes_is_that_of_each():
    g = torch.Generator().manual_seed(0)
    values, valid = torch.rand(3, 7, generator=g), torch.rand(3, 7, generator=g) < 0.6
    valid[1] = False
    k = torch.tensor([0.1, 0.5, 0.9])
    many = batched(bootstrap.quantile)(values, valid, k)
    assert many.tolist() == [
        bootstrap.quantile(*lane).item() for lane in zip(values, valid, k, strict=True)
    ]
