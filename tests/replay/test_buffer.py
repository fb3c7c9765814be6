"""The buffer of all lanes: what a new item gets, what is written back, and what it keeps."""

import numpy as np
import pytest
import torch

from aser import noise
from aser.replay import criteria
from aser.replay.buffer import Buffer
from aser.replay.sampler import Sampler
from aser.replay.storage import Layout

L, OBS, ACT, N, S, B = 3, 2, 1, 7, 4, 5


def make(drawing="mode_log_prob", new="current_max", extra=(), **kwargs):
    own = criteria.make(drawing)
    sampler = Sampler(Layout(OBS, ACT, extra), B, own, own, **kwargs)
    return Buffer(sampler, L, N, S, noise.lane_keys(range(L)), new)


def facts(number):
    """Transition `number`: features, lanes and transitions all differ."""
    lane = 100.0 * np.arange(L, dtype=np.float32)
    obs = np.stack([lane + number, -lane - number], 1)
    return {
        "obs": obs,
        "action": torch.from_numpy(lane + number + 0.25)[:, None],
        "reward": lane.astype(np.float64) - number,
        "next_obs": obs + 0.5,
        "terminated": np.full(L, number == 3),
        "truncated": np.full(L, number == 5),
    }


def filled(stored, **kwargs):
    buffer = make(**kwargs)
    for number in range(stored):
        buffer.append(facts(number))
    return buffer


def test_facts_arrive_in_their_columns_in_every_lane():
    buffer = filled(9)
    layout, rows = buffer.sampler.layout, buffer.storage.rows
    for number in range(2, 9):
        row, expected = rows[:, number % N], facts(number)
        for name in ("obs", "action", "next_obs"):
            found = layout.read_vector(row, name).T
            np.testing.assert_array_equal(found, np.asarray(expected[name]))
        for name in ("reward", "terminated", "truncated"):
            np.testing.assert_array_equal(layout.read(row, name), expected[name].astype(np.float32))


def test_the_warm_up_states_are_the_first_ones_for_good():
    buffer = make()
    for number in range(3 * N):
        buffer.append(facts(number))
        seen = min(number + 1, S)
        expected = np.stack([facts(i)["obs"] for i in range(seen)], 2)  # (L, OBS, seen)
        np.testing.assert_array_equal(buffer.warm_up[:, :, :seen], expected)
        assert buffer.warm_up[:, :, seen:].eq(0).all()
    memory = buffer.memory()
    assert memory.warm_up is buffer.warm_up and memory.rows is buffer.storage.rows


def written(buffer, index, mass):
    index = torch.tensor(index)
    errors = torch.zeros(index.shape)
    buffer.write_back(
        index, torch.ones_like(index), torch.tensor(mass, dtype=torch.float64), errors
    )


def test_a_new_item_gets_the_largest_mass_now_in_the_buffer():
    buffer = filled(4, prioritised=True)
    assert buffer.priorities.mass[:, :4].eq(1).all() and buffer.priorities.mass[:, 4:].eq(0).all()
    written(buffer, [[0, 1, 2, 3]] * L, [[5, 1, 1, 1], [0.1, 0.2, 0.1, 0.1], [2, 3, 4, 1]])
    buffer.append(facts(4))
    assert buffer.priorities.mass[:, 4].tolist() == [5, 0.2, 4]
    written(buffer, [[0, 4], [0, 4], [2, 4]], [[0.5, 0.5]] * L)  # the largest are gone
    buffer.append(facts(5))
    assert buffer.priorities.mass[:, 5].tolist() == [1, 0.5, 3]


def test_a_new_item_gets_the_largest_mass_there_ever_was():
    buffer = filled(4, prioritised=True, new="ever_max")
    written(buffer, [[0, 1, 2, 3]] * L, [[5, 1, 1, 1], [0.1, 0.2, 0.1, 0.1], [2, 3, 4, 1]])
    buffer.append(facts(4))
    assert buffer.priorities.mass[:, 4].tolist() == [5, 1, 4]  # the first items' own 1 counts
    written(buffer, [[0, 4], [0, 4], [2, 4]], [[0.5, 0.5]] * L)
    buffer.append(facts(5))
    assert buffer.priorities.mass[:, 5].tolist() == [5, 1, 4]
    written(buffer, [[1], [1], [1]], [[6.0], [0.1], [0.1]])
    for number in range(
        6, 6 + 2 * N
    ):  # the ring comes round twice, so the record's own item is gone
        buffer.append(facts(number))
    assert buffer.priorities.mass.tolist() == [[6.0] * N, [1.0] * N, [4.0] * N]


def test_an_item_of_a_frozen_criterion_gets_its_own_mass():
    buffer = make("oracle", prioritised=True)
    for number in range(3):
        buffer.append(facts(number), torch.tensor([0.1, 1.0, 0.5]).double() + number)
    expected = torch.tensor([[0.1, 1.1, 2.1], [1, 2, 3], [0.5, 1.5, 2.5]]).double()
    torch.testing.assert_close(buffer.priorities.mass[:, :3], expected)


def test_a_new_items_td_error_is_the_largest_in_its_lane():
    buffer = filled(3, extra=("td_error",), prioritised=True)
    layout = buffer.sampler.layout

    def errors():
        return layout.read(buffer.storage.rows, "td_error")

    assert errors().eq(0).all()
    index = torch.tensor([[0, 1], [2, 0], [1, 2]])
    buffer.write_back(
        index, torch.ones_like(index), None, torch.tensor([[0.5, 2.0], [4.0, 1.0], [3.0, 8.0]])
    )
    buffer.append(facts(3))
    expected = [[0.5, 2, 0, 2, 0, 0, 0], [1, 0, 4, 4, 0, 0, 0], [0, 3, 8, 8, 0, 0, 0]]
    assert errors().tolist() == expected
    buffer.write_back(index[:, :1], torch.ones(L, 1), None, torch.tensor([[1.0], [0.25], [5.0]]))
    assert errors()[:, :4].tolist() == [
        [1, 2, 0, 2],
        [1, 0, 0.25, 4],
        [0, 5, 8, 8],
    ]  # the new value alone counts
    for name in ("obs", "reward", "truncated"):  # nothing else was touched
        np.testing.assert_array_equal(
            layout.read_vector(buffer.storage.rows[:, 1], name).T.squeeze(), facts(1)[name]
        )


def test_draws_are_counted_and_written_back():
    buffer = filled(N, prioritised=True)
    index, unrolled = torch.tensor([[0, 0, 6]] * L), torch.tensor([[2, 3, 1], [1, 1, 1], [4, 4, 4]])
    mass = torch.tensor([[0.3, 0.3, 0.9]] * L, dtype=torch.float64)
    buffer.write_back(index, unrolled, mass, torch.zeros(L, 3))
    assert buffer.storage.draw_count[:, [0, 3, 6]].tolist() == [[2, 0, 1]] * L
    assert buffer.storage.unroll_sum[:, [0, 3, 6]].tolist() == [[5, 0, 1], [2, 0, 1], [8, 0, 4]]
    assert buffer.priorities.mass[:, [0, 3, 6]].tolist() == [[0.3, 1.0, 0.9]] * L
    buffer.write_back(index, unrolled, None, torch.zeros(L, 3))  # frozen criteria keep their mass
    assert buffer.priorities.mass[:, [0, 3, 6]].tolist() == [[0.3, 1.0, 0.9]] * L
    buffer.append(facts(N))
    assert buffer.storage.draw_count[:, [0, 6]].tolist() == [[0, 2]] * L


BETA = {"beta": torch.tensor([0.4, 0.5, 1.0])}
PLACES = torch.tensor([[0.01, 0.3, 0.55, 0.8, 0.999]] * L, dtype=torch.float64)


def test_an_unprioritised_draw_is_uniform_over_what_is_stored():
    buffer = filled(4)
    assert buffer.priorities is None
    index, weight = buffer.draw(PLACES, {}, buffer.storage.clock(4, 10))
    assert index.tolist() == [[0, 1, 2, 3, 3]] * L and weight.eq(1).all()


@pytest.mark.parametrize("weights", [False, True])
def test_a_prioritised_draw_and_its_weights(weights):
    buffer = filled(4, prioritised=True, weights=weights)
    written(buffer, [[0, 1, 2, 3]] * L, [[1, 2, 4, 1], [0, 1, 0, 1], [0.25, 0.25, 0.25, 0.25]])
    index, weight = buffer.draw(PLACES, BETA, buffer.storage.clock(25, 100))
    assert index.tolist() == [[0, 1, 2, 2, 3], [1, 1, 3, 3, 3], [0, 1, 2, 3, 3]]
    assert weight.dtype == torch.float32
    if weights:  # beta goes from its first value to 1 in a straight line: .4 -> .55 after a quarter
        ratio = torch.tensor([[1, 2, 4, 4, 1], [1.0] * B, [1.0] * B])
        torch.testing.assert_close(weight, ratio ** -torch.tensor([[0.55], [0.625], [1.0]]))
        _, last = buffer.draw(PLACES, BETA, buffer.storage.clock(100, 100))
        torch.testing.assert_close(last, 1 / ratio)
    else:
        assert weight.eq(1).all()


@pytest.mark.parametrize("new", ["current_max", "ever_max"])
@pytest.mark.parametrize("prioritised", [True, False])
def test_a_loaded_buffer_goes_on_alike(new, prioritised):
    kwargs = {"new": new, "prioritised": prioritised, "extra": ("td_error",)}
    one, two = filled(9, **kwargs), filled(2, **kwargs)
    mass = torch.tensor([[3.0, 0.5], [0.2, 7.0], [2.0, 2.5]]).double() if prioritised else None
    index = torch.tensor([[0, 5], [1, 1], [6, 2]])
    one.write_back(
        index, index + 1, mass, torch.rand(L, 2, generator=torch.Generator().manual_seed(0))
    )
    two.load_state_dict(
        {k: v.clone() if torch.is_tensor(v) else v for k, v in one.state_dict().items()}
    )
    for number in (9, 10):
        for buffer in (one, two):
            buffer.append(facts(number))
            lower = torch.full((L, 1), 0.1).double() if prioritised else None
            buffer.write_back(
                torch.zeros(L, 1, dtype=torch.long), torch.ones(L, 1), lower, torch.zeros(L, 1)
            )
    assert one.storage.stored == two.storage.stored == 11
    for name in ("rows", "draw_count", "unroll_sum"):
        assert getattr(one.storage, name).equal(getattr(two.storage, name))
    assert one.warm_up.equal(two.warm_up) and one.record.equal(two.record)
    if prioritised:
        assert one.priorities.mass.equal(two.priorities.mass)
    clock = one.storage.clock(11, 20)
    assert one.draw(PLACES, BETA, clock)[0].equal(two.draw(PLACES, BETA, clock)[0])
