"""Evaluation: the greedy policy's return, against one environment after the other."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from aser import envs
from aser.envs.single import Corridor, Maze, Pendulum
from aser.training.evaluation import EVALUATION_SEED, Evaluation, action_scaling

SEEDS, EPISODES = [4, 11], 3
CASES = {
    "aser/Maze-v0": (lambda: Maze(layout="toy"), {"layout": "toy"}, 1.0),
    "aser/Corridor-v0": (Corridor, {}, 1.0),
    "aser/Pendulum-v0": (Pendulum, {}, 2.0),
}


def weights(obs_dim, action_dim):
    """Linear policies, one a lane, (L, A, O + 1), that tell lanes and observations apart."""
    return torch.from_numpy(
        np.random.default_rng(6).normal(size=(len(SEEDS), action_dim, obs_dim + 1))
    ).float()


def greedy(state, obs):
    """(L, O, episodes) -> (L, A, episodes)"""
    assert obs.shape[0] == len(SEEDS) and obs.shape[2] == EPISODES and obs.is_contiguous()
    return torch.tanh(state[:, :, :-1] @ obs + state[:, :, -1:])


@pytest.mark.parametrize("id", CASES)
def test_returns_are_those_of_single_environments(id):
    single, kwargs, reach = CASES[id]
    vector = envs.make(id, len(SEEDS) * EPISODES, **kwargs)
    evaluation = Evaluation(greedy, vector, SEEDS, EPISODES, torch.device("cpu"))
    state = weights(vector.single_observation_space.shape[0], vector.single_action_space.shape[0])
    expected = np.zeros((len(SEEDS), EPISODES))
    for lane, seed in enumerate(SEEDS):
        for episode in range(EPISODES):
            env = single()
            obs, _ = env.reset(seed=EVALUATION_SEED + 1000 * seed + episode)
            over = False
            while not over:
                column = torch.from_numpy(obs)[:, None]
                action = torch.tanh(state[lane, :, :-1] @ column + state[lane, :, -1:])[
                    :, 0
                ].numpy()
                obs, reward, terminated, truncated, _ = env.step(reach * action)
                expected[lane, episode] += reward
                over = terminated or truncated
    found = evaluation(state)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected.mean(1), rtol=1e-4)
    if id == "aser/Pendulum-v0":
        assert len(np.unique(expected.round(6))) == len(SEEDS) * EPISODES  # every start is another
    if id == "aser/Maze-v0":
        assert found[0] != found[1]
    vector.step(np.zeros(vector.action_space.shape, np.float32))  # wherever the last call left them
    np.testing.assert_array_equal(evaluation(state), found)


def test_what_comes_after_an_episodes_end_does_not_count():
    vector = envs.make(
        "aser/Corridor-v0", len(SEEDS) * EPISODES, length=0.7, gates=[[0.2, 0.3, 0.7]]
    )
    # Lane 0 fails at every gate it meets.
    ended_early = torch.tensor([[[0.0, -0.5]], [[0.0, np.arctanh(0.5)]]])
    evaluation = Evaluation(greedy, vector, SEEDS, EPISODES, torch.device("cpu"))
    assert evaluation(ended_early.float()).tolist() == [-1.0, 0.0]


def test_actions_are_scaled_to_the_environments_range():
    class Lopsided:
        single_action_space = Box(np.float32([-3, 0]), np.float32([5, 0.5]))

    scale = action_scaling(Lopsided())
    actions = np.float32([[-1, -1], [1, 1], [0, 0.5]])
    np.testing.assert_allclose(scale(actions), [[-3, 0], [5, 0.5], [1, 0.375]])
    assert Lopsided.single_action_space.contains(scale(actions)[2])
    plain = action_scaling(envs.make("aser/Maze-v0", 2))
    np.testing.assert_array_equal(plain(actions), actions)
