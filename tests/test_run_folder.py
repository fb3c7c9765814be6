"""What a run never loses, never mixes up and never leaves behind."""

import importlib
import json
import multiprocessing
import os
import resource
import shutil
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import train
from aser import checkpoint, run, settle
from aser.errors import ConfigError
from aser.run_folder import RunFolder
from aser.settle import settled
from test_run import BEGUN, FILES, TINY, contents, summary, trained, unfinished


@pytest.fixture(autouse=True)
def _house(house):
    """Each test runs in a folder of its own."""


def refused(capsys, *overrides):
    """The line by which a run in the folder `run` is refused; nothing there changes."""
    before = contents(Path("run"))
    capsys.readouterr()
    trained(*overrides, status=1)
    assert contents(Path("run")) == before
    message = capsys.readouterr().err
    assert message.startswith("train: ") and message.count("\n") == 1
    return message


# force=true


def test_force_removes_what_a_run_writes_and_nothing_else():
    folder = trained()
    beside = {"thesis.tex": "years", "agent.pt": "mine", "notes": "more", ".hidden.txt": "x"}
    for file, text in beside.items():
        (folder / file).write_text(text)
    (folder / "data").mkdir()
    (folder / "data" / "returns.csv").write_text("not the run's")
    for stale in ("agent-20.pt", ".checkpoint.pt.123", ".summary.json.host_7-12"):
        (folder / stale).write_text("old")
    (folder / "tensorboard").mkdir()
    (folder / "tensorboard" / "events.out.tfevents.1.host.2.0").write_text("the old curve")
    (folder / "tensorboard" / "notes").write_text("mine")
    trained("force=true", "sampler=uniform")
    assert {path.name for path in folder.iterdir()} == FILES | set(beside) | {"data", "tensorboard"}
    assert [path.name for path in (folder / "tensorboard").iterdir()] == ["notes"]
    assert all((folder / file).read_text() == text for file, text in beside.items())
    assert (folder / "data" / "returns.csv").read_text() == "not the run's"


@pytest.mark.parametrize("content", ["title: my thesis\n", "- a\n- list\n", "{", ""])
def test_force_leaves_a_folder_whose_config_is_not_a_runs(content, capsys):
    Path("run").mkdir()
    Path("run/config.yaml").write_text(content)
    Path("run/returns.csv").write_text("of something else")
    assert "config.yaml is not a run's" in refused(capsys, "force=true")


def test_force_never_follows_a_link(capsys):
    trained("run_dir=real")
    Path("run").symlink_to("real")
    before = contents(Path("real"))
    assert "is a link" in refused(capsys, "force=true")
    assert contents(Path("real")) == before
    Path("run").unlink()
    trained()
    Path("kept.pt").write_bytes(b"of another")
    Path("run/checkpoint.pt").unlink()
    Path("run/checkpoint.pt").symlink_to(Path("kept.pt").resolve())
    trained("force=true")
    assert Path("kept.pt").read_bytes() == b"of another"
    assert not Path("run/checkpoint.pt").is_symlink()


def test_force_in_the_current_folder(capsys, monkeypatch):
    Path("run").mkdir()
    monkeypatch.chdir("run")
    Path("thesis.tex").write_text("years")
    assert train.main([*TINY, "run_dir=.", "force=true"]) == 1
    assert "holds other files than a run's" in capsys.readouterr().err
    assert [path.name for path in Path().iterdir()] == ["thesis.tex"]


# One owner


def test_a_folder_in_use_is_refused_and_free_again_when_its_owner_dies(capsys):
    folder = trained()
    config = train.settings([*TINY, "run_dir=run", "force=true"])

    def hold(ready):
        with RunFolder(config, Path("results")).owned():
            ready.set()
            signal.pause()

    ready = multiprocessing.get_context("fork").Event()
    owner = multiprocessing.get_context("fork").Process(target=hold, args=(ready,))
    owner.start()
    assert ready.wait(20)
    for words in ([], ["force=true"]):
        (folder / "summary.json").unlink(missing_ok=True)  # as if it were not finished
        assert "run_dir=run: another process trains there" in refused(capsys, *words)
    owner.kill()
    owner.join()
    trained("force=true")
    assert set(contents(folder)) == FILES


def test_a_finished_run_that_has_lost_its_returns_says_so(capsys):
    folder = trained()
    (folder / "returns.csv").unlink()
    said = "run_dir=run: holds a finished run without returns.csv; allowed: force=true"
    assert said in refused(capsys)


def test_a_run_without_its_checkpoint_says_that_it_begins_again(capsys):
    folder = trained()
    for file in ("summary.json", "checkpoint.pt"):
        (folder / file).unlink()
    trained("resume=true")
    assert "no checkpoint in run: the run begins again at step 0" in capsys.readouterr().out


def test_a_refused_run_leaves_no_folder(capsys):
    assert train.main([*TINY, "run_dir=a/b/c", "env.layout=nowhere"]) == 1
    assert not Path("a").exists()


@pytest.mark.parametrize("left", [".config.yaml.4711", ".checkpoint.pt.some_host-4711", ".lock"])
def test_what_a_killed_process_left_stops_no_start_and_goes(left):
    Path("run").mkdir()
    Path("run", left).write_text("half")
    assert set(contents(trained())) == FILES


# Checkpoints


def test_no_flipped_bit_is_loaded(tmp_path):
    path = tmp_path / "one.pt"
    content = {"rows": torch.arange(6.0).reshape(2, 3), "step": 3, "name": ["word"]}
    checkpoint.save(path, content)
    whole = path.read_bytes()
    assert checkpoint.load(path)["name"] == ["word"]
    for place in range(0, len(whole), 7):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << place % 8
        path.write_bytes(damaged)
        with pytest.raises(ConfigError, match=f"^checkpoint={path}: cannot be read"):
            checkpoint.load(path)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["seeds=[5,6]"], "seeds=[5, 6], not [0, 1]"),
        (["hyper.lr=.01"], "hyper.lr=0.01, not "),
        (["sampler=per"], "sampler=per, not aser"),
    ],
)
def test_the_checkpoint_of_another_run_is_refused(overrides, words, capsys):
    other = unfinished(*overrides)
    other.rename("other")
    unfinished()
    shutil.copy("other/checkpoint.pt", "run/checkpoint.pt")
    message = refused(capsys, "resume=true")
    assert "run_dir=run: its checkpoint.pt was made with " in message and words in message


@pytest.mark.parametrize("key", ["code", "torch"])
def test_the_checkpoint_of_another_version_is_refused(key, capsys):
    path = unfinished() / "checkpoint.pt"
    content = checkpoint.load(path)
    content["origin"][key] = "0.0.1"
    checkpoint.save(path, content)
    assert f"was made by {key} 0.0.1, and this is " in refused(capsys, "resume=true")
    del content["origin"]
    checkpoint.save(path, content)
    assert "was written by another version" in refused(capsys, "resume=true")


def test_a_full_disk_is_one_line_that_says_what_is_saved(capsys):
    folder = unfinished()
    saved, size = contents(folder), (folder / "checkpoint.pt").stat().st_size
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size // 2, limits[1]))
        capsys.readouterr()
        trained("resume=true", status=1)
        message = capsys.readouterr().err
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    assert message.startswith("train: ") and message.count("\n") == 1
    assert "File too large" in message and "the checkpoint of step 20 is whole" in message
    left = contents(folder)  # the tables have grown by the evaluation at step 24
    assert left.keys() == saved.keys() and left["checkpoint.pt"] == saved["checkpoint.pt"]
    trained("resume=true")


# What is said


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"auc_mean": "much"}', '{"auc_mean"'])
def test_a_broken_summary_is_one_line(content, capsys):
    folder = trained()
    (folder / "summary.json").write_text(content)
    assert "its summary.json is damaged; allowed: " in refused(capsys)
    trained("force=true")


def test_a_run_of_other_code_is_not_taken_for_this_codes(capsys):
    folder = trained()
    told = summary(folder)
    (folder / "summary.json").write_text(json.dumps({**told, "code": "0123456789ab"}))
    trained()
    line = f"finished before by other code, 0123456789ab and not {told['code']}, not trained again"
    assert line in capsys.readouterr().out


def test_no_number_in_the_summary_is_infinite(monkeypatch):
    returns = iter([[-1.0, float("nan")], [float("inf"), -2.0], [float("inf"), float("inf")]])
    monkeypatch.setattr(
        "aser.training.evaluation.Evaluation.__call__",
        lambda self, state, poll: np.array(next(returns)),
    )
    text = (trained() / "summary.json").read_text()
    assert "Infinity" not in text and "NaN" not in text
    assert [json.loads(text)[key] for key in ("iqm_final", "auc_mean")] == [None, None]


def test_divergence_is_said(capsys):
    told = summary(trained("hyper.lr=1e30"))
    assert [one["seed"] for one in told["diverged"]] == [0, 1]
    steps = [one["step"] for one in told["diverged"]]
    line = f"2 of 2 lanes diverged (seed 0 at step {steps[0]}, seed 1 at step {steps[1]})"
    assert line in capsys.readouterr().out


def test_more_threads_than_cores_are_refused(capsys):
    Path("run").mkdir()
    cores = os.cpu_count()
    assert f"threads=100000: must be at most {cores}, the cores" in refused(
        capsys, "threads=100000"
    )


# Modules and files of one's own


def test_an_edited_module_is_refused_by_the_process_that_loaded_it(capsys, monkeypatch):
    monkeypatch.syspath_prepend(".")
    monkeypatch.setattr(settle, "_LOADED", {})
    mine = Path("mine_once.py")
    mine.write_text("def flat(state, obs, gaussian):\n    return 0 * obs[0] + 1.0\n")
    own = ["sampler=aser", "criterion.name=mine_once.flat"]
    trained(*own)
    mine.write_text(mine.read_text().replace("1.0", "2.0"))
    said = refused(capsys, *own, "run_dir=second")
    assert "mine_once: has changed since this process loaded it; allowed: a new Python" in said
    assert not Path("second").exists()
    importlib.reload(sys.modules["mine_once"])
    trained(*own, "force=true")


def test_what_is_defined_in_the_main_module_is_refused(capsys, monkeypatch):
    function = staticmethod(lambda state, obs, gaussian: obs[0].abs())
    monkeypatch.setattr(sys.modules["__main__"], "crit", function, raising=False)
    assert train.main([*TINY, "sampler=aser", "criterion.name=__main__.crit"]) == 1
    assert "__main__: what a run reads was defined there" in capsys.readouterr().err


def test_an_edited_module_or_file_makes_another_run(capsys, monkeypatch):
    monkeypatch.syspath_prepend(".")
    Path("mine_helper.py").write_text("SCALE = 1.0\n")
    Path("mine.py").write_text(
        "from mine_helper import SCALE\n\n\n"
        "def flat(state, obs, gaussian):\n    return 0 * obs[0] + SCALE\n"
    )
    own = ["sampler=aser", "criterion.name=mine.flat"]
    folder = trained(*own)
    told = (folder / "config.yaml").read_text()
    assert "sources:\n  mine: " in told
    capsys.readouterr()
    Path("mine.py").write_text("# a comment\n" + Path("mine.py").read_text())
    trained(*own)
    assert "finished before, not trained again" in capsys.readouterr().out
    for file in ("mine.py", "mine_helper.py"):
        before = Path(file).read_text()
        Path(file).write_text(before.replace("1.0", "2.0").replace("0 *", "0.0 *"))
        monkeypatch.setattr(settle, "_LOADED", {})  # as in a new process
        assert "was begun with sources.mine=" in refused(capsys, *own)
        Path(file).write_text(before)
    shutil.copy(Path(train.__file__).parent / "aser/envs/layouts/toy.txt", "maze.txt")
    trained("run_dir=drawn", "env.layout=maze.txt")
    Path("maze.txt").write_text(Path("maze.txt").read_text() + "\n")
    assert train.main([*TINY, "run_dir=drawn", "env.layout=maze.txt"]) == 1
    assert "was begun with sources.env.layout=" in capsys.readouterr().err


def test_a_function_of_ones_own_that_raises_later_is_one_line(capsys, monkeypatch):
    monkeypatch.syspath_prepend(".")
    Path("late.py").write_text(
        "import sys\n\n\ndef flat(state, obs, gaussian):\n"
        "    if obs.shape[1] > 20:\n        raise KeyError('where')\n"
        "    return 0 * obs[0] + 1.0\n"
    )
    trained("sampler=aser", "criterion.name=late.flat", status=1)
    message = capsys.readouterr().err
    assert message.startswith("train: late.py, line 6: KeyError: 'where'; allowed: ")
    assert "no checkpoint was written" in message and message.count("\n") == 1


OWN_ENVIRONMENT = """
import os, signal
import gymnasium, numpy as np
from gymnasium.spaces import Box

class Odd(gymnasium.Env):
    observation_space, action_space = Box(-1, 1, (2,)), Box(-1, 1, (1,))
    steps = 0

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        if self.steps == 25:
            ODD
        return np.zeros(2, np.float32), 0.0, False, False, {}

gymnasium.register("Odd-v0", entry_point=Odd)
"""


@pytest.mark.parametrize(
    ("odd", "status", "words"),
    [
        (
            "raise OSError('no cable')",
            1,
            ":Odd-v0 fails in step: OSError: no cable",
        ),
        (
            "os.kill(os.getpid(), signal.SIGINT); os.kill(os.getpid(), signal.SIGINT)",
            130,
            "stopped at once by a second signal",
        ),
    ],
    ids=["raises", "signals"],
)
def test_what_ends_a_run_in_its_middle_says_what_is_saved(
    odd, status, words, capsys, monkeypatch, request
):
    name = f"odd_{request.node.callspec.id}"
    monkeypatch.syspath_prepend(".")
    Path(f"{name}.py").write_text(OWN_ENVIRONMENT.replace("ODD", odd))
    arguments = ["debug=smoke", "env=gym", f"env.id={name}:Odd-v0", "network.hidden=[5]", "batch=6"]
    arguments += ["sampler=uniform", "learning_starts=10", "steps=30", "run_dir=run"]
    try:
        ended = train.main([*arguments, "seeds=1", "eval.every=null", "checkpoint.every=10"])
    except SystemExit as exit:
        ended = exit.code
    said = capsys.readouterr()
    assert ended == status and words in said.out + said.err
    assert "the checkpoint of step 20 is whole, and resume=true goes on with it" in (
        said.out + said.err
    )
    assert checkpoint.load(Path("run/checkpoint.pt"))["training"]["step"] == 20


def test_ctrl_c_while_results_are_written_says_what_is_saved(capsys, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(SystemExit) as exit:
        patch.setattr(run, "_finish", lambda *_: os.kill(os.getpid(), signal.SIGINT))
        train.main([*TINY, "run_dir=run"])
    assert exit.value.code == 130
    said = capsys.readouterr()
    assert "stopped at once; the checkpoint of step 30 is whole" in said.out and not said.err
    trained("resume=true")
    assert "resumed at step 30" in capsys.readouterr().out


def test_two_signals_while_the_last_checkpoint_is_saved(capsys, monkeypatch):
    def stopped(saver):
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(run.Saver, "save", stopped)
    with pytest.raises(SystemExit) as exit:
        train.main([*TINY, "run_dir=run"])
    assert exit.value.code == 143
    assert "stopped at once by a second signal; no checkpoint was" in capsys.readouterr().out


def test_a_signal_that_is_ignored_stays_ignored():
    """As in the background of a script, whose Ctrl-C is for another command."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with run._stop_signals() as stop:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGTERM)
        assert stop == [signal.SIGTERM]
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_file_named_as_a_shipped_agent_is_no_source(monkeypatch):
    monkeypatch.syspath_prepend(".")
    Path("sac.py").write_text("x = 1\n")
    assert settled(train.settings(TINY)).sources == {}


def test_who_waited_for_a_folder_looks_at_it_again():
    """A run that began and died while another one waited is not overwritten."""
    config = train.settings([*TINY, "run_dir=run"])
    waiting = RunFolder(config, Path("results"))
    looked = waiting.check
    waiting.check = lambda: (looked(), unfinished() if not Path("run").exists() else None)
    refused = pytest.raises(ConfigError, match="run_dir=run: holds an unfinished run")
    with refused, waiting.owned():
        pass
    assert {path.name for path in Path("run").iterdir()} == BEGUN
