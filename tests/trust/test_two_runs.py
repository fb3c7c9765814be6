"""Several processes and one run folder: it has one owner at a time, and the others are told."""

from __future__ import annotations

import csv
import os
import signal
import time
from pathlib import Path

import pytest
import yaml
from bits import differing, results
from search import unclear

SECONDS = 120  # of one process
ARGUMENTS = [
    "debug=smoke",
    "env=maze",
    "env.layout=toy",
    "sampler=uniform",
    "batch=8",
    "learning_starts=20",
    "steps=200",
    "eval.every=50",
    "checkpoint.every=20",
    "compile=false",
    "run_dir=run",
]


def owned(folder: Path) -> list[int]:
    """The seeds of the run in a folder, which are the same in its config and in its results."""
    seeds = yaml.safe_load((folder / "config.yaml").read_text())["seeds"]
    for file in ("returns.csv", "diagnostics.csv"):
        rows = list(csv.DictReader((folder / file).read_text().splitlines()))
        assert {int(row["seed"]) for row in rows} == set(seeds), file
    assert (folder / "summary.json").exists()
    return seeds


def begun(folder: Path) -> None:
    """Wait until a run has saved a checkpoint."""
    deadline = time.monotonic() + SECONDS
    while not (folder / "checkpoint.pt").exists():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def at_once(warm, lines: list[list[str]], folder: Path) -> list:
    """What comes of several commands that begin at the same moment."""
    moment = time.monotonic() + 0.5
    running = [warm.start(line, folder, at=moment) for line in lines]
    return [warm.wait(one, SECONDS) for one in running]


def one_wins(ended: list, folder: Path) -> int:
    """Which of several processes trained; all others were refused in one line."""
    winners = [n for n, one in enumerate(ended) if one.status == 0]
    assert len(winners) == 1, [one.err for one in ended]
    for one in ended:
        assert unclear(one) is None
        assert one.status == 0 or "run_dir=run" in one.err
    assert owned(folder / "run")
    return winners[0]


WORDS = ["resume=true", pytest.param("force=true", marks=pytest.mark.slow)]


@pytest.mark.parametrize("count", [2, pytest.param(5, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "words",
    [[], *(pytest.param([word], marks=pytest.mark.slow) for word in ("resume=true", "force=true"))],
    ids=" ".join,
)
def test_of_runs_that_start_at_once_in_one_folder_one_trains(count, words, warm, tmp_path):
    lines = [[*ARGUMENTS, *words, f"seeds=[{seed}]"] for seed in range(count)]
    winner = one_wins(at_once(warm, lines, tmp_path), tmp_path)
    assert owned(tmp_path / "run") == [winner]


@pytest.mark.parametrize("word", WORDS)
def test_a_run_that_is_being_trained_is_not_taken(word, warm, tmp_path):
    owner = warm.start(ARGUMENTS, tmp_path)
    begun(tmp_path / "run")
    second = warm.run([*ARGUMENTS, word], tmp_path, SECONDS)
    assert second.status == 1 and unclear(second) is None and "run_dir=run" in second.err
    assert warm.wait(owner, SECONDS).status == 0
    assert warm.run([*ARGUMENTS, "run_dir=straight"], tmp_path, SECONDS).status == 0
    assert differing(results(tmp_path / "run"), results(tmp_path / "straight")) == []


@pytest.mark.parametrize("word", WORDS)
def test_the_folder_of_a_killed_run_can_be_taken(word, warm, tmp_path):
    owner = warm.start(ARGUMENTS, tmp_path)
    begun(tmp_path / "run")
    os.kill(owner.pid, signal.SIGKILL)
    assert warm.wait(owner, SECONDS).status == -signal.SIGKILL
    assert warm.run([*ARGUMENTS, word], tmp_path, SECONDS).status == 0
    assert owned(tmp_path / "run") == [0, 1]


@pytest.mark.parametrize("word", WORDS)
def test_of_several_that_take_up_a_killed_run_one_trains(word, warm, tmp_path):
    owner = warm.start(ARGUMENTS, tmp_path)
    begun(tmp_path / "run")
    os.kill(owner.pid, signal.SIGKILL)
    warm.wait(owner, SECONDS)
    one_wins(at_once(warm, [[*ARGUMENTS, word]] * 3, tmp_path), tmp_path)
