"""Draws by age against probabilities counted item by item, and against values worked out by hand.

Lanes L, items N and draws B all differ.
"""

import math
from functools import partial

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from aser.replay import draws
from aser.replay.storage import Clock

L, B = 2, 30_000
EVEN = (torch.arange(B, dtype=torch.float64) + 0.5) / B  # as even as uniform numbers can be


def clock(stored, capacity, step=0, progress=0.0):
    """The time in a ring of `capacity` items after `stored` were stored."""
    size, newest = min(stored, capacity), (stored - 1) % capacity
    return Clock(
        torch.tensor(step, dtype=torch.int32),
        torch.tensor(newest),
        torch.tensor(size),
        torch.tensor(progress),
    )


def ages(index, now, capacity):
    """How many items are newer than each, by walking back through the ring."""
    walk = [(int(now.newest) - age) % capacity for age in range(int(now.size))]
    return torch.tensor([walk.index(i) for i in index.flatten().tolist()])


def one(u, way, now, **parameters):
    return way(torch.tensor(u, dtype=torch.float64), now, **parameters).tolist()


def test_a_uniform_draw_covers_exactly_what_is_stored():
    u = [2.0**-33, 0.999 / 7, 1.001 / 7, 0.5, 1 - 2.0**-33]
    assert one(u, draws.uniform, clock(7, 11)) == [0, 0, 1, 3, 6]


def test_recent_by_hand():
    """q = 1/2 and N = 3: the ages 0, 1, 2 have 4/7, 2/7 and 1/7."""
    u = [0.0, 3.99 / 7, 4.01 / 7, 5.99 / 7, 6.01 / 7, 1 - 2.0**-53]
    assert one(u, draws.recent, clock(3, 5), q=0.5) == [2, 2, 1, 1, 0, 0]
    # A full ring whose newest item is number 1: the ages 0, 1, 2 are at 1, 0 and 2.
    assert one(u, draws.recent, clock(8, 3), q=0.5) == [1, 1, 0, 0, 2, 2]


@pytest.mark.parametrize(("stored", "capacity"), [(1, 4), (23, 40), (40, 40), (61, 40)])
@pytest.mark.parametrize("q", [1.0, 0.999, 0.9, 0.3])
def test_recent_draws_each_age_as_often_as_its_power_of_q(stored, capacity, q):
    now = clock(stored, capacity)
    u = torch.rand((L, B), dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    found = draws.recent(u, now, q=q)
    assert found.shape == (L, B) and found.dtype == torch.int64
    share = np.array([q**k for k in range(int(now.size))])
    share /= share.sum()
    for lane in found:
        count = np.bincount(ages(lane, now, capacity), minlength=len(share))
        assert len(count) == len(share)
        often = share * B > 5  # rare ages together, as the test asks for
        pairs = [np.append(x[often], x[~often].sum()) for x in (count, share * B)]
        pairs = [x if x[-1] or pairs[1][-1] else x[:-1] for x in pairs]
        assert len(pairs[0]) < 2 or chisquare(*pairs).pvalue > 1e-3


@pytest.mark.parametrize("q", [1e-300, 0.2, 1 - 1e-12, math.nextafter(1, 0), 1.0])
def test_recent_never_leaves_the_ring(q):
    u = torch.tensor([0.0, 2.0**-53, 0.5, 1 - 2.0**-53], dtype=torch.float64)
    for stored in (1, 2, 10**6):
        found = draws.recent(u, clock(stored, 10**6), q=q)
        assert ((found >= 0) & (found < stored)).all()


def test_cer_is_uniform_but_for_the_newest_item_first():
    now = clock(17, 12)
    u = torch.rand((L, 6), dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    found = draws.cer(u, now)
    assert found[:, 0].tolist() == [4, 4]
    assert torch.equal(found[:, 1:], draws.uniform(u, now)[:, 1:])
    assert draws.cer(u[0], now).tolist() == found[0].tolist()  # of one lane


def newest(n, k, period, eta, share, least):
    """c of Wang & Ross, in plain numbers."""
    eta_t = eta + (1 - eta) * share
    return min(n, max(int(n * eta_t ** (k * 1000 / period)), least))


def test_ere_by_hand():
    assert newest(800, 1, 10, 0.99, 0.0, 5) == 292  # 800 * .99^100
    now = clock(800, 900, step=20)  # k = 1 of 10
    u = [0.0, 1 - 2.0**-53]
    assert one(u, draws.ere, now, eta=0.99, least=5, cycle=10) == [799, 799 - 291]
    later = clock(800, 900, step=29)  # k = 10: 800 * .99^1000 is below 5
    assert one(u, draws.ere, later, eta=0.99, least=5, cycle=10) == [799, 795]
    end = clock(800, 900, step=29, progress=1.0)  # eta is 1 at the end: uniform
    assert one(u, draws.ere, end, eta=0.99, least=5, cycle=10) == [799, 0]


@pytest.mark.parametrize("step", [0, 1, 6, 7, 200])
@pytest.mark.parametrize(("stored", "capacity"), [(3, 60), (59, 60), (60, 60), (145, 60)])
def test_ere_is_uniform_over_the_newest_items(step, stored, capacity):
    now, eta, least, cycle = clock(stored, capacity, step, progress=0.25), 0.995, 11, 7
    size = int(now.size)
    c = newest(size, step % cycle + 1, cycle, eta, 0.25, least)
    found = draws.ere(EVEN.expand(L, B), now, eta=eta, least=least, cycle=cycle)
    for lane in found:
        count = np.bincount(ages(lane, now, capacity), minlength=size)
        assert count.sum() == B and np.abs(count - (np.arange(size) < c) * B / c).max() <= 1


@pytest.mark.parametrize(("stored", "capacity"), [(7, 12), (23, 12)])
@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("uniform", {}),
        ("recent", {"q": 0.8}),
        ("recent", {"q": 1.0}),
        ("cer", {}),
        ("ere", {"eta": 0.997, "least": 2, "cycle": 9}),
        ("laber", {"large": 4}),
    ],
)
def test_the_chances_of_a_way_are_those_of_its_draws(name, parameters, stored, capacity):
    now, batch = clock(stored, capacity, step=4, progress=0.3), 5
    way = partial(draws.WAYS[name], **parameters) if parameters else draws.WAYS[name]
    found = draws.chances(way, now, batch)
    index = way(EVEN.reshape(-1, 1).expand(-1, batch), now)  # each place of a batch sees all u
    count = np.bincount(ages(index, now, capacity), minlength=int(now.size))
    assert found.sum() == pytest.approx(1) and len(found) == len(count)
    np.testing.assert_allclose(found, count / count.sum(), atol=2 / B)


def test_every_way_has_a_file_and_its_parameters():
    from aser.settings.sampler import WAYS

    assert set(draws.WAYS) == set(draws.CHANCES) == set(WAYS)
