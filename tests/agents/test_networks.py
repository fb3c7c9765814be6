"""Networks of one lane against loops and torch.nn, and the squashed Gaussian against
torch.distributions.
"""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform

from aser import noise
from aser.agents import networks, sac
from aser.agents.networks import Gaussian, Layer
from aser.lanes import batched
from aser.noise import Stream

O, A, B, K = 5, 3, 7, 4


def key_of(seed):
    return noise.lane_keys([seed])[0, Stream.INIT]


def randn(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def double(layers):
    return [Layer(*(x.double() for x in layer)) for layer in layers]


# Initialisation.


def test_initialisation_is_that_of_torch_linear():
    """Uniform in +-1/sqrt(inputs), bias too, as a thousand lanes show."""
    sizes = [O, 11, 6, 2]
    keys = noise.lane_keys(range(1000))[:, Stream.INIT]
    layers = batched(lambda key: networks.init_mlp(key, sizes))(keys)
    assert [tuple(w.shape) for w, _ in layers] == [(1000, 11, O), (1000, 6, 11), (1000, 2, 6)]
    assert [tuple(b.shape) for _, b in layers] == [(1000, 11), (1000, 6), (1000, 2)]
    for layer, inputs, outputs in zip(layers, sizes[:-1], sizes[1:], strict=True):
        bound = 1 / math.sqrt(inputs)
        torch.manual_seed(0)
        reference = [torch.nn.Linear(inputs, outputs) for _ in range(1000)]
        torchs = [
            torch.stack([getattr(r, name).detach() for r in reference])
            for name in ("weight", "bias")
        ]
        for mine, theirs in zip(layer, torchs, strict=True):
            assert (
                mine.abs().max() <= bound
                and mine.max() > 0.99 * bound
                and mine.min() < -0.99 * bound
            )
            assert (
                stats.kstest((mine.flatten() / bound).numpy(), stats.uniform(-1, 2).cdf).pvalue
                > 1e-3
            )
            assert stats.ks_2samp(mine.flatten().numpy(), theirs.flatten().numpy()).pvalue > 1e-3


def test_every_weight_of_every_lane_has_a_number_of_its_own():
    """Lanes, layers, actor and both critics: if two shared a draw, their scaled weights would be
    the same.
    """
    keys = noise.lane_keys([0, 1, 5])[:, Stream.INIT]
    state = batched(lambda key: sac.init(key, O, A, [6, 4]))(keys)
    scaled = []
    for layers in (state.actor, state.critics):
        for weight, bias in layers:
            root = math.sqrt(weight.shape[-1])
            scaled += [weight.flatten() * root, bias.flatten() * root]
    numbers = torch.cat(scaled).sort().values
    # 741 numbers of 2^23 values: some 0.03 pairs by chance. Scaling rounds, hence the tolerance.
    assert (numbers.diff() < 1e-7).sum() <= 1
    assert [tuple(w.shape) for w, _ in state.actor] == [(3, 6, O), (3, 4, 6), (3, 2 * A, 4)]
    assert [tuple(w.shape) for w, _ in state.critics] == [
        (3, 2, 6, O + A),
        (3, 2, 4, 6),
        (3, 2, 1, 4),
    ]


def test_copies_are_independent_networks():
    layers = networks.init_mlp(key_of(0), [50, 40, 30], copies=(2,))
    for weight, bias in layers:
        one, two = torch.cat([weight.flatten(1), bias], 1)
        assert abs(torch.corrcoef(torch.stack([one, two]))[0, 1]) < 4 / math.sqrt(len(one))


def test_a_lane_is_initialised_alone_as_among_others():
    keys = noise.lane_keys([7, 2, 9])[:, Stream.INIT]
    among = batched(lambda key: networks.init_mlp(key, [O, 6, 2], copies=(2,)))(keys)
    alone = networks.init_mlp(keys[1], [O, 6, 2], copies=(2,))
    assert all(
        torch.equal(x[1], y)
        for xs, ys in zip(among, alone, strict=True)
        for x, y in zip(xs, ys, strict=True)
    )


# Networks.


@pytest.mark.parametrize("hidden", [[], [6], [6, 4]])
def test_mlp_equals_torch_nn(hidden):
    layers = double(networks.init_mlp(key_of(1), [O, *hidden, 2]))
    modules = []
    for weight, bias in layers:
        module = torch.nn.Linear(*weight.T.shape).double()
        module.load_state_dict({"weight": weight, "bias": bias})
        modules += [module, torch.nn.ReLU()]
    x = 3 * randn(B, O)
    expected = torch.nn.Sequential(*modules[:-1])(x)
    torch.testing.assert_close(networks.mlp(layers, x.T), expected.T, rtol=1e-12, atol=1e-14)


def wild_critics(sizes):
    pairs = enumerate(zip(sizes[:-1], sizes[1:], strict=True))
    return [
        Layer(randn(2, outs, ins, seed=10 + i), randn(2, outs, seed=20 + i))
        for i, (ins, outs) in pairs
    ]


def slow_q(critics, which, obs, action):
    """One critic at one state and action, a neuron at a time."""
    x = [*obs.tolist(), *action.tolist()]
    for depth, (weight, bias) in enumerate(critics):
        rows = zip(weight[which].tolist(), bias[which].tolist(), strict=True)
        x = [sum(w * v for w, v in zip(row, x, strict=True)) + b for row, b in rows]
        if depth < len(critics) - 1:
            x = [max(v, 0.0) for v in x]
    return x[0]


@pytest.mark.parametrize("hidden", [[6], [6, 4], [6, 4, 5]])
def test_q_values_and_grids_equal_loops(hidden):
    critics = wild_critics([O + A, *hidden, 1])
    obs, action = 2 * randn(O, B, seed=1), randn(A, B, seed=2)
    weight, bias = critics[-1]  # each critic is to be the smaller at times
    critics[-1] = Layer(
        weight, bias - networks.q_values(critics, obs, action).median(1).values[:, None]
    )
    expected = [[slow_q(critics, c, obs[:, i], action[:, i]) for i in range(B)] for c in range(2)]
    expected = torch.tensor(expected, dtype=torch.float64)
    torch.testing.assert_close(
        networks.q_values(critics, obs, action), expected, rtol=1e-12, atol=1e-14
    )

    grid, own = randn(A, K, seed=3), randn(A, K, B, seed=4)
    for actions in (grid, own):
        expected = torch.empty(K, B, dtype=torch.float64)
        for k in range(K):
            for i in range(B):
                a = actions[:, k] if actions.dim() == 2 else actions[:, k, i]
                expected[k, i] = min(slow_q(critics, c, obs[:, i], a) for c in range(2))
        torch.testing.assert_close(
            networks.q_grid(critics, obs, actions), expected, rtol=1e-12, atol=1e-14
        )
    assert networks.q_values(critics, obs, action).argmin(0).unique().tolist() == [0, 1], (
        "each is the smaller at times"
    )


def test_policy_splits_mean_from_log_std_and_clamps_the_latter():
    actor = [Layer(torch.zeros(2 * A, O), torch.tensor([1.0, -30.0, 30.0, -30.0, 0.5, 30.0]))]
    gaussian = networks.policy(actor, torch.randn(O, B))
    assert gaussian.mean[:, 0].tolist() == [1.0, -30.0, 30.0] and gaussian.mean.shape == (A, B)
    assert gaussian.log_std[:, 0].tolist() == [-20.0, 0.5, 2.0] and gaussian.log_std.shape == (A, B)


# The squashed Gaussian.


def a_gaussian(scale=1.0):
    return Gaussian(scale * randn(A, B, seed=5), randn(A, B, seed=6).clamp(-3.0, 2.0))


def reference(gaussian):
    """torch's tanh(Normal); the cache keeps u, so that nothing is lost in inverting the tanh."""
    tanh = TanhTransform(cache_size=1)
    return tanh, TransformedDistribution(Normal(gaussian.mean, gaussian.log_std.exp()), [tanh])


@pytest.mark.parametrize("scale", [0.3, 3.0, 30.0])
def test_sample_equals_torch_distributions(scale):
    gaussian, epsilon = a_gaussian(scale), randn(A, B, seed=7)
    action, log_prob = networks.sample(gaussian, epsilon)
    tanh, distribution = reference(gaussian)
    expected = tanh(gaussian.mean + gaussian.log_std.exp() * epsilon)
    assert action.shape == (A, B) and log_prob.shape == (B,)
    torch.testing.assert_close(action, expected, rtol=1e-14, atol=0)
    torch.testing.assert_close(
        log_prob, distribution.log_prob(expected).sum(0), rtol=1e-10, atol=1e-10
    )


def test_log_density_equals_torch_distributions():
    gaussian = a_gaussian()
    action = (
        2 * torch.rand(A, B, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 1
    ) * 0.999
    _, distribution = reference(gaussian)
    expected = distribution.log_prob(action).sum(0)
    torch.testing.assert_close(
        networks.log_density(gaussian, action), expected, rtol=1e-10, atol=1e-10
    )
    action, log_prob = networks.sample(gaussian, 0.5 * randn(A, B, seed=7))
    torch.testing.assert_close(
        networks.log_density(gaussian, action), log_prob, rtol=1e-6, atol=1e-6
    )


def test_log_density_integrates_to_one():
    gaussian = Gaussian(torch.tensor([[0.4]]).double(), torch.tensor([[-0.3]]).double())
    action = torch.linspace(-1, 1, 200_001, dtype=torch.float64)[None, 1:-1]
    wide = Gaussian(*(x.expand(1, action.shape[1]) for x in gaussian))
    assert networks.log_density(wide, action).exp().mean().item() * 2 == pytest.approx(
        1.0, abs=1e-4
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_log_density_is_finite_at_the_border(dtype):
    border = torch.tensor([[-1.0, 1.0, 1.0 - 1e-7]], dtype=dtype)
    gaussian = Gaussian(torch.zeros(1, 3, dtype=dtype), torch.zeros(1, 3, dtype=dtype))
    found = networks.log_density(gaussian, border)
    inside = networks.log_density(gaussian, border.sign() * (1 - 1e-6))
    assert found.isfinite().all()
    torch.testing.assert_close(found, inside)


@pytest.mark.parametrize("scale", [0.3, 3.0, 30.0])
def test_mode_log_density_equals_torch_distributions(scale):
    gaussian = a_gaussian(scale)
    tanh, distribution = reference(gaussian)
    expected = distribution.log_prob(tanh(gaussian.mean)).sum(0)
    torch.testing.assert_close(
        networks.mode_log_density(gaussian), expected, rtol=1e-10, atol=1e-10
    )
    plain = Normal(gaussian.mean, gaussian.log_std.exp()).log_prob(gaussian.mean).sum(0)
    torch.testing.assert_close(
        networks.mode_log_density(gaussian, squashed=False), plain, rtol=1e-10, atol=1e-10
    )


def test_a_hand_computed_mode():
    """log N(0; 0, e^-1) = 1 - log sqrt(2 pi); the tanh adds nothing at 0, and -log(1 - .64) at
    artanh .8.
    """
    gaussian = Gaussian(torch.tensor([[0.0, math.atanh(0.8)]]), torch.tensor([[-1.0, -1.0]]))
    plain = 1 - math.log(math.sqrt(2 * math.pi))
    expected = torch.tensor([plain, plain - math.log(0.36)])
    torch.testing.assert_close(networks.mode_log_density(gaussian), expected)


@pytest.mark.parametrize("log_std", [-20.0, 0.0, 2.0])
@pytest.mark.parametrize("mean", [-400.0, -20.0, 9.5, 60.0])
def test_saturation_is_finite_and_keeps_its_gradient(mean, log_std):
    """Where tanh is flat, d log pi(a) / d mean is 2 tanh(u) = +-2: exact, neither zero nor
    infinite.
    """
    inputs = (
        torch.full((1, 1), mean, requires_grad=True),
        torch.full((1, 1), log_std, requires_grad=True),
    )
    epsilon = torch.full((1, 1), 0.7)
    action, log_prob = networks.sample(Gaussian(*inputs), epsilon)
    of_mean, of_log_std = torch.autograd.grad(log_prob.sum(), inputs)
    u = mean + math.exp(log_std) * 0.7
    assert action.item() == pytest.approx(math.tanh(u))
    exact = -0.245 - log_std - math.log(math.sqrt(2 * math.pi)) - 2 * (math.log(2) - abs(u))
    assert log_prob.item() == pytest.approx(exact, abs=1e-4, rel=1e-5)
    assert of_mean.item() == pytest.approx(2 * math.tanh(u), rel=1e-5)
    assert of_log_std.item() == pytest.approx(
        -1 + 2 * math.tanh(u) * math.exp(log_std) * 0.7, rel=1e-4
    )

    mode = networks.mode_log_density(Gaussian(*inputs))
    (of_mean,) = torch.autograd.grad(mode.sum(), inputs[0])
    assert mode.isfinite().all() and of_mean.item() == pytest.approx(2 * math.tanh(mean), rel=1e-5)


def test_samples_are_distributed_as_tanh_of_the_gaussian():
    mean, log_std = 0.6, -0.2
    epsilon = noise.normal(key_of(3), (1, 100_000))
    wide = Gaussian(torch.full((1, 1), mean), torch.full((1, 1), log_std))
    action, _ = networks.sample(wide, epsilon)
    gaussian = stats.norm(mean, math.exp(log_std))
    assert stats.kstest(action[0].numpy(), lambda a: gaussian.cdf(np.arctanh(a))).pvalue > 1e-3
