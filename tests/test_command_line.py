"""A wrong input of `python -m train` is one line that names the key, and leaves nothing behind."""

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import train

SETTINGS = {  # arguments: words of the line
    # keys and choices
    "hyper.gama=.9": ["hyper.gama=.9", "did you mean hyper.gamma?"],
    "gamma=.9": ["gamma=.9", "did you mean hyper.gamma?"],
    "env.layot=toy": ["env.layot=toy", "did you mean env.layout?"],
    "stepz=300": ["stepz=300", "did you mean steps?"],
    "+foo=3": ["foo=3", "there is no such key"],
    "criterion=my_criteria.f": ["one of your own is criterion.name=my_criteria.f; must be one of"],
    "env=mazes": ["env=mazes", "did you mean maze?", "corridor"],
    "sampler=azer": ["sampler=azer", "did you mean aser?"],
    "sampler=Per": ["sampler=Per", "did you mean per?"],
    "env=gym env.id=Pendulum-v1 env.g=3": ["env.g=3", "+env.g=... is for an argument of the env"],
    "agent=ddpg": ["agent=ddpg", "must be one of dqn, sac"],
    "bootstrap.criterion=oracl": ["bootstrap.criterion=oracl", "did you mean oracle?"],
    "bootstrap=one_step bootstrap.threshold=1": [
        "bootstrap.threshold=1",
        "bootstrap has name, window",
    ],
    "prioritisation=uniform prioritisation.weights=true": ["prioritisation.weights=true"],
    "~steps": ["steps is missing"],
    "steps": ["steps", "key=value"],
    "seeds=[1,2": ["seeds=[1,2", "cannot be read"],
    "sampler=per,aser": ["sampler=per,aser", "-m"],
    "--steps=3": ["--steps=3", "--help"],
    # numbers
    "hyper.gamma=1.5": ["hyper.gamma=1.5", "[0, 1]"],
    "hyper.h=0": ["hyper.h=0", ">= 1"],
    "hyper.h=2.5": ["hyper.h=2.5", "whole number"],
    "hyper.alpha=-1": ["hyper.alpha=-1", ">= 0"],
    "hyper.k_m=85": ["hyper.k_m=85", "[0, 1]"],
    "hyper.lr=0": ["hyper.lr=0", "> 0"],
    "hyper.lr=nan": ["hyper.lr=nan", "finite"],
    "hyper.tau=inf": ["hyper.tau=inf", "(0, 1]"],
    "hyper.lr=fast": ["hyper.lr=fast", "number"],
    "batch=0": ["batch=0", ">= 1"],
    "batch=many": ["batch=many", "whole number"],
    "updates=0": ["updates=0", ">= 1"],
    "updates=.5": ["updates=0.5", "whole number"],
    "steps=1e6 updates=3000": ["updates=3000", "at most 2147 with steps=1000000"],
    "env=corridor agent=dqn sampler=uniform steps=16777217": [
        "steps=16777217",
        "must be at most 16777216 with agent=dqn",
    ],
    "env=corridor agent=dqn sampler=uniform updates=2": ["updates=2", "must be 1 with agent=dqn"],
    "learning_rate=0.1": ["learning_rate=0.1", "did you mean hyper.lr?"],
    "total_timesteps=9": ["total_timesteps=9", "did you mean steps?"],
    "sampler=aser,per": ["sampler=aser,per: several choices need -m\n"],
    "sampler=[aser,per]": ["sampler=[aser,per]", "several runs need -m sampler=A,B"],
    "steps=true": ["steps=true", "whole number"],
    "steps=100": ["steps=100", "learning_starts, which is 100"],
    "hyper=thesis buffer=9": ["buffer=9", "10 steps"],
    "hyper=thesis bootstrap.window=9": ["bootstrap.window=9", "hyper.h, which is 10"],
    "sampler=uniform bootstrap.window=9": ["bootstrap.window=9", "one_step reads one step"],
    "sampler=per criterion=uniform": [
        "criterion=uniform",
        "prioritisation=proportional needs another one",
    ],
    "sampler=rank criterion=oracle": ["criterion=oracle", "two values", "allowed: prioritisation="],
    "sampler=uniform criterion=outcome_spread": [
        "criterion=outcome_spread",
        "would not learn; allowed: auto",
    ],
    "sampler=recent criterion=visit_count": ["criterion=visit_count", "sampler=recent reads none"],
    "sampler=laber agent.loss=pal": ["agent.loss=pal", "LaBER", "squared, huber"],
    "threads=0": ["threads=0"],
    "prioritisation.over=batch": ["prioritisation.over=batch", "prioritisation.weights=true"],
    "sampler=per prioritisation.over=ring": ["prioritisation.over=ring", "batch, buffer"],
    "sampler=aser bootstrap.threshold=3 bootstrap.batch=prioritised": [
        "bootstrap.batch=prioritised",
        "bootstrap.threshold=3",
        "uniform",
    ],
    "+env.num_envs=3": ["env.num_envs=3", "seeds=N"],
    "sampler=la3p batch=1": ["prioritisation.fraction=0.5", "batch=1"],
    "sampler=la3p prioritisation.fraction=1": ["prioritisation.fraction=1.0", "both parts"],
    "agent.actor_batch=inverse sampler=uniform": ["actor_batch=inverse", "uniform has no prior"],
    "sampler=la3p buffer=100001": ["buffer=100001", "at most 100000", "actor_batch=inverse"],
    "env=corridor agent=dqn prioritisation=la3p": ["agent=dqn", "LA3P is for sac"],
    "sampler=laber prioritisation.large=1": ["prioritisation.large=1", ">= 2 and <= 1000"],
    "sampler=rank buffer=100001": ["buffer=100001", "at most 100000"],
    "eval.every=0": ["eval.every=0", ">= 1, or auto or null"],
    "eval.episodes=0": ["eval.episodes=0", ">= 1 and <= 100000, or auto"],
    "checkpoint.every=0": ["checkpoint.every=0", ">= 1, or auto"],
    "bootstrap.threshold=nan": ["bootstrap.threshold=nan"],
    "bootstrap.threshold=1e308": ["bootstrap.threshold=1e+308", "1e+38"],
    "bootstrap.threshold=high": ["bootstrap.threshold=high", "auto, quantile or a finite number"],
    "network.hidden=[]": ["network.hidden=[]", "such as [24]"],
    "network.hidden=[24,0]": ["network.hidden=[24, 0]", "such as [24]"],
    "network.hidden=null": ["network.hidden=null", "such as [24]"],
    "seeds=0": ["seeds=0", ">= 1"],
    "seeds=[]": ["seeds=[]", "at least one"],
    "seeds=[7,3,7]": ["seeds=[7, 3, 7]", "7 is there twice"],
    "seeds=[-1]": ["seeds=-1", ">= 0"],
    "resume=maybe": ["resume=maybe", "true or false"],
    "resume=true force=true": ["resume=true", "force=true"],
    # DQN
    "env=corridor agent=dqn agent.actions=1": ["agent.actions=1", ">= 2"],
    "env=corridor agent=dqn agent.actions=2.5": ["agent.actions=2.5", "whole number"],
    "env=corridor agent=dqn agent.target_interval=0": ["agent.target_interval=0", ">= 1"],
    "env=corridor agent=dqn agent.exploration.start=1.5": ["agent.exploration.start=1.5", "[0, 1]"],
    "env=corridor agent=dqn agent.exploration.end=-.1": ["agent.exploration.end=-0.1", "[0, 1]"],
    "env=corridor agent=dqn agent.exploration.share=0": ["agent.exploration.share=0", "(0, 1]"],
    "env=corridor agent=dqn agent.exploration=.1": ["agent.exploration=0.1", "start, end, share"],
    "env=corridor agent=dqn agent.exploration.shar=.1": [
        "agent.exploration.shar=.1",
        "agent.exploration.share?",
    ],
    "env=corridor agent=dqn agent.td_error=min": ["agent.td_error=min", "there is no such key"],
    "env=corridor agent.actions=7": ["agent.actions=7", "there is no such key"],
    "env=corridor agent=dqn hyper.tau=.1": ["hyper.tau=0.1", "lr, gamma"],
    "env=corridor agent=dqn hyper=thesis": ["hyper=thesis", "agent=dqn", "sb3"],
    "env=corridor agent=dqn criterion=mode_log_prob": [
        "criterion=mode_log_prob",
        "agent=dqn",
        "q_dropoff",
    ],
    "env=corridor agent=dqn sampler=aser_q": ["criterion=q_range", "agent=dqn", "q_dropoff"],
    "env=corridor agent=dqn bootstrap.criterion=entropy": [
        "bootstrap.criterion=entropy",
        "q_dropoff",
    ],
    "env=corridor agent=dqn sampler=pretrained criterion.of=curvature": [
        "criterion.of=curvature",
        "q_dropoff",
    ],
    "env=corridor agent=dqn bootstrap.path_entropy=fresh": [
        "bootstrap.path_entropy=fresh",
        "auto, none",
    ],
    "sampler=nstep bootstrap.correction=vtrace": [
        "bootstrap.correction=vtrace",
        "clipped, none, retrace",
    ],
    "sampler=uniform +bootstrap.correction=retrace": [
        "bootstrap=one_step has nothing to correct",
        "fixed",
    ],
    "sampler=laber bootstrap=fixed bootstrap.correction=clipped hyper.from=nstep": [
        "bootstrap.correction=clipped",
        "LaBER",
    ],
    "env=corridor agent=dqn sampler=nstep bootstrap.correction=retrace": [
        "bootstrap.correction=retrace",
        "agent=sac",
    ],
    "env=corridor criterion=q_dropoff": ["criterion=q_dropoff", "agent=sac", "mode_log_prob"],
    # what does not go together
    "sampler=uniform hyper.alpha=.5": ["hyper.alpha=0.5", "lr, gamma, tau, target_entropy"],
    "sampler=uniform bootstrap=threshold": ["bootstrap=threshold", "bootstrap.criterion"],
    "sampler=uniform prioritisation=proportional": ["hyper.alpha", "hyper.from"],
    "criterion.of=entropy": ["criterion.of=entropy", "only pretrained, shuffled"],
    "criterion=shuffled criterion.of=td_error": ["criterion.of=td_error", "mode_log_prob"],
    "criterion=shuffled criterion.of=oracle": ["criterion.of=oracle", "mode_log_prob"],
    "criterion=oracle criterion.squashed=true": ["criterion.squashed=true", "mode_log_prob"],
    "sampler=outcome_spread criterion.of=q": ["criterion.of=q", "both, state, value"],
    "env=corridor agent=dqn sampler=outcome_spread": ["criterion=outcome_spread", "agent=dqn"],
    "criterion.checkpoint=x": ["criterion.checkpoint=x", "only pretrained"],
    "bootstrap.criterion.of=entropy": ["bootstrap.criterion.of=entropy"],
    "env=pendulum sampler=oracle": ["criterion=oracle", "maze, maze_sparse, corridor"],
    "env.layout_seed=3": ["env.layout_seed=3", "env.layout=random"],
    "env=gym env.id=MountainCarContinuous-v0 hyper=tuned": ["hyper=tuned", "sb3"],
    "env=gym env.id=MountainCarContinuous-v0 hyper=thesis": ["hyper=thesis", "sb3"],
    "env=gym": ["env.id", "MountainCarContinuous-v0"],
    "device=tpu": ["device=tpu", "cpu, cuda"],
    "-m sampler=uniform,azer": ["sampler=azer", "did you mean aser?"],
    "-m sampler=per checkpoint.every=10,50": [
        "checkpoint.every=10] and [",
        "checkpoint.every=50] are one run",
        "each run once",
    ],
    "-m sampler=uniform,per run_dir=here": ["run_dir=here", "share one folder"],
}

BUILDING = {  # only the build can tell
    "device=cuda:99": ["device=cuda:99"],
    "env=maze agent=dqn": ["agent=dqn", "2 action dimensions", "one, as in corridor, pendulum"],
    "env=gym env.id=MountainCarContinous-v0": [
        "MountainCarContinous-v0",
        "MountainCarContinuous-v0",
    ],
    "env=gym env.id=CartPole-v1": ["agent=sac", "CartPole-v1", "2 discrete", "agent=dqn"],
    "env=gym env.id=CartPole-v1 agent=dqn agent.actions=3": ["agent.actions=3", "has 2", "auto"],
    "env=gym env.id=FrozenLake-v1 agent=dqn": ["FrozenLake-v1", "Discrete(16)"],
    "env=gym env.id=MountainCarContinuous-v0 sampler=oracle": [
        "criterion=oracle",
        "maze, maze_sparse, corridor",
    ],
    "env=gym env.id=MountainCarContinuous-v0 +env.goal=3": ["MountainCarContinuous-v0", "goal"],
    "+env.colour=red": ["env.colour", "layout"],
    "env.layout=nowhere.txt": ["nowhere.txt"],
    "env.layout=no_start.txt": ["no_start.txt", "S"],
    "env.layout=no_goal.txt": ["no_goal.txt", "T"],
    "env.layout=apart.txt": ["apart.txt"],
    "env.layout=random env.size=[1,1]": ["env.size=[1, 1]"],
    "env=corridor env.length=nan": ["env.length"],
    "env=corridor env.gates=[[.4,.7,.3]]": ["env.gates"],
    "sampler=pretrained criterion.checkpoint=nowhere": ["criterion.checkpoint=nowhere"],
    "sampler=pretrained criterion.checkpoint=empty": ["criterion.checkpoint=empty"],
    "run_dir=a_file": ["run_dir=a_file"],
    "run_dir=a_file/below": ["run_dir=a_file/below"],
    "run_dir=/proc/below": ["run_dir=/proc/below"],
    "run_dir=strangers": ["run_dir=strangers", "other files"],
    "run_dir=unfinished": ["run_dir=unfinished", "resume=true", "force=true"],
}

TOY = ["debug=smoke", "env.layout=toy"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder to run in and to leave results in, which holds a few files that are in the way."""
    monkeypatch.chdir(tmp_path)
    Path("conf").symlink_to(train.CONF)
    monkeypatch.setattr(train, "CONF", tmp_path / "conf")
    Path("a_file").write_text("not a folder")
    Path("empty").mkdir()
    Path("strangers").mkdir()
    Path("strangers/notes.txt").write_text("somebody's")
    Path("unfinished").mkdir()
    Path("unfinished/config.yaml").write_text("{}")
    walls = "#########\n#{0} . . {1}#\n#########\n"
    Path("no_start.txt").write_text(walls.format(".", "T"))
    Path("no_goal.txt").write_text(walls.format("S", "."))
    Path("apart.txt").write_text("#########\n#S .#. T#\n#########\n")
    return tmp_path


def everything(folder: Path) -> dict[str, str]:
    return {str(path): path.read_text() if path.is_file() else "" for path in folder.rglob("*")}


@pytest.mark.parametrize(
    ("line", "words"), [*SETTINGS.items(), *BUILDING.items()], ids=[*SETTINGS, *BUILDING]
)
def test_a_wrong_input_is_one_line(line, words, here, capfd):
    before = everything(here)
    assert train.main(["debug=smoke", *line.split(" ")]) == 1
    said = capfd.readouterr()
    assert said.err.startswith("train: ") and said.err.count("\n") == 1 and said.out == ""
    assert [word for word in words if word not in said.err] == []
    assert everything(here) == before


def test_the_command_itself_exits_with_one_line(tmp_path):
    command = [sys.executable, "-m", "train", "hyper.gamma=2"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr == "train: hyper.gamma=2: must be a finite number in [0, 1]\n"


def test_help_names_every_group_and_setting(capsys):
    assert train.main(["--help"]) == 0
    text = capsys.readouterr().out
    for word in [
        *train.names(train.CONF, "sampler"),
        *train.names(train.CONF, "env"),
        "run_dir:",
        "k_m:",
        "-m",
    ]:
        assert word in text
    assert "_keys" not in text and "_base" not in text and "hydra" not in text
    assert max(map(len, text.splitlines())) <= 100


def test_help_shows_each_setting_under_its_comment(capsys):
    assert train.main(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    place = lines.index("  batch: 256")
    assert lines[place - 1].startswith("  # Items in a batch: 256 in the thesis")
    place = lines.index("  gamma: null")
    assert lines[place - 1] == "  # Discount factor, in [0, 1]."
    for group in ("agent", "criterion", "sampler", "debug"):
        assert sum(line.startswith(f"  {group} ") for line in lines) == 1


def test_a_criterion_file_needs_no_more_than_a_name(tmp_path, monkeypatch):
    shutil.copytree(train.CONF, tmp_path / "conf")
    (tmp_path / "conf/criterion/short.yaml").write_text("defaults: [_base]\nname: mine.short\n")
    (tmp_path / "conf/criterion/bare.yaml").write_text("name: mine.bare\n")
    monkeypatch.setattr(train, "CONF", tmp_path / "conf")
    words = ["sampler=aser", "hyper=thesis"]
    for name in ("short", "bare"):
        config = train.settings([*words, f"criterion={name}", "bootstrap.criterion.name=oracle"])
        assert config.criterion.name == f"mine.{name}" and config.criterion.of is None
        assert config.bootstrap.criterion.name == "oracle"
        config = train.settings([*words, f"bootstrap.criterion.name={name}"])
        assert config.bootstrap.criterion.name == f"mine.{name}"


def test_cfg_prints_the_whole_settings_and_trains_nothing(here, capsys):
    before = everything(here)
    assert (
        train.main(
            ["--cfg", "sampler=oracle", "bootstrap.criterion=q_std", "hyper=thesis", "seeds=[5]"]
        )
        == 0
    )
    shown = yaml.safe_load(capsys.readouterr().out)
    assert train.parse(shown) == train.settings(
        ["sampler=oracle", "bootstrap.criterion.name=q_std", "hyper=thesis", "seeds=[5]"]
    )
    assert train.main(["-m", "--cfg", "sampler=per,aser", "seeds=[5]"]) == 0
    jobs = yaml.safe_load_all(capsys.readouterr().out)
    assert [job["sampler"] for job in jobs] == ["per", "aser"]
    assert everything(here) == before


def test_a_run_ends_with_its_folder_and_is_not_trained_twice(here, capsys):
    arguments = [*TOY, "sampler=aser", "seeds=[4,9]", "steps=150", "eval.every=40", "run_dir=run"]
    assert train.main(arguments) == 0
    assert capsys.readouterr().out.splitlines()[-2] == "results in run"
    config = yaml.safe_load(Path("run/config.yaml").read_text())
    assert train.parse(config) == train.settings(arguments)
    _, *rows = csv.reader(Path("run/returns.csv").read_text().splitlines())
    places = sorted((int(seed), int(step)) for seed, step, _ in rows)
    assert places == [(seed, step) for seed in (4, 9) for step in (40, 80, 120, 150)]
    assert {"iqm_final", "auc_mean", "solved", "diverged"} <= set(
        json.loads(Path("run/summary.json").read_text())
    )
    before = {path: path.stat().st_mtime_ns for path in Path("run").iterdir()}
    assert train.main(arguments) == 0
    said = capsys.readouterr().out.splitlines()
    assert "not trained again" in said[0] and said[-2] == "results in run"
    assert {path: path.stat().st_mtime_ns for path in Path("run").iterdir()} == before


def test_a_multirun_trains_every_combination(tmp_path):
    command = [
        sys.executable,
        "-m",
        "train",
        "-m",
        *TOY,
        "steps=120",
        "sampler=uniform,per",
        "seeds=1",
    ]
    command += [
        "run_dir=runs/${sampler}",
        f"hydra.sweep.dir={tmp_path}/multirun",
        "hydra.launcher.n_jobs=1",
    ]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    for sampler in ("uniform", "per"):
        assert (
            yaml.safe_load((tmp_path / "runs" / sampler / "config.yaml").read_text())["sampler"]
            == sampler
        )
        assert (tmp_path / "runs" / sampler / "summary.json").exists()
        assert f"results in runs/{sampler}" in result.stdout
