"""The buffer of all lanes: what a new item gets, what is written back, and what it keeps."""

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from aser import noise
from aser.agents import sac
from aser.errors import ConfigError
from aser.replay import kinds
from aser.replay.bootstrap import threshold
from aser.replay.buffer import Buffer
from aser.replay.kinds import Frozen
from aser.replay.priorities import by_rank, masses, proportional, rank
from aser.replay.sampler import Sampler
from aser.replay.storage import Layout
from aser.replay.unroll import Unroll

L, OBS, ACT, N, S, B = 3, 2, 1, 7, 4, 5
EQUALLY = {"alpha": torch.ones(L), "epsilon": torch.zeros(L)}  # the mass is p
FIRST = Frozen("first", lambda obs: obs[:, 0].abs())  # p is the first feature


def make(drawing="mode_log_prob", new="current_max", stopping=None, **kwargs):
    """A buffer; `drawing` and `stopping` name criteria, or are some. A stopping one is read by the
    rule.
    """
    own, other = (
        kinds.make(name) if isinstance(name, str) else name
        for name in (drawing, stopping or drawing)
    )
    extra = other.columns if stopping else ()
    layout = Layout(OBS, ACT, extra)
    unroll = Unroll(threshold, other, window=2) if stopping else Unroll()
    sampler = Sampler(sac, layout, B, own, unroll, **kwargs)
    return Buffer(sampler, L, N, S, noise.lane_keys(range(L)), new)


def facts(number):
    """Transition `number`: features, lanes and transitions all differ."""
    lane = 100.0 * np.arange(L, dtype=np.float32)
    obs = np.stack([lane + number, -lane - number], 1)
    return {
        "obs": obs,
        "action": (lane + number + 0.25)[:, None],
        "reward": lane.astype(np.float64) - number,
        "next_obs": obs + 0.5,
        "terminated": np.full(L, number == 3),
        "truncated": np.full(L, number == 5),
    }


def filled(stored, **kwargs):
    buffer = make(**kwargs)
    for number in range(stored):
        buffer.append(facts(number), EQUALLY)
    return buffer


def test_facts_arrive_in_their_columns_in_every_lane():
    buffer = filled(9)
    layout, rows = buffer.sampler.layout, buffer.storage.rows
    for number in range(2, 9):
        row, expected = rows[:, number % N], facts(number)
        for name in ("obs", "action", "next_obs"):
            found = layout.read_vector(row, name).T
            np.testing.assert_array_equal(found, expected[name])
        for name in ("reward", "terminated", "truncated"):
            np.testing.assert_array_equal(layout.read(row, name), expected[name].astype(np.float32))


def test_the_warm_up_states_are_the_first_ones_for_good():
    buffer = make()
    for number in range(3 * N):
        buffer.append(facts(number), EQUALLY)
        seen = min(number + 1, S)
        expected = np.stack([facts(i)["obs"] for i in range(seen)], 2)  # (L, OBS, seen)
        np.testing.assert_array_equal(buffer.warm_up[:, :, :seen], expected)
        assert buffer.warm_up[:, :, seen:].eq(0).all()
    clock = buffer.storage.clock(3 * N, 100)
    memory = buffer.memory(clock)
    assert memory.warm_up is buffer.warm_up and memory.rows is buffer.storage.rows
    assert memory.keys is buffer.keys and memory.clock is clock


def written(buffer, index, mass):
    index, mass = torch.tensor(index), torch.tensor(mass, dtype=torch.float64)
    buffer.write_back(index, torch.ones_like(index), torch.zeros(index.shape), mass)


def test_a_new_item_gets_the_largest_mass_now_in_the_buffer():
    buffer = filled(4, mass=proportional)
    assert buffer.priorities.mass[:, :4].eq(1).all() and buffer.priorities.mass[:, 4:].eq(0).all()
    written(buffer, [[0, 1, 2, 3]] * L, [[5, 1, 1, 1], [0.1, 0.2, 0.1, 0.1], [2, 3, 4, 1]])
    buffer.append(facts(4), EQUALLY)
    assert buffer.priorities.mass[:, 4].tolist() == [5, 0.2, 4]
    written(buffer, [[0, 4], [0, 4], [2, 4]], [[0.5, 0.5]] * L)  # the largest are gone
    buffer.append(facts(5), EQUALLY)
    assert buffer.priorities.mass[:, 5].tolist() == [1, 0.5, 3]


def test_a_new_item_gets_the_largest_mass_there_ever_was():
    buffer = filled(4, mass=proportional, new="ever_max")
    written(buffer, [[0, 1, 2, 3]] * L, [[5, 1, 1, 1], [0.1, 0.2, 0.1, 0.1], [2, 3, 4, 1]])
    buffer.append(facts(4), EQUALLY)
    assert buffer.priorities.mass[:, 4].tolist() == [5, 1, 4]  # the first items' own 1 counts
    written(buffer, [[0, 4], [0, 4], [2, 4]], [[0.5, 0.5]] * L)
    buffer.append(facts(5), EQUALLY)
    assert buffer.priorities.mass[:, 5].tolist() == [5, 1, 4]
    written(buffer, [[1], [1], [1]], [[6.0], [0.1], [0.1]])
    for number in range(
        6, 6 + 2 * N
    ):  # the ring comes round twice, so the record's own item is gone
        buffer.append(facts(number), EQUALLY)
    assert buffer.priorities.mass.tolist() == [[6.0] * N, [1.0] * N, [4.0] * N]


def test_an_item_of_a_frozen_criterion_gets_its_own_mass():
    buffer = make(FIRST, mass=proportional)
    hyper = {"alpha": torch.tensor([1.0, 0.5, 2.0]), "epsilon": torch.tensor([0.1, 0.21, 0.0])}
    for number in range(3):
        buffer.append(facts(number), hyper)
    p = 100.0 * torch.arange(L)[:, None].double() + torch.arange(3)
    expected = (p + hyper["epsilon"][:, None]) ** hyper["alpha"][:, None]
    torch.testing.assert_close(buffer.priorities.mass[:, :3], expected, rtol=1e-6, atol=0)
    assert buffer.priorities.mass[:, 3:].eq(0).all()


def test_the_record_counts_the_masses_of_a_frozen_criterion():
    buffer = make(FIRST, mass=proportional, new="ever_max")
    for number in (4, 6, 5):
        buffer.append(facts(number), EQUALLY)
    assert buffer.record.tolist() == [6, 106, 206]


def test_p_of_the_next_state_is_kept_where_the_rule_reads_a_frozen_criterion():
    buffer = filled(9, drawing="td_error", stopping=FIRST)
    layout, rows = buffer.sampler.layout, buffer.storage.rows
    assert list(layout.columns)[-1] == "p_next" and buffer.priorities is None
    next_obs = layout.read_vector(rows, "next_obs")  # (OBS, L, N)
    assert layout.read(rows, "p_next").equal(next_obs[0]) and next_obs[0, 2, 1] == 208.5
    buffer.write_back(torch.zeros(L, 1, dtype=torch.long), torch.ones(L, 1), torch.ones(L, 1), None)
    assert layout.read(rows, "p_next").equal(next_obs[0])  # once and for all


def test_a_new_items_td_error_is_the_largest_in_its_lane():
    buffer = filled(3, stopping="td_error", mass=proportional)
    layout = buffer.sampler.layout

    def errors():
        return layout.read(buffer.storage.rows, "td_error")

    assert errors().eq(0).all()
    index = torch.tensor([[0, 1], [2, 0], [1, 2]])
    error = torch.tensor([[0.5, 2.0], [4.0, 1.0], [3.0, 8.0]])
    buffer.write_back(index, torch.ones_like(index), error, None)
    buffer.append(facts(3), EQUALLY)
    expected = [[0.5, 2, 0, 2, 0, 0, 0], [1, 0, 4, 4, 0, 0, 0], [0, 3, 8, 8, 0, 0, 0]]
    assert errors().tolist() == expected
    buffer.write_back(index[:, :1], torch.ones(L, 1), torch.tensor([[1.0], [0.25], [5.0]]), None)
    # The new value alone counts.
    assert errors()[:, :4].tolist() == [
        [1, 2, 0, 2],
        [1, 0, 0.25, 4],
        [0, 5, 8, 8],
    ]
    for name in ("obs", "reward", "truncated"):  # nothing else was touched
        np.testing.assert_array_equal(
            layout.read_vector(buffer.storage.rows[:, 1], name).T.squeeze(), facts(1)[name]
        )


def test_draws_are_counted_and_written_back():
    buffer = filled(N, mass=proportional)
    index, unrolled = torch.tensor([[0, 0, 6]] * L), torch.tensor([[2, 3, 1], [1, 1, 1], [4, 4, 4]])
    mass = torch.tensor([[0.3, 0.3, 0.9]] * L, dtype=torch.float64)
    buffer.write_back(index, unrolled, torch.zeros(L, 3), mass)
    assert buffer.storage.draw_count[:, [0, 3, 6]].tolist() == [[2, 0, 1]] * L
    assert buffer.storage.unroll_sum[:, [0, 3, 6]].tolist() == [[5, 0, 1], [2, 0, 1], [8, 0, 4]]
    assert buffer.priorities.mass[:, [0, 3, 6]].tolist() == [[0.3, 1.0, 0.9]] * L
    buffer.write_back(index, unrolled, torch.zeros(L, 3), None)  # frozen criteria keep their mass
    assert buffer.priorities.mass[:, [0, 3, 6]].tolist() == [[0.3, 1.0, 0.9]] * L
    buffer.append(facts(N), EQUALLY)
    assert buffer.storage.draw_count[:, [0, 6]].tolist() == [[0, 2]] * L


BETA = {"beta": torch.tensor([0.4, 0.5, 1.0])}
PLACES = torch.tensor([[0.01, 0.3, 0.55, 0.8, 0.999]] * L, dtype=torch.float64)


def test_an_unprioritised_draw_is_uniform_over_what_is_stored():
    buffer = filled(4)
    assert buffer.priorities is None and buffer.masses() == []
    index, weight, *_ = buffer.draw(PLACES, {}, buffer.storage.clock(4, 10))
    assert index.tolist() == [[0, 1, 2, 3, 3]] * L and weight.eq(1).all()


@pytest.mark.parametrize("weights", [False, True])
def test_a_prioritised_draw_and_its_weights(weights):
    buffer = filled(4, mass=proportional, weights=weights)
    written(buffer, [[0, 1, 2, 3]] * L, [[1, 2, 4, 1], [0, 1, 0, 1], [0.25, 0.25, 0.25, 0.25]])
    index, weight, *_ = buffer.draw(PLACES, BETA, buffer.storage.clock(25, 100))
    assert index.tolist() == [[0, 1, 2, 2, 3], [1, 1, 3, 3, 3], [0, 1, 2, 3, 3]]
    assert weight.dtype == torch.float32
    if weights:  # beta goes from its first value to 1 in a straight line: .4 -> .55 after a quarter
        ratio = torch.tensor([[1, 2, 4, 4, 1], [1.0] * B, [1.0] * B])
        torch.testing.assert_close(weight, ratio ** -torch.tensor([[0.55], [0.625], [1.0]]))
        _, last, *_ = buffer.draw(PLACES, BETA, buffer.storage.clock(100, 100))
        torch.testing.assert_close(last, 1 / ratio)
    else:
        assert weight.eq(1).all()


@pytest.mark.parametrize("new", ["current_max", "ever_max"])
@pytest.mark.parametrize("prioritised", [True, False])
def test_a_loaded_buffer_goes_on_alike(new, prioritised):
    mass_of = proportional if prioritised else None
    kwargs = {"new": new, "mass": mass_of, "stopping": "td_error"}
    one, two = filled(9, **kwargs), filled(2, **kwargs)
    mass = torch.tensor([[3.0, 0.5], [0.2, 7.0], [2.0, 2.5]]).double() if prioritised else None
    index = torch.tensor([[0, 5], [1, 1], [6, 2]])
    error = torch.rand(L, 2, generator=torch.Generator().manual_seed(0))
    one.write_back(index, index + 1, error, mass)
    two.load_state_dict(
        {k: v.clone() if torch.is_tensor(v) else v for k, v in one.state_dict().items()}
    )
    for number in (9, 10):
        for buffer in (one, two):
            buffer.append(facts(number), EQUALLY)
            lower = torch.full((L, 1), 0.1).double() if prioritised else None
            first = torch.zeros(L, 1, dtype=torch.long)
            buffer.write_back(first, torch.ones(L, 1), torch.zeros(L, 1), lower)
    assert one.storage.stored == two.storage.stored == 11
    for name in ("rows", "draw_count", "unroll_sum"):
        assert getattr(one.storage, name).equal(getattr(two.storage, name))
    assert one.warm_up.equal(two.warm_up) and one.record.equal(two.record)
    if prioritised:
        assert one.priorities.mass.equal(two.priorities.mass)
    clock = one.storage.clock(11, 20)
    assert one.draw(PLACES, BETA, clock).index.equal(two.draw(PLACES, BETA, clock).index)


def lane_minus(bound):
    """p is the first feature, 100 times the lane and the number, minus a bound."""
    return Frozen("criterion: toys.f", lambda obs: obs[:, 0] - bound)


def test_a_negative_p_is_an_error_at_the_check_and_no_mass_until_then():
    buffer = make(lane_minus(101.0), mass=proportional)
    for number in (101, 102):
        buffer.append(facts(number), EQUALLY)
    buffer.check()
    buffer.append(facts(0), EQUALLY)  # -101 in lane 0 and -1 in lane 1
    buffer.append(facts(200), EQUALLY)
    assert buffer.priorities.mass[:, :4].tolist() == [
        [0, 1, 0, 99],
        [100, 101, 0, 199],
        [200, 201, 99, 299],
    ]
    drawn = buffer.draw(PLACES, BETA, buffer.storage.clock(4, 10)).index
    assert (drawn[:2] != 2).all() and (drawn >= 0).all() and (drawn < 4).all()
    said = "criterion=toys.f: p was negative in lane 0, 1; allowed: at least 0"
    for call in (buffer.check, buffer.state_dict):  # nor is it forgotten by stopping and resuming
        with pytest.raises(ConfigError) as error:
            call()
        assert str(error.value) == said
    buffer.load_state_dict(filled(3, mass=proportional).state_dict())
    buffer.check()


def test_a_p_that_turns_negative_in_an_update_is_an_error():
    buffer = filled(4, mass=proportional)
    index = torch.zeros(L, B, dtype=torch.long)
    for p, wrong in (
        (torch.zeros(L, B), None),
        (torch.zeros(L, B).index_fill(1, torch.tensor(3), -0.5), 1),
    ):
        p[[0, 2]] = torch.tensor([torch.nan, -torch.inf])[:, None]  # diverged lanes are no error
        mass = masses(proportional, p, {"alpha": torch.tensor(0.6), "epsilon": torch.tensor(0.1)})
        buffer.write_back(index, torch.ones_like(index), torch.zeros(L, B), mass)
        if wrong is None:
            buffer.check()
    with pytest.raises(ConfigError, match="^criterion=mode_log_prob: p was negative in lane 1; "):
        buffer.check()
    assert buffer.priorities.mass.ge(0).all()


def test_a_negative_mass_of_ones_own_prioritisation_is_an_error():
    own = {"mass": lambda p, hyper: p - 103.0, "prioritisation": "toys.shifted"}
    buffer = make(FIRST, **own)
    for number in (3, 103):
        buffer.append(facts(number), EQUALLY)
    said = "^prioritisation=toys.shifted: a mass was negative in lane 0; allowed: at least 0$"
    with pytest.raises(ConfigError, match=said):
        buffer.check()
    assert buffer.priorities.mass[:, :2].tolist() == [[0, 0], [0, 100], [100, 200]]


def test_ranked_items_are_drawn_by_their_ranks_and_weighted_by_them():
    """Ranks count, and no sizes: chi-square of the draws, and the weights (N P)^-beta by hand."""
    buffer = make(drawing="td_error", mass=rank, of_all=by_rank, weights=True)
    hyper = {"alpha": torch.tensor([0.7, 1.0, 0.0]), "beta": torch.tensor(0.5).expand(L)}
    for number in range(5):
        buffer.append(facts(number), hyper)
    sizes = torch.tensor([0.0, 100.0, 1e-9, 3.0, 2.0]).expand(L, 5)
    index = torch.arange(5).expand(L, 5)
    mass = masses(rank, sizes, hyper)
    buffer.write_back(index, torch.ones_like(index), sizes, mass)
    u = torch.rand((L, 20_000), dtype=torch.float64, generator=torch.Generator().manual_seed(9))
    drawn = buffer.draw(u, hyper, buffer.storage.clock(5, 10**9))
    for lane, alpha in enumerate((0.7, 1.0, 0.0)):
        chances = np.array([r**-alpha for r in (5, 1, 4, 2, 3)])
        chances /= chances.sum()
        count = np.bincount(drawn.index[lane].numpy(), minlength=5)
        assert chisquare(count, chances * u.shape[1]).pvalue > 1e-3
        weights = (5 * chances) ** -0.5
        expected = (weights / weights.max())[drawn.index[lane].numpy()]
        np.testing.assert_allclose(drawn.weight[lane], expected, rtol=1e-5)


@pytest.mark.parametrize("over", ["buffer", "batch"])
def test_the_largest_weight_is_that_of_the_buffer_or_of_the_batch(over):
    """Masses 1, 4, 16, 0, 64: the third, second and last are drawn."""
    buffer = make(drawing="td_error", mass=proportional, weights=True, over=over)
    for number in range(5):
        buffer.append(facts(number), EQUALLY)
    mass = torch.tensor([1.0, 4.0, 16.0, 0.0, 64.0], dtype=torch.float64).expand(L, 5)
    index = torch.arange(5).expand(L, 5)
    buffer.write_back(index, torch.ones_like(index), mass.float(), mass)
    u = torch.tensor([6.0, 1.5, 80.0], dtype=torch.float64).expand(L, 3) / 85
    beta = torch.tensor([0.5, 1.0, 0.0])
    drawn = buffer.draw(u, {"beta": beta}, buffer.storage.clock(0, 10))
    assert drawn.index.tolist() == [[2, 1, 4]] * L
    ratios = [16, 4, 64] if over == "buffer" else [4, 1, 16]
    for lane in range(L):
        expected = [ratio ** -beta[lane].item() for ratio in ratios]
        assert drawn.weight[lane].tolist() == pytest.approx(expected)
