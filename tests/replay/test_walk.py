"""The walk against the plain lines that it stands in for, in a full ring with ends of episodes."""

from functools import partial

import pytest
import torch

from aser import native, noise
from aser.agents import sac
from aser.compiled import compiled
from aser.lanes import batched
from aser.noise import Stream
from aser.replay import bootstrap, criteria, walk
from aser.replay.kinds import Constant, Frozen, Live
from aser.replay.sampler import Drawn, Sampler, State
from aser.replay.storage import LANES_OF_MEMORY, Clock, Layout, Memory
from aser.replay.unroll import Unroll

pytestmark = pytest.mark.skipif(native.library() is None, reason="nothing can be compiled here")

LANES, OBS, ITEMS, BATCH, STEPS = 2, 5, 61, 83, 7
GAUSSIAN = Live("gaussian", partial(criteria.mode_log_prob, squashed=False))
SAMPLERS = {
    "fixed": {"rule": bootstrap.fixed},
    "geometric": {"rule": bootstrap.geometric, "uses_random": True},
    "mode_log_prob": {"criterion": Live("m", criteria.mode_log_prob), "threshold": 0.8},
    "gaussian": {"criterion": GAUSSIAN, "threshold": 0.34},
    "quantile": {"criterion": Live("m", criteria.mode_log_prob), "threshold": None},
    "frozen": {"criterion": Frozen("oracle", lambda obs: obs[:, 0])},
    "entropy": {"criterion": Live("e", criteria.entropy), "threshold": None},
}


def assembled(name, actions, hidden=(9,), compile=False):
    """The batch, and how far its items were unrolled."""
    options = {"rule": bootstrap.threshold, "threshold": 0.5, "window": STEPS} | SAMPLERS[name]
    columns = options["criterion"].columns if "criterion" in options else ()
    layout = Layout(OBS, actions, columns)
    sampler = Sampler(sac, layout, BATCH, Constant("uniform"), Unroll(**options))
    torch.manual_seed(4)
    rows = torch.randn(LANES, ITEMS, layout.width)
    for fact in ("terminated", "truncated"):
        rows[:, :, layout.columns[fact]] = (torch.rand(LANES, ITEMS, 1) < 0.04).float()
    keys = noise.lane_keys(range(LANES))
    agents = batched(lambda key: sac.init(key, OBS, actions, hidden))(keys[:, Stream.INIT])
    agents = agents._replace(log_temperature=torch.tensor([-0.3, 0.4]))
    clock = Clock(*(torch.tensor(x) for x in (70, 23, ITEMS)), torch.tensor(0.3))
    memory = Memory(rows, torch.zeros(LANES, OBS, 1), keys, clock)
    numbers = batched(lambda key: noise.numbers(key, sampler.wanted(actions)))(keys)
    hyper = {"gamma": [0.97, 0.9], "h": [STEPS, 4.0], "lam": [0.8, 0.7], "k_m": [0.9, 0.7]}
    hyper = {key: torch.tensor(values) for key, values in hyper.items()}
    hyper["k_s"] = torch.ones(LANES)
    drawn = Drawn(torch.randint(ITEMS, (LANES, BATCH)), torch.ones(LANES, BATCH))
    function = batched(sampler.assemble, (0, LANES_OF_MEMORY, 0, 0, 0))
    return compiled(function, compile)(State(agents, {}), memory, drawn, hyper, numbers)


@pytest.fixture
def walks(monkeypatch):
    """How many unrolls the operator made."""
    made, unroll = [], walk.unroll
    monkeypatch.setattr(walk, "unroll", lambda *args: made.append(1) or unroll(*args))
    return made


@pytest.mark.parametrize("actions", [1, 2, 4])
@pytest.mark.parametrize("name", [name for name in SAMPLERS if name != "quantile"])
def test_a_walk_gives_the_numbers_of_the_plain_lines(walks, monkeypatch, name, actions):
    expected, plain = assembled(name, actions)
    assert walks == []  # a step that is not compiled is plain
    monkeypatch.setattr(walk, "tracing", lambda: True)
    batch, unrolled = assembled(name, actions)
    assert bool(walks) == (name != "entropy")  # which needs all outputs, and has them
    assert torch.equal(unrolled.n, plain.n) and len(plain.n.unique()) > 1
    torch.testing.assert_close(batch, expected, rtol=1e-6, atol=2e-6)


def test_compiled_a_walk_stops_at_the_same_states_where_p_equals_the_threshold(walks, monkeypatch):
    batch, unrolled = assembled("quantile", 2, compile=True)
    assert walks
    monkeypatch.setattr(walk, "serves", lambda lane: False)
    expected, plain = assembled("quantile", 2, compile=True)
    assert torch.equal(unrolled.n, plain.n) and torch.equal(unrolled.b, plain.b)
    torch.testing.assert_close(batch, expected, rtol=1e-6, atol=2e-6)


@pytest.mark.parametrize("hidden", [(9, 9), (native.MAX_HIDDEN + 1,)])
def test_no_walk_where_the_network_is_large(walks, monkeypatch, hidden):
    monkeypatch.setattr(walk, "tracing", lambda: True)
    assembled("mode_log_prob", 2, hidden)
    assert walks == []
