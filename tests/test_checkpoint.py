"""Saving and going on: the file itself, and runs that are killed, stopped and resumed."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

import train
from aser import build, checkpoint
from aser.compiled import why_not_compiled
from aser.errors import ConfigError

SMALL = ["debug=smoke", "batch=5", "seeds=[3,8]", "eval.every=50"]
TOY = [*SMALL, "env=maze", "env.layout=toy", "learning_starts=40"]


def built(config):
    return build.build(config, train.CONF, train.CONF.parent / "results")


def same(one, two):
    """Whether two trees are equal to the bit."""
    if isinstance(one, dict):
        return one.keys() == two.keys() and all(same(one[key], two[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(two) and all(map(same, one, two))
    if isinstance(one, torch.Tensor):
        one, two = one.numpy(), two.numpy()
        return one.dtype == two.dtype and one.shape == two.shape and one.tobytes() == two.tobytes()
    return type(one) is type(two) and one == two


# The file


def test_a_file_gives_back_what_was_saved(tmp_path):
    content = {
        "floats": torch.tensor([0.1, float("nan"), -0.0, 1e-45]),
        "doubles": np.array([[1 / 3, np.inf]]),
        "flags": np.array([True, False]),
        "counts": [torch.arange(3, dtype=torch.int32), np.int64(7), (np.float32(0.5), None)],
        "by number": {3: "text", 8: 2.5},
    }
    path = tmp_path / "checkpoint.pt"
    checkpoint.save(path, content)
    content["doubles"][:] = 0  # what is saved is saved
    back = checkpoint.load(path)
    assert same(back["floats"], content["floats"])
    assert back["doubles"].dtype == torch.float64 and back["doubles"].tolist() == [[1 / 3, np.inf]]
    assert back["flags"].tolist() == [True, False] and back["flags"].dtype == torch.bool
    assert back["counts"][0].dtype == torch.int32 and back["counts"][1:] == [7, [0.5, None]]
    assert back["by number"] == {3: "text", 8: 2.5}
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_saved_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "checkpoint.pt"
    checkpoint.save(path, {"step": 3})
    before = path.read_bytes()
    with pytest.raises(Exception, match="lambda"):
        checkpoint.save(path, {"step": 4, "bad": lambda: None})

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError):
        checkpoint.save(path, {"step": 4})
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_a_file_that_is_none_is_one_line(tmp_path):
    path = tmp_path / "checkpoint.pt"
    with pytest.raises(ConfigError, match=r"^checkpoint=.*no such file.*allowed[^\n]*$"):
        checkpoint.load(path)
    for content in (b"", b"not a checkpoint"):
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=r"^checkpoint=.*cannot be read[^\n]*$"):
            checkpoint.load(path)
    checkpoint.save(path, {"step": 3, "rows": torch.rand(40, 50)})
    path.write_bytes(path.read_bytes()[:-1500])
    with pytest.raises(ConfigError, match=r"^checkpoint=.*cannot be read[^\n]*$"):
        checkpoint.load(path)


def test_networks_of_another_size_are_refused():
    tree = {"a": torch.zeros(2, 3), "b": [torch.zeros(4)]}
    found = checkpoint.rebuild([torch.ones(2, 3), torch.ones(4)], tree)
    assert found["a"].sum() == 6 and found["b"][0].sum() == 4
    for leaves in (
        [torch.ones(2, 3)],
        [torch.ones(3, 2), torch.ones(4)],
        [torch.ones(2, 3), torch.ones(1, 4)],
    ):
        with pytest.raises(ConfigError, match="other sizes"):
            checkpoint.rebuild(leaves, tree)


# Resuming in a new training, at any step


def through_a_file(run, path):
    checkpoint.save(path, run.state_dict())
    fresh = built(run.config)
    fresh.config = run.config
    fresh.load_state_dict(checkpoint.load(path))
    return fresh


RARELY = [
    ("maze", "nstep_geometric", ["agent.actor_batch=uniform"]),
    ("maze", "aser_q", ["bootstrap=cumulative", "buffer=25"]),
    ("corridor", "nstep", ["bootstrap=averaged", "buffer=25"]),
    ("pendulum", "lap", ["buffer=25"]),
    ("corridor", "laber", ["agent=dqn", "agent.target_interval=9", "buffer=25"]),
    ("maze", "recent", ["prioritisation.q=.9", "buffer=25"]),
    ("corridor", "cer", ["buffer=25"]),
    ("corridor", "aser", ["agent=dqn", "agent.target_interval=9"]),
    ("pendulum", "aser_q", ["bootstrap.path_entropy=stored", "buffer=25"]),
    ("pendulum", "nstep", ["bootstrap.correction=retrace", "buffer=25"]),
    ("maze", "oracle", ["bootstrap.threshold=quantile"]),
    ("corridor", "relo", ["agent=dqn", "agent.target_interval=9", "buffer=25"]),
]


@pytest.mark.parametrize(
    ("env", "sampler", "extra"),
    [
        ("maze", "aser", ["bootstrap.criterion.name=td_error", "buffer=25"]),
        ("maze", "aser_shuffled", ["prioritisation.new=ever_max", "buffer=25"]),
        ("corridor", "per", ["buffer=25", "updates=3"]),
        ("corridor", "rank", ["buffer=25", "prioritisation.over=batch"]),
        ("maze", "aser_q", ["bootstrap=preferential", "buffer=25"]),
        ("maze", "la3p", ["buffer=25", "prioritisation.fraction=.7"]),
        ("corridor", "reaper", ["buffer=25"]),
        ("maze", "relo", ["buffer=25"]),
        ("corridor", "laber", ["buffer=25", "prioritisation.large=3"]),
        ("corridor", "pal", ["buffer=25"]),
        ("maze", "ere", ["prioritisation.least=5", "prioritisation.cycle=7", "buffer=25"]),
        (
            "corridor",
            "per",
            ["agent=dqn", "agent.target_interval=9", "agent.exploration.share=.8", "buffer=25"],
        ),
        ("corridor", "mmddpg", ["bootstrap.correction=clipped", "buffer=25"]),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in RARELY),
    ],
)
def test_every_step_is_a_place_to_go_on_from(env, sampler, extra, tmp_path):
    overrides = [
        *SMALL,
        f"env={env}",
        f"sampler={sampler}",
        "learning_starts=12",
        "steps=42",
        "eval.every=7",
    ]
    overrides += [*extra, *(["env.layout=toy"] if env == "maze" else []), "eval.episodes=1"]
    config = train.settings(overrides)
    straight, broken = built(config), built(config)
    straight.run()
    broken.config = config
    for stop in (
        5,
        12,
        13,
        29,
        35,
    ):  # in the warm-up, at its end, after one update, later, at an evaluation
        broken.run(after_step=lambda run, stop=stop: run.step == stop)
        assert broken.step == stop
        broken = through_a_file(broken, tmp_path / "checkpoint.pt")
    assert broken.run()
    states = [run.state_dict() for run in (straight, broken)]
    for run, state in zip((straight, broken), states, strict=True):
        del state["steady"]
        checkpoint.save(tmp_path / f"{id(run)}", state)
    assert same(
        checkpoint.load(tmp_path / f"{id(straight)}"), checkpoint.load(tmp_path / f"{id(broken)}")
    )


@pytest.mark.skipif(
    why_not_compiled() is not None, reason=f"not compiled: {why_not_compiled()} here"
)
@pytest.mark.parametrize(
    "agent",
    [[], pytest.param(["env=corridor", "agent=dqn"], marks=pytest.mark.slow)],
    ids=["sac", "dqn"],
)
def test_a_compiled_run_goes_on_to_the_bit_and_evaluation_changes_nothing_in_it(agent, tmp_path):
    where = agent or ["env=maze", "env.layout=toy"]
    overrides = [*SMALL, *where, "sampler=aser", "learning_starts=12", "steps=42", "compile=true"]
    straight = built(train.settings([*overrides, "eval.every=null"]))
    straight.run()
    config = train.settings([*overrides, "eval.every=7"])
    broken = built(config)
    broken.config = config
    broken.run(after_step=lambda run: run.step == 20)
    broken = through_a_file(broken, tmp_path / "checkpoint.pt")
    assert broken.run() and len(broken.history.returns) == 6
    kept = []
    for run in (straight, broken):
        state = run.state_dict()
        checkpoint.save(
            tmp_path / "end.pt", {name: state[name] for name in ("agent", "buffer", "actions")}
        )
        kept.append(checkpoint.load(tmp_path / "end.pt"))
    assert same(*kept)


# The command, in a process of its own, that somebody ends


def end(arguments, folder, number, saved=2):
    """Start training, send it a signal once it has saved `saved` times, and wait for its end."""
    command = [sys.executable, "-m", "train", *arguments, f"run_dir={folder}"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    path, seen = Path(folder) / "checkpoint.pt", set()
    deadline = time.monotonic() + 90
    while len(seen) < saved:
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        if path.exists():
            seen.add(path.stat().st_mtime_ns)
        time.sleep(0.002)
    time.sleep(0.05)  # some steps later
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err


def results(folder):
    """What a run came to: its returns, and all that it saved but for the time it took."""
    content = checkpoint.load(Path(folder) / "checkpoint.pt")
    del content["seconds"], content["training"]["steady"]
    return (Path(folder) / "returns.csv").read_bytes(), content


def finish(arguments, folder):
    assert train.main([*arguments, f"run_dir={folder}"]) == 0
    return results(folder)


@pytest.mark.parametrize(
    "sampler",
    [
        "aser",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("uniform", "per", "oracle", "per agent=dqn", "aser agent=dqn")
        ),
    ],
)
def test_killed_and_resumed_is_as_if_nothing_had_happened(sampler, tmp_path, capsys):
    sampler, *agent = sampler.split()
    where = [*SMALL, "env=corridor", "learning_starts=40"] if agent else TOY
    arguments = [*where, *agent, f"sampler={sampler}", "steps=240"]
    code, out, _ = end([*arguments, "checkpoint.every=30"], tmp_path / "killed", signal.SIGKILL)
    assert code == -signal.SIGKILL and "results in" not in out
    left = {path.name for path in (tmp_path / "killed").iterdir() if not path.name.startswith(".")}
    assert left == {"config.yaml", "checkpoint.pt", "returns.csv", "diagnostics.csv"}
    reached = checkpoint.load(tmp_path / "killed" / "checkpoint.pt")["training"]["step"]
    assert 60 <= reached < 240 and reached % 30 == 0
    resumed = finish([*arguments, "checkpoint.every=70", "resume=true"], tmp_path / "killed")
    assert f"resumed at step {reached}\n" in capsys.readouterr().out
    returns, content = finish(arguments, tmp_path / "straight")
    assert resumed[0] == returns and returns.count(b"\n") == 1 + 2 * 5
    assert same(resumed[1], content)
    assert content["training"]["step"] == 240 and content["agent"][0].isfinite().all()


@pytest.mark.slow
def test_pendulum_stopped_by_sigterm_goes_on_to_the_bit(tmp_path, capsys):
    arguments = [*SMALL, "env=pendulum", "sampler=aser", "steps=330", "eval.episodes=2"]
    code, out, err = end([*arguments, "checkpoint.every=35"], tmp_path / "ended", signal.SIGTERM)
    assert code == 143 and "Traceback" not in err
    reached = checkpoint.load(tmp_path / "ended" / "checkpoint.pt")["training"]["step"]
    last = out.splitlines()[-1]
    assert (
        last
        == f"stopped at step {reached} of 330; resume=true goes on, run_dir={tmp_path / 'ended'}"
    )
    assert not (tmp_path / "ended" / "summary.json").exists()
    resumed = finish([*arguments, "resume=true"], tmp_path / "ended")
    assert f"resumed at step {reached}\n" in capsys.readouterr().out
    straight = finish(arguments, tmp_path / "straight")
    assert resumed[0] == straight[0] and same(resumed[1], straight[1])
    assert {path.name for path in (tmp_path / "ended").iterdir()} == {
        path.name for path in (tmp_path / "straight").iterdir()
    }


def test_a_gymnasium_environment_stopped_by_ctrl_c_goes_on_within_its_episode(tmp_path, capsys):
    arguments = [
        *SMALL,
        "env=gym",
        "env.id=MountainCarContinuous-v0",
        "network=small",
        "sampler=nstep",
    ]
    arguments += ["steps=240", "eval.every=120", "eval.episodes=1"]
    code, out, err = end([*arguments, "checkpoint.every=20"], tmp_path / "ended", signal.SIGINT)
    assert code == 130 and "Traceback" not in err and "resume=true" in out.splitlines()[-1]
    reached = checkpoint.load(tmp_path / "ended" / "checkpoint.pt")["training"]["step"]
    resumed = finish([*arguments, "resume=true"], tmp_path / "ended")
    assert f"resumed at step {reached}\n" in capsys.readouterr().out
    straight = finish(arguments, tmp_path / "straight")
    assert resumed[0] == straight[0] and same(resumed[1], straight[1])
