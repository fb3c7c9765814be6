"""The critics' losses by hand, against Python loops, and LAP and PAL against each other."""

import pytest
import torch
from torch.func import grad, vmap

from aser.agents.losses import LOSSES, huber, of_items, pal, squared
from aser.replay.priorities import lap, masses

K, B = 2, 7  # critics, items
D = 3.0 * torch.randn(K, B, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
WEIGHT = torch.rand(B, dtype=torch.float64, generator=torch.Generator().manual_seed(6))
ONES = torch.ones(B, dtype=torch.float64)


def numbers(*rows):
    return torch.tensor(rows, dtype=torch.float64)


def test_by_hand():
    d, one = numbers([0.5, -3.0]), torch.ones(2, dtype=torch.float64)
    assert squared(d, one).item() == pytest.approx((0.125 + 4.5) / 2)
    assert huber(d, one).item() == pytest.approx((0.125 + 2.5) / 2)
    scale = (1 + 3**0.4) / 2
    assert pal(d, one).item() == pytest.approx((0.125 + 3**1.4 / 1.4) / 2 / scale)
    # The second critic's -5 sets lambda, and both critics' losses add up.
    two = numbers([0.5, -3.0], [0.25, -5.0])
    halves = 0.125 + 3**1.4 / 1.4 + 0.03125 + 5**1.4 / 1.4
    assert pal(two, one).item() == pytest.approx(halves / 2 / ((1 + 5**0.4) / 2))


@pytest.mark.parametrize("name", LOSSES)
def test_against_loops(name):
    def of(d):
        if name == "squared" or abs(d) < 1:
            return d * d / 2
        return abs(d) - 0.5 if name == "huber" else abs(d) ** 1.4 / 1.4

    total = 0.0
    for critic in D.tolist():
        total += sum(w * of(d) for d, w in zip(critic, WEIGHT.tolist(), strict=True)) / B
    if name == "pal":
        total /= sum(max(abs(a), abs(b), 1) ** 0.4 for a, b in D.T.tolist()) / B
    assert LOSSES[name](D, WEIGHT).item() == pytest.approx(total)


@pytest.mark.parametrize("name", LOSSES)
def test_the_loss_of_each_item_is_that_of_a_batch_of_it_alone(name):
    found, one = of_items(LOSSES[name], D), ONES[:1]
    alone = [LOSSES[name](D[:, i : i + 1], one).item() for i in range(B)]
    assert found.tolist() == pytest.approx(alone)
    if name != "pal":  # whose scale is the batch's
        assert found.mean().item() == pytest.approx(LOSSES[name](D, ONES).item())


def test_squared_is_the_expression_that_sac_always_had():
    q, target, weight = D.float(), WEIGHT.float(), WEIGHT.float()
    before = 0.5 * (weight * (q - target).square()).mean(1).sum()
    assert torch.equal(squared(q - target, weight), before)


def test_the_scale_of_pal_is_no_part_of_the_gradient():
    d = D[:1]
    sizes = d.abs()
    scale = sizes.clamp(min=1).pow(0.4).mean()
    slope = torch.where(sizes < 1, d, sizes**0.4 * d.sign()) / B / scale
    torch.testing.assert_close(grad(pal)(d, ONES), slope)


def test_pal_drawn_uniformly_has_the_expected_gradient_of_lap():
    """The paper's theorem, for one critic over a whole buffer of B items."""
    d = D[:1]
    mass = masses(lap, d[0].abs(), {"alpha": torch.tensor(0.4, dtype=torch.float64)})
    lap_gradient = grad(huber)(d, ONES) * B * mass / mass.sum()  # P(i) times that of item i
    torch.testing.assert_close(grad(pal)(d, ONES), lap_gradient)


@pytest.mark.parametrize("name", LOSSES)
def test_gradients_are_finite_at_no_error_and_at_huge_ones(name):
    d = torch.tensor([[0.0, 1.0, -1e18, 1e-30]])
    slope = vmap(grad(LOSSES[name]), (0, None))(d[None], torch.ones(4))
    assert slope.isfinite().all() and slope[0, 0, 0] == 0
