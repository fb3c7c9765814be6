"""Environments of one's own, also awkward ones: what is stored, and how they are refused."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

import train
from aser import build, checkpoint, envs
from aser.errors import ConfigError
from aser.policy import of
from aser.settings import compose
from aser.settings.config import parse
from aser.study.runs import load
from aser.training.evaluation import Evaluation, action_scaling, random_return


class Walk(gymnasium.Env):
    """Observes (steps since the reset, seed). It ends after `ends` steps; 0 stands for never."""

    def __init__(self, ends=4, reuse=False, reward=lambda r: r, info=dict, dtype=np.float32):
        self.observation_space = Box(-np.inf, np.inf, (2,), dtype)
        self.action_space = Box(-1, 3, (1,), np.float32)
        self.ends, self.reuse, self.reward, self.info = ends, reuse, reward, info
        self.place = np.zeros(2, dtype)
        self.steps_taken = 0

    def _observe(self, first=False):
        if first:
            self.place[0] = 0
        return self.place if self.reuse else self.place.copy()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place[1] = self.place[1] if seed is None else seed % 7
        return self._observe(first=True), self.info()

    def step(self, action):
        self.place[0] += 1
        self.steps_taken += 1
        reward = self.reward(float(action[0]))
        return self._observe(), reward, False, bool(self.place[0] == self.ends), self.info()


class Broken(Walk):
    """It fails at the second step, in the way that `fault` says."""

    def __init__(self, fault):
        super().__init__()
        self.fault = fault

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        if observation[0] == 2:
            return {
                "four": lambda: (observation, reward, terminated, info),
                "none": lambda: None,
                "shape": lambda: (observation[:1], reward, terminated, truncated, info),
                "words": lambda: ("left", reward, terminated, truncated, info),
                "rewards": lambda: (observation, np.ones(2), terminated, truncated, info),
                "word": lambda: (observation, "much", terminated, truncated, info),
                "no end": lambda: (observation, reward, None, truncated, info),
                "NaN": lambda: (observation, np.nan, terminated, truncated, info),
                "infinite": lambda: (observation, -np.inf, terminated, truncated, info),
                "NaN seen": lambda: (observation * np.nan, reward, terminated, truncated, info),
                "raises": lambda: 1 / 0,
                "exits": lambda: exit(3),
            }[self.fault]()
        return observation, reward, terminated, truncated, info


for _class in (Walk, Broken):
    gymnasium.register(f"AserForeign/{_class.__name__}-v0", entry_point=_class)
WALK = "AserForeign/Walk-v0"


def replayed(**kwargs):
    """The stored facts of two lanes with an environment of these arguments, after 12 steps."""
    overrides = ["env=gym", f"env.id={WALK}", "network.hidden=[5]", "sampler=uniform"]
    overrides += ["steps=12", "learning_starts=11", "eval.every=null", "compile=false", "seeds=2"]
    composed = compose.compose([*overrides, "batch=3"], train.CONF)
    composed["env"] |= kwargs
    run = build.build(parse(composed, train.CONF), train.CONF, train.CONF)
    run.run()
    storage = run.setup.buffer.storage
    return {
        name: storage.rows[:, :, columns].numpy()
        for name, columns in storage.layout.columns.items()
    }


def test_the_last_observation_of_an_episode_is_its_own_also_where_one_array_is_reused():
    facts, copied = replayed(reuse=True), replayed(reuse=False)
    for name, values in copied.items():
        np.testing.assert_array_equal(facts[name], values)
    assert facts["obs"][0, :, 0].tolist() == [0, 1, 2, 3] * 3
    assert facts["next_obs"][0, :, 0].tolist() == [1, 2, 3, 4] * 3  # and not [1, 2, 3, 0]
    assert facts["truncated"][0, :, 0].tolist() == [0, 0, 0, 1] * 3


def test_what_infos_hold_is_nobodys_business():
    growing = iter(range(1, 1000))

    def info():
        return {
            "final_obs": "mine",
            "_final_obs": None,
            "final_info": 3,
            "shape": np.zeros(next(growing)),
        }

    for name, values in replayed(info=info).items():
        np.testing.assert_array_equal(values, replayed()[name])


@pytest.mark.parametrize(
    "reward", [lambda r: np.array([r]), lambda r: np.float64(r), lambda r: np.array(r)]
)
def test_a_reward_may_be_an_array_of_one_number(reward):
    np.testing.assert_array_equal(replayed(reward=reward)["reward"], replayed()["reward"])


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("four", "gives (array([2., 5.]"),
        ("none", "gives None in step: allowed is (observation, reward, terminated, truncated, inf"),
        ("shape", "allowed is an observation of shape (2,), as in its space"),
        ("words", "gives left in step: allowed is an observation"),
        ("rewards", "allowed is a number as reward, and two truth values"),
        ("word", "allowed is a number as reward, and two truth values"),
        ("no end", "allowed is a number as reward, and two truth values"),
        ("NaN", "gives nan in step: allowed is a finite reward"),
        ("infinite", "gives -inf in step: allowed is a finite reward"),
        ("NaN seen", "in step: allowed is an observation of numbers, without NaN"),
        ("raises", "fails in step: ZeroDivisionError: division by zero"),
        ("exits", "fails in step: SystemExit: 3"),
    ],
)
def test_what_breaks_the_rules_is_one_line(fault, words):
    env = envs.make("AserForeign/Broken-v0", 2, fault=fault)
    env.reset(seed=[5, 6])
    env.step(np.zeros((2, 1)))
    with pytest.raises(ConfigError) as refusal:
        env.step(np.zeros((2, 1)))
    text = str(refusal.value)
    assert text.startswith("env.id=AserForeign/Broken-v0 ") and words in text and "\n" not in text


def test_an_environment_may_write_into_its_action():
    class Halving(Walk):
        def step(self, action):
            action *= 0.5
            observation, _, *rest = super().step(action)
            return observation, float(action[0]), *rest

    gymnasium.register("AserForeign/Halving-v0", entry_point=Halving)
    env = envs.make("AserForeign/Halving-v0", 2)
    env.reset(seed=[5, 6])
    actions = np.array([[0.5], [-1.0]], np.float32)
    for _ in range(2):
        assert env.step(actions)[1].tolist() == [0.25, -0.5]
    again = envs.make("AserForeign/Halving-v0", 2)
    episodes = env.episodes()
    assert again.play(episodes) and again.play(env.episodes())
    assert again.observations().tolist() == env.observations().tolist()


@pytest.mark.parametrize("which", ["observation_space", "action_space"])
def test_empty_spaces_are_refused(which):
    class Empty(Walk):
        def __init__(self):
            super().__init__()
            setattr(self, which, Box(-1, 1, (0,), np.float32))

    gymnasium.register("AserForeign/Empty-v0", entry_point=Empty)
    with pytest.raises(ConfigError, match="a Box of at least one number is allowed$"):
        envs.make("AserForeign/Empty-v0", 1)


def test_an_observation_beyond_float32_is_infinite_and_no_warning():
    env = envs.make(WALK, 1, dtype=np.float64)
    env.envs[0].unwrapped.place[1] = 1e300
    seen, _ = env.reset()
    assert seen.tolist() == [[0.0, np.inf]]


def test_an_evaluation_is_cut_hears_and_lets_ended_environments_rest():
    env = envs.make(WALK, 4, ends=0)
    assert env.time_limit is None

    def greedy(state, obs):
        return obs[:, :1] * 0 + state  # (L, 1, episodes)

    evaluation = Evaluation(greedy, env, [2, 5], 2, "cpu", max_steps=9)
    # 1 in [-1, 1] is 3 in the space, and the reward is the action.
    assert evaluation(1.0).tolist() == [27.0, 27.0]
    assert Evaluation(greedy, env, [2, 5], 2, "cpu").max_steps == 1000
    calls = iter([False] * 5 + [True])
    assert evaluation(1.0, poll=lambda: next(calls)) is None
    mixed = envs.make(WALK, 2)
    for lane, ends in enumerate((3, 8)):
        mixed.envs[lane].unwrapped.ends = ends
    assert Evaluation(greedy, mixed, [2, 5], 1, "cpu")(0.0).tolist() == [3.0, 8.0]
    assert [one.unwrapped.steps_taken for one in mixed.envs] == [3, 8]  # and not [8, 8]
    mixed.reset()
    mixed.step(np.zeros((2, 1)))
    assert [one.unwrapped.steps_taken for one in mixed.envs] == [4, 9]


def test_no_action_passes_its_box_by_rounding():
    class Narrow(Walk):
        def __init__(self):
            super().__init__()
            self.action_space = Box(np.float32(-0.1), np.float32(0.3), (1,), np.float32)

    gymnasium.register("AserForeign/Narrow-v0", entry_point=Narrow)
    env = envs.make("AserForeign/Narrow-v0", 1)
    scale = action_scaling(env)
    for action in (-1.0, 1.0):
        assert scale(np.array([[action]], np.float32))[0] in env.single_action_space


def test_an_environment_that_never_ends_is_trained_and_evaluated(tmp_path, capsys):
    folder = tmp_path / "run"
    words = ["env=gym", f"env.id={WALK}", "+env.ends=0", "network.hidden=[5]", "compile=false"]
    words += ["sampler=uniform", "seeds=2", "steps=30", "learning_starts=10", f"run_dir={folder}"]
    assert train.main([*words, "eval.every=10", "eval.max_steps=7"]) == 0
    assert "by 1 episode a seed, of at most 7 steps" in capsys.readouterr().out
    assert (folder / "returns.csv").read_text().count("\n") == 1 + 2 * 3
    assert checkpoint.load(folder / checkpoint.NAME)["training"]["step"] == 30


def test_an_environment_that_fails_to_close_is_no_failure():
    class Stubborn(Walk):
        def close(self):
            raise SystemExit(3)

    gymnasium.register("AserForeign/Stubborn-v0", entry_point=Stubborn)
    envs.make("AserForeign/Stubborn-v0", 2).close()


def test_a_very_long_error_is_cut():
    class Wordy(Walk):
        def __init__(self):
            raise ValueError("word \x1b[31m" * 5000)

    gymnasium.register("AserForeign/Wordy-v0", entry_point=Wordy)
    with pytest.raises(ConfigError) as refusal:
        envs.make("AserForeign/Wordy-v0", 1)
    assert len(str(refusal.value)) < 950 and "\x1b" not in str(refusal.value)


class Lever(gymnasium.Env):
    """Three levers, 5, 6 and 7; lever 6 pays. Episodes have four steps."""

    observation_space = Box(-1, 1, (1,), np.float32)
    action_space = Discrete(3, start=5)

    def reset(self, *, seed=None, options=None):
        self.pulled = []
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.pulled.append(int(action))
        ended = len(self.pulled) == 4
        return np.zeros(1, np.float32), float(action == 6), False, ended, {}


gymnasium.register("AserTest/Lever-v0", entry_point=Lever)
LEVER = ["env=gym", "env.id=AserTest/Lever-v0", "network=small", "debug=smoke", "run_dir=run"]


def test_discrete_actions_stand_evenly_between_minus_one_and_one():
    many = envs.make("AserTest/Lever-v0", 5)
    assert many.discrete == 3 and many.single_action_space.shape == (1,)
    many.reset(seed=0)
    values = np.array([[-1.0], [0.0], [1.0], [np.nan], [0.4]], np.float32)
    assert many.step(values)[1].tolist() == [0, 1, 0, 1, 1]
    assert [one.unwrapped.pulled for one in many.envs] == [[5], [6], [7], [6], [6]]
    assert envs.make("AserForeign/Walk-v0", 1).discrete is None


def test_the_random_policy_takes_each_discrete_action_as_often():
    """With equal chances a third of the pulls pays, of four an episode."""
    many = envs.make("AserTest/Lever-v0", 1000)
    assert random_return(many) == pytest.approx(4 / 3, abs=4 * (4 * 2 / 9 / 1000) ** 0.5)


@pytest.mark.parametrize("sampler", ["aser", "per"])
def test_dqn_learns_which_discrete_action_pays(sampler, house, capsys):
    words = ["agent=dqn", f"sampler={sampler}", "hyper.lr=.01", "steps=260", "eval.every=130"]
    assert train.main([*LEVER, *words]) == 0
    run = load("run")
    assert run.config["agent"]["actions"] == 3
    assert run.returns["return"].tolist()[-2:] == [4, 4]
    policy = of(run)
    action = policy.act(np.zeros(1))
    assert action == 6 and action.dtype == np.int64 and action.shape == ()
    assert policy.act(np.zeros((3, 1))).tolist() == [6, 6, 6]


def test_an_agent_that_does_not_fit_the_actions_is_one_line(house, capsys):
    assert train.main(LEVER) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "agent=sac: AserTest/Lever-v0 has 3 discrete actions; allowed: agent=dqn" in said
    assert train.main([*LEVER, "agent=dqn", "agent.actions=21"]) == 1
    assert "agent.actions=21: AserTest/Lever-v0 has 3; allowed: auto" in capsys.readouterr().err
    assert not (house / "run").exists()
