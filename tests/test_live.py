"""What is seen of a run while it trains: tables that grow, lines on the screen, and logs."""

import csv
import re
import sys
from pathlib import Path

import numpy as np
import pytest

import train
from aser import progress
from aser import run as running
from aser.progress import duration
from aser.run_folder import Growing, RunFolder

TINY = ["debug=smoke", "hyper=thesis", "env.layout=toy", "sampler=aser"]
TINY += ["batch=6", "learning_starts=10", "steps=30", "eval.every=8", "run_dir=run"]
TABLES = ("returns.csv", "diagnostics.csv")


def contents(folder="run"):
    return {file: (Path(folder) / file).read_text() for file in TABLES}


def test_the_tables_grow_to_what_they_are_at_the_end(house, monkeypatch):
    seen, add = [], Growing.add
    monkeypatch.setattr(
        Growing, "add", lambda *words: (add(*words), seen.append(contents("run")))[0]
    )
    assert train.main(TINY) == 0
    last = contents()
    assert len(seen) == 4 and last["returns.csv"].count("\n") == 1 + 2 * 4  # 8, 16, 24 and 30
    for number, tables in enumerate(seen, 1):
        assert tables["returns.csv"].count("\n") == 1 + 2 * number
        assert tables["diagnostics.csv"].count("\n") == 1 + 2 * (number - 1)  # none before step 10
        assert last["returns.csv"].startswith(tables["returns.csv"])
        assert number == 1 or last["diagnostics.csv"].startswith(tables["diagnostics.csv"])
    assert seen[-1] == last


def test_the_tables_of_a_resumed_run_are_cut_back_to_its_checkpoint(house):
    folder = RunFolder(train.settings(TINY), house)
    folder.begin()
    seeds = [4, 2]
    returns = [(step, np.array([step / 3, -step])) for step in (8, 16, 24)]
    notes = [(step, {"a": np.array([step, np.nan]), "b": np.ones(2)}) for step in (16, 24)]
    growing = Growing(folder, seeds, [], [])
    for many in (1, 2, 3):
        growing.add(returns[:many], notes[: many - 1])
    whole = contents()
    assert whole["diagnostics.csv"] == (
        "seed,step,a,b\n4,16,16,1\n2,16,nan,1\n4,24,24,1\n2,24,nan,1\n"
    )
    with (Path("run") / "returns.csv").open("a") as file:
        file.write("4,32,1")  # it was killed while it wrote
    for kept in (0, 1, 2):
        again = Growing(folder, seeds, returns[:kept], notes[: max(kept - 1, 0)])
        assert contents()["returns.csv"].count("\n") == 1 + 2 * kept
        again.add(returns, notes)
        assert contents() == whole


def test_lines_say_how_far_it_is_where_there_is_no_terminal(house, monkeypatch, capsys):
    monkeypatch.setattr(progress, "SECONDS", 0.0)
    monkeypatch.setattr(progress, "SHARE", 0.0)
    assert train.main(TINY) == 0
    first, second, *lines = capsys.readouterr().out.splitlines()
    assert first.startswith("maze, aser: 2 lanes of 30 steps, hyper-parameters from")
    assert second == "maze, aser: training begins"
    assert lines[0] == "maze, aser: step 1 of 30"
    row = r"maze, aser: step 20 of 30, score -[\d.]+ so far, [\d,]+ lane-steps/s, \d+ s left"
    assert re.fullmatch(row, lines[19]), lines[19]
    with Path("run/returns.csv").open() as file:
        known = [float(row["return"]) for row in csv.DictReader(file) if int(row["step"]) <= 16]
    assert f"score {np.mean(known):.4g} so far" in lines[19]
    score, folder, after = lines[30:]
    assert re.fullmatch(r"score -[\d.]+ \(mean area .* 2 seeds\)", score)
    assert folder == "results in run" and after.endswith("scripts/show.py run")


def test_the_first_line_says_that_it_compiles_and_long_runs_say_less(house, capsys):
    training = running.build.build(train.settings([*TINY, "run_dir=x"]), train.CONF, house)
    object.__setattr__(training.setup, "compile", True)
    with progress.Progress("here", training) as shown:
        assert "here: compiling" in capsys.readouterr().out
        training.step = 3
        shown.step()
        shown.said -= 6
        shown.step()
        assert capsys.readouterr().out == "here: step 3 of 30\n"
        shown.began -= 3600  # in an hour, a line every 36 seconds
        shown.said -= 30
        shown.step()
        assert capsys.readouterr().out == ""
        shown.said -= 10
        shown.step()
        assert capsys.readouterr().out == "here: step 3 of 30\n"


def test_durations():
    shown = [duration(seconds) for seconds in (0.4, 99, 100, 5900, 6000, 12_000)]
    assert shown == ["0 s", "99 s", "2 min", "98 min", "1 h 40 min", "3 h 20 min"]


def logged(folder):
    """The numbers of a log of TensorBoard by their names: step to value."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    return {
        tag: [(event.step, event.value) for event in events.Scalars(tag)]
        for tag in events.Tags()["scalars"]
    }


def test_tensorboard_shows_the_numbers_of_the_tables(house):
    pytest.importorskip("tensorboard")
    assert train.main(TINY) == 0
    plain = contents()
    assert train.main([*TINY, "log=tensorboard", "force=true"]) == 0
    assert contents() == plain  # a log changes nothing of the training
    shown = logged(Path("run"))
    for file, names in (("returns.csv", ["return"]), ("diagnostics.csv", ["td_error", "age_mean"])):
        rows = list(csv.DictReader((Path("run") / file).open()))
        for name in names:
            for end, of in (("mean", np.mean), ("low", min), ("high", max)):
                values = {}
                for row in rows:
                    values.setdefault(int(row["step"]), []).append(float(row[name]))
                for step, value in shown[f"{name}/{end}"]:
                    assert value == pytest.approx(of(values.pop(step)), rel=1e-5)
                assert not values


def test_a_log_that_cannot_begin_is_one_line(house, capsys, monkeypatch):
    for kind, module in (("tensorboard", "torch.utils.tensorboard"), ("wandb", "wandb.sdk")):
        monkeypatch.setitem(sys.modules, module, None)  # as where it is not installed
        assert train.main([*TINY, f"log={kind}"]) == 1
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and f"log={kind}" in said and f"pip install {kind}" in said
    assert not Path("run").exists()
    assert train.main([*TINY, "log=mlflow"]) == 1
    assert "log=mlflow: must be one of none, tensorboard, wandb" in capsys.readouterr().err


def test_a_log_is_no_part_of_a_runs_identity(house, capsys):
    pytest.importorskip("tensorboard")
    assert train.main(TINY) == 0
    assert train.main([*TINY, "log=tensorboard"]) == 0
    assert "not trained again" in capsys.readouterr().out
    one, other = (
        RunFolder(train.settings([*TINY[:-1], f"log={kind}"]), house) for kind in ("none", "wandb")
    )
    assert one.path == other.path and one.origin() == other.origin()


def test_a_resumed_run_is_logged_once(house):
    pytest.importorskip("tensorboard")
    words = [*TINY, "log=tensorboard", "checkpoint.every=10"]
    assert train.main(words) == 0
    whole = logged(Path("run"))
    (Path("run") / "summary.json").unlink()  # the process died at the very end
    assert train.main([*words, "resume=true"]) == 0
    assert logged(Path("run")) == whole and len(list(Path("run/tensorboard").iterdir())) == 1


def test_wandb_keeps_a_run_offline(house, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    assert train.main(TINY) == 0
    plain = contents()
    assert train.main([*TINY, "log=wandb", "force=true"]) == 0
    assert contents() == plain
    (kept,) = Path("run/wandb").glob("offline-run-*/run-*.wandb")
    assert b"effective_sample_size/high" in kept.read_bytes()
