"""Running means and variances against a dictionary of lists of outcomes, and cases by hand."""

from collections import defaultdict

import pytest
import torch

from aser import native
from aser.compiled import compiled, why_not_compiled
from aser.lanes import batched
from aser.replay import moments

CPU = torch.device("cpu")
SIZES = [[3], [1], [3, 1], [2, 5, 1]]  # numbers of each part
RATES = [0.05, 0.3, 1.0]
PLAIN, CPP = "plain", "operator"


@pytest.fixture(params=[PLAIN, CPP])
def observed(request, monkeypatch):
    """The table after `moments.observe`, on either of its ways; the one before is kept."""
    if request.param == PLAIN:
        monkeypatch.setattr(native, "library", lambda: None)
    elif native.library() is None:
        pytest.skip("nothing can be compiled here")
    assert native.serves(torch.zeros(1)) == (request.param == CPP)

    def after(table, place, outcomes, sizes, rate):
        table = table.clone()
        moments.observe(table, place, outcomes, sizes, rate)
        return table

    return after


class Lists:
    """A list of outcomes for each place; means and variances are sums over the lists."""

    def __init__(self, sizes, rate):
        self.sizes, self.rate, self.seen = sizes, rate, defaultdict(list)

    def add(self, place, outcomes):
        for at, outcome in zip(place.tolist(), outcomes.T.double(), strict=True):
            self.seen[at].append(outcome)

    def row(self, at):
        """The visits, the means and the variance of each part."""
        values = torch.stack(self.seen[at])  # (n, D)
        n, rate = len(values), self.rate
        # The first one is the mean that the others move.
        weight = torch.tensor(
            [(rate if i else 1.0) * (1.0 - rate) ** (n - 1 - i) for i in range(n)],
            dtype=torch.float64,
        )
        assert weight.sum().item() == pytest.approx(1.0)
        mean = weight @ values
        each = weight @ (values - mean).square()  # (D,)
        parts = torch.stack([part.sum() for part in each.split(self.sizes)])
        return torch.cat([torch.tensor([n]), mean, parts]).float()


def random_outcomes(seed, count, places, numbers):
    """Places (B,) and outcomes (D, B): unlike numbers, not around zero."""
    g = torch.Generator().manual_seed(seed)
    place = torch.randint(places, (count,), generator=g)
    spread = torch.arange(1, numbers + 1)[:, None] * torch.randn(numbers, count, generator=g)
    return place, spread + 5.0


@pytest.mark.parametrize("sizes", SIZES, ids=str)
@pytest.mark.parametrize("rate", RATES)
def test_a_table_is_a_dictionary_of_lists(observed, sizes, rate):
    lists, table = Lists(sizes, rate), moments.empty(11, sizes, CPU)
    assert table.shape == (11, 1 + sum(sizes) + len(sizes))
    for seed, count in enumerate([1, 17, 40, 2, 33]):
        # 2 to 6 of the 11 places, so that many outcomes share one.
        place, outcomes = random_outcomes(seed, count, 2 + seed, sum(sizes))
        lists.add(place, outcomes)
        table = observed(table, place, outcomes, sizes, rate)
        for at in range(11):
            expected = lists.row(at) if at in lists.seen else torch.zeros(table.shape[1])
            torch.testing.assert_close(table[at], expected, rtol=1e-4, atol=1e-4)
    assert table[:, 0].sum() == 93 and table[:, 0].max() > 20 and table[6:].count_nonzero() == 0
    if rate == 1.0:  # only the last outcome counts
        assert table[:, -len(sizes) :].max() < 1e-3
    else:
        assert (table[:6, -len(sizes) :].amax(0) > 0.1).all()


@pytest.mark.parametrize("rate", RATES)
def test_outcomes_of_one_update_are_taken_one_by_one_in_their_order(observed, rate):
    sizes, start = [2, 1], moments.empty(5, [2, 1], CPU)
    place, outcomes = random_outcomes(3, 37, 4, 3)
    whole, singly = observed(start, place, outcomes, sizes, rate), start
    for i in range(37):
        singly = observed(singly, place[i : i + 1], outcomes[:, i : i + 1], sizes, rate)
    torch.testing.assert_close(whole, singly, rtol=1e-4, atol=1e-4)
    backwards = observed(start, place.flip(0), outcomes.flip(1), sizes, rate)
    assert not torch.allclose(whole, backwards, atol=0.1)  # the order counts


def test_parts_of_a_row_are_read_by_their_number():
    sizes = [2, 1, 3]
    rows = torch.arange(2 * 10).reshape(2, 10).float()  # visits, 6 means, 3 variances
    assert [moments.means(rows, part, sizes).tolist() for part in range(3)] == [
        [[1, 2], [11, 12]],
        [[3], [13]],
        [[4, 5, 6], [14, 15, 16]],
    ]
    assert moments.variances(rows, sizes).tolist() == [[7, 8, 9], [17, 18, 19]]


# By hand


def row_after(observed, outcomes, sizes, rate):
    """The row of place 2 of 4 after these outcomes, one list each."""
    columns = torch.tensor(outcomes).T
    place = torch.full((columns.shape[1],), 2)
    table = observed(moments.empty(4, sizes, CPU), place, columns, sizes, rate)
    assert table[[0, 1, 3]].count_nonzero() == 0
    return table[2].tolist()


def test_one_outcome_has_variance_zero_however_often_it_came(observed):
    outcome = [0.37, -11.3, 4.1]
    row = row_after(observed, [outcome] * 23, [2, 1], 0.05)
    assert row[0] == 23 and row[4:] == [0.0, 0.0]  # exactly
    assert row[1:4] == torch.tensor(outcome).tolist()


def test_two_outcomes(observed):
    # The parts are (3, 4) and 2 apart: their squared distances are 25 and 4.
    one, two = [1.0, 1.0, 1.0], [4.0, 5.0, -1.0]
    row = row_after(observed, [one, two], [2, 1], 0.2)
    expected = [2, 1.6, 1.8, 0.6, 25 * 0.8 * 0.2, 4 * 0.8 * 0.2]
    assert row == pytest.approx(expected, rel=1e-5)
    # In turns for long, the one that came last has the weight 1 / (2 - rate).
    row, late = row_after(observed, [one, two] * 100, [2, 1], 0.2), 1 / 1.8
    assert row[1] == pytest.approx(1 + 3 * late, rel=1e-5)
    assert row[4:] == pytest.approx([25 * late * (1 - late), 4 * late * (1 - late)], rel=1e-4)


@pytest.mark.parametrize("count", [1, 5, 90])
def test_an_outcome_that_drifts_is_followed_and_then_forgotten(observed, count):
    row = row_after(observed, [[0.0]] * 9 + [[4.0]] * count, [1], 0.1)
    left = 0.9**count  # the weight of the old outcome
    expected = [9 + count, 4 * (1 - left), 16 * left * (1 - left)]
    assert row == pytest.approx(expected, rel=1e-4, abs=1e-5)


def test_the_last_outcome_is_all_that_counts_at_rate_one(observed):
    row = row_after(observed, [[1.0, 2.0], [-3.0, 7.0], [5.0, 0.25]], [1, 1], 1.0)
    assert row == [3.0, 5.0, 0.25, 0.0, 0.0]


# In lanes and compiled

LANES = 3


def lanes(seed, numbers):
    each = [random_outcomes(10 * seed + i, 29, 3 + i, numbers) for i in range(LANES)]
    return [torch.stack(x) for x in zip(*each, strict=True)]


def many(observed, sizes):
    return batched(lambda table, place, x: observed(table, place, x, sizes, 0.1))


def tables(sizes):
    return torch.stack([moments.empty(7, sizes, CPU)] * LANES)


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_lanes_do_not_touch_each_other(observed, sizes):
    table = tables(sizes)
    for seed in (1, 2):
        place, outcomes = lanes(seed, sum(sizes))
        alone = [observed(table[i], place[i], outcomes[i], sizes, 0.1) for i in range(LANES)]
        table = many(observed, sizes)(table, place, outcomes)
        torch.testing.assert_close(table, torch.stack(alone), rtol=1e-5, atol=1e-5)
    outcomes[1] = torch.nan
    spoilt = many(observed, sizes)(table, place, outcomes)
    sound = many(observed, sizes)(table, *lanes(2, sum(sizes)))
    assert spoilt[[0, 2]].equal(sound[[0, 2]]) and spoilt[1].isnan().any()


@pytest.mark.skipif(why_not_compiled() is not None, reason="nothing can be compiled here")
def test_compiled_it_is_the_same(observed):
    sizes = [2, 1]
    eager = fast = tables(sizes)
    function = compiled(many(observed, sizes), True)
    for seed in range(3):
        eager = many(observed, sizes)(eager, *lanes(seed, 3))
        fast = function(fast, *lanes(seed, 3))
        torch.testing.assert_close(fast, eager, rtol=1e-4, atol=1e-4)
    assert fast[:, :, 0].sum(1).tolist() == [3 * 29] * LANES
    assert function._graph is not None  # it does not run as it is


@pytest.mark.parametrize("compile", [False, True])
def test_a_table_is_changed_where_it_lies(observed, compile):
    """Compiled as well, where it would be dear to copy it."""
    if compile and why_not_compiled() is not None:
        pytest.skip("nothing can be compiled here")
    sizes = [2, 1]

    def observe(table, place, x):
        moments.observe(table, place, x, sizes, 0.1)
        return table

    function, table = compiled(batched(observe), compile), tables(sizes)
    for seed in range(3):
        place, outcomes = lanes(seed, 3)
        expected = many(observed, sizes)(table, place, outcomes)
        assert function(table, place, outcomes).data_ptr() == table.data_ptr()
        torch.testing.assert_close(table, expected, rtol=1e-4, atol=1e-4)
    assert table[:, :, 0].sum(1).tolist() == [3 * 29] * LANES
    assert not compile or function._graph is not None  # it does not run as it is
