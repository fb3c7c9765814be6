"""Deep Q-learning: equal to Stable-Baselines3's, its criterion by hand, and what a run of it is
made of.
"""

import shutil
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from scipy import stats
from stable_baselines3 import DQN
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples

import train
from aser import build, checkpoint, noise
from aser.agents import dqn, optim, with_large_batch
from aser.agents.batch import Batch
from aser.agents.laber import laber
from aser.agents.losses import huber
from aser.agents.networks import Layer, mlp
from aser.compiled import compiled, why_not_compiled
from aser.errors import ConfigError
from aser.lanes import batched
from aser.noise import Stream
from aser.replay import criteria, kinds
from aser.replay.storage import Layout, Memory
from aser.training import frozen
from aser.trees import contiguous, take, tree_leaves, tree_map

O, N, B, L = 5, 4, 7, 3
STEPS, STARTS = 60, 13  # of the run; before learning
OWN = {
    "learning_starts": STARTS,
    "exploration_start": 0.9,
    "exploration_end": 0.15,
    "exploration_steps": 0.4 * STEPS,
}
HYPER = {"lr": 3e-3, "target_interval": 8.0, **OWN}
OTHERS = [
    {**HYPER, "lr": 1e-2, "target_interval": 5.0},
    HYPER,
    {**HYPER, "lr": 3e-4, "exploration_steps": 6.0},
]
CLOSE = {"rtol": 1e-9, "atol": 1e-11}


def options(actions):
    """The agent's settings, as far as a fresh state needs them."""
    return SimpleNamespace(actions=actions)


def stack(trees):
    return tree_map(lambda *leaves: torch.stack(leaves), *trees)


def scalars(values):
    return {key: torch.tensor(value, dtype=torch.float64) for key, value in values.items()}


def same(one, two):
    leaves = zip(tree_leaves(one), tree_leaves(two), strict=True)
    return all(torch.equal(x, y) for x, y in leaves)


def a_state(seed, hidden, actions=N):
    """A float64 agent whose target network is another one."""
    key = noise.lane_keys([seed])[0, Stream.INIT]
    state = tree_map(torch.Tensor.double, dqn.init(key, O, 1, hidden, options(actions)))
    generator = torch.Generator().manual_seed(seed)
    return state._replace(
        target=tree_map(
            lambda x: x + 0.1 * torch.randn(x.shape, generator=generator).double(), state.target
        )
    )


def a_batch(seed, size=1.0):
    """Numbers that float32 can hold, n-step discounts, some ends, and errors on both sides of the
    Huber loss' knee.
    """
    generator = torch.Generator().manual_seed(1000 + seed)
    obs, boot, other = (size * torch.randn(O, B, generator=generator).double() for _ in range(3))
    action = dqn.value(torch.randint(0, N, (1, B), generator=generator), N).double()
    reward = size * 2.0 * torch.randn(B, generator=generator).double()
    steps = torch.randint(1, 5, (B,), generator=generator)
    discount = torch.where(torch.rand(B, generator=generator) < 0.3, 0.0, 0.97**steps).double()
    return Batch(obs, action, reward, discount, boot, torch.ones(B).double(), other)


def batches_of(lane, count):
    """Every third is large, so that its gradient is clipped."""
    return [a_batch(100 * lane + i, size=64.0 if i % 3 == 0 else 1.0) for i in range(count)]


# Stable-Baselines3's.


class Space(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (O,))
    action_space = gymnasium.spaces.Discrete(N)


class InDouble(FlattenExtractor):
    def forward(self, observations):
        return super().forward(observations).double()


def sb3s(state, hidden, hyper):
    """Stable-Baselines3's DQN with the same weights, in float64."""
    model = DQN(
        "MlpPolicy",
        Space(),
        hyper["lr"],
        buffer_size=1,
        gamma=0.5,
        device="cpu",
        policy_kwargs={"features_extractor_class": InDouble, "net_arch": hidden},
        target_update_interval=int(hyper["target_interval"]),
        exploration_initial_eps=hyper["exploration_start"],
        exploration_final_eps=hyper["exploration_end"],
        exploration_fraction=hyper["exploration_steps"] / STEPS,
    )
    model.policy.double()
    model.set_logger(Logger(None, []))
    with torch.no_grad():
        for network, layers in ((model.q_net, state.network), (model.q_net_target, state.target)):
            for theirs, mine in zip(network.parameters(), tree_leaves(layers), strict=True):
                theirs.copy_(mine)
    model._n_calls = int(hyper["learning_starts"])
    return model


def train_sb3(model, batches):
    """For each batch what it does at one step of the environment, and one of its own gradient
    steps.
    """
    for b in batches:
        model._current_progress_remaining = 1.0 - (model._n_calls + 1) / STEPS
        model._on_step()
        columns = (x[:, None] for x in ((b.discount == 0).double(), b.reward, b.discount))
        sample = ReplayBufferSamples(b.obs.T, dqn.index(b.action, N).T, b.boot_obs.T, *columns)
        model.replay_buffer = SimpleNamespace(sample=lambda size, env, sample=sample: sample)
        model.train(gradient_steps=1, batch_size=B)


def assert_same(state, model):
    for network, layers in ((model.q_net, state.network), (model.q_net_target, state.target)):
        for theirs, mine in zip(network.parameters(), tree_leaves(layers), strict=True):
            torch.testing.assert_close(mine, theirs.detach(), **CLOSE)
    for key, tree in {"exp_avg": state.moments.first, "exp_avg_sq": state.moments.second}.items():
        for mine, theirs in zip(tree_leaves(tree), model.q_net.parameters(), strict=True):
            torch.testing.assert_close(
                mine, model.policy.optimizer.state[theirs][key], rtol=1e-8, atol=1e-12
            )


@pytest.mark.parametrize("count", [1, 20])
@pytest.mark.parametrize("hidden", [[24], [16, 8]], ids=str)
def test_updates_equal_sb3s(hidden, count):
    state = start = a_state(0, hidden)
    model = sb3s(state, hidden, HYPER)
    norms = []
    for batch in batches_of(0, count):
        state, info = dqn.update(state, batch, scalars(HYPER), {})
        train_sb3(model, [batch])
        norms.append(info.gradient_norm.item())
        assert info.loss.item() == pytest.approx(
            model.logger.name_to_value["train/loss"], rel=1e-12
        )
        rate = dqn.exploration(state, scalars(HYPER)).item()  # of the action that comes next
        assert rate == pytest.approx(model.exploration_rate, rel=1e-12)
    assert_same(state, model)
    assert state.updates == count and max(norms) > dqn.MOST_NORM
    moved = [
        (x - y).abs().max()
        for x, y in zip(tree_leaves(state.network), tree_leaves(start.network), strict=True)
    ]
    assert min(moved) > HYPER["lr"] * 0.5
    if count == 20:
        assert min(norms) < dqn.MOST_NORM and rate == pytest.approx(0.15)
        assert not same(state.target, start.target)


@pytest.mark.parametrize("count", [1, 20])
def test_each_lane_among_others_equals_its_own_sb3(count):
    """Three lanes with weights, batches and hyper-parameters of their own; one lane's gradient
    clips no other's.
    """
    hidden = [16, 8]
    starts = [a_state(lane, hidden) for lane in range(L)]
    batches = [batches_of(lane, count) for lane in range(L)]
    # A quiet lane between loud ones.
    batches[1] = [a_batch(500 + i, size=0.125) for i in range(count)]
    hyper, state = stack([scalars(h) for h in OTHERS]), stack(starts)
    for i in range(count):
        state, info = batched(dqn.update)(state, stack([own[i] for own in batches]), hyper, {})
        assert info.gradient_norm[1] < dqn.MOST_NORM
    for lane in range(L):
        model = sb3s(starts[lane], hidden, OTHERS[lane])
        train_sb3(model, batches[lane])
        assert_same(take(state, lane), model)


def test_the_greedy_action_is_sb3s():
    state = a_state(4, [16, 8])
    obs = torch.randn(O, B).double()
    theirs, _ = sb3s(state, [16, 8], HYPER).policy.predict(obs.T.numpy(), deterministic=True)
    assert dqn.index(dqn.greedy(state, obs), N).tolist() == [theirs.tolist()]


# What acts on what.


def test_the_target_and_the_weighted_loss_by_hand():
    state, plain = a_state(1, [6]), a_batch(3)
    weight = torch.tensor([0.1, 1.0, 0.0, 0.5, 0.25, 0.7, 0.9]).double()
    after, info = dqn.update(state, plain._replace(weight=weight), scalars(HYPER), {})
    targets = []
    for i in range(B):
        best = max(mlp(state.target, plain.boot_obs[:, i : i + 1])[:, 0].tolist())
        targets.append(plain.reward[i].item() + plain.discount[i].item() * best)
    assert info.target.tolist() == pytest.approx(targets)
    assert (info.target[plain.discount == 0] == plain.reward[plain.discount == 0]).all()
    leaves = [x.clone().requires_grad_() for x in tree_leaves(state.network)]
    loss = 0.0
    for i in range(B):
        action = [-1.0, -1 / 3, 1 / 3, 1.0].index(pytest.approx(plain.action[0, i].item()))
        error = (
            mlp([Layer(*leaves[:2]), Layer(*leaves[2:])], plain.obs[:, i : i + 1])[action, 0]
            - targets[i]
        ).abs()
        loss = loss + weight[i] * (0.5 * error**2 if error < 1 else error - 0.5) / B  # Huber
        assert error.item() == pytest.approx(
            criteria.td_error(info.q, info.target, "min")[i].item()
        )
    assert info.loss.item() == pytest.approx(loss.item())
    grads = torch.autograd.grad(loss, leaves)
    norm = torch.nn.utils.get_total_norm(grads)
    assert info.gradient_norm.item() == pytest.approx(norm.item()) and norm < dqn.MOST_NORM
    for mine, expected in zip(tree_leaves(after.moments.first), grads, strict=True):
        torch.testing.assert_close(mine, 0.1 * expected)  # Adam's first moment after one step
    changed = dqn.update(
        state, a_batch(3)._replace(weight=weight, actor_obs=plain.boot_obs), scalars(HYPER), {}
    )
    assert same(changed, (after, info))  # there is no actor


def test_the_target_network_is_copied_every_so_many_steps_of_the_environment():
    state = a_state(2, [6])
    for step in range(STARTS + 1, STARTS + 30):
        before = state
        state, _ = dqn.update(state, a_batch(step), scalars(HYPER), {})
        copied = step % 8 == 0  # between this step and its update
        assert same(state.target, before.network if copied else before.target)
        assert not same(state.target, state.network)


def test_the_reducible_loss_is_the_authors_with_the_target_network_of_the_update():
    """ReLo's code for DQN: Huber's loss now, minus that with the target network's values."""
    copied = 0
    for step in range(STARTS + 1, STARTS + 12):
        state, batch = a_state(step, [6]), a_batch(step)
        state = state._replace(updates=torch.tensor(step - STARTS - 1.0).double())
        after, info = dqn.update(state, batch, scalars(HYPER), {})
        found = dqn.reducible_loss(state, batch, info, scalars(HYPER))
        taken = dqn.index(batch.action, N)
        lagging = mlp(after.target, batch.obs).gather(0, taken)[0]
        losses = [
            torch.nn.functional.smooth_l1_loss(q, info.target, reduction="none")
            for q in (info.q[0], lagging)
        ]
        torch.testing.assert_close(found, (losses[0] - losses[1]).clamp(min=0))
        copied += step % 8 == 0
        assert (found == 0).all() == (step % 8 == 0)  # the networks are one after a copy
    assert copied == 2


def test_of_a_large_batch_it_learns_from_what_laber_draws():
    large = Batch(*(torch.cat(x, -1) for x in zip(a_batch(1)[:-1], a_batch(2)[:-1], strict=True)))
    state, few = a_state(3, [6]), 5
    u = torch.rand(1, few, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    agent = with_large_batch(dqn, 2)
    after, info = agent.update(state, large, scalars(HYPER), {Stream.REDRAW: u})
    assert info.q.shape == (1, 2 * B) and info.target.shape == (2 * B,)
    place, weight = laber(info.q - info.target, u, huber)
    own = Batch(*(x[..., place[0]] for x in large[:-1]))._replace(weight=weight[0])
    plain, told = dqn.update(state, own, scalars(HYPER), {})
    torch.testing.assert_close(info.loss, told.loss)
    for one, two in zip(tree_leaves(after), tree_leaves(plain), strict=True):
        torch.testing.assert_close(one, two)
    assert agent.wanted(1, 8)[Stream.REDRAW][1] == (1, 4)


@pytest.mark.parametrize("size", [1e-9, 1.0, 30.0])
def test_clipping_is_torchs(size):
    grads = [
        size * torch.randn(4, 3).double(),
        {"b": size * torch.randn(5).double(), "c": torch.zeros(()).double()},
    ]
    theirs = [torch.zeros_like(x, requires_grad=True) for x in tree_leaves(grads)]
    for parameter, grad in zip(theirs, tree_leaves(grads), strict=True):
        parameter.grad = grad.clone()
    norm = torch.nn.utils.clip_grad_norm_(theirs, 10.0)
    found, mine = optim.clip_norm(grads, 10.0)
    torch.testing.assert_close(mine, norm, **CLOSE)
    for x, parameter in zip(tree_leaves(found), theirs, strict=True):
        torch.testing.assert_close(x, parameter.grad, rtol=1e-12, atol=0)
    assert optim.clip_norm([torch.zeros(3)], 10.0)[0][0].tolist() == [0.0] * 3


# Actions.


@pytest.mark.parametrize("n", [2, 3, 16, 21, 50, 101])
def test_an_actions_value_and_back(n):
    value = dqn.value(torch.arange(n), n)
    assert value.equal(torch.from_numpy(np.linspace(-1, 1, n)).float())  # to the bit
    assert dqn.index(value, n).tolist() == list(range(n))
    near = (value + (torch.rand(n) - 0.5) * 1.9 / (n - 1)).clamp(-1, 1)
    assert dqn.index(near, n).tolist() == list(range(n))
    state = SimpleNamespace(network=[Layer(None, torch.zeros(L, n))])
    smallest, largest = 2.0**-24, 1 - 2.0**-24  # of noise.uniform
    assert dqn.index(dqn.at_random(state, torch.tensor([smallest, largest])), n).tolist() == [
        0,
        n - 1,
    ]
    u = noise.uniform(noise.lane_keys([3])[0, Stream.ACTION], (20_000,))
    counts = torch.bincount(dqn.index(dqn.at_random(state, u), n), minlength=n)
    assert len(counts) == n and stats.chisquare(counts).pvalue > 1e-4


def test_every_gate_of_the_corridor_lets_five_actions_through():
    env = train.settings(["env=corridor", "agent=dqn"]).env
    actions = dqn.value(torch.arange(21), 21).numpy()
    assert [
        ((actions >= np.float32(low)) & (actions <= np.float32(high))).sum()
        for _, low, high in env.kwargs["gates"]
    ] == [5] * 4


def test_epsilon_greedy():
    keys = noise.lane_keys(range(4000))
    numbers = batched(lambda keys: noise.numbers(keys, dqn.wanted(1, B)))(keys)
    assert numbers[Stream.ACTION].shape == (4000, 2, 1) and list(numbers) == [Stream.ACTION]
    state, obs = tree_map(torch.Tensor.float, a_state(3, [6])), torch.randn(O, 1)
    best = dqn.index(dqn.greedy(state, obs), N).item()
    for updates, rate in [
        (0, 0.9 - 0.75 * 13 / 24),
        (5, 0.9 - 0.75 * 18 / 24),
        (11, 0.15),
        (40, 0.15),
    ]:
        state = state._replace(updates=torch.tensor(float(updates)))
        hyper = {key: torch.tensor(x) for key, x in HYPER.items()}
        assert dqn.exploration(state, hyper).item() == pytest.approx(rate)
        chosen = torch.vmap(lambda noise: dqn.act(state, obs, hyper, noise))(numbers)  # noqa: B023
        counts = torch.bincount(dqn.index(chosen, N).flatten(), minlength=N)
        expected = [4000 * (rate / N + (1 - rate) * (a == best)) for a in range(N)]
        assert chosen.shape == (4000, 1, 1) and stats.chisquare(counts, expected).pvalue > 1e-4
    for rate, everywhere in [(0.0, {best}), (1.0, set(range(N)))]:
        hyper = {
            **hyper,
            "exploration_start": torch.tensor(rate),
            "exploration_end": torch.tensor(rate),
        }
        chosen = torch.vmap(lambda noise: dqn.act(state, obs, hyper, noise))(numbers)  # noqa: B023
        assert set(dqn.index(chosen, N).flatten().tolist()) == everywhere


def test_init():
    state = dqn.init(noise.lane_keys([5])[0, Stream.INIT], O, 1, [6, 3], options(N))
    assert [tuple(x.shape) for x in tree_leaves(state.network)] == [
        (6, O),
        (6,),
        (3, 6),
        (3,),
        (N, 3),
        (N,),
    ]
    assert same(state.network, state.target) and dqn.temperature(state) == state.updates == 0
    assert not {id(x) for x in tree_leaves(state.network)} & {
        id(x) for x in tree_leaves(state.target)
    }
    assert all((x == 0).all() for x in tree_leaves(state.moments))


# The criterion.


def dropoff(q):
    return kinds.make("q_dropoff").function(None, None, torch.tensor(q).T).tolist()


def test_q_dropoff_by_hand():
    states = [
        [0.0, 0.0, 0.0, 0.0],  # no action matters
        [3.0, 3.0, 3.0, 2.0],  # one bad action: the last rank, of weight 1/6
        [2.0, 3.0, 2.0, 2.0],  # one good action: every rank loses 1
        [3.0, 2.0, 3.0, 2.0],  # ranks 3 and 4: 2/6 + 1/6
        [1.0, -3.0, 0.0, -1.0],  # drops 1, 2, 4: 3/6 + 2 2/6 + 4 1/6
    ]
    assert dropoff(states) == pytest.approx([0.0, 1 / 6, 1.0, 1 / 2, 11 / 6])
    assert dropoff([[5.0, 2.5]]) == [2.5]


@pytest.mark.parametrize("n", [2, 5, 21])
def test_q_dropoff_is_the_weighted_drop_of_the_sorted_values(n):
    q = np.random.default_rng(n).normal(size=(B, n)).round(1)  # some are equal
    expected = []
    for state in q:
        best, *rest = sorted(state, reverse=True)
        weights = [n + 1 - rank for rank in range(2, n + 1)]
        expected.append(
            sum(w * (best - x) for w, x in zip(weights, rest, strict=True)) / sum(weights)
        )
    found = dropoff(q)
    assert found == pytest.approx(expected) and min(found) >= 0
    # It follows the distances between values, and not where they lie.
    assert dropoff(3.0 * q - 7.0) == pytest.approx([3.0 * p for p in expected])
    assert dropoff(q[:, ::-1].copy()) == pytest.approx(expected)


def test_q_dropoff_is_that_of_the_agents_network():
    state, obs = tree_map(torch.Tensor.float, a_state(6, [6])), torch.randn(O, B)
    outputs = dqn.outputs(dqn.kept(state), obs)
    found = criteria.function("q_dropoff")(dqn.kept(state), obs, outputs).tolist()
    assert found == pytest.approx(dropoff(mlp(state.network, obs).T.tolist()), rel=1e-5)
    warm_up, keys = torch.randn(O, 11), noise.lane_keys([0])[0]
    known = dropoff(mlp(state.network, warm_up).T.tolist())
    lane = kinds.Lane(dqn, Layout(O, 1), state, {}, Memory(None, warm_up, keys, None))
    for p in kinds.make("shuffled", "q_dropoff").p(lane, obs, outputs).tolist():
        assert min(abs(p - other) for other in known) < 1e-5


# A run.

CORRIDOR = [
    "env=corridor",
    "agent=dqn",
    "compile=false",
    "seeds=[3,8]",
    "batch=5",
    "eval.every=null",
]


def built(*overrides):
    config = train.settings([*CORRIDOR, *overrides])
    return build.build(config, train.CONF, train.CONF.parent / "results")


def test_a_run_acts_on_the_grid_and_explores_as_its_settings_say():
    exploring = [
        "agent.exploration.start=1",
        "agent.exploration.end=0",
        "agent.exploration.share=.25",
    ]
    run = built("steps=400", "learning_starts=40", "agent.actions=6", *exploring, "hyper.lr=.01")
    run.run()
    storage = run.setup.buffer.storage
    action = storage.layout.read(storage.rows, "action")
    chosen = dqn.index(action, 6)
    assert action.equal(dqn.value(chosen, 6)) and set(chosen[:, :40].flatten().tolist()) == set(
        range(6)
    )
    assert {name: x.tolist() for name, x in run.setup.hyper.items() if name in OWN} == {
        "learning_starts": [40.0] * 2,
        "exploration_start": [1.0] * 2,
        "exploration_end": [0.0] * 2,
        "exploration_steps": [100.0] * 2,
    }
    told = {step: values for step, values in run.history.diagnostics}
    # The action of step 100 was drawn with it.
    assert told[100]["exploration"].tolist() == pytest.approx([0.01] * 2)
    assert told[200]["exploration"].tolist() == [0.0] * 2
    assert {"loss", "gradient_norm", "td_error"} <= set(told[100]) and "temperature" not in told[
        100
    ]


def test_it_learns_the_corridors_first_gates():
    config = [
        "env=corridor",
        "agent=dqn",
        "sampler=uniform",
        "hyper=sb3",
        "hyper.lr=1e-3",
        "seeds=[1000,1001,1002]",
    ]
    config = train.settings([*config, "steps=1200", "eval.every=400"])
    run = build.build(config, train.CONF, train.CONF.parent / "results")
    run.run()
    # The values of the actions at the first gate.
    q = mlp(take(run.state.agent, 0).network, torch.tensor([[2 * 0.4 / 2.0 - 1]]))[:, 0]
    assert 0.3 - 1e-6 <= dqn.value(q.argmax(), 21) <= 0.7 + 1e-6
    # An even choice at four gates fails 997 times in 1000.
    assert run.history.returns[-1][1].mean() > -0.7


@pytest.mark.parametrize(
    ("sampler", "drawing", "weights"),
    [
        ("uniform", "uniform", False),
        ("per", "td_error", True),
        ("nstep", "uniform", False),
        ("aser", "q_dropoff", False),
        ("pretrained", "pretrained", False),
        ("oracle", "oracle", False),
        ("aser_shuffled", "shuffled", False),
        ("nstep_geometric", "uniform", False),
        ("relo", "reducible_loss", True),
        ("laber", "uniform", False),
    ],
)
def test_what_its_samplers_are_made_of(sampler, drawing, weights):
    config = train.settings(["env=corridor", "agent=dqn", f"sampler={sampler}"])
    assert (config.criterion.name, config.prioritisation.weights) == (drawing, weights)
    assert config.bootstrap.path_entropy == "none"
    assert config.criterion.of == ("q_dropoff" if drawing in ("pretrained", "shuffled") else None)
    assert not {"tau", "target_entropy"} & set(config.hyper.values)
    assert config.hyper.values["lr"] > 0 and config.hyper.source.split("/")[1] == "dqn"


def test_a_longer_unroll_adds_discounted_rewards_and_no_entropy():
    run = built(
        "sampler=nstep", "steps=60", "learning_starts=30", "hyper.h=3", "hyper.gamma=.5", "batch=64"
    )
    run.run()
    buffer, clock, numbers = run.setup.buffer, run._clock, run._numbers(60)
    drawn = buffer.draw(numbers[Stream.DRAW], run.hyper, clock)
    for lane in range(2):
        memory = Memory(*(part[lane] for part in buffer.memory(clock)[:3]), clock)
        state, hyper = take(run.state, lane), take(run.hyper, lane)
        arguments = take(drawn, lane), hyper, take(numbers, lane)
        batch, (n, _) = buffer.sampler.assemble(state, memory, *arguments)
        rows = buffer.storage.rows[lane]
        for i, first in enumerate(drawn.index[lane].tolist()):
            rewards = rows[first : first + n[i], 2].tolist()  # position, action, reward
            assert batch.reward[i].item() == pytest.approx(
                sum(r * 0.5**j for j, r in enumerate(rewards))
            )
        assert n.max() == 3


# Where its hyper-parameters come from.


def test_every_sampler_takes_the_tuned_rates_of_even_draws_and_the_rest_from_sb3s(
    tmp_path, monkeypatch
):
    conf = tmp_path / "conf"
    shutil.copytree(train.CONF, conf)
    monkeypatch.setattr(train, "CONF", conf)
    shutil.rmtree(conf / "hyper/tuned/dqn", ignore_errors=True)
    (conf / "hyper/tuned/dqn/corridor").mkdir(parents=True)
    (conf / "hyper/tuned/dqn/corridor/uniform.yaml").write_text("lr: .004\ngamma: .9\n")
    lent = {
        "uniform": "",
        "per": ", alpha, epsilon, beta from sb3",
        "aser": ", alpha, epsilon, h, k_m, k_s from sb3",
    }
    for sampler, rest in lent.items():
        config = train.settings(["env=corridor", "agent=dqn", f"sampler={sampler}"])
        assert (config.hyper.set, config.hyper.source) == (
            "tuned",
            "tuned/dqn/corridor/uniform" + rest,
        )
        rest = train.settings(
            ["env=corridor", "agent=dqn", f"sampler={sampler}", "hyper=sb3"]
        ).hyper.values
        assert config.hyper.values == {**rest, "lr": 0.004, "gamma": 0.9}
    sac = train.settings(["env=corridor", "sampler=uniform"])
    assert "dqn" not in sac.hyper.source


# Frozen agents.


def test_frozen_agents_are_dqns_in_a_file_of_their_own(house, capsys):
    short = ["sampler=pretrained", "env.steps=112", "steps=40", "learning_starts=30"]
    run = built(*short)
    assert "training the frozen agents" in capsys.readouterr().out
    (path,) = (house / "results" / "pretrained").glob("[!.]*.pt")
    assert path.name.startswith("corridor-dqn-")
    again = built(*short, "hyper.gamma=.5", "network.hidden=[5]")
    assert capsys.readouterr().out == "" and isinstance(again.setup, type(run.setup))
    agents = frozen.shipped(path, dqn, lambda: pytest.fail("it is there"), torch.device("cpu")).kept
    obs = torch.rand(2, 1, 6) * 2 - 1
    criterion = run.setup.buffer.sampler.drawing
    for lane, seed in enumerate(run.setup.seeds):
        expected = dropoff(mlp(take(agents, seed % 16).network, obs[lane]).T.tolist())
        assert criterion.function(obs)[lane].tolist() == pytest.approx(expected, rel=1e-4, abs=1e-6)
    built(*short, "agent.actions=5")  # another agent
    assert len(list((house / "results" / "pretrained").glob("[!.]*.pt"))) == 2


def test_a_run_lends_its_agents_to_its_own_kind(house, capsys):
    small = [
        "debug=smoke",
        "env=corridor",
        "batch=5",
        "steps=40",
        "learning_starts=30",
        "eval.every=null",
    ]
    dqns = ["agent=dqn", "agent.actions=6", "network.hidden=[5,3]", "seeds=[6,1,9]", "run_dir=dqn"]
    assert train.main([*small, *dqns]) == 0 and train.main([*small, "run_dir=sac"]) == 0
    lent = torch.load("dqn/checkpoint.pt", weights_only=True)["agent"]
    agents = frozen.of_run(house / "dqn").kept
    assert same(checkpoint.leaves(agents), lent[:6])
    own = ["sampler=pretrained", "steps=40", "learning_starts=30"]
    built(*own, "criterion.checkpoint=dqn").run()  # of six actions, to an agent of 21
    for borrower, lender in [("dqn", "sac"), ("sac", "dqn")]:
        with pytest.raises(
            ConfigError,
            match=rf"^criterion.checkpoint={lender}: .*allowed: agent={borrower}[^\n]*$",
        ):
            built(*own, f"agent={borrower}", f"criterion.checkpoint={lender}")


# Compiled.


@pytest.mark.skipif(
    why_not_compiled() is not None, reason=f"not compiled: {why_not_compiled()} here"
)
def test_the_compiled_update_is_the_eager_one():
    keys = noise.lane_keys(range(L))
    state = contiguous(
        batched(lambda key: dqn.init(key, O, 1, [6], options(N)))(keys[:, Stream.INIT])
    )
    hyper = tree_map(torch.Tensor.float, stack([scalars(h) for h in OTHERS]))
    numbers = batched(lambda keys: noise.numbers(keys, dqn.wanted(1, B)))(keys)

    def step(state, batch, hyper, noise):
        state, info = dqn.update(state, batch, hyper, noise)
        p = criteria.q_dropoff(state, batch.obs, mlp(state.network, batch.obs))
        return state, info, p, dqn.act(state, batch.obs[:, :1], hyper, noise)

    program = compiled(batched(step))
    with torch.no_grad():
        for i in range(12):
            batch = tree_map(
                torch.Tensor.float, stack([a_batch(100 * lane + i) for lane in range(L)])
            )
            arguments = state, batch, hyper, numbers
            eager, found = batched(step)(*arguments), program(*arguments)
            for mine, theirs in zip(tree_leaves(found), tree_leaves(eager), strict=True):
                torch.testing.assert_close(mine, theirs, rtol=2e-4, atol=2e-5)
            state = contiguous(eager[0])
