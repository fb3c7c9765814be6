"""LaBER's redraw by hand, against the authors' lines in numpy, and its expected gradient.

K critics, M items of the large batch, B redrawn ones.
"""

import numpy as np
import pytest
import torch
from torch.func import grad

from aser.agents.laber import laber
from aser.agents.losses import LOSSES, huber, squared

K, M, B = 2, 12, 5


def numbers(*rows):
    return torch.tensor(rows, dtype=torch.float64)


def test_by_hand():
    """p is 1, 3, 0, 4 of 8, and its mean is 2."""
    d, u = numbers([1.0, -3.0, 0.0, 4.0]), numbers([0.0, 0.124, 0.126, 0.499, 0.501, 1 - 2.0**-33])
    place, weight = laber(d, u, squared)
    assert place.tolist() == [[0, 0, 1, 1, 3, 3]]
    assert weight[0].tolist() == pytest.approx([2, 2, 2 / 3, 2 / 3, 1 / 2, 1 / 2])


def test_with_hubers_loss_no_error_counts_more_than_1():
    """As in the authors' DQN: the priorities are min(|d|, 1), here 1/2, 1, 0, 1 of 5/2."""
    d, u = numbers([0.5, -3.0, 0.0, 1.0]), numbers([0.19, 0.21, 0.59, 0.61])
    place, weight = laber(d, u, huber)
    assert place.tolist() == [[0, 1, 1, 3]]
    assert weight[0].tolist() == pytest.approx([1.25, 0.625, 0.625, 0.625])


def test_against_the_authors_lines():
    """Their TD3 draws by np.random.choice, which looks u up in the cumulative probabilities."""
    g = torch.Generator().manual_seed(1)
    d = 3.0 * torch.randn(K, M, generator=g, dtype=torch.float64)
    u = torch.rand(K, B, generator=g, dtype=torch.float64)
    place, weight = laber(d, u, squared)
    assert place.shape == weight.shape == (K, B)
    for critic in range(K):
        td_errors = d[critic].abs().numpy()
        cdf = np.cumsum(td_errors / td_errors.sum())
        indices = np.searchsorted(cdf, u[critic].numpy(), side="right")
        assert place[critic].tolist() == indices.tolist()
        expected = (1.0 / td_errors[indices]) * td_errors.mean()
        np.testing.assert_allclose(weight[critic], expected)


@pytest.mark.parametrize("name", LOSSES)
def test_the_expected_gradient_is_that_of_the_large_batch(name):
    """Over uniform numbers as even as can be, of a function of each item too."""
    loss = LOSSES[name]
    d = 3.0 * torch.randn(K, M, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    feature = torch.randn(M, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    many = 200_000
    u = ((torch.arange(many, dtype=torch.float64) + 0.5) / many).expand(K, many)
    place, weight = laber(d, u, loss)
    slope = grad(loss)(d, torch.ones(M, dtype=torch.float64)) * M  # dL/dq of each item
    found = (weight * slope.gather(1, place) * feature[place]).mean(1)
    torch.testing.assert_close(found, (slope * feature).mean(1), rtol=0, atol=1e-3)


def test_where_no_item_has_a_gradient_or_one_is_no_number():
    u = numbers([0.1, 0.9])
    place, weight = laber(torch.zeros(1, 4, dtype=torch.float64), u, squared)
    assert ((place >= 0) & (place < 4)).all() and weight.tolist() == [[1.0, 1.0]]
    place, _ = laber(numbers([1.0, np.nan, 2.0, np.inf]), u, squared)
    assert ((place >= 0) & (place < 4)).all()
