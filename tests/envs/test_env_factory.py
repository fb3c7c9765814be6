"""Every environment: spaces, autoreset, seeds, saved states, and errors of one line."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from aser import envs
from aser.errors import ConfigError

SHIPPED = [
    ("aser/Maze-v0", {"layout": "toy"}),
    ("aser/Maze-v0", {"layout": "random", "layout_seed": 5, "size": [3, 4], "reward": "sparse"}),
    ("aser/Corridor-v0", {"length": 0.9, "gates": [[0.2, -0.9, 0.8], [0.5, -0.5, 0.9]]}),
    ("aser/Pendulum-v0", {}),
]
each_shipped = pytest.mark.parametrize(
    "id, kwargs", SHIPPED, ids=["maze", "sparse", "corridor", "pendulum"]
)


class Counter(gymnasium.Env):
    """Observes its seed and its number of steps in float64; the episode ends after `ends` steps."""

    def __init__(self, ends=3, action_space=None, observation_space=None):
        self.observation_space = observation_space or Box(-np.inf, np.inf, (5,), np.float64)
        self.action_space = action_space or Box(-1, 3, (2,), np.float32)
        self.ends, self.seed_ = ends, 0

    def _observe(self):
        return np.array([self.seed_, self.t, 0.1, 0, 0])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.seed_ = 0, self.seed_ if seed is None else seed
        return self._observe(), {}

    def step(self, action):
        self.t += 1
        return self._observe(), float(action[0]), self.t >= self.ends, False, {}


gymnasium.register("AserTest/Counter-v0", entry_point=Counter)


@each_shipped
def test_check_env_passes_on_the_single_version(id, kwargs):
    env = gymnasium.make(id, **kwargs)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Pendulum-v1 warns of its torques.
        warnings.filterwarnings("ignore", ".*symmetric and normalized.*")
        check_env(env.unwrapped)


@each_shipped
def test_a_lane_equals_the_single_version_step_by_step(id, kwargs):
    seeds, steps = [7, 3, 12], 450
    many = envs.make(id, len(seeds), **kwargs)
    singles = [gymnasium.make(id, **kwargs) for _ in seeds]
    rng = np.random.default_rng(0)
    space = many.single_action_space
    actions = rng.uniform(space.low, space.high, (steps, len(seeds), *space.shape)).astype(
        np.float32
    )
    seen, _ = many.reset(seed=seeds)
    firsts = [single.reset(seed=seed)[0] for single, seed in zip(singles, seeds, strict=True)]
    np.testing.assert_array_equal(seen, firsts)
    episodes = 0
    for action in actions:
        seen, rewards, terminated, truncated, info = many.step(action)
        for lane, single in enumerate(singles):
            expected, reward, end, cut, _ = single.step(action[lane])
            assert (rewards[lane], terminated[lane], truncated[lane]) == (reward, end, cut)
            if end or cut:
                np.testing.assert_array_equal(info["final_obs"][lane], expected)
                expected, _ = single.reset()
                episodes += 1
            np.testing.assert_array_equal(seen[lane], expected)
    assert episodes >= 6


@each_shipped
def test_a_saved_state_goes_on_bit_for_bit(id, kwargs):
    lanes = 4
    env, other = envs.make(id, lanes, **kwargs), envs.make(id, lanes, **kwargs)
    rng = np.random.default_rng(0)
    space = env.single_action_space
    env.reset(seed=100), other.reset(seed=55)
    for cut in (13, 230):
        for _ in range(cut):
            env.step(rng.uniform(space.low, space.high, (lanes, *space.shape)))
        saved = env.state_dict()
        for array in saved.values():
            assert (
                type(array) is np.ndarray
                and array.dtype in (np.int64, np.float64)
                and len(array) == lanes
            )
        other.load_state_dict({name: array.copy() for name, array in saved.items()})
        np.testing.assert_array_equal(env.observations(), other.observations())
        before = {name: array.copy() for name, array in saved.items()}
        for _ in range(450):
            action = rng.uniform(space.low, space.high, (lanes, *space.shape))
            for got, expected in zip(other.step(action)[:4], env.step(action)[:4], strict=True):
                np.testing.assert_array_equal(got, expected)
        for name in saved:  # later steps do not change a saved state
            np.testing.assert_array_equal(saved[name], before[name])
    with pytest.raises(ValueError, match="shape"):
        envs.make(id, lanes + 1, **kwargs).load_state_dict(saved)
    with pytest.raises(ValueError, match="state holds"):
        other.load_state_dict({"seed": saved["seed"]})


@each_shipped
def test_spaces_types_and_attributes(id, kwargs):
    env = gymnasium.make_vec(id, num_envs=3, **kwargs)  # gymnasium makes the array version, too
    assert type(env) is type(envs.make(id, 3, **kwargs))
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    seen, _ = env.reset(seed=[1, 2, 3])
    kept = seen.copy()
    following, rewards, terminated, truncated, _ = env.step(env.action_space.sample())
    np.testing.assert_array_equal(seen, kept)  # later steps do not change a returned array
    assert (
        seen.shape == following.shape == env.observation_space.shape
        and following in env.observation_space
    )
    assert seen.dtype == np.float32 and rewards.dtype == np.float64
    assert rewards.shape == terminated.shape == truncated.shape == (3,)
    assert env.oracle is None or env.oracle(seen).shape == (3,)
    assert env.best_return is None or env.worst_return < env.best_return


@each_shipped
def test_seeds(id, kwargs):
    env = envs.make(id, 3, **kwargs)
    one, _ = env.reset(seed=4)
    np.testing.assert_array_equal(env.reset(seed=[4, 5, 6])[0], one)
    following = env.reset()[0], env.reset()[0]
    env.reset(seed=range(4, 7))
    np.testing.assert_array_equal([env.reset()[0], env.reset()[0]], following)
    for improper in ([1, 2], [1, 2, -3], [1, 2, 0.5]):
        with pytest.raises(ValueError, match="seeds"):
            env.reset(seed=improper)
    if id == "aser/Pendulum-v0":
        assert len(np.unique(np.concatenate([one, *following]), axis=0)) == 9
        unseeded = [envs.make(id, 3).reset()[0] for _ in range(2)]
        assert len(np.unique(np.concatenate(unseeded), axis=0)) == 6


def test_any_gymnasium_environment_keeps_the_promises():
    env = envs.make("AserTest/Counter-v0", 2, ends=3)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert env.single_observation_space.dtype == np.float32 and env.observation_space.shape == (
        2,
        5,
    )
    assert (env.best_return, env.worst_return, env.oracle) == (None, None, None)
    assert (env.state_dict, env.load_state_dict) == (None, None)
    seen, _ = env.reset(seed=[30, 7])
    assert seen.dtype == np.float32 and seen[:, 0].tolist() == [30, 7]
    for t in (1, 2, 3, 1):
        actions = np.array([[0.5, 0], [np.nan, 0]], dtype=np.float32)
        seen, rewards, terminated, truncated, info = env.step(actions)
        # NaN counts as the middle of [-1, 3].
        assert seen.dtype == np.float32 and rewards.tolist() == [
            0.5,
            1.0,
        ]
        assert terminated.tolist() == [t == 3] * 2 and not truncated.any()
        assert seen[:, 1].tolist() == [t % 3] * 2
        if t == 3:
            assert info["_final_obs"].all() and info["final_obs"].shape == (2, 5)
            assert info["final_obs"].dtype == np.float32 and info["final_obs"][:, 1].tolist() == [
                3,
                3,
            ]
    assert env.reset(seed=9)[0][:, 0].tolist() == [9, 10]


def test_any_gymnasium_environment_equals_its_single_version():
    env = envs.make("MountainCarContinuous-v0", 2)
    twins = [gymnasium.make("MountainCarContinuous-v0") for _ in range(2)]
    seen, _ = env.reset(seed=[5, 1])
    firsts = [twin.reset(seed=seed)[0] for twin, seed in zip(twins, [5, 1], strict=True)]
    np.testing.assert_array_equal(seen, firsts)
    cut_at = []
    for step in range(1100):
        action = np.random.default_rng(step).uniform(-1, 1, (2, 1)).astype(np.float32)
        seen, rewards, terminated, truncated, info = env.step(action)
        for lane, twin in enumerate(twins):
            expected, reward, end, cut, _ = twin.step(action[lane])
            assert (rewards[lane], terminated[lane], truncated[lane]) == (reward, end, cut)
            if end or cut:
                np.testing.assert_array_equal(info["final_obs"][lane], expected)
                expected, _ = twin.reset()
                cut_at.append(step)
            np.testing.assert_array_equal(seen[lane], expected)
    assert cut_at == [998, 998]


@pytest.mark.parametrize(
    "id, kwargs, message",
    [
        (
            "Pendulumm-v1",
            {},
            "env.id=Pendulumm-v1 is unknown to gymnasium: the nearest id is Pendulum-v1",
        ),
        ("Pendulum-v7", {}, "the nearest id is Pendulum-v1"),
        ("aser/Mase-v0", {}, "the nearest id is aser/Maze-v0"),
        ("nobody/Nothing-v0", {}, "is unknown to gymnasium: the nearest id is "),
        ("", {}, "env.id= is unknown"),
        (None, {}, "env.id=None is unknown"),
        (
            "no.such.module:Thing-v0",
            {},
            "env.id=no.such.module:Thing-v0 cannot be made: No module named",
        ),
        (
            "AserTest/Counter-v0",
            {"action_space": Discrete(1)},
            "acts in Discrete(1): a one-dimensional, continuous Box is allowed, and a Discrete of",
        ),
        ("FrozenLake-v1", {}, "env.id=FrozenLake-v1 observes Discrete(16): a one-dimensional Box"),
        ("Pendulum-v1", {"bogus": 1}, "env.id=Pendulum-v1 cannot be made: "),
        (
            "AserTest/Counter-v0",
            {"action_space": Box(-np.inf, 1, (2,))},
            "with finite bounds is allowed",
        ),
        ("AserTest/Counter-v0", {"action_space": Box(0, 0, (2,))}, "with finite bounds is allowed"),
        (
            "AserTest/Counter-v0",
            {"action_space": Box(-1, 1, (2, 3))},
            "one-dimensional, continuous Box",
        ),
        ("AserTest/Counter-v0", {"action_space": Box(-1, 1, (2,), np.int64)}, "continuous Box"),
        ("AserTest/Counter-v0", {"observation_space": Box(0, 255, (4, 3))}, "one-dimensional Box"),
        (
            "AserTest/Counter-v0",
            {"observation_space": Box(0, 255, (4,), np.uint8)},
            "of real numbers",
        ),
        ("AserTest/Counter-v0", {"observation_space": Discrete(4)}, "observes Discrete(4)"),
        (
            "aser/Maze-v0",
            {"layouts": "toy"},
            "env.layouts is unknown to aser/Maze-v0: allowed are layout, ",
        ),
        ("aser/Maze-v0", {"self": 3}, "env.self is unknown"),
        ("aser/Pendulum-v0", {"g": 9.81}, "env.g is unknown to aser/Pendulum-v0: allowed are none"),
        ("aser/Maze-v0", {"layout": "nowhere"}, "env.layout=nowhere cannot be read"),
    ],
)
def test_refusals_are_one_line(id, kwargs, message):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ConfigError) as refusal:
            envs.make(id, 2, **kwargs)
    assert message in str(refusal.value) and "\n" not in str(refusal.value)


def test_the_modules_of_an_environment(tmp_path, monkeypatch):
    (tmp_path / "walks.py").write_text("from gymnasium.envs.classic_control import PendulumEnv\n")
    (tmp_path / "walk_ids.py").write_text(
        "import gymnasium\ngymnasium.register('Swing-v3', entry_point='walks:PendulumEnv', "
        "max_episode_steps=7)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    for id in ("walk_ids:Swing-v3", "walk_ids:Swing"):  # gymnasium takes the latest version
        assert envs.modules_of(id) == {"walk_ids", "walks"}
        assert envs.time_limit(id, {}) == 7
    assert envs.modules_of("Pendulum-v1") == {"gymnasium.envs.classic_control.pendulum"}


@pytest.mark.parametrize("lanes", [0, -1, 2.0, True, "3"])
def test_the_number_of_lanes_is_checked(lanes):
    with pytest.raises(
        ConfigError, match=f"^num_envs={lanes}: a whole number of at least 1 is allowed$"
    ):
        envs.make("aser/Maze-v0", lanes)
