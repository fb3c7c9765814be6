"""The ring of facts against a plain list of all that was stored, and the windows read from it."""

import pytest
import torch

from aser.replay.storage import Layout, Storage, read_window

L, OBS, ACT = 2, 3, 2


def numbered(layout, number, end=0):
    """Row `number` of every lane: each entry tells its transition, its column and its lane."""
    # (L, width)
    row = torch.arange(layout.width) / 100 + number + 1000.0 * torch.arange(L)[:, None]
    row[:, layout.columns["terminated"]] = float(end == 1)
    row[:, layout.columns["truncated"]] = float(end == 2)
    return row


def filled(capacity, stored, ends=None):
    storage = Storage(Layout(OBS, ACT), L, capacity)
    for number in range(stored):
        storage.append(numbered(storage.layout, number, (ends or {}).get(number, 0)))
    return storage


def test_every_fact_has_its_own_columns():
    layout = Layout(OBS, ACT, ("p_next", "td_error"))
    columns = [c for part in layout.columns.values() for c in range(part.start, part.stop)]
    assert columns == list(range(layout.width)) and layout.width == 2 * OBS + ACT + 3 + 2
    assert list(layout.columns)[-4:] == ["terminated", "truncated", "p_next", "td_error"]
    rows = torch.arange(5 * 7 * layout.width).reshape(5, 7, layout.width)
    start = layout.columns["next_obs"].start
    assert layout.read_vector(rows, "next_obs").shape == (OBS, 5, 7)
    for feature in range(OBS):
        assert layout.read_vector(rows, "next_obs")[feature].equal(rows[:, :, start + feature])
    assert layout.read(rows, "p_next").equal(rows[:, :, layout.width - 2])


@pytest.mark.parametrize("stored", [1, 6, 7, 8, 24])
def test_the_ring_keeps_the_latest_items_and_an_index_means_the_same_item(stored):
    capacity = 7
    storage = filled(capacity, stored)
    assert (storage.stored, storage.size) == (stored, min(stored, capacity))
    for number in range(max(0, stored - capacity), stored):
        assert storage.rows[:, number % capacity].equal(numbered(storage.layout, number))
    assert storage.rows[:, storage.newest].equal(numbered(storage.layout, stored - 1))
    assert storage.rows[:, storage.size :].eq(0).all()
    clock = storage.clock(30, 120)
    assert [x.item() for x in clock] == [30, storage.newest, storage.size, 0.25]
    assert (clock.step.dtype, clock.newest.dtype) == (torch.int32, torch.int64)


def test_append_tells_where_it_stored():
    storage = Storage(Layout(OBS, ACT), L, 3)
    assert [storage.append(numbered(storage.layout, number)) for number in range(8)] == [
        0,
        1,
        2,
    ] * 2 + [0, 1]


def test_draws_are_counted_item_by_item_and_a_new_item_starts_at_zero():
    storage = filled(5, 5)
    storage.count(
        torch.tensor([[0, 3, 3, 4], [1, 1, 1, 0]]), torch.tensor([[2, 1, 4, 3], [5, 1, 2, 7]])
    )
    storage.count(
        torch.tensor([[3, 0, 2, 2], [4, 4, 0, 1]]), torch.tensor([[1, 1, 6, 1], [2, 2, 1, 1]])
    )
    drawn = torch.tensor([[2, 0, 2, 3, 1], [2, 4, 0, 0, 2]])
    steps = torch.tensor([[3, 0, 7, 6, 3], [8, 9, 0, 0, 4]])
    assert storage.draw_count.equal(drawn.int()) and storage.unroll_sum.equal(steps.int())
    storage.append(numbered(storage.layout, 5))  # over index 0
    drawn[:, 0] = steps[:, 0] = 0
    assert storage.draw_count.equal(drawn.int()) and storage.unroll_sum.equal(steps.int())


def chronicle(storage, ends):
    """(number, index, whether an unroll must end there) of each item in the ring, in the order of
    storing.
    """
    oldest = storage.stored - storage.size
    numbers = range(oldest, storage.stored)
    return [
        (i, i % storage.capacity, ends.get(i, 0) > 0 or i == storage.stored - 1) for i in numbers
    ]


@pytest.mark.parametrize("stored", [1, 4, 9, 13, 17, 18])
@pytest.mark.parametrize("width", [1, 2, 5, 9])
def test_windows_follow_the_order_of_storing(stored, width):
    ends = {3: 1, 5: 2, 6: 1, 11: 2, 14: 1}
    storage = filled(9, stored, ends)
    items = chronicle(storage, ends)
    index = torch.tensor([index for _, index, _ in items])
    for lane in range(L):
        newest = storage.clock(0, 1).newest
        window = read_window(storage.rows[lane], storage.layout, index, width, newest)
        assert all(part.shape == (width, len(items)) for part in window)
        for start in range(len(items)):
            for step, (number, at, last) in enumerate(items[start : start + width]):
                assert window.at[step, start] == at
                reward = numbered(storage.layout, number)[lane, storage.layout.columns["reward"]]
                assert window.reward[step, start] == reward
                assert window.terminated[step, start] == (ends.get(number) == 1)
                assert window.last[step, start] == last
                if last:
                    break
            else:
                assert step == width - 1  # a window that is cut short was marked as such


def test_a_window_as_wide_as_the_ring_comes_round_but_the_newest_is_marked():
    storage = filled(3, 5)
    window = read_window(
        storage.rows[0], storage.layout, torch.tensor([2]), 3, storage.clock(0, 1).newest
    )
    assert window.at[:, 0].tolist() == [2, 0, 1]
    assert window.last[:, 0].tolist() == [False, False, True]


def test_the_state_goes_round_and_what_was_loaded_goes_on_alike():
    one, two = filled(5, 7), filled(5, 2)
    one.count(torch.tensor([[0, 3], [1, 1]]), torch.tensor([[2, 4], [5, 1]]))
    state = {
        k: v.clone() if isinstance(v, torch.Tensor) else v for k, v in one.state_dict().items()
    }
    two.load_state_dict(state)
    for storage in (one, two):
        storage.append(numbered(storage.layout, 7))
    assert (two.stored, two.newest) == (one.stored, one.newest) == (8, 2)
    for name in ("rows", "draw_count", "unroll_sum"):
        assert getattr(one, name).equal(getattr(two, name))
    two.append(numbered(two.layout, 8))  # nothing is shared
    assert not one.rows.equal(two.rows) and not state["rows"].equal(two.rows)


def test_an_episode_ended_by_hand_is_cut_after_the_newest_item():
    storage = filled(5, 7)
    storage.end_episode()
    storage.append(numbered(storage.layout, 7))
    for lane in range(L):
        window = read_window(
            storage.rows[lane], storage.layout, torch.tensor([0]), 3, storage.clock(0, 1).newest
        )
        assert window.at[:, 0].tolist() == [0, 1, 2]  # transitions 5, 6, 7
        assert window.last[:, 0].tolist() == [False, True, True] and not window.terminated.any()
