"""The maze against a slow twin that walks over the ASCII drawing with plain Python."""

import math
from collections import deque

import gymnasium
import numpy as np
import pytest

from aser import envs
from aser.envs.layouts import draw
from aser.envs.maze import MazeVectorEnv
from aser.envs.maze_states import HEADINGS
from aser.errors import ConfigError

LOOPS = """\
###########
#         #
# # # ### #
# #S      #
# # ### # #
#      T# #
# ##### # #
#         #
###########
"""
ROOM = "#####\n#S  #\n# # #\n#  T#\n#####\n"
# East, north, south, west; y points up.
COMPASS = [
    (1.0, 0.0),
    (0.0, 1.0),
    (0.0, -1.0),
    (-1.0, 0.0),
]


class Twin:
    """One agent. Every step reads the characters again."""

    def __init__(self, text, reward="dense"):
        self.page, self.reward = text.splitlines(), reward
        cells = [
            (x, y) for y in range(1, len(self.page), 2) for x in range(1, len(self.page[0]), 2)
        ]
        self.cells = [(x, y) for x, y in cells if self.page[y][x] != "#"]
        self.limit = round(5 / 3 * len(self.cells))
        self.reset()

    def reset(self):
        (self.position,) = [(x, y) for x, y in self.cells if self.page[y][x] == "S"]
        self.move, self.t = None, 0
        return self.observe()

    def open_ways(self):
        x, y = self.position
        return [(dx, dy) for dx, dy in COMPASS if self.page[y - int(dy)][x + int(dx)] != "#"]

    def allowed(self):
        ways = self.open_ways()
        back = None if self.move is None else (-self.move[0], -self.move[1])
        return [way for way in ways if way != back] or ways

    def observe(self):
        width, height = len(self.page[0]) // 2, len(self.page) // 2
        column, row = self.position[0] // 2, self.position[1] // 2
        return [2 * column / (width - 1) - 1, 1 - 2 * row / (height - 1), *(self.move or (0, 0))]

    def at_end(self):
        return self.page[self.position[1]][self.position[0]] == "T"

    def step(self, action):
        scores = [dx * action[0] + dy * action[1] for dx, dy in self.allowed()]
        self.move = self.allowed()[scores.index(max(scores))]
        self.position = (
            self.position[0] + 2 * int(self.move[0]),
            self.position[1] - 2 * int(self.move[1]),
        )
        self.t += 1
        if self.reward == "sparse":
            reward = 1 - self.t / self.limit if self.at_end() else 0.0
        else:
            reward = -1.0 if len(self.open_ways()) == 1 and not self.at_end() else 0.0
        return self.observe(), reward, self.at_end(), self.t >= self.limit and not self.at_end()


def arguments_of(layout, tmp_path):
    if "#" not in layout:
        return {"layout": layout}
    (tmp_path / "layout.txt").write_text(layout)
    return {"layout": str(tmp_path / "layout.txt")}


@pytest.mark.parametrize("reward", ["dense", "sparse"])
@pytest.mark.parametrize(
    "layout", ["toy", "large", LOOPS, ROOM], ids=["toy", "large", "loops", "room"]
)
def test_every_lane_walks_as_the_twin(layout, reward, tmp_path):
    lanes, steps = 3, 700
    env = envs.make("aser/Maze-v0", lanes, reward=reward, **arguments_of(layout, tmp_path))
    twins = [Twin(draw(env.layout), reward) for _ in range(lanes)]
    rng = np.random.default_rng(4)
    actions = rng.uniform(-1, 1, (steps, lanes, 2)).astype(np.float32)
    chosen = rng.random(steps) < 0.2  # ties, and moves straight along an axis
    actions[chosen] = rng.integers(-1, 2, (chosen.sum(), lanes, 2))
    seen, info = env.reset(seed=5)
    np.testing.assert_allclose(seen, [twin.reset() for twin in twins], atol=1e-6)
    ends, cuts = 0, 0
    for action in actions:
        seen, rewards, terminated, truncated, info = env.step(action)
        assert seen.dtype == np.float32 and terminated.dtype == truncated.dtype == bool
        for lane, twin in enumerate(twins):
            expected, reward_, end, cut = twin.step(action[lane].tolist())
            assert (rewards[lane], terminated[lane], truncated[lane]) == (
                pytest.approx(reward_),
                end,
                cut,
            )
            if end or cut:
                assert info["_final_obs"][lane]
                np.testing.assert_allclose(info["final_obs"][lane], expected, atol=1e-6)
                expected = twin.reset()
            else:
                assert not info or not info["_final_obs"][lane]
            np.testing.assert_allclose(seen[lane], expected, atol=1e-6)
            ends, cuts = ends + end, cuts + cut
    assert ends + cuts >= 6
    assert cuts > 0 or layout == ROOM


@pytest.mark.parametrize(
    "layout", ["toy", "large", LOOPS, ROOM], ids=["toy", "large", "loops", "room"]
)
def test_tables_and_oracle_against_the_twin_in_every_state(layout, tmp_path):
    env = envs.make("aser/Maze-v0", 1, **arguments_of(layout, tmp_path))
    twin, states = Twin(draw(env.layout)), env.states
    start = twin.position
    possible = {(start, None)} | {
        (position, move)
        for position in twin.cells
        for move in COMPASS
        if twin.page[position[1] + int(move[1])][position[0] - int(move[0])]
        != "#"  # the cell that it came from is open
    }
    assert len(states) == len(possible)
    reached = set()
    for number in range(len(states)):
        move = states.last_move[number]
        twin.move = None if move == 4 else COMPASS[move]
        row, column = divmod(int(states.cell[number]), env.layout.columns)
        twin.position = (2 * column + 1, 2 * row + 1)
        reached.add((twin.position, twin.move))
        seen = states.observation[number]
        np.testing.assert_allclose(seen, twin.observe(), atol=1e-6)
        allowed = [] if twin.at_end() else twin.allowed()
        assert env.oracle(seen) == (len(allowed) >= 2) == states.decision[number]
        assert [COMPASS[k] for k in np.flatnonzero(states.allowed[number])] == allowed
        assert states.dead_end[number] == (len(twin.open_ways()) == 1 and not twin.at_end())
        assert states.of_observations(seen) == number
    assert reached == possible
    oracle = env.oracle(states.observation)
    assert oracle.dtype == np.float32 and oracle.shape == (len(states),)
    stacked = np.stack([states.observation[:7].reshape(7, 1, 4)] * 3)  # (3, 7, 1, 4)
    np.testing.assert_array_equal(env.oracle(stacked), np.stack([oracle[:7, None]] * 3))


def twin_distance(twin):
    """Return the fewest moves from S to T, by a breadth-first search over (position, move)."""
    twin.reset()
    queue, met = deque([(twin.position, None, 0)]), set()
    while queue:
        twin.position, twin.move, distance = queue.popleft()
        if twin.at_end():
            return distance
        for dx, dy in twin.allowed():
            following = ((twin.position[0] + 2 * int(dx), twin.position[1] - 2 * int(dy)), (dx, dy))
            if following not in met:
                met.add(following)
                queue.append((*following, distance + 1))
    return math.inf


@pytest.mark.parametrize("reward", ["dense", "sparse"])
@pytest.mark.parametrize(
    "layout", ["toy", "large", LOOPS, ROOM], ids=["toy", "large", "loops", "room"]
)
def test_the_shortest_path_is_shortest_and_earns_the_best_return(layout, reward, tmp_path):
    env = envs.make("aser/Maze-v0", 1, reward=reward, **arguments_of(layout, tmp_path))
    path = env.states.shortest_path()
    twin = Twin(draw(env.layout))
    assert len(path) - 1 == twin_distance(twin)
    env.reset(seed=0)
    earned = 0.0
    for state in path[1:]:
        move = env.states.observation[None, state, 2:]  # the move that enters this state
        _, rewards, terminated, _, _ = env.step(move)
        earned += rewards[0]
    assert terminated[0]
    assert earned == pytest.approx(env.best_return)
    assert env.best_return == pytest.approx(
        0 if reward == "dense" else 1 - (len(path) - 1) / twin.limit
    )


def test_no_policy_earns_less_than_the_worst_return_nor_more_than_the_best():
    for layout, reward in [("toy", "dense"), ("large", "dense"), ("toy", "sparse")]:
        env = envs.make("aser/Maze-v0", 1, layout=layout, reward=reward)
        best = {
            state: 0.0 for state in range(len(env.states))
        }  # the largest return still possible, by steps left
        worst = dict(best)
        for left in range(1, env.time_limit + 1):
            t = env.time_limit - left + 1  # the number of the next step
            new_best, new_worst = {}, {}
            for state in best:
                following = env.states.successor[state, env.states.allowed[state]].tolist()
                if reward == "dense":
                    earned = [-1.0 if env.states.dead_end[n] else 0.0 for n in following]
                else:
                    earned = [
                        1 - t / env.time_limit if env.states.terminal[n] else 0.0 for n in following
                    ]
                options = list(zip(earned, following, strict=True))
                new_best[state] = max((r + best[n] for r, n in options), default=0.0)
                new_worst[state] = min((r + worst[n] for r, n in options), default=0.0)
            best, worst = new_best, new_worst
        assert best[0] == pytest.approx(env.best_return)
        assert env.worst_return <= worst[0] < best[0]


def test_time_limits_and_defaults():
    assert envs.make("aser/Maze-v0", 2).time_limit == 200
    assert envs.make("aser/Maze-v0", 2, layout="toy").time_limit == 50
    assert envs.make("aser/Maze-v0", 2, layout="random", size=[4, 7]).time_limit == 47
    default, large = envs.make("aser/Maze-v0", 1), envs.make("aser/Maze-v0", 1, layout="large")
    assert draw(default.layout) == draw(large.layout)


def test_a_nan_counts_as_zero_and_touches_no_other_lane():
    odd, zero = MazeVectorEnv(3, layout="toy"), MazeVectorEnv(3, layout="toy")
    odd.reset(seed=0), zero.reset(seed=0)
    rng = np.random.default_rng(1)
    for step in range(120):
        action = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        broken = action.copy()
        broken[1, step % 2] = np.nan
        action[1, step % 2] = 0
        for got, expected in zip(odd.step(broken)[:4], zero.step(action)[:4], strict=True):
            np.testing.assert_array_equal(got, expected)
    everything = np.array([[np.inf, -np.inf], [np.nan, np.nan], [1e30, 0]], dtype=np.float32)
    assert np.isfinite(odd.step(everything)[0]).all()


def test_actions_of_a_wrong_shape_are_refused():
    env = MazeVectorEnv(2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"\(2, 3\), not \(2, 2\)"):
        env.step(np.zeros((2, 3)))


def test_an_unknown_reward_is_refused():
    with pytest.raises(ConfigError, match="^env.reward=thick: allowed are dense, sparse$"):
        envs.make("aser/Maze-v0", 2, reward="thick")


def test_the_move_slips_as_often_as_asked_to_each_allowed_neighbour_alike():
    lanes, slip = 4000, 0.3
    env = envs.make("aser/Maze-v0", lanes, layout="toy", slip=slip)
    east = np.tile(np.array([1, 0], dtype=np.float32), (lanes, 1))
    env.reset(seed=0)
    twin = Twin(draw(env.layout), "dense")
    twin.reset()
    for _ in range(3):
        before = env._state.copy()
        intended = env.states.successor[
            before, (env._barred[before] + east @ HEADINGS.T).argmax(axis=1)
        ]
        env.step(east)
        for state in np.unique(before):
            ways = np.flatnonzero(env.states.allowed[state])
            here = before == state
            after = env._state[here]
            for heading in ways:
                chance = slip / len(ways)
                if env.states.successor[state, heading] == intended[here][0]:
                    chance += 1 - slip
                share, spread = (after == env.states.successor[state, heading]).mean(), here.sum()
                assert abs(share - chance) <= 4 * np.sqrt(chance * (1 - chance) / spread) + 1e-9


def test_slips_depend_on_the_seed_and_the_episode_alone_and_are_saved():
    one, many = MazeVectorEnv(1, slip=0.5), MazeVectorEnv(5, slip=0.5)
    one.reset(seed=8), many.reset(seed=6)  # lane 2 of `many` has the seed 8
    actions = np.random.default_rng(3).uniform(-1, 1, (450, 5, 2)).astype(np.float32)
    saved = None
    for number, action in enumerate(actions):
        seen = many.step(action)[0]
        np.testing.assert_array_equal(one.step(action[2:3])[0][0], seen[2])
        if number == 230:
            saved = many.state_dict()
    end = many.step(actions[0])[0]
    other = MazeVectorEnv(5, slip=0.5)
    other.load_state_dict(saved)
    for action in [*actions[231:], actions[0]]:
        last = other.step(action)[0]
    np.testing.assert_array_equal(last, end)


def test_with_slip_zero_nothing_changes_and_with_one_the_action_has_no_effect():
    plain, none = MazeVectorEnv(3, layout="toy"), MazeVectorEnv(3, layout="toy", slip=0.0)
    left, right = (MazeVectorEnv(3, layout="toy", slip=1.0) for _ in range(2))
    for env in (plain, none, left, right):
        env.reset(seed=2)
    assert plain.state_dict().keys() == none.state_dict().keys()
    for action in np.random.default_rng(5).uniform(-1, 1, (130, 3, 2)).astype(np.float32):
        np.testing.assert_array_equal(plain.step(action)[0], none.step(action)[0])
        np.testing.assert_array_equal(left.step(action)[0], right.step(-action)[0])


def test_an_impossible_slip_is_refused():
    for slip in (-0.1, 1.1, "often", True, float("nan")):
        with pytest.raises(ConfigError, match=f"^env.slip={slip}: a number from 0 to 1 is allowed"):
            envs.make("aser/Maze-v0", 2, slip=slip)


def test_rendering():
    env = gymnasium.make("aser/Maze-v0", layout="toy", render_mode="ansi")
    env.reset(seed=0)
    layout = draw(env.unwrapped.lane.layout)
    assert env.render() == layout.replace("S", "@")
    env.step(np.array([1, 0], dtype=np.float32))
    assert env.render() == layout.replace("#S  #", "#S @#")
    picture = gymnasium.make("aser/Maze-v0", layout="toy", render_mode="rgb_array")
    picture.reset(seed=0)
    assert picture.render().shape == (8 * 11, 8 * 13, 3)
    assert (picture.render()[8, 8] == (213, 94, 0)).all()
