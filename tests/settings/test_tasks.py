"""Tables of hyper-parameters go by task, and `hyper=` may name a table of one's own."""

from pathlib import Path

import pytest

import train
from aser.errors import ConfigError
from aser.settings import compose
from aser.settings.config import parse
from aser.settle import settled

GYM = ["env=gym", "env.id=MountainCarContinuous-v0", "sampler=per"]


def settings(*words, conf=train.CONF):
    return parse(compose.compose(compose.command_line(words, set())[1], conf), conf)


@pytest.fixture
def conf(tmp_path):
    """A copy of conf/ in which a sweep has tuned PER in MountainCarContinuous."""
    for path in train.CONF.rglob("*.yaml"):
        copy = tmp_path / "conf" / path.relative_to(train.CONF)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(path.read_bytes())
    table = tmp_path / "conf/hyper/tuned/MountainCarContinuous-v0/per.yaml"
    table.parent.mkdir()
    keys = "gamma: .9\ntau: 0.01\nalpha: .5\nepsilon: 1e-2\nbeta: .4\n"
    table.write_text(f"lr: 4e-3\n{keys}")  # 4e-3 is a word for YAML, and a number for us
    return tmp_path / "conf"


def test_a_tuned_table_serves_its_own_task_only(conf):
    tuned = settings(*GYM, conf=conf).hyper
    assert tuned.source == "tuned/MountainCarContinuous-v0/per"
    assert (tuned.values["lr"], tuned.values["epsilon"]) == (0.004, 0.01)
    for words in (["env.id=Pendulum-v1"], ["+env.goal_velocity=.01"]):
        other = settings(*GYM, *words, conf=conf).hyper
        assert (other.source, other.values["lr"]) == ("sb3/any/any", 0.0003)


@pytest.mark.parametrize(
    ("words", "task"),
    [
        (["env=maze", "env.layout=toy"], "maze"),
        (["env=maze_sparse"], "maze_sparse"),
        (["env=gym", "env.id=Hopper-v5"], "Hopper-v5"),
        (["env=gym", "env.id=my_tasks.walk:Walk-v0"], "my_tasks.walk_Walk-v0"),
        (["env=gym", "env.id=../x"], "_x"),
        (["env=gym", "env.id=A-v0", "+env.b=[1,2]", "+env.a=.5"], "A-v0-a=0.5-b=_1_2_"),
    ],
)
def test_the_name_of_a_task(words, task):
    assert settings(*words).env.task == task


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["env=pendulum", "env.id=Hopper-v5"],
            "env.id=Hopper-v5: env=pendulum is aser/Pendulum-v0;",
        ),
        (["env=maze", "env.reward=sparse"], "env.reward=sparse: this is the task env=maze_sparse,"),
        (["env.name=../up"], "env.name=../up: must be of letters, digits and . _ + = -"),
    ],
)
def test_one_task_has_one_name(words, line):
    with pytest.raises(ConfigError) as refusal:
        settings(*words)
    assert str(refusal.value).startswith(line)


def test_hyper_names_the_table_of_a_sweep():
    folder = train.CONF.parent / "results/sweeps/corridor-per"
    tuned = settings("env=corridor", "sampler=per", "hyper=tuned").hyper
    for path in (folder, folder / "tuned.yaml"):
        there = settings("env=corridor", "sampler=per", f"hyper={path}").hyper
        assert there.values == tuned.values
        assert (there.set, there.source) == (str(path), str(folder / "tuned.yaml"))
    with pytest.raises(ConfigError, match="^hyper=no/where: there is no /.*/no/where; all"):
        settings("hyper=no/where")


def test_what_evaluations_of_other_environments_cost():
    """At most a tenth of the training steps between two of them."""
    config = settled(settings(*GYM))
    assert (config.eval_episodes, config.eval_max_steps, config.eval_every) == (1, 999, 10000)
    config = settled(settings(*GYM, "env.id=Pendulum-v1", "eval.episodes=2"))
    assert (config.eval_episodes, config.eval_max_steps, config.eval_every) == (2, 200, 4000)
    config = settled(settings(*GYM, "+env.max_episode_steps=30"))
    assert (config.eval_max_steps, config.eval_every) == (30, 300)
    config = settled(settings(*GYM, "eval.every=50", "eval.max_steps=7"))
    assert (config.eval_max_steps, config.eval_every) == (7, 50)
    maze = settled(settings("env=maze"))
    assert (maze.eval_max_steps, maze.eval_every) == (None, 100)
    assert maze.to_dict()["eval"] == {"every": 100, "episodes": 1}


def test_a_path_is_short_in_a_runs_name():
    from aser.run_folder import name

    folder = Path("results/sweeps/corridor-per")
    words = ["env=corridor", "sampler=per"]
    assert name(settings(*words, f"hyper={train.CONF.parent / folder}")).startswith(
        "corridor-per-corridor_per-"
    )


def test_a_criterion_of_ones_own_is_in_a_runs_name_unless_its_folder_is_there(tmp_path):
    from aser.run_folder import name, place

    words = ["env=maze", "sampler=aser", "hyper=thesis"]
    own = settings(*words, "criterion.name=my_criteria.regret")
    new, old = tmp_path / name(own), tmp_path / name(own, "aser")
    assert name(own).startswith("maze-aser_my_criteria.regret-thesis-")
    assert name(own).rpartition("-")[2] == old.name.rpartition("-")[2]
    assert place(own, tmp_path) == new
    old.mkdir()  # of a run from before criteria were in names
    assert place(own, tmp_path) == old
    assert name(settings(*words, "criterion=q_range")).startswith("maze-aser-thesis-")
