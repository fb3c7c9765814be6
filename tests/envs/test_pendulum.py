"""The pendulum equals gymnasium's, and its start states are pure functions of seed and episode."""

import gymnasium
import numpy as np

from aser import envs
from aser.envs import drawing
from aser.envs.pendulum import PendulumVectorEnv


def test_equal_to_gymnasium_step_by_step():
    lanes, episodes = 3, 3
    env = envs.make("aser/Pendulum-v0", lanes)
    twins = [gymnasium.make("Pendulum-v1") for _ in range(lanes)]
    assert env.single_observation_space == twins[0].observation_space
    assert env.single_action_space == twins[0].action_space
    rng = np.random.default_rng(3)
    seen, _ = env.reset(seed=8)
    for _ in range(episodes):
        state = env.state_dict()
        for lane, twin in enumerate(twins):
            twin.reset(seed=0)
            twin.unwrapped.state = np.array([state["angle"][lane], state["speed"][lane]])
            np.testing.assert_allclose(twin.unwrapped._get_obs(), seen[lane], rtol=0, atol=1e-7)
        for step in range(200):
            # Also beyond the limits of the torque.
            actions = rng.uniform(-3, 3, (lanes, 1)).astype(np.float32)
            seen, rewards, terminated, truncated, info = env.step(actions)
            shown = info["final_obs"] if info else seen
            for lane, twin in enumerate(twins):
                expected, reward, end, cut, _ = twin.step(actions[lane])
                np.testing.assert_allclose(shown[lane], expected, rtol=1e-6, atol=1e-6)
                np.testing.assert_allclose(rewards[lane], reward, rtol=1e-9, atol=1e-12)
                assert (terminated[lane], truncated[lane]) == (end, cut) == (False, step == 199)
            assert env.worst_return <= 200 * rewards.min()


def start(seed, episode):
    env = PendulumVectorEnv(1)
    for number in range(episode + 1):
        env.reset(seed=[seed] if number == 0 else None)
    return env.state_dict()["angle"][0], env.state_dict()["speed"][0]


def test_starts_depend_on_seed_and_episode_alone():
    env = PendulumVectorEnv(3)
    env.reset(seed=[11, 4, 2**40])
    for episode in range(3):
        state = env.state_dict()
        assert state["episode"].tolist() == [episode] * 3
        for lane, seed in enumerate([11, 4, 2**40]):
            assert (state["angle"][lane], state["speed"][lane]) == start(seed, episode)
        for _ in range(200):
            env.step(np.zeros((3, 1)))
    distinct = {start(seed, episode) for seed in range(5) for episode in range(4)}
    assert len(distinct) == 20


def test_starts_are_uniform_within_gymnasiums_limits():
    env = PendulumVectorEnv(4000)
    env.reset(seed=0)  # 4,000 neighbouring seeds
    state = env.state_dict()
    ranks = (np.arange(4000) + 0.5) / 4000
    for values, limit in ((state["angle"], np.pi), (state["speed"], 1.0)):
        uniform = (np.sort(values) / limit + 1) / 2
        assert np.abs(uniform - ranks).max() < 1.63 / np.sqrt(4000)  # Kolmogorov-Smirnov at 1%
    assert abs(np.corrcoef(state["angle"], state["speed"])[0, 1]) < 0.05
    assert abs(np.corrcoef(state["angle"][1:], state["angle"][:-1])[0, 1]) < 0.05


def test_a_nan_counts_as_no_torque_and_touches_no_other_lane():
    odd, zero = PendulumVectorEnv(3), PendulumVectorEnv(3)
    odd.reset(seed=1), zero.reset(seed=1)
    for _ in range(30):
        for got, expected in zip(
            odd.step(np.array([[1.5], [np.nan], [-0.3]]))[:2],
            zero.step(np.array([[1.5], [0.0], [-0.3]]))[:2],
            strict=True,
        ):
            np.testing.assert_array_equal(got, expected)


def test_it_has_no_oracle_and_no_known_best():
    env = envs.make("aser/Pendulum-v0", 2)
    assert env.oracle is None and env.best_return is None
    assert -3255 < env.worst_return < -3254


def test_the_picture_shows_the_rod_and_the_torque():
    env = gymnasium.make("aser/Pendulum-v0", render_mode="rgb_array")
    env.reset(seed=3)
    (obs, *_), picture = env.step(np.array([9.0], np.float32)), env.render()
    x, y = 150 + 90 * obs[1], 135 - 90 * obs[0]  # near the end of the rod
    assert picture.shape == (300, 300, 3)
    assert (picture[round(float(y)), round(float(x))] == drawing.BLUE).all()
    assert (picture[280, 245] == drawing.RED).all()  # the torque is cut to 2
    assert gymnasium.make("aser/Pendulum-v0").render_mode is None
