"""The spread of outcomes against a dictionary of lists, cases by hand, and runs that use it."""

import math
from collections import defaultdict

import pytest
import torch
import yaml

import train
from aser import build, checkpoint, noise
from aser.agents import sac
from aser.agents.networks import policy, q_values
from aser.compiled import compiled, why_not_compiled
from aser.errors import ConfigError
from aser.lanes import batched
from aser.noise import Stream
from aser.replay import cells
from aser.replay.kinds import Lane, Learned, Shuffled, Transitions
from aser.replay.outcome_spread import OutcomeSpread, one_step_target
from aser.replay.storage import Layout, Memory
from aser.settings.sampler import LEARNED_KEYS, SPREAD_DEFAULTS
from aser.trees import take, tree_leaves

OBS, ACT, L = 3, 2, 4
KEYS = noise.lane_keys([4, 5, 6, 9])
AGENTS = batched(lambda key: sac.init(key, OBS, ACT, [24]))(KEYS[:, Stream.INIT])
SCALE = torch.tensor([0.5, 2.0, 1.0])
HYPER = {"gamma": torch.tensor(0.9)}
RATE = 0.05
OF, NOISE = ["state", "value", "both"], ["subtract", "keep"]


def rule(of="state", noise="keep", width=0.1, rate=RATE, buckets=4096, tilings=0):
    return OutcomeSpread(of, width, rate, buckets, noise, tilings)


def facts(obs, change, action=None, reward=None, terminated=None, scale=SCALE):
    """Transitions of columns obs (O, B) that move by `change` (O, B), in units of the scale."""
    count = obs.shape[1]
    return Transitions(
        obs=obs,
        action=torch.zeros(ACT, count) if action is None else action,
        reward=torch.zeros(count) if reward is None else reward,
        next_obs=obs + change * scale[:, None],
        terminated=torch.zeros(count, dtype=torch.bool) if terminated is None else terminated,
        truncated=torch.zeros(count, dtype=torch.bool),
        scale=scale,
    )


CENTRES = torch.randn(9, OBS, generator=torch.Generator().manual_seed(99)).T


def random_facts(seed, count, places=6):
    """Transitions from few places, so that many share a cell."""
    g = torch.Generator().manual_seed(seed)
    return facts(
        obs=CENTRES[:, torch.randint(places, (count,), generator=g)],
        change=torch.randn(OBS, count, generator=g) + 2.0,
        action=torch.rand(ACT, count, generator=g) * 2 - 1,
        reward=torch.randn(count, generator=g),
        terminated=torch.rand(count, generator=g) < 0.3,
    )


def column(*values):
    return torch.tensor(values)[:, None].float()


def learned(spread, *updates, state=None, lane=0):
    """What a lane has seen after these transitions, and a function that gives p there."""
    state = take(AGENTS, 0) if state is None else state
    own = spread.init(KEYS[lane, Stream.CRITERION], OBS, ACT)
    for transitions in updates:
        own = spread.update(own, transitions, state, HYPER, {})
    return own, lambda obs: spread.p(own, state, obs, None)


class Twin:
    """A list of outcomes for each cell; means and variances are sums over the lists."""

    def __init__(self, spread, key):
        self.spread, self.key = spread, key
        self.states, self.actions, self.level = defaultdict(list), defaultdict(list), None

    def cells(self, obs, action=None):
        """The cell of each state in each tiling, and with an action its kind too: T lists of B."""
        spread = self.spread
        cell = cells.of_states(obs / SCALE[:, None], self.key, spread.width, spread.tilings)
        kind = None if action is None else cells.of_actions(action)
        if spread.buckets < 100:  # cells collide
            place = cells.places(self.key, cell, spread.buckets, kind)
            return place.reshape(len(cell), -1).tolist()
        kinds = [()] * obs.shape[1] if kind is None else list(map(tuple, kind.T.tolist()))
        return [
            [(t, *one, *kind) for one, kind in zip(tiling.T.tolist(), kinds, strict=True)]
            for t, tiling in enumerate(cell)
        ]

    def update(self, transitions, state):
        change = (transitions.next_obs - transitions.obs) / SCALE[:, None]
        target = one_step_target(state, transitions, HYPER["gamma"])
        whole = {"state": [change], "value": [target[None]], "both": [change, target[None]]}
        outcomes = [
            [part[:, i].tolist() for part in whole[self.spread.of]] for i in range(len(target))
        ]
        kinds = self.cells(transitions.obs, transitions.action)
        states = self.cells(transitions.obs)
        for tiling in kinds:
            for cell, outcome in zip(tiling, outcomes, strict=True):
                self.actions[cell].append(outcome)
        for of_state, of_kind in zip(states, kinds, strict=True):
            for cell, kind, outcome in zip(of_state, of_kind, outcomes, strict=True):
                self.states[cell].append((outcome, self.variances(self.actions[kind])))
        drawn = [self.of_cell(cell) for tiling in states for cell in tiling]
        means = [sum(part) / len(drawn) for part in zip(*drawn, strict=True)]
        rate = self.spread.rate
        self.level = [
            old + rate * (new - old) if old > 0.0 else new
            for old, new in zip(self.level or [0.0] * len(means), means, strict=True)
        ]

    def moments(self, values):
        """The mean and variance of numbers, of which the last ones count most."""
        n, rate = len(values), self.spread.rate
        weights = [(rate if i else 1.0) * (1.0 - rate) ** (n - 1 - i) for i in range(n)]
        assert sum(weights) == pytest.approx(1.0)
        mean = sum(w * x for w, x in zip(weights, values, strict=True))
        return mean, sum(w * (x - mean) ** 2 for w, x in zip(weights, values, strict=True))

    def variances(self, outcomes):
        """The variance of each part, summed over its numbers."""
        return [
            sum(self.moments(numbers)[1] for numbers in zip(*part, strict=True))
            for part in zip(*outcomes, strict=True)
        ]

    def of_cell(self, cell):
        """The spread of each part."""
        outcomes, alike = zip(*self.states[cell], strict=True)
        spread = self.variances(outcomes)
        if self.spread.noise == "keep":
            return spread
        # What was the spread of like actions when each of the outcomes came.
        within = [self.moments(part)[0] for part in zip(*alike, strict=True)]
        return [max(0.0, all_ - part) for all_, part in zip(spread, within, strict=True)]

    def p(self, obs):
        tilings = self.cells(obs)
        return [
            math.sqrt(sum(self.squared(cell) for cell in found) / len(tilings))
            for found in zip(*tilings, strict=True)
        ]

    def squared(self, cell):
        if cell not in self.states:
            return 0.0
        return sum(
            part / level if level > 0.0 else 0.0
            for part, level in zip(self.of_cell(cell), self.level, strict=True)
        )


@pytest.mark.parametrize("of", OF)
@pytest.mark.parametrize("noise", NOISE)
@pytest.mark.parametrize(
    ("width", "rate", "buckets", "tilings"),
    [(0.1, 0.05, 2**16, 0), (0.1, 0.3, 2**16, 0), (0.1, 0.05, 5, 0), (2.0, 0.1, 2**16, 3)],
)
def test_the_tables_are_dictionaries_of_lists(of, noise, width, rate, buckets, tilings):
    spread, state = rule(of, noise, width, rate, buckets, tilings), take(AGENTS, 1)
    key, obs = KEYS[0, Stream.CRITERION], random_facts(7, 50, places=9).obs
    twin, own = Twin(spread, key), spread.init(key, OBS, ACT)
    for number, count in enumerate([1, 17, 40, 2, 33]):
        transitions = random_facts(number, count, places=2 + number)
        twin.update(transitions, state)
        own = spread.update(own, transitions, state, HYPER, {})
        assert own.level.tolist() == pytest.approx(twin.level, rel=1e-3, abs=1e-6)
        p = spread.p(own, state, obs, None)
        assert p.tolist() == pytest.approx(twin.p(obs), rel=2e-3, abs=2e-3)
    assert own.states[:, 0].sum() == 93 * max(1, tilings) and p.max() > 0.5
    assert max(map(len, twin.states.values())) > 15 and len(twin.actions) > len(twin.states)
    if (buckets, tilings) == (2**16, 0):  # 3 of the 9 states are new
        assert (p == 0).sum() >= sum(obs.T.tolist().count(new) for new in CENTRES.T.tolist()[6:])


# By hand


HERE, THERE = column(0.3, 0.0, -1.0), column(2.0, 1.0, 1.0)
RIGHT, LEFT = column(0.9, 0.2), column(-0.9, 0.2)
SHARE = RATE * (1 - RATE)  # the variance of two outcomes that lie 1 apart
ENDS = torch.ones(2, dtype=torch.bool)


def here(*changes, actions=None, obs=HERE, **more):
    """Transitions from one state with these changes."""
    action = None if actions is None else torch.cat(actions, 1)
    return facts(obs.expand(-1, len(changes)), torch.cat(changes, 1), action, **more)


@pytest.mark.parametrize("of", ["state", "both"])
@pytest.mark.parametrize("noise", NOISE)
def test_one_outcome_has_no_spread_however_often_it_came(of, noise):
    once = column(0.37, -11.3, 4.1)
    own, p = learned(
        rule(of, noise), *[here(*[once] * 7, terminated=torch.ones(7, dtype=torch.bool))] * 3
    )
    assert p(HERE).tolist() == [0.0] and own.level.count_nonzero() == 0


@pytest.mark.parametrize("of", OF)
@pytest.mark.parametrize("noise", NOISE)
@pytest.mark.parametrize("tilings", [0, 3])
def test_a_state_that_was_not_drawn_has_no_spread(of, noise, tilings):
    both, spread = torch.cat([HERE, 50 * THERE], 1), rule(of, noise, tilings=tilings)
    _, p = learned(spread)
    assert p(both).tolist() == [0.0, 0.0]
    rewards = torch.tensor([1.0, 2.0])
    _, p = learned(spread, here(HERE, THERE, actions=[RIGHT, LEFT], reward=rewards))
    seen, new = p(both).tolist()
    assert seen > 0.0 and new == 0.0


def test_two_outcomes():
    # 3 units of the first number apart and 1 of the second: the squared distance is 10.
    two = here(column(1.0, 1.0, 1.0), column(4.0, 0.0, 1.0))
    own, p = learned(rule(), two)
    (place,) = own.states[:, 0].nonzero()
    expected = [2, 1 + 3 * RATE, 1 - RATE, 1.0, 10 * SHARE]
    assert own.states[place].flatten().tolist() == pytest.approx(expected, rel=1e-4)
    # They are all that was drawn, so the level is their spread.
    assert own.level.tolist() == pytest.approx([10 * SHARE], rel=1e-4)
    assert p(HERE).item() == pytest.approx(1.0, rel=1e-6)
    # An update of another state, without spread, moves the level towards 0.
    _, p = learned(rule(), two, here(column(2.0, 0.0, 7.0), obs=THERE))
    assert p(HERE).item() == pytest.approx(1 / math.sqrt(1 - RATE), rel=1e-5)
    assert p(THERE).item() == 0.0


def test_two_outcomes_in_turns_for_long():
    # Each has half the weight, apart from the order; the level has come to the same spread.
    two = here(column(1.0, 1.0, 1.0), column(4.0, 0.0, 1.0))
    own, p = learned(rule(), *[two] * 300)
    late = 1 / (2 - RATE)  # the weight of the one that came last
    assert own.level.tolist() == pytest.approx([10 * late * (1 - late)], rel=1e-3)
    assert p(HERE).item() == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("count", [1, 5, 100])
def test_an_outcome_that_drifts_is_followed_and_then_forgotten(count):
    old, new = here(column(0.0, 0.0, 0.0)), here(column(0.0, 0.0, 4.0))
    own, p = learned(rule(), *[old] * 9, *[new] * count)
    left = [(1 - RATE) ** n for n in range(1, count + 1)]  # the weight of the old one
    spreads = [16 * share * (1 - share) for share in left]
    level = spreads[0]  # the first one that is not 0
    for spread in spreads[1:]:
        level += RATE * (spread - level)
    assert own.level.tolist() == pytest.approx([level], rel=1e-3)
    assert p(HERE).item() == pytest.approx(math.sqrt(spreads[-1] / level), rel=2e-3)
    (place,) = own.states[:, 0].nonzero()
    mean = 4 * (1 - left[-1])
    assert own.states[place, 1:4].flatten().tolist() == pytest.approx([0, 0, mean], rel=1e-4)


@pytest.mark.parametrize("noise", NOISE)
def test_the_value_is_the_spread_of_the_targets(noise):
    state, zero = take(AGENTS, 2), column(0.0, 0.0, 0.0)
    rewards = torch.tensor([1.0, 3.0])
    two = here(zero, zero, actions=[RIGHT, LEFT], reward=rewards, terminated=ENDS)
    own, p = learned(rule("value", noise), two, state=state)
    assert own.level.tolist() == pytest.approx([4 * SHARE], rel=1e-4)
    assert p(HERE).item() == pytest.approx(1.0, rel=1e-5)


def test_the_target_is_the_reward_and_the_smaller_q_of_the_next_state():
    state, transitions = take(AGENTS, 2), random_facts(5, 30)
    action = torch.tanh(policy(state.actor, transitions.next_obs).mean)
    for i, found in enumerate(one_step_target(state, transitions, HYPER["gamma"])):
        next_obs = transitions.next_obs[:, i : i + 1]
        q = q_values(state.targets, next_obs, action[:, i : i + 1]).min().item()
        q = 0.0 if transitions.terminated[i] else q
        assert found.item() == pytest.approx(transitions.reward[i].item() + 0.9 * q, abs=1e-5)
    assert transitions.terminated.any() and not transitions.terminated.all()


def test_both_weighs_each_part_by_its_mean_over_drawn_items():
    zero = column(0.0, 0.0, 0.0)
    # Squared distances 1 and 4.
    one = here(zero, column(1.0, 0.0, 0.0), reward=torch.tensor([1.0, 3.0]), terminated=ENDS)
    # Squared distances 4 and 0.25.
    two = here(
        zero,
        column(0.0, 2.0, 0.0),
        obs=THERE,
        reward=torch.tensor([5.0, 5.5]),
        terminated=ENDS,
    )
    together = Transitions(
        *(torch.cat(x, -1) for x in zip(one[:-1], two[:-1], strict=True)), scale=SCALE
    )
    own, p = learned(rule("both"), together)
    levels = [2.5 * SHARE, 2.125 * SHARE]
    assert own.level.tolist() == pytest.approx(levels, rel=1e-3)
    expected = [
        math.sqrt(1 / 2.5 + 4 / 2.125),
        math.sqrt(4 / 2.5 + 0.25 / 2.125),
    ]
    assert p(torch.cat([HERE, THERE], 1)).tolist() == pytest.approx(expected, rel=1e-3)
    # A part that never varies does not count.
    still = one._replace(next_obs=one.obs)
    own, p = learned(rule("both"), still)
    assert own.level[0] == 0.0
    assert p(HERE).item() == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("noise", NOISE)
def test_states_that_collide_share_their_outcomes(noise):
    both, action = torch.cat([HERE, THERE], 1), torch.cat([RIGHT, LEFT], 1)
    two = facts(both, torch.cat([column(0.0, 0.0, 0.0), column(0.0, 0.0, 2.0)], 1), action)
    apart, p = learned(rule(noise=noise), two)
    assert p(both).tolist() == [0.0, 0.0] and apart.states[:, 0].sum() == 2
    assert apart.states[:, 0].max() == 1
    together, p = learned(rule(buckets=1), two)
    assert together.states[:, 0].tolist() == [2]
    assert together.level.tolist() == pytest.approx([4 * SHARE], rel=1e-4)
    assert p(both).tolist() == pytest.approx([1.0, 1.0], rel=1e-5)
    # With one place, all kinds of actions collide too: all of the spread is taken off.
    _, p = learned(rule(noise="subtract", buckets=1), two)
    assert p(both).max() < 1e-3


# Noise and control


def coin(seed, count):
    return torch.randint(2, (count,), generator=torch.Generator().manual_seed(seed)) * 2.0 - 1.0


@pytest.mark.parametrize("of", ["state", "value"])
def test_noise_does_not_count_where_it_is_taken_off(of):
    # HERE the outcome is 1 or -1 whatever the action; THERE the action's sign decides it.
    action, noise_ = coin(1, 1200), coin(2, 1200)
    obs = torch.cat([HERE, THERE], 1).repeat(1, 600)
    outcome = torch.where(obs[0] == HERE[0], noise_, action)
    whole = facts(
        obs,
        torch.stack([outcome, 0 * outcome, 0 * outcome]),
        action * torch.tensor([[0.8], [0.3]]),
        reward=outcome,
        terminated=torch.ones(1200, dtype=torch.bool),
    )
    updates = [
        Transitions(*(x[..., i : i + 8] for x in whole[:-1]), scale=SCALE)
        for i in range(0, 1200, 8)
    ]
    found = {}
    for setting in NOISE:
        _, p = learned(rule(of, setting, rate=0.02), *updates)
        found[setting] = p(torch.cat([HERE, THERE], 1)).tolist()
    noisy, controlled = found["keep"]
    assert noisy == pytest.approx(controlled, rel=0.1) and noisy == pytest.approx(1.0, rel=0.1)
    noisy, controlled = found["subtract"]
    assert noisy < 0.25 * controlled and controlled > 1.0


@pytest.mark.parametrize("of", OF)
def test_without_noise_the_settings_are_the_same_to_the_bit(of):
    # Two kinds of action lead to two outcomes, again and again, in an uneven order.
    order = [0, 1, 1, 0, 0, 0, 1]
    change = [column(0.3, -1.0, 2.0), column(-0.7, 0.1, 0.0)]
    each = facts(
        HERE.expand(-1, 7),
        torch.cat([change[i] for i in order], 1),
        torch.cat([[RIGHT, LEFT][i] for i in order], 1),
        reward=torch.tensor([[0.4, -1.3][i] for i in order]),
        terminated=torch.ones(7, dtype=torch.bool),
    )
    subtract, p = learned(rule(of, "subtract"), *[each] * 5)
    keep, q = learned(rule(of, "keep"), *[each] * 5)
    assert p(HERE).item() > 0.5 and p(HERE).equal(q(HERE))
    assert subtract.level.equal(keep.level) and keep.level.min() > 0.0
    assert len(keep.actions) == 0 and subtract.actions[:, 0].max() == 4 * 5
    # The same outcomes by one kind of action are noise.
    alike = each._replace(action=RIGHT.expand(-1, 7) * torch.linspace(0.4, 1.0, 7))
    _, p = learned(rule(of, "subtract"), here(THERE, HERE, obs=THERE), *[alike] * 40)
    _, q = learned(rule(of, "subtract"), here(THERE, HERE, obs=THERE), *[each] * 40)
    assert p(HERE).item() < 0.5 * q(HERE).item()


def test_p_is_the_root_of_the_mean_over_tilings():
    near = HERE + column(0.05, -0.3, 0.1)
    spread = rule(width=0.5, tilings=11)
    _, p = learned(spread, here(column(0.0, 0.0, 0.0), column(0.0, 3.0, 0.0)))
    of_both = [
        cells.of_states(x / SCALE[:, None], KEYS[0, Stream.CRITERION], 0.5, 11)
        for x in (HERE, near)
    ]
    shared = (of_both[0] == of_both[1]).all(1).sum().item()
    assert 0 < shared < 11
    assert p(HERE).item() == pytest.approx(1.0, rel=1e-5)
    assert p(near).item() == pytest.approx(math.sqrt(shared / 11), rel=1e-5)


# In lanes, compiled, and behind the seam


VARIANTS = [("state", "keep", 0), ("value", "subtract", 0), ("both", "subtract", 3)]


def lanes(seed):
    """Transitions of all lanes."""
    each = [random_facts(seed + i, 16) for i in range(L)]
    return Transitions(*(torch.stack(x) for x in zip(*each, strict=True)))


def many(spread):
    def update(own, transitions, state):
        new = spread.update(own, transitions, state, HYPER, {})
        return new, spread.p(new, state, transitions.obs, None)

    return batched(update)


def tables(spread):
    init = batched(lambda key: spread.init(key, OBS, ACT))
    own = init(KEYS[:, Stream.CRITERION])
    return type(own)(*(x.contiguous() for x in own))


@pytest.mark.parametrize(("of", "noise", "tilings"), VARIANTS)
def test_lanes_do_not_touch_each_other(of, noise, tilings):
    spread = rule(of, noise, buckets=64, tilings=tilings)
    transitions = lanes(10)
    found, p = many(spread)(tables(spread), transitions, AGENTS)
    for i in range(L):
        alone, look = learned(spread, take(transitions, i), state=take(AGENTS, i), lane=i)
        torch.testing.assert_close(take(found, i), alone, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(p[i], look(transitions.obs[i]), rtol=1e-3, atol=1e-3)
    assert (p.amax(1) > 0.1).all()
    spoilt = transitions._replace(next_obs=transitions.next_obs.clone())
    spoilt.next_obs[1] = torch.nan
    other, q = many(spread)(tables(spread), spoilt, AGENTS)
    others = [0, *range(2, L)]
    for x, y in zip([*found, p], [*other, q], strict=True):
        assert x[others].equal(y[others])
    assert other.states[1].isnan().any()


@pytest.mark.skipif(why_not_compiled() is not None, reason="nothing can be compiled here")
def test_compiled_it_is_the_same():
    spread = rule("both", "subtract", tilings=3)  # it has all parts of the others
    eager, fast = tables(spread), tables(spread)
    function = compiled(many(spread), True)
    for seed in range(4):
        eager, p = many(spread)(eager, lanes(seed), AGENTS)
        fast, q = function(fast, lanes(seed), AGENTS)
        torch.testing.assert_close(p, q, rtol=1e-3, atol=2e-3)
    torch.testing.assert_close(eager, fast, rtol=1e-3, atol=1e-3)
    assert p.max() > 0.1 and function._graph is not None  # it does not run as it is


def test_the_scale_is_that_of_the_warm_up_states():
    layout, spread = Layout(OBS, ACT), rule(width=0.7)
    g = torch.Generator().manual_seed(4)
    rows, warm_up = torch.randn(9, layout.width, generator=g), torch.randn(OBS, 50, generator=g)
    warm_up[1] = 3.25  # an observation that never changes counts in its own units
    criterion = Learned("spread", spread)
    own = criterion.init(KEYS[0, Stream.CRITERION], OBS, ACT)
    lane = Lane(sac, layout, take(AGENTS, 0), own, Memory(rows, warm_up, KEYS[0], None))
    found = criterion.update(lane, torch.tensor([2, 2, 5]), HYPER, {})["spread"]
    expected = [warm_up[0].numpy().std(), 1.0, warm_up[2].numpy().std()]
    assert found.scale.tolist() == pytest.approx(expected, rel=1e-5)
    obs = layout.read_vector(rows[[2]], "obs")
    cell = cells.of_states(obs / found.scale[:, None], found.key, 0.7, 0)
    row = found.states[cells.places(found.key, cell, 4096)].flatten()
    change = (layout.read_vector(rows[[2]], "next_obs") - obs) / found.scale[:, None]
    assert row[0] == 2 and found.states[:, 0].sum() == 3
    torch.testing.assert_close(row[1:4], change.flatten())


# Settings and training


def values(criterion):
    return {key: getattr(criterion, key) for key in SPREAD_DEFAULTS}


def test_the_defaults_of_the_settings_are_those_of_the_file():
    file = yaml.safe_load((train.CONF / "criterion" / "outcome_spread.yaml").read_text())
    assert {key: file[key] for key in SPREAD_DEFAULTS} == SPREAD_DEFAULTS
    words = [
        "sampler=aser",
        "bootstrap.criterion.name=outcome_spread",
        "bootstrap.criterion.width=0.2",
    ]
    config = train.settings(words)
    assert values(config.bootstrap.criterion) == SPREAD_DEFAULTS | {"width": 0.2}
    assert config.criterion.width is None and not set(LEARNED_KEYS) & set(
        config.to_dict()["criterion"]
    )
    for name in ("outcome_spread", "outcome_spread_shuffled"):
        assert values(train.settings([f"sampler={name}"]).criterion) == SPREAD_DEFAULTS
        for key, value in OTHERS.items():
            config = train.settings([f"sampler={name}", f"criterion.{key}={value}"])
            assert config.criterion.name == name
            assert values(config.criterion) == SPREAD_DEFAULTS | {key: value}


OTHERS = {  # none of them is a default
    "of": "value" if SPREAD_DEFAULTS["of"] == "both" else "both",
    "width": 0.37,
    "rate": 0.21,
    "buckets": 77,
    "noise": "keep" if SPREAD_DEFAULTS["noise"] == "subtract" else "subtract",
    "tilings": 5,
}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["sampler=outcome_spread", "criterion.of=stat"],
            "criterion.of=stat: must be one of both, state, value; did you mean state?",
        ),
        (
            ["sampler=outcome_spread_shuffled", "criterion.of=q_range"],
            "criterion.of=q_range: must be one of both, state, value",
        ),
        (
            ["sampler=outcome_spread", "criterion.width=0"],
            "criterion.width=0: must be a finite number > 0",
        ),
        (
            ["sampler=outcome_spread", "criterion.rate=1.5"],
            "criterion.rate=1.5: must be a finite number in (0, 1]",
        ),
        (
            ["sampler=outcome_spread", "criterion.buckets=0"],
            "criterion.buckets=0: must be a whole number >= 1 and <= 65536",
        ),
        (
            ["sampler=outcome_spread_shuffled", "criterion.buckets=65537"],
            "criterion.buckets=65537: must be a whole number >= 1 and <= 65536",
        ),
        (
            ["sampler=outcome_spread", "criterion.noise=substract"],
            "criterion.noise=substract: must be one of keep, subtract; did you mean subtract?",
        ),
        (
            ["sampler=outcome_spread", "criterion.noise=true"],
            "criterion.noise=true: must be one of keep, subtract",
        ),
        (
            ["sampler=outcome_spread", "criterion.tilings=-1"],
            "criterion.tilings=-1: must be a whole number >= 0 and <= 32",
        ),
        (
            ["sampler=outcome_spread_shuffled", "criterion.tilings=33"],
            "criterion.tilings=33: must be a whole number >= 0 and <= 32",
        ),
        (
            ["sampler=outcome_spread", "criterion.tilings=2.5"],
            "criterion.tilings=2.5: must be a whole number >= 0 and <= 32",
        ),
        (
            ["sampler=outcome_spread", "criterion.of=state", "criterion.squashed=true"],
            "criterion.squashed=true: state takes none; only mode_log_prob and mode_prob do",
        ),
    ],
)
def test_a_wrong_parameter_is_one_line(words, said):
    with pytest.raises(ConfigError) as caught:
        train.settings(words)
    assert str(caught.value) == said


@pytest.mark.parametrize("key", LEARNED_KEYS)
@pytest.mark.parametrize("place", ["criterion", "bootstrap.criterion"])
def test_other_criteria_have_none_of_its_parameters(key, place):
    value = {**OTHERS, "hidden": 7, "lr": 0.02}[key]
    words = ["sampler=aser", f"{place}.name=mode_log_prob", f"{place}.{key}={value}"]
    with pytest.raises(ConfigError) as caught:
        train.settings(words)
    able = "outcome_spread" if key in SPREAD_DEFAULTS else "outcome_model"
    said = f"{place}.{key}={value}: mode_log_prob takes none; only {able}, "
    assert str(caught.value).startswith(said) and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["pretrained", "shuffled"])
def test_other_criteria_do_not_take_it(name):
    words = [f"sampler={'aser_shuffled' if name == 'shuffled' else name}"]
    with pytest.raises(ConfigError, match=r"^criterion\.of=outcome_spread: must be one of [^\n]*$"):
        train.settings([*words, "criterion.of=outcome_spread"])


TOY = ["debug=smoke", "seeds=[3,8]", "batch=11", "steps=60", "learning_starts=30", "eval.every=30"]
TOY += ["env=maze", "env.layout=toy", "hyper=thesis"]


def built(*words):
    config = train.settings([*TOY, *words])
    return build.build(config, train.CONF, train.CONF.parent / "results")


def through_a_file(run, path, words):
    checkpoint.save(path, run.state_dict())
    fresh = built(*words)
    fresh.load_state_dict(checkpoint.load(path))
    return fresh


@pytest.mark.parametrize(
    "words",
    [
        ["sampler=outcome_spread"],
        ["sampler=outcome_spread_shuffled", "criterion.of=both", "criterion.tilings=3"],
        *(
            pytest.param(["sampler=outcome_spread", *words], marks=pytest.mark.slow)
            for words in (
                ["criterion.of=state", "criterion.noise=keep"],
                ["bootstrap.criterion.name=outcome_spread_shuffled"],
                ["bootstrap.criterion.name=outcome_spread", "criterion.rate=0.3"],
            )
        ),
    ],
    ids=" ".join,
)
def test_a_resumed_run_is_that_run_to_the_bit(words, tmp_path):
    whole = built(*words)
    whole.run()
    part = built(*words)
    while part.step < 45:
        part.advance()
    part = through_a_file(part, tmp_path / "checkpoint.pt", words)
    part.run()
    for one, other in zip(tree_leaves(whole.state), tree_leaves(part.state), strict=True):
        assert one.equal(other)
    times = 3 if "criterion.tilings=3" in words else 1
    for seen in whole.state.criteria.values():
        assert seen.states[:, :, 0].sum(1).tolist() == [30 * 11 * times] * 2
        assert (seen.level > 0.0).all()
    two = "criterion.rate=0.3" in words  # drawing and stopping learn tables of their own
    assert len(whole.state.criteria) == 1 + two


def test_the_control_is_the_same_spread_at_warm_up_states():
    run = built("sampler=outcome_spread_shuffled")
    run.run()
    sampler, buffer = run.setup.buffer.sampler, run.setup.buffer
    assert isinstance(sampler.drawing, Shuffled) and isinstance(sampler.drawing.function, Learned)
    memory, state = buffer.memory(run._clock), run.state
    everywhere = [state.agent, state.criteria, memory]
    obs = sampler.layout.read_vector(buffer.storage.rows[:, :60], "obs").movedim(0, 1)
    shuffled = sampler.drawing.anywhere(sampler.agent, *everywhere, obs)
    itself = sampler.drawing.function.anywhere(sampler.agent, *everywhere, buffer.warm_up)
    for lane in range(2):
        values = set(itself[lane].tolist())
        assert len(values) >= 3 and set(shuffled[lane].tolist()) <= values
