"""Adam against torch's, Polyak averaging by hand."""

import pytest
import torch

from aser.agents import optim
from aser.lanes import batched
from aser.trees import take, tree_map


def stack(trees):
    return tree_map(lambda *leaves: torch.stack(leaves), *trees)


def randn(*shape, seed):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def scalar(value):
    return torch.tensor(value, dtype=torch.float64)


def a_tree(seed):
    return {"w": randn(5, 3, seed=seed), "b": [randn(3, seed=seed + 1), randn((), seed=seed + 2)]}


def gradient(tree, step):
    """Of sizes from 1e-9 to 1e3, so that epsilon counts in some and not in others; one element is
    always 0.
    """
    sizes = torch.logspace(-9, 3, 15, dtype=torch.float64).reshape(5, 3)
    w = sizes * (randn(5, 3, seed=100 + step) + tree["w"])
    w[2, 1] = 0.0
    return {"w": w, "b": [tree["b"][0] ** 3, randn((), seed=200 + step)]}


def flat(tree):
    return [tree["w"], *tree["b"]]


def adams(seed, lr, steps=20):
    """The parameters after each step, by optim.adam."""
    params = a_tree(seed)
    moments = optim.init_moments(params)
    for t in range(1, steps + 1):
        grads = gradient(params, t)
        params, moments = optim.adam(params, grads, moments, scalar(lr), scalar(t))
        yield params, moments


def torchs(seed, lr, steps=20):
    tree = a_tree(seed)
    tree = {"w": tree["w"].requires_grad_(), "b": [b.requires_grad_() for b in tree["b"]]}
    adam = torch.optim.Adam(flat(tree), lr=lr)
    for t in range(1, steps + 1):
        with torch.no_grad():
            grads = flat(gradient(tree, t))
        for parameter, grad in zip(flat(tree), grads, strict=True):
            parameter.grad = grad
        adam.step()
        yield [p.detach().clone() for p in flat(tree)], [adam.state[p] for p in flat(tree)]


@pytest.mark.parametrize("lr", [3e-4, 0.1])
def test_adam_equals_torchs_over_twenty_steps(lr):
    steps = 0
    for (params, moments), (expected, state) in zip(adams(3, lr), torchs(3, lr), strict=True):
        for i, parameter in enumerate(flat(params)):
            torch.testing.assert_close(parameter, expected[i], rtol=1e-12, atol=1e-13)
            torch.testing.assert_close(
                flat(moments.first)[i], state[i]["exp_avg"], rtol=1e-12, atol=1e-300
            )
            torch.testing.assert_close(
                flat(moments.second)[i], state[i]["exp_avg_sq"], rtol=1e-12, atol=1e-300
            )
        steps += 1
    assert steps == 20
    start = a_tree(3)
    assert params["w"][2, 1] == start["w"][2, 1], "no gradient, no step"
    assert (params["w"] != start["w"]).sum() == 14


def test_the_first_step_has_the_size_of_the_learning_rate():
    params = torch.tensor([1.0, 2.0, 3.0])
    grads = torch.tensor([100.0, -0.01, 1e-8])
    after, _ = optim.adam(
        params, grads, optim.init_moments(params), torch.tensor(0.25), torch.tensor(1.0)
    )
    # The last is halved by epsilon = 1e-8.
    torch.testing.assert_close(after, torch.tensor([0.75, 2.25, 3.0 - 0.125]))


def test_each_lane_has_its_own_learning_rate_and_count():
    seeds, rates = [3, 6, 9], [1e-3, 0.1, 0.02]
    trees = [a_tree(seed) for seed in seeds]
    counts = scalar([1.0, 7.0, 1000.0])
    moments = [optim.Moments(gradient(t, 40), {k: v for k, v in a_tree(50).items()}) for t in trees]
    moments = [
        optim.Moments(m.first, {"w": m.second["w"] ** 2, "b": [b**2 for b in m.second["b"]]})
        for m in moments
    ]
    grads = [gradient(tree, 60) for tree in trees]
    lr = scalar(rates)
    many = batched(optim.adam)(stack(trees), stack(grads), stack(moments), lr, counts)
    for lane in range(3):
        alone = optim.adam(trees[lane], grads[lane], moments[lane], lr[lane], counts[lane])
        for mine, expected in zip(flat(take(many[0], lane)), flat(alone[0]), strict=True):
            torch.testing.assert_close(mine, expected, rtol=1e-13, atol=0)


def test_polyak():
    targets = {"a": torch.tensor([1.0, 2.0]), "b": [torch.tensor(4.0)]}
    params = {"a": torch.tensor([3.0, -2.0]), "b": [torch.tensor(0.0)]}
    new = optim.polyak(targets, params, torch.tensor(0.25))
    assert new["a"].tolist() == [1.5, 1.0] and new["b"][0] == 3.0
    assert optim.polyak(targets, params, torch.tensor(1.0))["a"].tolist() == [3.0, -2.0]
    assert targets["a"].tolist() == [1.0, 2.0], "nothing is changed in place"
