"""Soft actor-critic: equal to Stable-Baselines3's, and what each part of a batch may touch."""

from collections import deque
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from aser import noise
from aser.agents import sac, with_large_batch, with_loss
from aser.agents.batch import Batch
from aser.agents.laber import laber
from aser.agents.losses import LOSSES, squared
from aser.agents.networks import Layer, mlp, policy, q_values, sample
from aser.lanes import batched
from aser.noise import Stream
from aser.trees import take, tree_leaves, tree_map

O, A, B = 5, 3, 7
HYPER = {"lr": 3e-3, "tau": 0.02, "target_entropy": -3.0}
OTHERS = [
    {"lr": 1e-2, "tau": 0.3, "target_entropy": 4.0},
    HYPER,
    {"lr": 3e-4, "tau": 1.0, "target_entropy": -1.0},
]


def stack(trees):
    return tree_map(lambda *leaves: torch.stack(leaves), *trees)


def scalars(values):
    return {key: torch.tensor(value, dtype=torch.float64) for key, value in values.items()}


def a_state(seed, hidden):
    """A float64 agent whose targets are not its critics, and whose second action stands at the
    clamp of its log_std.
    """
    key = noise.lane_keys([seed])[0, Stream.INIT]
    state = tree_map(torch.Tensor.double, sac.init(key, O, A, hidden))
    generator = torch.Generator().manual_seed(seed)
    targets = tree_map(
        lambda x: x + 0.1 * torch.randn(x.shape, generator=generator).double(), state.targets
    )
    state.actor[-1].bias[A + 1] += 10.0
    return state._replace(targets=targets)


def a_batch(seed):
    """Numbers that float32 can hold, n-step discounts, and some ends."""
    generator = torch.Generator().manual_seed(1000 + seed)
    obs, boot, other = (torch.randn(O, B, generator=generator).double() for _ in range(3))
    action = torch.tanh(torch.randn(A, B, generator=generator)).double()
    reward = 3.0 * torch.randn(B, generator=generator).double()
    steps = torch.randint(1, 5, (B,), generator=generator)
    discount = torch.where(torch.rand(B, generator=generator) < 0.3, 0.0, 0.97**steps).double()
    return Batch(obs, action, reward, discount, boot, torch.ones(B).double(), obs), other


def a_noise(seed):
    """Small where the policy is wide: Stable-Baselines3's log(1 - a^2) is exact only off
    saturation.
    """
    generator = torch.Generator().manual_seed(2000 + seed)
    size = torch.tensor([1.0, 0.1, 1.0])[:, None]
    return {
        s: (size * torch.randn(A, B, generator=generator)).double()
        for s in (Stream.POLICY, Stream.TARGET)
    }


# Stable-Baselines3's.


class Space(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (O,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (A,))


class InDouble(FlattenExtractor):
    def forward(self, observations):
        return super().forward(observations).double()


def sb3s(state, hidden, hyper):
    """Stable-Baselines3's SAC with the same weights, in float64, with the exact tanh correction."""
    extractor = {"features_extractor_class": InDouble, "net_arch": hidden}
    rest = {k: hyper[k] for k in ("tau", "target_entropy")} | {
        "learning_rate": hyper["lr"],
        "gamma": 0.5,
    }
    model = SAC(
        "MlpPolicy",
        Space(),
        ent_coef="auto_1.0",
        buffer_size=1,
        policy_kwargs=extractor,
        device="cpu",
        **rest,
    )
    model.policy.double()
    model.actor.action_dist.epsilon = 0.0  # 1e-6 inside the log otherwise
    model.log_ent_coef = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    model.ent_coef_optimizer = torch.optim.Adam([model.log_ent_coef], lr=hyper["lr"])
    model.set_logger(Logger(None, []))
    parts = parameters(model)
    with torch.no_grad():
        for name in ("actor", "critics", "targets"):
            for theirs, mine in zip(parts[name], flat(getattr(state, name)), strict=True):
                theirs.copy_(mine)
    return model


def parameters(model):
    """Stable-Baselines3's parameters, in the order and the grouping of `flat`."""
    actor = [m for m in model.actor.latent_pi if isinstance(m, torch.nn.Linear)]
    actor = [p for m in actor for p in (m.weight, m.bias)]
    heads = [
        model.actor.mu.weight,
        model.actor.log_std.weight,
        model.actor.mu.bias,
        model.actor.log_std.bias,
    ]
    parts = {"actor": [*actor, *heads]}
    for name, critic in {"critics": model.critic, "targets": model.critic_target}.items():
        parts[name] = [
            p
            for pair in zip(*(q.parameters() for q in critic.q_networks), strict=True)
            for p in pair
        ]
    return parts


def flat(layers):
    """Every parameter of the actor, its last layer split into its heads; or of both critics in
    turn.
    """
    if layers[0].weight.dim() == 2:
        weight, bias = layers[-1]
        return [x for layer in layers[:-1] for x in layer] + [*weight.chunk(2), *bias.chunk(2)]
    return [x for layer in layers for both in layer for x in both]


def train_sb3(model, batches, noises, monkeypatch):
    """One of its own gradient steps for each batch, with the same Gaussian numbers."""
    queue = deque(n[stream].T for n in noises for stream in (Stream.POLICY, Stream.TARGET))
    monkeypatch.setattr(
        "torch.distributions.normal._standard_normal", lambda shape, dtype, device: queue.popleft()
    )

    def column(x):
        return x[:, None]

    samples = deque(
        ReplayBufferSamples(
            b.obs.T,
            b.action.T,
            b.boot_obs.T,
            column((b.discount == 0).double()),
            column(b.reward),
            column(b.discount),
        )
        for b in batches
    )
    model.replay_buffer = SimpleNamespace(sample=lambda size, env: samples.popleft())
    model.train(gradient_steps=len(batches), batch_size=B)
    assert not queue and not samples


def assert_same(state, model):
    close = {"rtol": 1e-9, "atol": 1e-11}
    parts = parameters(model)
    for name in parts:
        for mine, theirs in zip(flat(getattr(state, name)), parts[name], strict=True):
            torch.testing.assert_close(mine, theirs.detach(), **close)
    torch.testing.assert_close(state.log_temperature, model.log_ent_coef.detach()[0], **close)
    optimizers = {"actor": model.actor.optimizer, "critics": model.critic.optimizer}
    for name, optimizer in optimizers.items():
        moments = getattr(state, f"{name}_moments")
        for key, tree in {"exp_avg": moments.first, "exp_avg_sq": moments.second}.items():
            for mine, theirs in zip(flat(tree), parts[name], strict=True):
                torch.testing.assert_close(
                    mine, optimizer.state[theirs][key], rtol=1e-8, atol=1e-12
                )
    theirs = model.ent_coef_optimizer.state[model.log_ent_coef]
    torch.testing.assert_close(state.temperature_moments.first, theirs["exp_avg"][0], **close)
    torch.testing.assert_close(state.temperature_moments.second, theirs["exp_avg_sq"][0], **close)


@pytest.mark.parametrize("count", [1, 20])
@pytest.mark.parametrize("hidden", [[24], [16, 8]], ids=str)
def test_updates_equal_sb3s(hidden, count, monkeypatch):
    state = start = a_state(0, hidden)
    model = sb3s(state, hidden, HYPER)
    batches, noises = [a_batch(i)[0] for i in range(count)], [a_noise(i) for i in range(count)]
    for batch, numbers in zip(batches, noises, strict=True):
        state, info = sac.update(state, batch, scalars(HYPER), numbers)
    train_sb3(model, batches, noises, monkeypatch)
    assert_same(state, model)
    said = model.logger.name_to_value
    if count == 1:
        assert info.critic_loss.item() == pytest.approx(said["train/critic_loss"], rel=1e-12)
        assert info.actor_loss.item() == pytest.approx(said["train/actor_loss"], rel=1e-12)
        assert info.temperature.item() == said["train/ent_coef"] == 1.0
    moved = [(x - y).abs().max() for x, y in zip(flat(state.actor), flat(start.actor), strict=True)]
    assert min(moved) > HYPER["lr"] * 0.5 and state.updates == count


@pytest.mark.parametrize("count", [1, 20])
def test_each_lane_among_others_equals_its_own_sb3(count, monkeypatch):
    """Three lanes with weights, batches, noise and hyper-parameters of their own."""
    hidden = [16, 8]
    starts = [a_state(lane, hidden) for lane in range(3)]
    batches = [[a_batch(100 * lane + i)[0] for i in range(count)] for lane in range(3)]
    noises = [[a_noise(100 * lane + i) for i in range(count)] for lane in range(3)]
    hyper, state = stack([scalars(h) for h in OTHERS]), stack(starts)
    for i in range(count):
        one = (
            stack([batches[lane][i] for lane in range(3)]),
            stack([noises[lane][i] for lane in range(3)]),
        )
        state, _ = batched(sac.update)(state, one[0], hyper, one[1])
    for lane in range(3):
        model = sb3s(starts[lane], hidden, OTHERS[lane])
        train_sb3(model, batches[lane], noises[lane], monkeypatch)
        assert_same(take(state, lane), model)


def test_greedy_and_exploring_actions_equal_sb3s(monkeypatch):
    state = a_state(4, [16, 8])
    model = sb3s(state, [16, 8], HYPER)
    obs, epsilon = torch.randn(O, B).double(), torch.randn(A, B).double()
    with torch.no_grad():
        torch.testing.assert_close(sac.greedy(state, obs), model.actor(obs.T, deterministic=True).T)
        monkeypatch.setattr(
            "torch.distributions.normal._standard_normal", lambda shape, dtype, device: epsilon.T
        )
        torch.testing.assert_close(
            sac.act(state, obs, {}, {Stream.ACTION: epsilon}), model.actor(obs.T).T
        )


# What acts on what.


def an_update(batch, seed=0, hyper=HYPER):
    state = a_state(seed, [6])
    return state, *sac.update(state, batch, scalars(hyper), a_noise(seed))


def same(one, two):
    leaves = zip(tree_leaves(one), tree_leaves(two), strict=True)
    return all(torch.equal(x, y) for x, y in leaves)


def differ(one, two):
    leaves = zip(tree_leaves(one), tree_leaves(two), strict=True)
    return all(not torch.equal(x, y) for x, y in leaves)


def slow_target(state, batch, numbers):
    """y of each transition, one at a time."""
    values = []
    for i in range(B):
        obs, epsilon = batch.boot_obs[:, i : i + 1], numbers[Stream.TARGET][:, i : i + 1]
        action, log_prob = sample(policy(state.actor, obs), epsilon)
        x = torch.cat([obs, action])
        q = min(mlp([Layer(w[c], b[c]) for w, b in state.targets], x).item() for c in range(2))
        soft = q - state.log_temperature.exp().item() * log_prob.item()
        values.append(batch.reward[i].item() + batch.discount[i].item() * soft)
    return torch.tensor(values, dtype=torch.float64)


def gradients(loss, layers):
    """By autograd, without functorch."""
    leaves = [x.clone().requires_grad_() for layer in layers for x in layer]
    return torch.autograd.grad(
        loss([Layer(*leaves[i : i + 2]) for i in range(0, len(leaves), 2)]), leaves
    )


def test_importance_weights_act_on_the_critics_loss_alone():
    plain, _ = a_batch(0)
    batch = plain._replace(weight=torch.tensor([0.1, 1.0, 0.0, 0.5, 0.25, 0.7, 0.9]).double())
    start, state, info = an_update(batch)
    start = start._replace(log_temperature=torch.zeros(()).double())
    target = slow_target(start, batch, a_noise(0))
    torch.testing.assert_close(info.target, target)

    def critics_loss(critics):
        total = 0.0
        for c in range(2):
            for i in range(B):
                x = torch.cat([batch.obs[:, i], batch.action[:, i]])[:, None]
                error = mlp([Layer(w[c], b[c]) for w, b in critics], x)[0, 0] - target[i]
                total = total + 0.5 * batch.weight[i] * error**2 / B
        return total

    first = [x for layer in state.critics_moments.first for x in layer]
    for mine, expected in zip(first, gradients(critics_loss, start.critics), strict=True):
        torch.testing.assert_close(mine, 0.1 * expected)  # Adam's first moment after one step
    assert info.critic_loss.item() == pytest.approx(critics_loss(start.critics).item())

    def actor_loss(actor):  # every item counts the same, at the updated critics
        total = 0.0
        for i in range(B):
            gaussian = policy(actor, batch.obs[:, i : i + 1])
            action, log_prob = sample(gaussian, a_noise(0)[Stream.POLICY][:, i : i + 1])
            x = torch.cat([batch.obs[:, i : i + 1], action])
            q = torch.stack(
                [mlp([Layer(w[c], b[c]) for w, b in state.critics], x)[0, 0] for c in range(2)]
            )
            total = total + (log_prob[0] - q.min()) / B  # the temperature is 1
        return total

    first = [x for layer in state.actor_moments.first for x in layer]
    for mine, expected in zip(first, gradients(actor_loss, start.actor), strict=True):
        torch.testing.assert_close(mine, 0.1 * expected)

    _, unweighted, _ = an_update(plain)
    assert same(state.log_temperature, unweighted.log_temperature)
    assert same(state.temperature_moments, unweighted.temperature_moments)
    assert differ(state.critics, unweighted.critics)


def test_a_transition_of_weight_zero_teaches_the_critics_nothing():
    batch, _ = a_batch(1)
    batch = batch._replace(weight=torch.tensor([1.0, 1, 0, 1, 1, 1, 1]).double())
    changed = batch.reward.clone()
    changed[2] = 1e6
    _, one, info = an_update(batch)
    _, two, other = an_update(batch._replace(reward=changed))
    assert other.target[2] > info.target[2] + 1e5
    assert same(one, two)


def test_actor_states_act_on_actor_and_temperature_alone():
    batch, other = a_batch(2)
    _, one, info = an_update(batch)
    _, two, changed = an_update(batch._replace(actor_obs=other))
    for name in ("critics", "targets", "critics_moments"):
        assert same(getattr(one, name), getattr(two, name))
    assert same(
        (info.q, info.target, info.critic_loss), (changed.q, changed.target, changed.critic_loss)
    )
    assert differ(one.actor, two.actor) and not same(
        one.temperature_moments, two.temperature_moments
    )

    # Neither the temperature nor y depends on the drawn states.
    _, three, changed = an_update(batch._replace(obs=other))
    assert differ(one.critics, three.critics)
    assert same((one.log_temperature, info.target), (three.log_temperature, changed.target))


def test_the_target_by_hand():
    """y = R at a discount of 0; else it grows by discount times (min Q - temperature * log pi)."""
    batch, _ = a_batch(3)
    batch = batch._replace(discount=torch.tensor([0.0, 0.97, 0.5, 0.0, 0.9, 0.8, 0.0]).double())
    start = a_state(0, [6])._replace(log_temperature=torch.tensor(-0.7).double())
    _, info = sac.update(start, batch, scalars(HYPER), a_noise(0))
    torch.testing.assert_close(info.target, slow_target(start, batch, a_noise(0)))
    assert (info.target[[0, 3, 6]] == batch.reward[[0, 3, 6]]).all()
    assert info.q.shape == (2, B) and info.temperature.item() == pytest.approx(np.exp(-0.7))


def test_the_target_of_a_mixture_is_the_mixture_of_targets():
    """With the same epsilon at every state of an item."""
    one, two = a_batch(3)[0], a_batch(4)[0]
    start = a_state(0, [6])
    shares = torch.rand(2, B, generator=torch.Generator().manual_seed(1)).double()
    batch = one._replace(
        discount=shares * torch.stack([one.discount, two.discount]),
        boot_obs=torch.cat([one.boot_obs, two.boot_obs], 1),
    )
    _, info = sac.update(start, batch, scalars(HYPER), a_noise(0))
    expected = one.reward.clone()
    for share, other in zip(shares, (one, two), strict=True):
        _, alone = sac.update(start, other, scalars(HYPER), a_noise(0))
        expected += share * (alone.target - other.reward)
    torch.testing.assert_close(info.target, expected)


@pytest.mark.parametrize("name", ["huber", "pal"])
def test_another_loss_is_the_critics_alone(name):
    """It is a function of q - y and the weights."""
    batch, _ = a_batch(6)
    start, state, info = an_update(batch)
    agent = with_loss(sac, name)
    changed, other = agent.update(start, batch, scalars(HYPER), a_noise(0))
    expected = LOSSES[name](info.q - info.target, batch.weight)
    torch.testing.assert_close(other.critic_loss, expected)
    assert same((other.q, other.target), (info.q, info.target))
    assert differ(changed.critics, state.critics)
    assert agent.greedy is sac.greedy and agent.act is sac.act


@pytest.mark.parametrize("name", LOSSES)
def test_the_reducible_loss_is_the_authors(name):
    """ReLo's code for SAC: half the squared errors of both critics, before and after the lag."""
    batch, _ = a_batch(7)
    start = a_state(0, [6])
    agent = sac if name == "squared" else with_loss(sac, name)
    _, info = agent.update(start, batch, scalars(HYPER), a_noise(0))
    found = agent.reducible_loss(start, batch, info, scalars(HYPER))
    lagging = q_values(start.targets, batch.obs, batch.action)
    one = torch.ones(1).double()
    for i in range(B):
        y = info.target[i].item()
        if name == "squared":
            now = sum((q - y) ** 2 for q in info.q[:, i].tolist()) / 2
            before = sum((q - y) ** 2 for q in lagging[:, i].tolist()) / 2
        else:
            now, before = (
                LOSSES[name]((q - info.target)[:, i : i + 1], one).item() for q in (info.q, lagging)
            )
        assert found[i].item() == pytest.approx(max(now - before, 0.0), abs=1e-12)
    assert (found > 0).any() and (found == 0).any()


def test_of_a_large_batch_each_critic_learns_from_draws_of_its_own():
    """Each is the critic of a plain update on what it drew, with the large batch's targets."""
    large = tree_map(lambda *x: torch.cat(x, -1), *(a_batch(seed)[0] for seed in (1, 2, 3)))
    start, few = a_state(0, [6]), 4
    numbers = {
        s: 0.1 * torch.randn(A, n, generator=torch.Generator().manual_seed(s)).double()
        for s, n in ((Stream.TARGET, 3 * B), (Stream.POLICY, few))
    }
    u = torch.rand(2, few, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    agent, other = with_large_batch(sac, 3), large.actor_obs.clone()
    state, info = agent.update(start, large, scalars(HYPER), {**numbers, Stream.REDRAW: u})
    assert info.q.shape == (2, 3 * B) and info.target.shape == (3 * B,)
    place, weight = laber(info.q - info.target, u, squared)
    total = 0.0
    for critic in range(2):
        at = place[critic]
        own = Batch(
            obs=large.obs[:, at],
            action=large.action[:, at],
            reward=info.target[at],
            discount=torch.zeros(few).double(),
            boot_obs=large.boot_obs[:, at],
            weight=weight[critic],
            actor_obs=large.actor_obs[:, :few],
        )
        noise_of_few = {**numbers, Stream.TARGET: numbers[Stream.POLICY]}
        plain, _ = sac.update(start, own, scalars(HYPER), noise_of_few)
        for one, two in zip(state.critics, plain.critics, strict=True):
            torch.testing.assert_close(one.weight[critic], two.weight[critic])
            torch.testing.assert_close(one.bias[critic], two.bias[critic])
        error = info.q[critic, at] - info.target[at]
        total += (weight[critic] * error.square()).mean() / 2
    torch.testing.assert_close(info.critic_loss, total)
    # The actor learns from the first states, and from no other.
    other[:, few:] += 1.0
    again, _ = agent.update(
        start, large._replace(actor_obs=other), scalars(HYPER), {**numbers, Stream.REDRAW: u}
    )
    assert same(again, state)
    other[:, :few] += 1.0
    changed, _ = agent.update(
        start, large._replace(actor_obs=other), scalars(HYPER), {**numbers, Stream.REDRAW: u}
    )
    assert differ(changed.actor, state.actor) and same(changed.critics, state.critics)


@pytest.mark.parametrize(("wanted", "direction"), [(50.0, 1.0), (-50.0, -1.0)])
def test_the_temperature_rises_when_entropy_lacks(wanted, direction):
    """Adam's first step is lr in size."""
    batch, _ = a_batch(4)
    _, state, info = an_update(batch, hyper=HYPER | {"target_entropy": wanted})
    assert state.log_temperature.item() == pytest.approx(direction * HYPER["lr"], rel=1e-6)
    assert abs(info.entropy) < 50.0
    assert sac.temperature(state).item() == pytest.approx(np.exp(direction * HYPER["lr"]))


def test_init():
    key = noise.lane_keys([5])[0, Stream.INIT]
    state = sac.init(key, O, A, [6, 4])
    assert same(state.critics, state.targets)
    assert not {id(x) for x in tree_leaves(state.critics)} & {
        id(x) for x in tree_leaves(state.targets)
    }
    assert sac.temperature(state) == 1.0 and state.updates == 0.0
    assert all((x == 0).all() for x in tree_leaves(state[4:]))
    wanted = sac.wanted(A, B)
    shapes = {
        stream: tuple(x.shape)
        for stream, x in noise.numbers(noise.lane_keys([5])[0], wanted).items()
    }
    assert shapes == {Stream.POLICY: (A, B), Stream.TARGET: (A, B), Stream.ACTION: (A, 1)}
    large = {stream: shape for stream, (_, shape) in sac.wanted(A, 4 * B, large=4).items()}
    assert large == {
        Stream.POLICY: (A, B),
        Stream.TARGET: (A, 4 * B),
        Stream.ACTION: (A, 1),
        Stream.REDRAW: (2, B),
    }
