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
from aser.replay.kinds import Lane, Learned, Shuffled, Transitions
from aser.replay.outcome_spread import OutcomeSpread, bucket_of, one_step_target
from aser.replay.storage import Layout, Memory
from aser.settings.sampler import SPREAD_DEFAULTS
from aser.trees import take, tree_leaves

OBS, ACT, L = 3, 2, 3
KEYS = noise.lane_keys([4, 5, 6])
AGENTS = batched(lambda key: sac.init(key, OBS, ACT, [24]))(KEYS[:, Stream.INIT])
SCALE = torch.tensor([0.5, 2.0, 1.0])
HYPER = {"gamma": torch.tensor(0.9)}
RATE = 0.05
OF = ["state", "value", "both"]


def rule(of="state", width=0.1, rate=RATE, buckets=4096):
    return OutcomeSpread(of, width, rate, buckets)


def facts(obs, next_obs, reward=None, terminated=None, scale=SCALE):
    """Transitions of columns obs (O, B)."""
    count = obs.shape[1]
    return Transitions(
        obs=obs,
        action=torch.zeros(ACT, count),
        reward=torch.zeros(count) if reward is None else reward,
        next_obs=next_obs,
        terminated=torch.zeros(count, dtype=torch.bool) if terminated is None else terminated,
        truncated=torch.zeros(count, dtype=torch.bool),
        scale=scale,
    )


def random_facts(seed, count, places=6):
    """Transitions from few places, so that many share a bucket."""
    g = torch.Generator().manual_seed(seed)
    place = torch.randint(places, (count,), generator=g)
    centres = torch.randn(OBS, places, generator=torch.Generator().manual_seed(99))
    return facts(
        obs=centres[:, place],
        next_obs=torch.randn(OBS, count, generator=g) + 5.0,
        reward=torch.randn(count, generator=g),
        terminated=torch.rand(count, generator=g) < 0.3,
    )


def column(*values):
    return torch.tensor(values)[:, None].float()


def learned(spread, *updates, state=None, lane=0):
    """The table of a lane after these transitions, and a function that gives p there."""
    state = take(AGENTS, 0) if state is None else state
    own = spread.init(KEYS[lane, Stream.CRITERION], OBS, ACT)
    for transitions in updates:
        own = spread.update(own, transitions, state, HYPER, {})
    return own, lambda obs: spread.p(own, state, obs, None)


class Twin:
    """A list of outcomes for each bucket; means and variances are sums over the lists."""

    def __init__(self, spread, scale=SCALE):
        self.spread, self.scale, self.lists = spread, scale, defaultdict(list)

    def bucket(self, obs, key):
        width, buckets = self.spread.width, self.spread.buckets
        return bucket_of(key, obs, self.scale, width, buckets).tolist()

    def update(self, transitions, state, key):
        targets = one_step_target(state, transitions, HYPER["gamma"]).tolist()
        for i, bucket in enumerate(self.bucket(transitions.obs, key)):
            outcome = (transitions.next_obs[:, i] / self.scale).tolist()
            self.lists[bucket].append((outcome, targets[i]))

    def moments(self, values):
        """The mean and variance of numbers, of which the last ones count most."""
        n, rate = len(values), self.spread.rate
        weights = [(rate if i else 1.0) * (1.0 - rate) ** (n - 1 - i) for i in range(n)]
        assert sum(weights) == pytest.approx(1.0)
        mean = sum(w * x for w, x in zip(weights, values, strict=True))
        return mean, sum(w * (x - mean) ** 2 for w, x in zip(weights, values, strict=True))

    def of_state(self, bucket):
        outcomes = [outcome for outcome, _ in self.lists[bucket]]
        return sum(self.moments([o[d] for o in outcomes])[1] for d in range(OBS))

    def of_value(self, bucket):
        return self.moments([target for _, target in self.lists[bucket]])

    def p(self, obs, key):
        visited = [bucket for bucket in self.lists if self.lists[bucket]]
        means = [self.of_value(bucket)[0] for bucket in visited]
        centre = sum(means) / len(means)
        between = sum((mean - centre) ** 2 for mean in means) / len(means)
        found = []
        for bucket in self.bucket(obs, key):
            if bucket not in visited:
                found.append(0.0)
                continue
            by_state, by_value = self.of_state(bucket), self.of_value(bucket)[1]
            found.append(
                {
                    "state": by_state,
                    "value": by_value,
                    "both": by_state / OBS + (by_value / between if between else 0.0),
                }[self.spread.of]
                ** 0.5
            )
        return found


@pytest.mark.parametrize("of", OF)
@pytest.mark.parametrize(("rate", "buckets"), [(0.05, 4096), (0.3, 4096), (0.05, 4), (1.0, 4096)])
def test_the_table_is_a_dictionary_of_lists(of, rate, buckets):
    spread, state = rule(of, rate=rate, buckets=buckets), take(AGENTS, 1)
    twin, key = Twin(spread), KEYS[0, Stream.CRITERION]
    own = spread.init(key, OBS, ACT)
    for number, count in enumerate([1, 17, 40, 2, 33]):
        transitions = random_facts(number, count, places=2 + number)
        twin.update(transitions, state, key)
        own = spread.update(own, transitions, state, HYPER, {})
        obs = random_facts(7, 50, places=9).obs  # some are new
        found = spread.p(own, state, obs, None)
        assert found.tolist() == pytest.approx(twin.p(obs, key), rel=2e-3, abs=2e-3)
    assert own.visits.sum() == 93 and max(map(len, twin.lists.values())) > 15
    for bucket, outcomes in twin.lists.items():
        assert own.visits[bucket] == len(outcomes)
        if of != "state":
            assert own.mean[-1, bucket].item() == pytest.approx(twin.of_value(bucket)[0], abs=1e-4)
    if rate == 1.0:  # only the last outcome counts
        assert own.variance.abs().max() < 1e-6 or of == "both"


@pytest.mark.parametrize("of", OF)
def test_items_of_one_update_are_taken_one_by_one_in_their_order(of):
    spread, whole = rule(of), random_facts(3, 40, places=4)
    state = take(AGENTS, 1)
    singly = [Transitions(*(x[..., i : i + 1] for x in whole[:-1]), scale=SCALE) for i in range(40)]
    one, _ = learned(spread, whole, state=state)
    other, _ = learned(spread, *singly, state=state)
    for x, y in zip(one, other, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-4, atol=1e-4)


# By hand


HERE, THERE = column(0.3, 0.0, -1.0), column(2.0, 1.0, 1.0)


def test_one_outcome_has_no_spread_however_often_it_came():
    next_obs = column(0.37, -11.3, 4.1)
    _, p = learned(rule(), *[facts(HERE.expand(-1, 7), next_obs.expand(-1, 7))] * 3)
    assert p(HERE).tolist() == [0.0]


@pytest.mark.parametrize("of", OF)
def test_a_state_that_was_not_drawn_has_no_spread(of):
    _, p = learned(rule(of))
    assert p(torch.cat([HERE, THERE], 1)).tolist() == [0.0, 0.0]
    twice = facts(HERE.expand(-1, 2), torch.cat([HERE, THERE], 1), torch.tensor([1.0, 2.0]))
    _, p = learned(rule(of), twice)
    here, there = p(torch.cat([HERE, THERE], 1)).tolist()
    assert here > 0.0 and there == 0.0


def test_two_outcomes():
    # 3 units of the first observation (scale .5) apart and 1 of the second (scale 2): the squared
    # distance is 10, with the weights 1 - rate and rate.
    start = column(1.0, 1.0, 1.0)
    two = torch.cat([start, start + column(1.5, -2.0, 0.0)], 1)
    own, p = learned(rule(), facts(HERE.expand(-1, 2), two))
    assert p(HERE).item() == pytest.approx(math.sqrt(10 * 0.95 * 0.05), rel=1e-5)
    (bucket,) = own.visits.nonzero()
    expected = [2.0 + 3 * 0.05, 0.5 - 0.05, 1.0]
    assert own.mean[:, bucket].flatten().tolist() == pytest.approx(expected, rel=1e-5)
    # Drawn in turns for long, each has half the weight, apart from the order.
    _, p = learned(rule(), *[facts(HERE.expand(-1, 2), two)] * 300)
    late = 1 / (2 - RATE)  # the weight of the one that came last
    assert p(HERE).item() == pytest.approx(math.sqrt(10 * late * (1 - late)), rel=1e-4)


def test_an_outcome_that_drifts_is_followed_and_then_forgotten():
    old, new = column(0.0, 0.0, 0.0), column(0.0, 0.0, 4.0)
    for count in (1, 5, 200):
        updates = [facts(HERE, old)] * 9 + [facts(HERE, new)] * count
        own, p = learned(rule(), *updates)
        left = 0.95**count  # the weight of the old one
        assert p(HERE).item() == pytest.approx(4 * math.sqrt(left * (1 - left)), rel=1e-3)
        (bucket,) = own.visits.nonzero()
        assert own.mean[2, bucket].item() == pytest.approx(4 * (1 - left), rel=1e-4)


def test_the_value_is_the_spread_of_the_targets():
    state = take(AGENTS, 2)
    obs = HERE.expand(-1, 2)
    end = torch.tensor([True, True])
    _, p = learned(rule("value"), facts(obs, obs, torch.tensor([1.0, 3.0]), end), state=state)
    assert p(HERE).item() == pytest.approx(2 * math.sqrt(0.95 * 0.05), rel=1e-5)
    transitions = random_facts(5, 30)
    action = torch.tanh(policy(state.actor, transitions.next_obs).mean)
    for i, found in enumerate(one_step_target(state, transitions, HYPER["gamma"])):
        next_obs = transitions.next_obs[:, i : i + 1]
        q = q_values(state.targets, next_obs, action[:, i : i + 1]).min().item()
        q = 0.0 if transitions.terminated[i] else q
        assert found.item() == pytest.approx(transitions.reward[i].item() + 0.9 * q, abs=1e-5)
    assert transitions.terminated.any() and not transitions.terminated.all()


def test_both_weighs_the_target_by_how_far_states_differ():
    ends = torch.ones(3, dtype=torch.bool)
    obs = torch.cat([HERE, HERE, THERE], 1)
    rewards = torch.tensor([1.0, 3.0, 7.1])  # the mean targets: 1.1 here and 7.1 there
    next_obs = torch.cat([HERE, HERE + column(0.5, 0.0, 0.0), THERE], 1)  # one unit apart
    own, p = learned(rule("both"), facts(obs, next_obs, rewards, ends))
    assert own.between.item() == pytest.approx(9.0, rel=1e-4)
    share = 0.95 * 0.05
    assert p(HERE).item() == pytest.approx(math.sqrt(share / 3 + 4 * share / 9), rel=1e-4)
    assert p(THERE).item() == 0.0
    # A single bucket tells nothing of how far states differ: the target is left out.
    own, p = learned(rule("both"), facts(obs[:, :2], next_obs[:, :2], rewards[:2], ends[:2]))
    assert own.between.item() == 0.0
    assert p(HERE).item() == pytest.approx(math.sqrt(share / 3), rel=1e-4)


def test_states_that_collide_share_their_outcomes():
    obs = torch.cat([HERE, THERE], 1)
    two = torch.cat([column(0.0, 0.0, 0.0), column(0.0, 0.0, 2.0)], 1)
    apart, p = learned(rule(), facts(obs, two))
    assert p(obs).tolist() == [0.0, 0.0] and apart.visits.sum() == 2 and apart.visits.max() == 1
    together, p = learned(rule(buckets=1), facts(obs, two))
    assert p(obs).tolist() == pytest.approx([2 * math.sqrt(0.95 * 0.05)] * 2, rel=1e-5)
    assert together.visits.tolist() == [2]


def test_a_bucket_is_a_cell_in_units_of_the_scale():
    key = KEYS[0, Stream.CRITERION]

    def bucket(*obs, width=0.1):
        return bucket_of(key, column(*obs), SCALE, width, 2**31).item()

    here = bucket(0.0, 0.0, 0.0)
    # A tenth of the scale .5, 2 and 1 is .05, .2 and .1; half of it on either side.
    assert bucket(0.024, -0.09, 0.04) == bucket(-0.024, 0.09, -0.04) == here
    others = {bucket(0.026, 0.0, 0.0), bucket(0.0, 0.11, 0.0), bucket(0.0, 0.0, -0.06)}
    assert len(others) == 3 and here not in others
    assert bucket(0.026, 0.11, -0.06, width=1.0) == here
    many = torch.randn(OBS, 20_000, generator=torch.Generator().manual_seed(1)) * 1e3
    places = bucket_of(key, many, SCALE, 0.1, 16).bincount(minlength=16)
    assert ((places - 1250).abs() < 200).all()  # the hash fills the table evenly


def test_a_lane_hashes_by_a_key_of_its_own():
    obs = torch.randn(OBS, 200, generator=torch.Generator().manual_seed(1))
    one, two = (bucket_of(KEYS[i, Stream.CRITERION], obs, SCALE, 0.1, 4096) for i in (0, 1))
    assert (one == two).sum() < 5


# In lanes, compiled, and behind the seam


def lanes(of, seed):
    """Transitions of three lanes."""
    each = [random_facts(seed + i, 16) for i in range(L)]
    return Transitions(*(torch.stack(x) for x in zip(*each, strict=True)))


def many(spread):
    def update(own, transitions, state):
        new = spread.update(own, transitions, state, HYPER, {})
        return new, spread.p(new, state, transitions.obs, None)

    return batched(update)


def tables(spread):
    init = batched(lambda key: spread.init(key, OBS, ACT))
    return tree_copy(init(KEYS[:, Stream.CRITERION]))


def tree_copy(table):
    return type(table)(*(x.contiguous() for x in table))


@pytest.mark.parametrize("of", OF)
def test_lanes_do_not_touch_each_other(of):
    spread = rule(of, buckets=64)
    own, transitions = tables(spread), lanes(of, 10)
    found, p = many(spread)(own, transitions, AGENTS)
    for i in range(L):
        alone, look = learned(spread, take(transitions, i), state=take(AGENTS, i), lane=i)
        torch.testing.assert_close(take(found, i), alone, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(p[i], look(transitions.obs[i]), rtol=1e-4, atol=1e-4)
    spoilt = transitions._replace(next_obs=transitions.next_obs.clone())
    spoilt.next_obs[1] = torch.nan
    other, q = many(spread)(own, spoilt, AGENTS)
    for x, y in zip([*found, p], [*other, q], strict=True):
        assert x[0].equal(y[0]) and x[2].equal(y[2])


@pytest.mark.skipif(why_not_compiled() is not None, reason="nothing can be compiled here")
@pytest.mark.parametrize("of", ["state", "both"])
def test_compiled_it_is_the_same(of):
    spread = rule(of)
    eager, fast = tables(spread), tables(spread)
    function = compiled(many(spread), True)
    for seed in range(4):
        eager, p = many(spread)(eager, lanes(of, seed), AGENTS)
        fast, q = function(fast, lanes(of, seed), AGENTS)
        torch.testing.assert_close(p, q, rtol=1e-3, atol=1e-3)
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
    bucket = bucket_of(found.key, rows[[2], :OBS].T, found.scale, 0.7, 4096)
    assert found.visits[bucket].tolist() == [2] and found.visits.sum() == 3


# Settings and training


def test_the_defaults_of_the_settings_are_those_of_the_file():
    file = yaml.safe_load((train.CONF / "criterion" / "outcome_spread.yaml").read_text())
    assert {key: file[key] for key in SPREAD_DEFAULTS} == SPREAD_DEFAULTS
    words = [
        "sampler=aser",
        "bootstrap.criterion.name=outcome_spread",
        "bootstrap.criterion.width=0.2",
    ]
    config = train.settings(words)
    own = config.bootstrap.criterion
    assert (own.of, own.width, own.rate, own.buckets) == ("state", 0.2, 0.05, 4096)
    assert config.criterion.width is None and "width" not in config.to_dict()["criterion"]
    for name in ("outcome_spread", "outcome_spread_shuffled"):
        config = train.settings([f"sampler={name}", "criterion.of=both", "criterion.rate=0.1"])
        assert (config.criterion.name, config.criterion.of) == (name, "both")
        assert (config.criterion.rate, config.criterion.buckets) == (0.1, 4096)


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
            ["sampler=aser", "criterion.width=0.2"],
            "criterion.width=0.2: mode_log_prob takes none; only outcome_spread does",
        ),
        (
            ["sampler=outcome_spread", "criterion.squashed=true"],
            "criterion.squashed=true: state takes none; only mode_log_prob and mode_prob do",
        ),
    ],
)
def test_a_wrong_parameter_is_one_line(words, said):
    with pytest.raises(ConfigError) as caught:
        train.settings(words)
    assert str(caught.value) == said


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
        ["sampler=outcome_spread_shuffled", "criterion.of=both"],
        ["sampler=outcome_spread", "bootstrap.criterion.name=outcome_spread_shuffled"],
        ["sampler=outcome_spread", "bootstrap.criterion.name=outcome_spread", "criterion.of=value"],
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
    for table in whole.state.criteria.values():
        assert table.visits.sum(1).tolist() == [30 * 11] * 2
        assert table.variance.amax() > 0.0
    two = "criterion.of=value" in words  # drawing and stopping learn tables of their own
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
