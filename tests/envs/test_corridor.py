"""The corridor against a slow twin in plain Python."""

import gymnasium
import numpy as np
import pytest

from aser import envs
from aser.envs import drawing
from aser.errors import ConfigError

OTHER = {"length": 0.7, "gates": [[0.0, -1, 0.2], [0.3, 0.25, 0.25], [0.6, -1, 1]]}


DEFAULT_GATES = ((0.4, 0.3, 0.7), (0.8, -0.7, -0.3), (1.2, -0.1, 0.3), (1.6, -0.9, -0.5))


class Twin:
    def __init__(self, length=2.0, gates=DEFAULT_GATES):
        self.length, self.gates, self.x = length, gates, 0.0

    def step(self, action):
        gate = next((gate for gate in self.gates if abs(gate[0] - self.x) < 0.01), None)
        stopped = gate is not None and not (np.float32(gate[1]) <= action <= np.float32(gate[2]))
        self.x += 0.1
        return (-1.0 if stopped else 0.0), stopped or abs(self.x - self.length) < 0.01

    def observe(self):
        return 2 * self.x / self.length - 1


@pytest.mark.parametrize("kwargs", [{}, OTHER], ids=["default", "other"])
def test_every_lane_moves_as_the_twin(kwargs):
    lanes = 5
    env = envs.make("aser/Corridor-v0", lanes, **kwargs)
    twins = [Twin(**kwargs) for _ in range(lanes)]
    edges = np.array([-1, -0.9, -0.7, -0.5, -0.3, -0.1, 0.2, 0.25, 0.3, 0.7, 1], dtype=np.float32)
    rng = np.random.default_rng(2)
    seen, _ = env.reset(seed=1)
    np.testing.assert_array_equal(seen, np.full((lanes, 1), -1, np.float32))
    through, stopped = 0, 0
    for _ in range(3000):
        on_edge = rng.random((lanes, 1)) < 0.4
        actions = np.where(on_edge, rng.choice(edges, (lanes, 1)), rng.uniform(-1, 1, (lanes, 1)))
        # Most lanes aim at the gate, so that some episodes reach the end.
        for lane, twin in enumerate(twins[:3]):
            for x, low, high in twin.gates:
                if abs(x - twin.x) < 0.01:
                    actions[lane] = rng.choice([low, (low + high) / 2, high])
        actions = actions.astype(np.float32)
        seen, rewards, terminated, truncated, info = env.step(actions)
        assert not truncated.any()
        for lane, twin in enumerate(twins):
            reward, end = twin.step(actions[lane, 0])
            assert (rewards[lane], terminated[lane]) == (reward, end)
            if end:
                assert info["_final_obs"][lane]
                assert info["final_obs"][lane, 0] == pytest.approx(twin.observe(), abs=1e-5)
                through, stopped = through + (reward == 0), stopped + (reward < 0)
                twin.x = 0.0
            assert seen[lane, 0] == pytest.approx(twin.observe(), abs=1e-5)
    assert through > 50 and stopped > 50


@pytest.mark.parametrize(
    "kwargs, gates", [({}, [4, 8, 12, 16]), (OTHER, [0, 3])], ids=["default", "other"]
)
def test_the_oracle_knows_the_gates(kwargs, gates):
    env = envs.make("aser/Corridor-v0", 1, **kwargs)
    steps = round(env.steps)
    seen = np.array([[2 * k / steps - 1] for k in range(steps + 1)], dtype=np.float32)
    oracle = env.oracle(seen)
    # A gate that every action passes is no decision point.
    assert oracle.dtype == np.float32 and np.flatnonzero(oracle).tolist() == gates
    stacked = env.oracle(np.stack([seen, seen])[:, :, None])
    np.testing.assert_array_equal(stacked, np.stack([oracle, oracle])[:, :, None])


def test_returns_lie_between_worst_and_best():
    env = envs.make("aser/Corridor-v0", 1)
    assert (env.worst_return, env.best_return) == (-1.0, 0.0)
    env.reset(seed=0)
    heights = {4: 0.5, 8: -0.5, 12: 0.1, 16: -0.7}
    results = [env.step(np.array([[heights.get(k, 0.9)]])) for k in range(20)]
    assert sum(result[1][0] for result in results) == env.best_return
    assert [bool(result[2][0]) for result in results] == [False] * 19 + [True]


def test_a_nan_counts_as_zero():
    env = envs.make("aser/Corridor-v0", 3)
    env.reset(seed=0)
    for k in range(5):
        action = np.array([[0.5], [np.nan], [0.5]])
        _, rewards, terminated, _, _ = env.step(action)
        assert rewards.tolist() == [0, -1.0 if k == 4 else 0, 0]  # 0 misses the gate at 0.4
        assert terminated.tolist() == [False, k == 4, False]


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"length": 0}, "env.length=0: a multiple of 0.1"),
        ({"length": 0.25}, "env.length=0.25: "),
        ({"length": "long"}, "env.length=long: "),
        ({"length": float("nan")}, "env.length=nan: "),
        ({"length": True}, "env.length=True: "),
        ({"length": 1e12}, "env.length=1000000000000.0: "),
        ({"gates": 3}, "env.gates=3: a list of [x, low, high]"),
        ({"gates": [[0.4, 0.1]]}, "env.gates=[0.4, 0.1]: [x, low, high], three numbers"),
        ({"gates": [0.4, 0.1, 0.2]}, "env.gates=0.4: "),
        ({"gates": [[0.4, "a", 1]]}, "three numbers"),
        ({"gates": [[0.4, 0.1, float("inf")]]}, "three numbers"),
        ({"gates": [[0.45, 0.1, 0.2]]}, "x must be a multiple of 0.1 from 0 and below 2.0"),
        ({"gates": [[2.0, 0.1, 0.2]]}, "below 2.0"),
        ({"gates": [[0.4, 0.2, 0.1]]}, "-1 <= low <= high <= 1"),
        ({"gates": [[0.4, 0.2, 1.1]]}, "-1 <= low <= high <= 1"),
        ({"gates": [[0.4, 0, 0.1], [0.4, 0.2, 0.3]]}, "another gate"),
    ],
)
def test_improper_values_are_refused_in_one_line(kwargs, message):
    with pytest.raises(ConfigError) as refusal:
        envs.make("aser/Corridor-v0", 2, **kwargs)
    assert message in str(refusal.value) and "\n" not in str(refusal.value)


def test_the_picture_shows_the_gates_and_the_last_action():
    env = gymnasium.make("aser/Corridor-v0", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (120, 388, 3) and first.dtype == np.uint8
    assert (first[60, 14] == drawing.BLUE).all()  # the agent at x = 0, action 0
    for _ in range(4):
        env.step(np.array([0.5], np.float32))
    at_gate = env.render()
    # At the gate x = .4: the gap is from .3 to .7, and the agent in the middle of it.
    assert (at_gate[60 - 21, 14 + 4 * 18] == drawing.BLUE).all()
    assert (at_gate[60 + 21, 14 + 4 * 18] == drawing.DARK).all()
    _, reward, terminated, _, _ = env.step(np.array([-0.5], np.float32))
    assert (reward, terminated) == (-1.0, True)
    assert (env.render()[60 + 21, 14 + 4 * 18] == drawing.RED).all()  # stopped at the gate
    long = gymnasium.make("aser/Corridor-v0", length=10_000.0, render_mode="rgb_array")
    long.reset()
    assert long.render().shape == (120, 1228, 3)
