"""Stable Baselines3's SAC with a sampler, against this project's own functions on the same numbers.

B items, O observation, A action, E environments that one agent learns from.
"""

from collections import deque
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv

from aser import noise
from aser.agents import sac
from aser.integrations.sb3 import SAC, ReplayBuffer, samplers, unrolls
from aser.integrations.sb3.networks import networks
from aser.integrations.sb3.sac import Batch
from aser.noise import Stream
from aser.replay import buffer as own
from aser.replay import kinds
from aser.replay.bootstrap import RULES
from aser.replay.criteria import td_error
from aser.replay.outcome_spread import OutcomeSpread
from aser.replay.priorities import proportional
from aser.replay.sampler import Drawn, Sampler, State
from aser.replay.storage import Clock, Layout, Memory
from aser.replay.unroll import Unroll
from aser.settings.sampler import SPREAD_DEFAULTS
from aser.trees import tree_leaves, tree_map

O, A, B, E, SLOTS, STARTS, SEED = 3, 2, 8, 3, 16, 12, 5
STEP, GAMMA, LR = 700, 0.9, 3e-3
OBS, ACTION = gymnasium.spaces.Box(-np.inf, np.inf, (O,)), gymnasium.spaces.Box(-1.0, 1.0, (A,))
SPREAD = OutcomeSpread(**SPREAD_DEFAULTS | {"width": 1.5})
GIVEN = {  # the quantile's rank is no whole number, so no p is equal to the threshold
    "per": {},
    "lap": {},
    "nstep": {"h": 4},
    "aser": {"h": 5, "k_m": 0.75},
    "outcome_spread": {"h": 5, "k_m": 0.75, "width": 1.5},
}


class Space(gymnasium.Env):
    observation_space, action_space = OBS, ACTION


def ours(name):
    """This project's sampler of the same name."""
    live = kinds.Live("mode_log_prob", kinds.function("mode_log_prob"))
    criterion, rule = {
        "per": (kinds.PerItem("td_error"), None),
        "nstep": (kinds.Constant("uniform"), "fixed"),
        "aser": (live, "threshold"),
        "outcome_spread": (kinds.Learned("spread", SPREAD), "threshold_or_zero"),
    }[name]
    return Sampler(
        agent=sac,
        layout=Layout(O, A),
        batch=B,
        drawing=criterion,
        unroll=Unroll(
            RULES.get(rule),
            criterion if rule in ("threshold", "threshold_or_zero") else None,
            window=GIVEN[name].get("h", 1),
        ),
        mass=None if name == "nstep" else proportional,
        weights=name == "per",
    )


def a_model(name, seed=0):
    """An agent whose targets are not its critics, with a ring that has been overwritten."""
    model = SAC(
        "MlpPolicy",
        DummyVecEnv([Space] * E),
        sampler=name,
        sampler_kwargs=GIVEN[name],
        policy_kwargs={"net_arch": [7]},
        buffer_size=SLOTS * E,
        learning_starts=STARTS,
        learning_rate=LR,
        gamma=GAMMA,
        ent_coef="auto_0.3",
        target_entropy=-1.5,
        seed=SEED,
        device="cpu",
    )
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for x in [*model.critic_target.parameters(), *model.actor.parameters()]:
            x.add_(0.3 * torch.randn(x.shape, generator=generator))
    model.actor.action_dist.epsilon = 0.0  # 1e-6 inside the logarithm otherwise
    model.set_logger(Logger(None, []))
    model.num_timesteps = STEP
    fill(model.replay_buffer, SLOTS + 5, seed)
    return model


def fill(buffer, count, seed):
    """Transitions of which a few end an episode, by a terminal state or by a time limit."""
    random = np.random.default_rng(seed)
    obs = random.normal(size=(buffer.n_envs, O)).astype(np.float32)
    for t in range(count):
        next_obs = random.normal(size=obs.shape).astype(np.float32)
        action = random.uniform(-1, 1, (buffer.n_envs, A)).astype(np.float32)
        reward = random.normal(size=buffer.n_envs).astype(np.float32)
        phase = (t + np.arange(buffer.n_envs)) % 7
        terminated, truncated = phase == 3, phase == 5
        done = terminated | truncated
        infos = [{"TimeLimit.truncated": bool(x)} for x in truncated & ~terminated]
        buffer.add(obs, next_obs, action, reward, done, infos)
        obs = np.where(done[:, None], random.normal(size=obs.shape), next_obs).astype(np.float32)


def terminals(buffer):
    return buffer.dones * (1 - buffer.timeouts)


def memory_of(buffer, lane, layout, numbers):
    """The items of one environment as the rows of one lane."""
    rows = torch.zeros(SLOTS, layout.width)
    facts = {
        "obs": buffer.observations,
        "action": buffer.actions,
        "reward": buffer.rewards[..., None],
        "next_obs": buffer.next_observations,
        "terminated": terminals(buffer)[..., None],
        "truncated": buffer.timeouts[..., None],
    }
    for name, values in facts.items():
        rows[:, layout.columns[name]] = torch.from_numpy(values[:, lane])
    warm_up = torch.from_numpy(buffer.observations[: STARTS // E].reshape(-1, O)).T
    newest = torch.tensor((buffer.pos - 1) % SLOTS)
    clock = Clock(torch.tensor(STEP, dtype=torch.int32), newest, torch.tensor(SLOTS), None)
    return Memory(rows, warm_up, numbers, clock)


def state_of(model, sampler, keys):
    """The model's networks, copied, as an agent of this project with fresh optimisers."""
    read = tree_map(lambda x: x.detach().clone(), networks(model.policy))
    critics = networks(SimpleNamespace(actor=model.actor, critic_target=model.critic)).targets
    start = sac.init(keys[Stream.INIT], O, A, [7])
    agent = start._replace(
        actor=read.actor,
        critics=tree_map(lambda x: x.detach().clone(), critics),
        targets=read.targets,
        log_temperature=model.log_ent_coef.detach().clone()[0],
    )
    return State(agent, sampler.init(keys[Stream.CRITERION]))


def close(x, y, rtol=1e-4, atol=1e-5):
    torch.testing.assert_close(x, y, rtol=rtol, atol=atol, check_dtype=False)


@pytest.mark.parametrize("lane", range(E))
@pytest.mark.parametrize("name", ["per", "nstep", "aser", "outcome_spread"])
def test_one_update_is_this_projects(name, lane, monkeypatch):
    """The batch, the unrolls, the gradients, the learned criterion and the new priorities."""
    model, sampler = a_model(name, seed=lane), ours(name)
    buffer, keys = model.replay_buffer, noise.lane_keys([SEED])[0]
    random = np.random.default_rng(lane)
    judged = random.permutation(SLOTS)[:B]
    newest, terminal = (buffer.pos - 1) % SLOTS, np.flatnonzero(terminals(buffer)[:, lane])[0]
    others = [slot for slot in random.permutation(SLOTS) if slot not in (newest, terminal)]
    slots = np.array([newest, terminal, *others])[:B]
    weight = torch.linspace(0.5, 1.0, B) if name == "per" else None
    numbers = {
        Stream.PATH: torch.randn(A, B),
        Stream.POLICY: 0.5 * torch.randn(A, B),
        Stream.TARGET: 0.5 * torch.randn(A, B),
        Stream.UNIFORM: torch.from_numpy((judged + 0.5) / SLOTS),
    }
    hyper = {k: torch.tensor(v) for k, v in buffer.sampler.hyper.items()}
    hyper |= {k: torch.tensor(v) for k, v in {"gamma": GAMMA, "lr": LR, "tau": 0.005}.items()}
    hyper["target_entropy"] = torch.tensor(-1.5)
    memory = memory_of(buffer, lane, sampler.layout, keys)
    state = state_of(model, sampler, keys)
    if name == "outcome_spread":  # both have learned from every item of this environment before
        every = torch.arange(SLOTS)
        state = sampler.learn(state, memory, every, hyper, {})
        facts = buffer.transitions(every.numpy() * E + lane)
        buffer.seen = SPREAD.update(buffer.seen, facts, state.agent, hyper, {})
    drawn = Drawn(torch.from_numpy(slots), torch.ones(B) if weight is None else weight)
    batch, unrolled = sampler.assemble(state, memory, drawn, hyper, numbers)
    agent, info = sac.update(state.agent, batch, hyper, numbers)
    state = sampler.learn(State(agent, state.criteria), memory, drawn.index, hyper, {})

    seen = {}
    original = unrolls.unroll

    def spied(*arguments):
        seen["result"] = original(*arguments)
        return seen["result"]

    queue = deque(numbers[stream].T for stream in (Stream.POLICY, Stream.TARGET))
    chance = unrolls.Chance(judged * E + lane, numbers[Stream.PATH])
    with monkeypatch.context() as patch:
        patch.setattr(unrolls, "unroll", spied)
        patch.setattr(unrolls, "chance", lambda *_: chance)
        patch.setattr(buffer, "draw", lambda *_: (slots * E + lane, weight))
        patch.setattr(
            "torch.distributions.normal._standard_normal", lambda *_, **__: queue.popleft()
        )
        model.train(1, B)

    samples, n, b = seen["result"]
    assert torch.equal(n, unrolled.n) and n[0] == 1
    assert name == "per" or n.max() > 1
    assert name in ("per", "nstep") or 1 < n.double().mean() < 4
    close(b, unrolled.b) if name in ("aser", "outcome_spread") else None
    assert torch.equal(samples.observations, batch.obs.T)
    assert torch.equal(samples.actions, batch.action.T)
    assert torch.equal(samples.next_observations, batch.boot_obs.T)
    close(samples.rewards[:, 0], batch.reward)
    close(((1 - samples.dones) * samples.discounts)[:, 0], batch.discount)
    assert batch.discount[0] > 0.0 and batch.discount[1] == 0.0

    critic = [
        p
        for pair in zip(*(q.parameters() for q in model.critic.q_networks), strict=True)
        for p in pair
    ]
    moments = [x for layer in agent.critics_moments.first for both in layer for x in both]
    for theirs, mine in zip(critic, moments, strict=True):
        close(model.critic.optimizer.state[theirs]["exp_avg"], mine)
    log_temperature = model.ent_coef_optimizer.state[model.log_ent_coef]["exp_avg"][0]
    close(log_temperature, agent.temperature_moments.first)
    actor = model.actor.mu.weight
    close(model.actor.optimizer.state[actor]["exp_avg"], agent.actor_moments.first[-1].weight[:A])

    if name == "outcome_spread":
        for theirs, mine in zip(
            tree_leaves(buffer.seen), tree_leaves(state.criteria["spread"]), strict=True
        ):
            close(theirs, mine, rtol=1e-3, atol=1e-4)
    if sampler.rewrites:
        error = td_error(info.q, info.target, "min")
        mass = sampler.mass_of_drawn(state, memory, batch.obs, error, hyper)
        close(buffer.priorities.mass[0, slots * E + lane], mass, rtol=1e-3)
        assert mass.std() > 0.01


@pytest.mark.parametrize(("name", "new"), [("per", "current_max"), ("lap", "ever_max")])
def test_draws_priorities_and_weights_are_this_projects(name, new):
    """Over 40 steps in a ring of 8 items, of which every step draws some."""
    size, batch = 8, 6
    buffer = ReplayBuffer(size, OBS, ACTION, device="cpu", sampler=name)
    read = buffer.sampler
    sampler = Sampler(
        agent=sac,
        layout=Layout(O, A),
        batch=batch,
        drawing=kinds.PerItem("td_error"),
        mass=read.mass,
        weights=name == "per",
    )
    twin = own.Buffer(sampler, 1, size, 1, noise.lane_keys([0]), new)
    hyper = {key: torch.tensor([value]) for key, value in read.hyper.items()}
    random = np.random.default_rng(0)
    weights = []
    for step in range(40):
        fill(buffer, 1, step)
        facts = {"obs": np.zeros((1, O)), "action": np.zeros((1, A)), "next_obs": np.zeros((1, O))}
        facts |= {key: np.zeros(1) for key in ("reward", "terminated", "truncated")}
        twin.append(facts, hyper)
        np.random.seed(step)
        u = torch.from_numpy(np.random.random_sample((1, batch)))
        np.random.seed(step)
        drawn = twin.draw(u, hyper, twin.storage.clock(step, 40))
        index, weight = buffer.draw(batch, step / 40)
        assert np.array_equal(index, drawn.index[0])
        assert (weight is None) == (name == "lap")
        if weight is not None:
            assert torch.equal(weight, drawn.weight[0])
            weights.append(weight)
        error = torch.from_numpy(random.exponential(3.0, batch)).float()
        buffer.write_back(index, error)
        mass = read.mass(error[None], {k: v[:, None] for k, v in hyper.items()})
        twin.write_back(drawn.index, torch.ones_like(drawn.index), error[None], mass)
        assert torch.equal(buffer.priorities.mass, twin.priorities.mass)
    assert name == "lap" or torch.stack(weights).min() < 0.5


def test_laps_priorities_by_hand():
    """max(|d|, 1)^0.4; a new item gets the largest so far, and the first one gets 1."""
    buffer = ReplayBuffer(4, OBS, ACTION, device="cpu", sampler="lap")
    fill(buffer, 2, 0)
    assert buffer.priorities.mass.tolist() == [[1.0, 1.0, 0.0, 0.0]]
    buffer.write_back(np.array([0, 1]), torch.tensor([0.2, 32.0]))
    assert buffer.priorities.mass[0].tolist() == pytest.approx([1.0, 4.0, 0.0, 0.0])
    buffer.write_back(np.array([1]), torch.tensor([2.0]))
    fill(buffer, 1, 1)
    assert buffer.priorities.mass[0].tolist() == pytest.approx([1.0, 2**0.4, 4.0, 0.0])


def test_laps_loss_and_td_error_by_hand(monkeypatch):
    model = a_model("lap")
    q = (torch.tensor([[1.0], [5.0]]), torch.tensor([[0.5], [-3.0]]))
    target = torch.tensor([[0.6], [0.0]])
    by_hand = (0.5 * 0.4**2 + (5 - 0.5)) / 2 + (0.5 * 0.1**2 + (3 - 0.5)) / 2
    assert model._critic_loss(q, target, None).item() == pytest.approx(by_hand)
    written = []
    monkeypatch.setattr(model.replay_buffer, "write_back", lambda index, p: written.append(p))
    batch = Batch(None, np.array([0, 1]), None, {})
    model._write_back(batch, torch.cat(q, dim=1).T, target[:, 0])
    assert written[0].tolist() == pytest.approx([0.4, 5.0])
    assert samplers.read("lap").hyper == {"alpha": 0.4}
