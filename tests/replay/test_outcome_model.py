"""The outcome model against torch.nn and torch.optim, cases whose answer is known, and runs."""

import pytest
import torch
import yaml
from torch import nn

import train
from aser import build, checkpoint, noise
from aser.agents import sac
from aser.compiled import compiled, why_not_compiled
from aser.errors import ConfigError
from aser.lanes import batched
from aser.noise import Stream
from aser.replay.kinds import Transitions
from aser.replay.outcome_model import RATE, OutcomeModel
from aser.replay.outcome_spread import one_step_target
from aser.settings.sampler import MODEL_DEFAULTS
from aser.trees import take, tree_leaves, tree_map

OBS, ACT, L = 3, 2, 4
KEYS = noise.lane_keys([4, 5, 6, 9])
AGENTS = batched(lambda key: sac.init(key, OBS, ACT, [24]))(KEYS[:, Stream.INIT])
HYPER = {"gamma": torch.tensor(0.9)}
OF = ["state", "value", "both"]


def facts(seed, count=17):
    g = torch.Generator().manual_seed(seed)
    obs = torch.randn(OBS, count, generator=g)
    return Transitions(
        obs=obs,
        action=torch.rand(ACT, count, generator=g) * 2 - 1,
        reward=torch.randn(count, generator=g),
        next_obs=obs + torch.randn(OBS, count, generator=g),
        terminated=torch.rand(count, generator=g) < 0.3,
        truncated=torch.zeros(count, dtype=torch.bool),
        scale=torch.tensor([0.5, 2.0, 1.0]),
    )


def module(layers):
    linear = [nn.Linear(layer.weight.shape[1], layer.weight.shape[0]) for layer in layers]
    for one, layer in zip(linear, layers, strict=True):
        one.weight.data, one.bias.data = layer.weight.clone(), layer.bias.clone()
    return nn.Sequential(linear[0], nn.ReLU(), linear[1])


@pytest.mark.parametrize("of", OF)
def test_it_is_three_regressions(of):
    rule, agent = OutcomeModel(of, hidden=7, lr=0.02), take(AGENTS, 1)
    own = rule.init(KEYS[1, Stream.CRITERION], OBS, ACT)
    of_state, of_pair, of_spread = (module(layers) for layers in own.models)
    parameters = [p for one in (of_state, of_pair, of_spread) for p in one.parameters()]
    adam = torch.optim.Adam(parameters, lr=0.02)
    parts = {"state": [3], "value": [1], "both": [3, 1]}[of]
    mean, variance, level = None, None, None
    for seed in range(6):
        batch = facts(seed)
        own = rule.update(own, batch, agent, HYPER, {})
        # The same with samples as rows.
        change = ((batch.next_obs - batch.obs) / batch.scale[:, None]).T
        target = one_step_target(agent, batch, HYPER["gamma"])[:, None]
        o = {"state": change, "value": target, "both": torch.cat([change, target], 1)}[of]
        mean = o.mean(0) if mean is None else (1 - RATE) * mean + RATE * o.mean(0)
        square = (o - mean).square().mean(0)
        variance = square if variance is None else (1 - RATE) * variance + RATE * square
        s = (batch.obs / batch.scale[:, None]).T
        m, q = of_state(s), of_pair(torch.cat([s, batch.action.T], 1))
        apart = ((q - m) ** 2 * variance).detach()
        spread = torch.stack([x.sum(1) for x in apart.split(parts, 1)], 1)  # (B, P)
        drawn = spread.mean(0)
        level = drawn if level is None else (1 - RATE) * level + RATE * drawn
        y = (o - mean) / variance.sqrt()
        wrong = [m - y, q - y, of_spread(s) - spread / level]
        adam.zero_grad()
        sum(0.5 * (x**2).sum() / len(x) for x in wrong).backward()
        adam.step()
        torch.testing.assert_close(own.level, level, rtol=1e-4, atol=1e-6)
        there = torch.randn(OBS, 9, generator=torch.Generator().manual_seed(90 + seed))
        p = of_spread((there / batch.scale[:, None]).T).clamp(min=0).sum(1).sqrt()
        found = rule.p(own, agent, there, None)
        torch.testing.assert_close(found, p, rtol=1e-3, atol=1e-4)
    assert (found > 0).any()


def test_it_tells_control_from_noise_and_from_nothing():
    # At x = 1 the action decides where the state goes, at x = 0 chance does, at x = -1 nothing.
    rule, g = OutcomeModel("state", hidden=24, lr=0.003), torch.Generator().manual_seed(1)
    own = rule.init(KEYS[0, Stream.CRITERION], OBS, ACT)
    for _ in range(1500):
        x = torch.randint(-1, 2, (64,), generator=g).float()
        action = torch.rand(ACT, 64, generator=g) * 2 - 1
        chance = torch.rand(64, generator=g) * 2 - 1
        moved = torch.where(x == 1, action[0], torch.where(x == 0, chance, 0.0))
        obs = torch.stack([x, 0 * x, 0 * x])
        step = torch.stack([0 * x, moved, 0 * x])
        never = torch.zeros(64, dtype=torch.bool)
        batch = Transitions(obs, action, 0 * x, obs + step, never, never, torch.ones(OBS))
        own = rule.update(own, batch, None, HYPER, {})
    p = rule.p(own, None, torch.tensor([[1.0, 0.0, -1.0], [0.0] * 3, [0.0] * 3]), None)
    control, chance, nothing = p.square().tolist()
    # A third of the drawn items have control, and the level is the mean over all of them.
    assert control == pytest.approx(3.0, rel=0.15)
    assert chance < 0.3 and nothing < 0.3
    # The variance of an action that is uniform in [-1, 1] is a third.
    assert float(own.level) == pytest.approx(1 / 9, rel=0.15)


def many(rule):
    def update(own, batch, agent):
        new = rule.update(own, batch, agent, HYPER, {})
        return new, rule.p(new, agent, batch.obs, None)

    return batched(update)


def learners(rule):
    own = batched(lambda key: rule.init(key, OBS, ACT))(KEYS[:, Stream.CRITERION])
    return tree_map(torch.Tensor.contiguous, own)


def of_lanes(seed):
    each = [facts(seed + i) for i in range(L)]
    return Transitions(*(torch.stack(x) for x in zip(*each, strict=True)))


def test_lanes_do_not_touch_each_other():
    rule = OutcomeModel("both", hidden=9, lr=0.01)
    own, batch = learners(rule), of_lanes(10)
    found, p = many(rule)(own, batch, AGENTS)
    for i in range(L):
        alone = rule.init(KEYS[i, Stream.CRITERION], OBS, ACT)
        alone = rule.update(alone, take(batch, i), take(AGENTS, i), HYPER, {})
        torch.testing.assert_close(take(found, i), alone, rtol=1e-3, atol=1e-5)
    spoilt = batch._replace(next_obs=batch.next_obs.clone())
    spoilt.next_obs[1] = torch.nan
    other, q = many(rule)(own, spoilt, AGENTS)
    others = [0, *range(2, L)]
    assert p[others].equal(q[others]) and q[1].isnan().all()


@pytest.mark.skipif(why_not_compiled() is not None, reason="nothing can be compiled here")
def test_compiled_it_is_the_same():
    rule = OutcomeModel("both", hidden=9, lr=0.01)
    eager, fast = learners(rule), learners(rule)
    function = compiled(many(rule), True)
    for seed in range(4):
        eager, p = many(rule)(eager, of_lanes(seed), AGENTS)
        fast, q = function(fast, of_lanes(seed), AGENTS)
        torch.testing.assert_close(p, q, rtol=1e-3, atol=2e-3)
    assert p.max() > 0.1 and function._graph is not None  # it does not run as it is


# Settings and training


def values(criterion):
    return {key: getattr(criterion, key) for key in MODEL_DEFAULTS}


def test_the_defaults_of_the_settings_are_those_of_the_file():
    file = yaml.safe_load((train.CONF / "criterion" / "outcome_model.yaml").read_text())
    assert {key: file[key] for key in MODEL_DEFAULTS} == MODEL_DEFAULTS
    for name in ("outcome_model", "outcome_model_shuffled"):
        config = train.settings([f"sampler={name}"])
        assert config.criterion.name == name and values(config.criterion) == MODEL_DEFAULTS
        for key, value in {"of": "state", "hidden": 5, "lr": 0.02}.items():
            config = train.settings([f"sampler={name}", f"criterion.{key}={value}"])
            assert values(config.criterion) == MODEL_DEFAULTS | {key: value}


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("criterion.of=stat", "must be one of both, state, value; did you mean state?"),
        ("criterion.hidden=0", "must be a whole number >= 1 and <= 1024"),
        ("criterion.hidden=1025", "must be a whole number >= 1 and <= 1024"),
        ("criterion.lr=0", "must be a finite number in (0, 1]"),
        ("criterion.lr=1.5", "must be a finite number in (0, 1]"),
        (
            "criterion.tilings=8",
            "outcome_model takes none; only outcome_spread, outcome_spread_shuffled do",
        ),
    ],
)
def test_a_wrong_parameter_is_one_line(word, said):
    with pytest.raises(ConfigError) as caught:
        train.settings(["sampler=outcome_model", word])
    assert str(caught.value) == f"{word}: {said}"


TOY = ["debug=smoke", "seeds=[3,8]", "batch=11", "steps=60", "learning_starts=30", "eval.every=30"]
TOY += ["env=maze", "env.layout=toy", "hyper=thesis", "hyper.from=aser"]


def built(*words):
    config = train.settings([*TOY, *words])
    return build.build(config, train.CONF, train.CONF.parent / "results")


@pytest.mark.parametrize("sampler", ["outcome_model", "outcome_model_shuffled"])
def test_a_resumed_run_is_that_run_to_the_bit(sampler, tmp_path):
    whole = built(f"sampler={sampler}")
    whole.run()
    part = built(f"sampler={sampler}")
    while part.step < 45:
        part.advance()
    checkpoint.save(tmp_path / "checkpoint.pt", part.state_dict())
    part = built(f"sampler={sampler}")
    part.load_state_dict(checkpoint.load(tmp_path / "checkpoint.pt"))
    part.run()
    for one, other in zip(tree_leaves(whole.state), tree_leaves(part.state), strict=True):
        assert one.equal(other)
    (key,) = whole.state.criteria
    assert whole.state.criteria[key].updates.tolist() == [30.0, 30.0]
