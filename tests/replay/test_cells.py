"""Which states share a cell, which actions a kind, and where a cell lies in the table."""

import itertools

import pytest
import torch

from aser import noise
from aser.lanes import batched
from aser.noise import Stream
from aser.replay import cells

KEYS = noise.lane_keys([4, 5, 6])[:, Stream.CRITERION]
KEY = KEYS[0]


def generator(seed):
    return torch.Generator().manual_seed(seed)


def column(*values):
    return torch.tensor(values)[:, None].float()


def same_cells(one, other, key=KEY, width=0.5, tilings=7):
    """The share of tilings in which each pair of columns shares a cell."""
    one, other = (cells.of_states(x, key, width, tilings) for x in (one, other))
    return (one == other).all(1).float().mean(0)


# Cells of states


def test_a_cell_is_a_box_with_sides_of_the_width():
    def cell(*obs, width=0.4):
        (found,) = cells.of_states(column(*obs), KEY, width, 0)
        return found.flatten().tolist()

    assert cell(0.19, -0.19, 0.0) == cell(-0.19, 0.19, 0.1) == [0.0, 0.0, 0.0]
    assert cell(0.21, -0.19, 0.0) == [1.0, 0.0, 0.0]
    assert cell(0.59, -0.61, 1.2) == [1.0, -2.0, 3.0]
    assert cell(0.59, -0.61, 1.2, width=10.0) == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("tilings", [1, 7, 32])
@pytest.mark.parametrize(("numbers", "left"), [(1, 1), (2, 2), (3, 3), (10, 3)])
def test_a_state_has_a_cell_of_few_numbers_in_each_tiling(tilings, numbers, left):
    obs = torch.randn(numbers, 13, generator=generator(1))
    found = cells.of_states(obs, KEY, 0.3, tilings)
    assert found.shape == (tilings, left, 13)
    assert found.equal(found.round()) and found.equal(cells.of_states(obs, KEY, 0.3, tilings))
    whole = cells.of_states(obs, KEY, 0.3, 0)
    assert whole.shape == (1, numbers, 13)


def test_near_states_share_most_cells_and_far_ones_few():
    obs, step = torch.randn(2, 10, 300, generator=generator(2))
    step = step / step.norm(dim=0)
    # A direction sees a step of length d in 10 numbers as about 0.3 d.
    shares = [same_cells(obs, obs + d * step, tilings=16).mean().item() for d in (0, 0.05, 1, 10)]
    assert shares[0] == 1.0
    assert 0.8 < shares[1] < 0.98 and 0.02 < shares[2] < 0.4 and shares[3] < 0.01


def test_boxes_of_a_tiling_are_of_the_width_along_its_direction():
    # With one number, a direction is 1 or -1: cells of the line have the length `width`.
    line = torch.linspace(-6.0, 6.0, 12_001)[None]
    for tiling in cells.of_states(line, KEY, 0.4, 5):
        (steps,) = tiling[0].diff().nonzero(as_tuple=True)
        assert steps.diff().float().mul(0.001).sub(0.4).abs().max() < 0.0021
    edges = {
        round(line[0, tiling[0].diff().nonzero()[0, 0]].item(), 2)
        for tiling in cells.of_states(line, KEY, 0.4, 5)
    }
    assert len(edges) == 5  # each is shifted by a part of its own


def test_tilings_of_one_lane_differ_and_so_do_lanes():
    obs = 3 * torch.randn(5, 200, generator=generator(3))
    for one, other in itertools.combinations(cells.of_states(obs, KEY, 0.5, 6), 2):
        assert (one == other).all(0).float().mean() < 0.1
    lanes = [cells.of_states(obs, key, 0.5, 6) for key in KEYS]
    for one, other in itertools.combinations(lanes, 2):
        assert (one == other).all(1).float().mean() < 0.1
    together = batched(lambda key: cells.of_states(obs, key, 0.5, 6))(KEYS)
    assert (together == torch.stack(lanes)).all(2).float().mean() > 0.999  # but for rounding


# Kinds of actions


@pytest.mark.parametrize(("numbers", "kinds"), [(1, 2), (2, 8), (3, 24)])
def test_the_kind_of_an_action_is_its_signs_and_its_largest_number(numbers, kinds):
    action = torch.rand(numbers, 4000, generator=generator(4)) * 2 - 1
    found = cells.of_actions(action)
    assert found.shape == (numbers + 1, 4000)
    columns = [tuple(x) for x in found.T.tolist()]
    assert len(set(columns)) == kinds
    assert min(columns.count(kind) for kind in set(columns)) > 0.8 * 4000 / kinds
    for x, kind in zip(action.T.tolist(), columns, strict=True):
        largest = max(range(numbers), key=lambda i: abs(x[i]))
        assert kind == (*(float(number > 0) for number in x), largest)


def test_kinds_of_some_actions():
    def kind(*action):
        return cells.of_actions(column(*action)).flatten().tolist()

    assert kind(0.3, -0.9) == kind(0.8, -1.0) == [1.0, 0.0, 1.0]
    assert kind(0.9, -0.3) == [1.0, 0.0, 0.0]
    assert kind(-0.9, -0.3) == [0.0, 0.0, 0.0]
    assert kind(0.1) == kind(1.0) == [1.0, 0.0] and kind(-0.1) == [0.0, 0.0]


# Places in the table


def grid(count=20_000, numbers=3):
    """Different cells (1, M, B)."""
    number = torch.arange(count)
    return torch.stack([number // 27**i % 27 - 13 for i in range(numbers)]).float()[None]


@pytest.mark.parametrize("count", [16, 37, 64])
def test_the_hash_fills_the_table_evenly(count):
    found = cells.places(KEY, grid(19_683), count)  # all boxes around 0 of three numbers
    counts, mean = found.bincount(minlength=count), 19_683 / count
    assert len(counts) == count and found.min() >= 0
    assert ((counts - mean).abs() < 5 * mean**0.5).all()


def test_a_lane_hashes_by_a_key_of_its_own():
    each = [cells.places(key, grid(200), 4096) for key in KEYS]
    for one, other in itertools.combinations(each, 2):
        assert (one == other).sum() < 5
    together = batched(lambda key: cells.places(key, grid(200), 4096))(KEYS)
    assert together.equal(torch.stack(each))


def test_the_place_depends_on_the_cell_the_kind_and_the_tiling():
    cell = grid(50)
    one, most = cells.places(KEY, cell, 2**31), 2**31
    assert one.shape == (50,) and len(set(one.tolist())) == 50
    # The same cell, read twice, has the same place; 0 and -0 are one cell.
    assert cells.places(KEY, cell.clone(), most).equal(one)
    zero = torch.zeros(1, 2, 1)
    assert cells.places(KEY, zero, most).equal(cells.places(KEY, -zero, most))
    # All eight kinds have places of their own, and not that of the cell alone.
    action = torch.tensor([[x, y] for x in (-0.9, -0.3, 0.3, 0.9) for y in (-0.6, 0.6)]).T
    kinds = cells.of_actions(action)
    found = [cells.places(KEY, cell, most, kinds[:, [i]].expand(-1, 50)) for i in range(8)]
    assert len(set(torch.cat([one, *found]).tolist())) == 9 * 50
    # So has each tiling, whose places stand one after another.
    many = cells.places(KEY, cell.expand(4, -1, -1), most)
    assert many.shape == (4 * 50,) and len(set(many.tolist())) == 4 * 50
    third = cells.places(KEY, cell.expand(4, -1, -1)[:3], most)
    assert many[:150].equal(third)
    both = cells.places(KEY, cell.expand(4, -1, -1), most, kinds[:, [5]].expand(-1, 50))
    assert len(set(torch.cat([many, both]).tolist())) == 2 * 4 * 50
