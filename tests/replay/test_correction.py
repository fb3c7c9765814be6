"""Corrected targets against a loop over one window, and by hand."""

import math

import numpy as np
import pytest
import torch

from aser import noise
from aser.agents import sac
from aser.agents.networks import log_density, policy, q_values, sample
from aser.lanes import batched
from aser.noise import Stream
from aser.replay import bootstrap, correction
from aser.replay.kinds import Constant, Frozen
from aser.replay.sampler import Drawn, Sampler, State
from aser.replay.storage import LANES_OF_MEMORY, Clock, Layout, Memory
from aser.replay.unroll import Unroll
from aser.trees import take, tree_map

L, OBS, ACT, N, B, H = 2, 3, 2, 37, 29, 5
NEWEST = 22
HYPER = {"gamma": [0.9, 0.8], "h": [5.0, 4.0], "lam": [0.8, 0.6], "lr": [1e-3] * 2}
HYPER = {k: torch.tensor(v) for k, v in {**HYPER, "tau": [0.1] * 2}.items()}
HYPER["target_entropy"] = torch.full((L,), -2.0)
ORACLE = Frozen("oracle", lambda obs: obs[:, 0])
RULES = {
    "fixed": {"rule": bootstrap.fixed},
    "geometric": {"rule": bootstrap.geometric, "uses_random": True},
    "threshold": {"rule": bootstrap.threshold, "criterion": ORACLE, "threshold": 0.7},
    "averaged": {"rule": bootstrap.averaged, "mixes": True},
}


class Case:
    """A full ring with ends of episodes, agents that differ from their targets, and draws."""

    def __init__(self, name="fixed", far=0.4, **options):
        unroll = Unroll(window=H, **RULES[name], **options)
        self.layout = Layout(OBS, ACT, ("p_next",), (correction.COLUMN,))
        self.sampler = Sampler(sac, self.layout, B, Constant("uniform"), unroll)
        torch.manual_seed(3)
        keys = noise.lane_keys([6, 7])
        agents = batched(lambda key: sac.init(key, OBS, ACT, [6]))(keys[:, Stream.INIT])
        targets = tree_map(lambda x: x + 0.3 * torch.randn_like(x), agents.targets)
        self.agents = agents._replace(
            targets=targets, log_temperature=torch.tensor([-0.9, 0.2]), updates=torch.zeros(L)
        )
        self.rows = torch.randn(L, N, self.layout.width)
        self.write("p_next", torch.rand(L, N))
        self.write("action", torch.rand(L, N, ACT) * 1.9 - 0.95)
        for end in ("terminated", "truncated"):
            self.write(end, (torch.rand(L, N) < 0.07).float())
        obs = torch.roll(self.rows[..., self.layout.columns["next_obs"]], 1, 1)
        self.write("obs", obs)  # so that s_t is the next observation before it
        taken = self.rows[..., self.layout.columns["action"]].mT
        log_pi = batched(lambda s, o, a: log_density(sac.outputs(s, o), a))
        self.write(correction.COLUMN, log_pi(self.agents, obs.mT, taken) + far * torch.randn(L, N))
        self.index = torch.randint(N, (L, B))
        self.weight = torch.rand(L, B) + 0.5
        clock = Clock(*(torch.tensor(x) for x in (70, NEWEST, N)), torch.tensor(0.3))
        self.memory = Memory(self.rows, torch.zeros(L, OBS, 1), keys, clock)
        wanted = self.sampler.wanted(ACT) | sac.wanted(ACT, B)
        self.noise = batched(lambda key: noise.numbers(key, wanted))(keys)

    def write(self, name, values):
        self.rows[..., self.layout.columns[name]] = values.reshape(L, N, -1)

    def assembled(self):
        function = batched(self.sampler.assemble, (0, LANES_OF_MEMORY, 0, 0, 0))
        drawn = Drawn(self.index, self.weight)
        return function(State(self.agents, {}), self.memory, drawn, HYPER, self.noise)

    def target(self):
        """The batch, and the targets (L, B) of the critics that the agent makes of it."""
        batch, _ = self.assembled()
        _, info = batched(sac.update)(self.agents, batch, HYPER, self.noise)
        return batch, info.target

    # What the twins know of an item of a lane

    def read(self, lane, item, step, name):
        row = self.rows[lane, (self.index[lane, item] + step) % N]
        return row[self.layout.columns[name]]

    def ratio(self, lane, item, t):
        """pi(a_t|s_t) / mu(a_t|s_t)."""
        obs, action = (self.read(lane, item, t, name)[:, None] for name in ("obs", "action"))
        log_pi = log_density(policy(take(self.agents, lane).actor, obs), action).item()
        return math.exp(log_pi - self.read(lane, item, t, correction.COLUMN).item())

    def q(self, lane, item, t):
        """min Q_target(s_t, a_t) of the action that was taken."""
        obs, action = (self.read(lane, item, t, name)[:, None] for name in ("obs", "action"))
        return q_values(take(self.agents, lane).targets, obs, action).amin().item()

    def value(self, lane, item, t):
        """min Q_target(s_t, a') and -alpha log pi(a'|s_t) of the item's fresh action a'."""
        agent, obs = take(self.agents, lane), self.read(lane, item, t - 1, "next_obs")[:, None]
        epsilon = self.noise[Stream.TARGET][lane, :, item, None]
        action, log_prob = sample(policy(agent.actor, obs), epsilon)
        alpha = agent.log_temperature.exp()
        return q_values(agent.targets, obs, action).amin().item(), -(alpha * log_prob).item()

    def passes(self, name, lane, item, t):
        """Which share of the target the rule lets pass s_t."""
        before = (self.index[lane, item].item() + t - 1) % N
        ended = any(self.read(lane, item, t - 1, end) > 0.5 for end in ("terminated", "truncated"))
        h = HYPER["h"][lane].item()
        if ended or before == NEWEST or t >= h:
            return 0.0
        if name == "geometric":
            u = self.noise[Stream.UNROLL][lane, item]
            return float(u < HYPER["lam"][lane] ** t)
        if name == "threshold":
            return float(self.read(lane, item, t - 1, "p_next") < 0.7)
        return (h - t) / (h - t + 1) if name == "averaged" else 1.0


def retrace_twin(case, name, lane, item):
    """y = r_0 + gamma V(s_1) + sum gamma^t c_1 ... c_t (r_t + gamma V(s_{t+1}) - Q(s_t, a_t))."""
    gamma, trace, y, t = HYPER["gamma"][lane].item(), 1.0, 0.0, 0
    while trace > 0:
        ends = case.read(lane, item, t, "terminated") > 0.5
        value = 0.0 if ends else sum(case.value(lane, item, t + 1))
        error = case.read(lane, item, t, "reward").item() + gamma * value
        y += gamma**t * trace * (error - (case.q(lane, item, t) if t else 0.0))
        t += 1
        if share := case.passes(name, lane, item, t):
            trace *= share * min(1.0, case.ratio(lane, item, t))
        else:
            trace = 0.0
    return y


@pytest.mark.parametrize("name", RULES)
def test_retrace_is_its_equation(name):
    case = Case(name, correction="retrace")
    case.noise[Stream.PATH] = case.noise[Stream.TARGET]  # one fresh action at each state
    batch, target = case.target()
    expected = [[retrace_twin(case, name, lane, i) for i in range(B)] for lane in range(L)]
    np.testing.assert_allclose(target.numpy(), expected, rtol=2e-4, atol=2e-4)
    assert batch.weight.equal(case.weight)
    scale = batch.retraced.scale
    assert scale.shape == (L, H - 1, B) and len(scale.unique()) > 20
    assert (scale[1, -1] == 0).all()  # h of the second lane is shorter than the window


def test_where_the_action_does_not_matter_and_pi_is_mu_retrace_is_the_n_step_target():
    """Then Q(s_t, a') - Q(s_t, a_t) is 0, and only c_t = 1 is left."""
    for entropy in ("fresh", "stored", "none"):
        found = []
        for kind in ("none", "retrace"):
            case = Case(far=0.0, correction=kind, path_entropy=entropy)
            case.agents.targets[0].weight[..., OBS:] = 0.0
            found.append(case.target()[1])
        torch.testing.assert_close(*found, rtol=1e-4, atol=1e-4)
    plain, corrected = Case(far=0.0), Case(far=0.0, correction="retrace")  # where it matters
    assert not torch.allclose(plain.target()[1], corrected.target()[1], atol=0.01)


def test_an_action_that_pi_would_not_take_cuts_the_trace_at_once():
    case, one_step = Case(correction="retrace"), Case()
    case.write(correction.COLUMN, torch.full((L, N), 60.0))
    one_step.sampler = Sampler(sac, one_step.layout, B, Constant("u"))
    torch.testing.assert_close(case.target()[1], one_step.target()[1])
    assert case.assembled()[1].n.eq(1).all()


def test_actions_that_pi_likes_more_count_no_more_than_once():
    case, other = Case(correction="retrace"), Case(correction="retrace")
    case.write(correction.COLUMN, torch.full((L, N), -60.0))
    other.write(correction.COLUMN, torch.full((L, N), -30.0))
    assert torch.equal(case.target()[1], other.target()[1])
    n = case.assembled()[1].n
    assert torch.equal(n, Case().assembled()[1].n) and n.amax(1).tolist() == [5, 4]


@pytest.mark.parametrize("name", ["fixed", "geometric", "threshold"])
def test_clipped_weights_are_products_below_a_quantile(name):
    case, plain = Case(name, correction="clipped"), Case(name)
    batch, unrolled = case.assembled()
    expected, (without, _) = [], plain.assembled()
    for lane in range(L):
        rho = []
        for item in range(B):
            t, product = 1, 1.0
            while case.passes(name, lane, item, t):
                product *= case.ratio(lane, item, t)
                t += 1
            assert unrolled.n[lane, item] == t
            rho.append(math.log(product))
        q = np.quantile(rho, 0.75)
        weight = np.exp(np.minimum(rho, q))
        expected.append(weight / weight.max() * case.weight[lane].numpy())
    np.testing.assert_allclose(batch.weight.numpy(), expected, rtol=1e-4)
    assert (batch.weight / case.weight).max() == pytest.approx(1.0)
    assert batch.weight.ne(case.weight).any()
    torch.testing.assert_close(batch.reward, without.reward)
    torch.testing.assert_close(batch.discount, without.discount)


def test_clipped_averaged_is_the_loss_of_all_n_step_targets_with_weights():
    """The gradient in Q of the mean over n of w_n (Q - y_n)^2."""
    case = Case("averaged", correction="clipped", path_entropy="none")
    batch, target = case.target()
    for lane in range(L):
        h, gamma = int(HYPER["h"][lane]), HYPER["gamma"][lane].item()
        y, log_rho = np.zeros((h, B)), np.zeros((h, B))
        share, valid = np.zeros((h, B)), np.zeros((h, B), bool)
        for item in range(B):
            reach, reward, product = 1.0, 0.0, 0.0
            for n in range(1, h + 1):
                last = n - 1
                reward += gamma**last * case.read(lane, item, last, "reward").item()
                ends = case.read(lane, item, last, "terminated") > 0.5
                value = 0.0 if ends else sum(case.value(lane, item, n))
                y[last, item], log_rho[last, item] = reward + gamma**n * value, product
                valid[last, item] = True
                go_on = case.passes("averaged", lane, item, n)
                share[last, item] = reach * (1.0 - go_on)
                if (reach := reach * go_on) == 0.0:
                    break
                product += math.log(case.ratio(lane, item, n))
        q = np.quantile(log_rho[valid], 0.75)
        weight = np.where(valid, np.exp(np.minimum(log_rho, q)), 0.0)
        weight /= weight.max(1, keepdims=True)
        assert (weight[0] == 1.0).all()  # one step needs no correction
        now = 0.3
        expected = (share * weight * (now - y)).sum(0)
        own = (batch.weight[lane] / case.weight[lane]) * (now - target[lane])
        np.testing.assert_allclose(own.numpy(), expected, rtol=1e-3, atol=1e-4)


def test_while_pi_is_mu_clipped_changes_nothing():
    for name in ("fixed", "averaged"):
        (one, a), (two, b) = (Case(name, 0.0, correction=c).target() for c in ("none", "clipped"))
        torch.testing.assert_close(a, b)
        torch.testing.assert_close(one.weight, two.weight)


def test_clipped_by_hand_and_far_from_any_float():
    log_rho = torch.tensor([-2000.0, math.log(2), math.log(2), 3000.0])
    found = correction.clipped(log_rho, torch.tensor([True, True, True, False]))
    assert found.tolist() == [0.0, 1.0, 1.0, 0.0]
    rows = torch.tensor([[0.0, 0.0], [-1000.0, -1000.5]])
    found = correction.clipped(rows, torch.ones(2, 2, dtype=torch.bool))
    assert found[0].tolist() == [1.0, 1.0] and found[1, 1].item() == pytest.approx(math.exp(-0.5))
