"""The baselines that count, against plain dictionaries."""

from collections import Counter, defaultdict

import pytest
import torch

import train
from aser import build, noise
from aser.lanes import batched
from aser.noise import Stream
from aser.replay.counts import SLOTS, SuccessorCount, VisitCount
from aser.replay.kinds import Transitions
from aser.trees import contiguous

OBS, ACT = 3, 2
KEYS = noise.lane_keys([4, 5, 6, 7])
SCALE = torch.tensor([0.5, 2.0, 1.0])


def walk(seed, count, places):
    """Transitions between few places."""
    g = torch.Generator().manual_seed(seed)
    centres = torch.randn(OBS, places, generator=torch.Generator().manual_seed(99))
    start, end = (torch.randint(places, (count,), generator=g) for _ in range(2))
    no = torch.zeros(count, dtype=torch.bool)
    zeros = torch.zeros(count)
    facts = Transitions(
        centres[:, start], zeros.expand(ACT, -1), zeros, centres[:, end], no, no, SCALE
    )
    return facts, start.tolist(), end.tolist(), centres


@pytest.mark.parametrize("rule", [VisitCount(0.1, 4096), SuccessorCount(0.1, 4096)])
def test_the_table_is_a_dictionary(rule):
    visits, successors = Counter(), defaultdict(set)
    own = rule.init(KEYS[0, Stream.CRITERION], OBS, ACT)
    for number, count in enumerate([1, 17, 40, 2]):
        facts, start, end, centres = walk(number, count, places=5)
        own = rule.update(own, facts, None, {}, {})
        visits.update(start)
        for here, there in zip(start, end, strict=True):
            successors[here].add(there)
        unseen = torch.full((OBS, 1), 9.0)
        p = rule.p(own, None, torch.cat([centres, unseen], 1), None).tolist()
        if isinstance(rule, VisitCount):
            expected = [(1 + visits[place]) ** -0.5 for place in range(5)] + [1.0]
        else:
            expected = [float(len(successors[place])) for place in range(5)] + [0.0]
        assert p == pytest.approx(expected)
    assert max(visits.values()) > 10 and max(map(len, successors.values())) == 5


def test_next_states_are_told_apart_up_to_the_slots():
    rule = SuccessorCount(0.1, 64)
    facts, *_ = walk(3, 600, places=200)
    facts = facts._replace(obs=torch.zeros(OBS, 600))
    own = rule.update(rule.init(KEYS[1, Stream.CRITERION], OBS, ACT), facts, None, {}, {})
    assert rule.p(own, None, torch.zeros(OBS, 1), None).item() == SLOTS


@pytest.mark.parametrize("rule", [VisitCount(0.1, 16), SuccessorCount(0.1, 16)])
def test_lanes_do_not_touch_each_other(rule):
    each = [walk(seed, 21, places=7)[0] for seed in range(4)]
    facts = Transitions(*(torch.stack(x) for x in zip(*each, strict=True)))
    own = contiguous(batched(lambda key: rule.init(key, OBS, ACT))(KEYS[:, Stream.CRITERION]))
    update = batched(lambda own, facts: rule.update(own, facts, None, {}, {}))
    together = update(own, facts)
    for lane, key in enumerate(KEYS[:, Stream.CRITERION]):
        alone = rule.update(rule.init(key, OBS, ACT), each[lane], None, {}, {})
        assert together.seen[lane].equal(alone.seen)


@pytest.mark.parametrize(
    "name", ["visit_count", pytest.param("successor_count", marks=pytest.mark.slow)]
)
def test_it_trains_by_its_name(name, tmp_path):
    words = ["debug=smoke", "env=maze", "env.layout=toy", "hyper=thesis", "hyper.from=aser"]
    words += ["sampler=outcome_spread", f"criterion={name}", "criterion.width=0.2", "seeds=[3,8]"]
    config = train.settings(words)
    assert config.bootstrap.criterion == config.criterion and config.criterion.width == 0.2
    training = build.build(config, train.CONF, tmp_path)
    training.run()
    key = f"{name} width=0.2 buckets=4096"
    assert list(training.state.criteria) == [key]
    assert training.state.criteria[key].seen.sum() > 0
