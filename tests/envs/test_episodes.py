"""Running episodes of foreign environments: they are played again, to the bit or not at all."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

import train
from aser import checkpoint, envs
from aser.envs import episodes
from aser.run import Saver
from aser.run_folder import RunFolder
from aser.settings import compose
from aser.settings.config import parse
from aser.settle import settled


class Drift(gymnasium.Env):
    """A place that random steps and actions move. `fault` says in which way it is not repeated."""

    observation_space = Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, fault=None, legacy=False, discrete=False, ends=7):
        self.fault, self.legacy, self.ends = fault, legacy, ends
        self.action_space = Discrete(3, start=4) if discrete else Box(-2, 2, (1,), np.float32)
        self.made, self.wild = 0, np.random.default_rng()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if self.legacy and seed is not None:
            self._np_random = np.random.RandomState(seed)
        self.made, self.t, self.place = self.made + 1, 0, self.np_random.uniform()
        return self._observe(), {}

    def _observe(self):
        return np.array([self.place, self.made if self.fault == "counts" else self.t])

    def step(self, action):
        self.t += 1
        if self.fault == "raises" and self.made == 2 and self.t == 2:
            raise RuntimeError("only once")
        numbers = self.wild if self.fault == "random" else self.np_random
        self.place += float(np.ravel(action)[0]) + numbers.normal()
        return self._observe(), self.place, self.t == self.ends, False, {}


gymnasium.register("AserEpisodes/Drift-v0", entry_point=Drift)
DRIFT = "AserEpisodes/Drift-v0"


def through_a_checkpoint(content, tmp_path):
    checkpoint.save(tmp_path / "file.pt", {"episodes": content})
    return checkpoint.load(tmp_path / "file.pt")["episodes"]


@pytest.mark.parametrize("steps", [0, 1, 5, 7, 8, 20])
@pytest.mark.parametrize("kwargs", [{}, {"legacy": True}, {"discrete": True}, {"ends": 1}])
def test_an_episode_goes_on_bit_for_bit(steps, kwargs, tmp_path):
    one, other = (envs.make(DRIFT, 3, **kwargs) for _ in range(2))
    one.reset(seed=[5, 1, 9]), other.reset(seed=[8, 8, 8])
    actions = np.random.default_rng(0).uniform(-1, 1, (steps + 20, 3, 1)).astype(np.float32)
    for action in actions[:steps]:
        one.step(action)
    content = through_a_checkpoint(one.episodes(), tmp_path)
    for action in actions[3:5]:  # nothing that comes later changes what was saved
        other.step(action)
    assert other.play(content) and other.play(content)
    np.testing.assert_array_equal(one.observations(), other.observations())
    assert same_content(one.episodes(), other.episodes())
    for action in actions[steps:]:
        for got, expected in zip(other.step(action)[:4], one.step(action)[:4], strict=True):
            np.testing.assert_array_equal(got, expected)


def same_content(one, two):
    actions = zip(one["actions"], two["actions"], strict=True)
    known = all(np.array_equal(a, b) for a, b in actions)
    return known and one["began"] == two["began"] and one["check"] == two["check"]


@pytest.mark.parametrize("fault", ["random", "raises", "counts"])
def test_what_does_not_repeat_itself_is_noticed(fault, tmp_path):
    env = envs.make(DRIFT, 2, fault=None if fault == "raises" else fault)
    env.reset(seed=[5, 1])
    for _ in range(16):  # into the third episode
        env.step(np.ones((2, 1), np.float32))
    content = through_a_checkpoint(env.episodes(), tmp_path)
    assert not envs.make(DRIFT, 2, fault=fault).play(content)


def test_an_episode_without_an_end_is_too_long_to_keep(monkeypatch):
    monkeypatch.setattr(episodes, "LONGEST", 4)
    env = envs.make(DRIFT, 1, ends=0)
    env.reset(seed=[5])
    for steps in range(1, 8):
        env.step(np.ones((1, 1), np.float32))
        assert env.play(env.episodes()) == (steps <= 4)


WORDS = ["env=gym", f"env.id={DRIFT}", "network.hidden=[5]", "compile=false", "sampler=nstep"]
WORDS += ["seeds=[4,8]", "steps=60", "learning_starts=21", "batch=3", "eval.every=30", "buffer=60"]
WORDS += ["eval.max_steps=3", "env.wrappers=[{FrameStackObservation:{stack_size:2}},"]
WORDS[-1] += "FlattenObservation,own_noise_here.Noise]"
NOISE = """
import gymnasium

class Noise(gymnasium.ObservationWrapper):
    def observation(self, observation):
        return observation + self.np_random.normal()
"""


@pytest.mark.parametrize("fault", ["null", "random"])
def test_a_run_goes_on_within_its_episode_and_wrappers(fault, tmp_path, capsys, monkeypatch):
    (tmp_path / "own_noise_here.py").write_text(NOISE)
    monkeypatch.syspath_prepend(tmp_path)
    straight, halved = tmp_path / "straight", tmp_path / "halved"
    words = [*WORDS, f"+env.fault={fault}", "checkpoint.every=25"]
    assert train.main([*words, f"run_dir={straight}"]) == 0
    words.append(f"run_dir={halved}")
    config = settled(parse(compose.compose(words, train.CONF), train.CONF))
    training = train_until(config, 25, tmp_path)
    assert train.main([*words, "resume=true"]) == 0
    said, again = capsys.readouterr().out, "; the running episode begins again"
    assert f"resumed at step 25{again if fault == 'random' else ''}\n" in said
    for name in ("returns.csv", "diagnostics.csv"):
        whole = (straight / name).read_bytes() == (halved / name).read_bytes()
        assert whole == (fault == "null"), name
    rows = checkpoint.load(halved / checkpoint.NAME)["training"]["buffer"]["storage"]["rows"]
    truncated = rows[..., training.setup.buffer.storage.layout.columns["truncated"]]
    assert truncated.sum() == (2 if fault == "random" else 0)  # no unroll crosses the gap


def train_until(config, step, tmp_path):
    """A run that was killed after its checkpoint at this step."""
    from aser import build

    training, folder = build.build(config, train.CONF, tmp_path), RunFolder(config, tmp_path)
    saver = Saver(training, folder, 0.0)
    folder.begin()
    training.run(after_step=lambda training: saver.step() or training.step == step)
    return training
