"""Standard tasks (MuJoCo, Box2D, the DeepMind Control Suite) by name, and wrappers by name."""

import importlib.util
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

import train
from aser import build, envs
from aser.errors import ConfigError
from aser.settings import compose
from aser.settings.config import parse
from aser.settle import settled
from aser.study.runs import load

NEEDS = {"mujoco": ["mujoco"], "box2d": ["Box2D"], "dmc": ["dm_control", "shimmy"]}
TASKS = {"mujoco": "HalfCheetah-v5", "box2d": "BipedalWalker-v3", "dmc": "cheetah-run"}
SIZES = {"mujoco": (17, 6), "box2d": (24, 4), "dmc": (17, 6)}  # of observations and actions


def settings(*words):
    return parse(compose.compose(list(words), train.CONF), train.CONF)


@pytest.fixture
def family(request):
    """The name of a group of tasks whose packages are installed."""
    for package in NEEDS[request.param]:
        pytest.importorskip(package, reason=f"the extra `{request.param}` is not installed")
    return request.param


each_family = pytest.mark.parametrize("family", NEEDS, indirect=True)


@each_family
def test_a_standard_task_trains(family, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [f"env={family}", f"env.id={TASKS[family]}", "network.hidden=[5]", "compile=false"]
    words += ["seeds=2", "steps=30", "learning_starts=20", "batch=3", "buffer=30", "run_dir=run"]
    assert train.main([*words, "eval.every=15", "eval.max_steps=3", "sampler=uniform"]) == 0
    run = load(tmp_path / "run")
    assert len(run.returns) == 2 * 2 and np.isfinite(run.returns["return"]).all()
    assert run.config["env"]["name"] == "gym"
    said = "".join(capfd.readouterr())
    assert "deprecated" not in said and not (tmp_path / "MUJOCO_LOG.TXT").exists()


@pytest.mark.parametrize(
    "sampler",
    [
        name if name in ("la3p", "outcome_spread") else pytest.param(name, marks=pytest.mark.slow)
        for name in train.names(train.CONF, "sampler")
        if not name.startswith("oracle") and name != "pretrained"  # it trains agents first
    ],
)
@pytest.mark.parametrize("family", ["mujoco"], indirect=True)
def test_every_sampler_trains_in_a_task_of_many_numbers(family, sampler, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its hints to the working folder
    words = ["env=mujoco", "env.id=Hopper-v5", "network.hidden=[5]", "compile=false", "seeds=2"]
    words += ["steps=40", "learning_starts=20", "batch=3", "buffer=30", "eval.every=40"]
    assert train.main([*words, "eval.max_steps=3", f"sampler={sampler}", "run_dir=run"]) == 0
    run = load(tmp_path / "run")
    assert len(run.returns) == 2 and np.isfinite(run.returns["return"]).all()
    assert run.summary["diverged"] == []


@each_family
def test_a_standard_task_equals_gymnasiums_own_step_by_step(family, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its hints to the working folder
    config = settings(f"env={family}", f"env.id={TASKS[family]}")
    many = build.make_envs(config, 2)
    assert build.sizes_of(many) == dict(zip(("obs", "action"), SIZES[family], strict=True))
    singles = [gymnasium.make(config.env.id) for _ in range(2)]
    seen, _ = many.reset(seed=[7, 3])
    firsts = [single.reset(seed=seed)[0] for single, seed in zip(singles, [7, 3], strict=True)]
    np.testing.assert_array_equal(seen, [flat(first) for first in firsts])
    space, numbers = many.single_action_space, np.random.default_rng(0)
    for _ in range(25):
        actions = numbers.uniform(space.low, space.high, (2, *space.shape)).astype(space.dtype)
        seen, rewards, terminated, truncated, info = many.step(actions)
        last = info.get("final_obs", seen)
        for lane, single in enumerate(singles):
            expected, reward, *ends, _ = single.step(actions[lane])
            assert [rewards[lane], terminated[lane], truncated[lane]] == [reward, *ends]
            np.testing.assert_array_equal(last[lane] if any(ends) else seen[lane], flat(expected))
            if any(ends):
                single.reset()


def flat(observation):
    """The numbers of an observation, those of a mapping in the order of its sorted keys."""
    if isinstance(observation, dict):
        parts = [np.ravel(observation[key]) for key in sorted(observation)]
        observation = np.concatenate(parts)
    return np.float32(observation)


def test_every_way_to_name_a_task_is_one_task():
    task = settings("env=dmc", "env.id=cheetah-run").env
    assert task == settings("env=dmc", "env.id=dm_control/cheetah-run-v0").env
    assert (task.name, task.id, task.task) == (
        "gym",
        "dm_control/cheetah-run-v0",
        "dm_control_cheetah-run-v0",
    )
    plain = settings("env=gym", "env.id=Hopper-v5", "env.steps=100000")
    assert settings("env=mujoco", "env.id=Hopper-v5") == plain


@pytest.mark.parametrize("family", NEEDS)
def test_what_to_install_is_one_line(family, monkeypatch, capsys):
    for name in [*sys.modules]:
        if name.partition(".")[0] in NEEDS[family]:
            monkeypatch.delitem(sys.modules, name)
    for package in NEEDS[family]:
        monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
    assert train.main([f"env={family}", f"env.id={TASKS[family]}", "sampler=uniform"]) == 1
    said = capsys.readouterr().err
    assert f"needs the package {NEEDS[family][0]}, which cannot be imported" in said
    assert f"pip install -e '.[{family}]' installs it" in said and said.count("\n") == 1


def test_an_unknown_task_of_the_suite_has_its_nearest_name():
    if importlib.util.find_spec("shimmy") is None or importlib.util.find_spec("dm_control") is None:
        pytest.skip("the extra `dmc` is not installed")
    with pytest.raises(ConfigError, match="the nearest id is dm_control/cheetah-run-v0$"):
        build.make_envs(settings("env=dmc", "env.id=cheetah-rum"), 1)


class Both(gymnasium.Env):
    """Observes steps and seed by name. An episode has three steps."""

    observation_space = gymnasium.spaces.Dict(
        {"seed": Box(0, 9, (), np.float64), "all": Box(-1, 9, (2, 2), np.float32)}
    )
    action_space = Box(-1, 1, (1,), np.float32)

    def _observe(self):
        return {"seed": np.array(self.given), "all": np.array([[self.t, 5], [6, 7]], np.float32)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.given = 0, getattr(self, "given", 0) if seed is None else seed
        return self._observe(), {}

    def step(self, action):
        self.t += 1
        return self._observe(), float(action[0]), False, self.t == 3, {}


gymnasium.register("AserStandard/Both-v0", entry_point=Both, max_episode_steps=3)
BOTH = "AserStandard/Both-v0"


def test_observations_by_name_are_laid_end_to_end():
    env = envs.make(BOTH, 2)
    assert env.reset(seed=[4, 8])[0].tolist() == [[0, 5, 6, 7, 4], [0, 5, 6, 7, 8]]
    filtered = envs.make(BOTH, 2, wrappers=[{"FilterObservation": {"filter_keys": ["seed"]}}])
    assert filtered.reset(seed=[4, 8])[0].tolist() == [[4], [8]]


def test_wrappers_are_applied_from_the_inside_out_with_their_arguments():
    stack = {"FrameStackObservation": {"stack_size": 2}}
    env = envs.make(BOTH, 1, wrappers=["FlattenObservation", stack, "FlattenObservation"])
    assert env.reset(seed=[4])[0].tolist() == [[0, 5, 6, 7, 4] * 2]
    assert env.step(np.zeros((1, 1)))[0].tolist() == [[0, 5, 6, 7, 4, 1, 5, 6, 7, 4]]
    with pytest.raises(ConfigError, match="one-dimensional Box of real numbers is allowed"):
        envs.make(BOTH, 1, wrappers=["FlattenObservation", stack])


OWN = """
import gymnasium
import numpy as np

class Doubled(gymnasium.ObservationWrapper):
    def observation(self, observation):
        return 2 * observation

class Counting(gymnasium.ObservationWrapper):
    calls = 0

    def observation(self, observation):
        self.calls += 1
        return observation + np.float32(self.calls > 70)

class Falling(gymnasium.Wrapper):
    def __init__(self, env):
        raise RuntimeError("no\\nmore")

def function(env):
    return env
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    (tmp_path / "own_wrappers_here.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_wrappers_here", raising=False)
    return tmp_path / "own_wrappers_here.py"


PENDULUM = ["env=gym", "env.id=Pendulum-v1"]


def test_a_wrapper_of_ones_own_is_part_of_the_runs_identity(own):
    from aser.run_folder import name

    plain = settled(settings(*PENDULUM))
    words = [*PENDULUM, "env.wrappers=[own_wrappers_here.Doubled]"]
    wrapped = settled(settings(*words))
    assert set(wrapped.sources) - set(plain.sources) == {"own_wrappers_here"}
    assert settings(*PENDULUM, "env.wrappers=[]").env.kwargs == {}
    assert name(plain) != name(wrapped)
    task = "Pendulum-v1-wrappers=_own_wrappers_here.Doubled_"
    assert (plain.env.task, wrapped.env.task) == ("Pendulum-v1", task)
    seen = [build.make_envs(one, 1).reset(seed=[3])[0] for one in (plain, wrapped)]
    np.testing.assert_array_equal(2 * seen[0], seen[1])
    own.write_text(OWN.replace("2 *", "3 *"))
    del sys.modules["own_wrappers_here"]
    assert name(settled(settings(*words))) != name(wrapped)


@pytest.mark.parametrize(
    ("given", "line"),
    [
        (
            "FlatenObservation",
            "=FlatenObservation: gymnasium.wrappers has no such wrapper; did you",
        ),
        ("xxxx", "=xxxx: gymnasium.wrappers has no such wrapper; its documentation lists them"),
        ("vector", "=vector: must be a class that extends gymnasium.Wrapper"),
        ("no_such.Thing", "=no_such.Thing: cannot be imported (ModuleNotFoundError: No module"),
        (
            "own_wrappers_here.Nothing",
            "Nothing: own_wrappers_here has no Nothing; ",
        ),
        ("own_wrappers_here.function", "must be a class that extends gymnasium.Wrapper"),
        (
            "own_wrappers_here.Falling",
            "=own_wrappers_here.Falling cannot be made: RuntimeError: no",
        ),
        ("own_wrappers_here.Counting", "gives other numbers when an episode is repeated; allowed"),
        ("NormalizeObservation", "gives other numbers when an episode is repeated; allowed: wrap"),
        ("NormalizeReward", "gives other numbers when an episode is repeated; allowed: wrappers"),
        ("RescaleAction", "=RescaleAction cannot be made: TypeError: "),
        ("{RescaleAction: 3}", '=[{"RescaleAction": 3}]: must be a list of names of gymnasium.'),
        ("3", "=[3]: must be a list of names of gymnasium.wrappers, module.Class, or {NAME: {arg"),
    ],
)
def test_a_wrong_wrapper_is_one_line(own, given, line, capsys):
    assert train.main([*PENDULUM, f"env.wrappers=[{given}]", "sampler=uniform"]) == 1
    said = capsys.readouterr().err
    assert said.startswith("train: env.wrappers=") and line in said and said.count("\n") == 1


def test_a_wrapper_serves_where_an_environment_does_not_repeat_itself():
    """Box2D's episodes differ in the last bits when they are repeated; ours differ at once."""

    class Fresh(Both):
        def _observe(self):
            return {**super()._observe(), "seed": np.random.default_rng().random()}

    gymnasium.register("AserStandard/Fresh-v0", entry_point=Fresh, max_episode_steps=3)
    wrappers = ["FlattenObservation", "TimeAwareObservation", {"StickyAction": STICKY}]
    assert envs.make("AserStandard/Fresh-v0", 3, wrappers=wrappers).num_envs == 3
    with pytest.raises(ConfigError, match="gives other numbers when an episode is repeated"):
        envs.make("AserStandard/Fresh-v0", 3, wrappers=[*wrappers, "NormalizeObservation"])


STICKY = {"repeat_action_probability": 0.5}
