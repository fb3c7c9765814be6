"""Runs that are killed at random moments and resumed equal those that never were, bit for bit."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from bits import differing, results

import train
from aser import checkpoint
from aser.compiled import why_not_compiled
from aser.replay import priorities

SECONDS = 300  # of one process
STEPS = 260
SMALL = f"debug=smoke seeds=[3,8] batch=5 learning_starts=30 eval.every=65 steps={STEPS}".split()
TOY = ["env=maze", "env.layout=toy"]
CORRIDOR, DQN = ["env=corridor"], ["env=corridor", "agent=dqn", "agent.target_interval=9"]
RING, TREE = ["buffer=40"], ["buffer=110000"]
OFTEN, ODD, SELDOM = (f"checkpoint.every={every}" for every in (7, 23, 50))
COMPILED = ["compile=true"]
CASES = {  # 32 runs, each killed four times
    "uniform": [*TOY, *RING, OFTEN],
    "per": [*TOY, *TREE, OFTEN],
    "rank": [*TOY, *RING, ODD],
    "la3p": [*TOY, *RING, ODD],
    "reaper": [*CORRIDOR, *RING, ODD],
    "relo": [*TOY, *TREE, ODD],
    "laber": [*CORRIDOR, *RING, OFTEN],
    "lap": [*TOY, *RING, ODD],
    "pal": [*CORRIDOR, *RING, OFTEN],
    "recent": [*TOY, *RING, ODD],
    "cer": ["env=pendulum", "eval.episodes=2", *RING, OFTEN],
    "ere": [*CORRIDOR, *RING, "prioritisation.least=8", "prioritisation.cycle=50", ODD],
    "nstep": [*CORRIDOR, *RING, ODD],
    "nstep_geometric": [*TOY, ODD],
    "aser": [*TOY, *TREE, ODD],
    "aser_no_bootstrap": [*CORRIDOR, *TREE, OFTEN],
    "aser_no_prioritisation": [*TOY, *RING, SELDOM],
    "aser_shuffled": [*TOY, *RING, OFTEN],
    "aser_q": ["env=pendulum", "eval.episodes=2", *TREE, ODD],
    "outcome_spread": [*TOY, *RING, ODD],
    "outcome_spread_shuffled": [*CORRIDOR, *TREE, OFTEN],
    "outcome_model": [*TOY, *TREE, ODD],
    "outcome_model_shuffled": ["env=pendulum", "eval.episodes=2", *RING, OFTEN],
    "oracle": [*CORRIDOR, *RING, SELDOM],
    "oracle_no_bootstrap": [*TOY, *TREE, OFTEN],
    "oracle_no_prioritisation": [*CORRIDOR, ODD],
    "cvs": [*TOY, *RING, ODD],
    "mmddpg": [*CORRIDOR, *RING, OFTEN],
    "preferential": [*TOY, *RING, ODD],
    "pretrained": ["env=maze", *RING, OFTEN],
    "per dqn": [*DQN, *TREE, OFTEN],
    "aser dqn": [*DQN, *RING, ODD],
}
COMPILED_CASES = {"aser": [*TOY, *TREE, ODD], "per dqn": [*DQN, *RING, OFTEN]}


class Process:
    """A run in a process of its own."""

    def __init__(self, arguments: list[str], folder: Path):
        self.folder, self.began = folder, time.monotonic()
        command = [sys.executable, "-m", "train", *arguments, f"run_dir={folder}"]
        pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen(command, **pipes)

    def step(self) -> int:
        """The step of the last checkpoint, 0 where there is none yet."""
        path = self.folder / checkpoint.NAME
        return checkpoint.load(path)["training"]["step"] if path.exists() else 0

    def wait_for(self, happened) -> bool:
        """Wait until something has happened; False where the run ended before."""
        while self.process.poll() is None and not happened():
            assert time.monotonic() - self.began < SECONDS
            time.sleep(0.002)
        return self.process.poll() is None

    def kill(self) -> bool:
        """Kill it; False where it had ended before."""
        self.process.send_signal(signal.SIGKILL)
        _, said = self.process.communicate()
        assert "Traceback" not in said, said
        return self.process.returncode == -signal.SIGKILL

    def finish(self) -> None:
        _, said = self.process.communicate(timeout=SECONDS)
        assert self.process.returncode == 0, said


def killed_and_resumed(arguments: list[str], moments: list, folder: Path) -> int:
    """Kill a run at each moment, a function that waits for it, and let it finish.

    The run is started with resume=true each time. Returns how many kills met a running process.
    """
    kills = 0
    for moment in moments:
        process = Process([*arguments, "resume=true"], folder)
        moment(process)
        kills += process.kill()
    Process([*arguments, "resume=true"], folder).finish()
    return kills


def starting(seconds: float):
    """A moment after so many seconds, while the process still starts or has just begun."""
    return lambda process: process.wait_for(lambda: time.monotonic() - process.began > seconds)


def past(step: int, seconds: float):
    """A moment so many seconds after the checkpoint of a step."""

    def moment(process: Process) -> None:
        process.wait_for(lambda: process.step() >= step)
        time.sleep(seconds)

    return moment


def saving(step: int):
    """A moment while a checkpoint is being written, after that of a step."""

    def moment(process: Process) -> None:
        process.wait_for(lambda: process.step() >= step)
        process.wait_for(lambda: any(process.folder.glob(f".{checkpoint.NAME}.*")))

    return moment


def check(name: str, arguments: list[str], tmp_path: Path, seed: str) -> None:
    chance = random.Random(seed)
    sampler = name.split()[0]
    arguments = [*SMALL, f"sampler={sampler}", *arguments]
    straight = Process(arguments, tmp_path / "straight")
    straight.finish()
    at = sorted(chance.sample(range(7, STEPS - 70), 3))
    moments = [starting(chance.uniform(0.5, 5)), past(at[0], chance.uniform(0, 0.4))]
    moments += [saving(at[1]), past(at[2], chance.uniform(0, 0.4))]
    kills = killed_and_resumed(arguments, moments, tmp_path / "killed")
    assert kills == len(moments)
    assert differing(*(results(tmp_path / run) for run in ("killed", "straight"))) == []
    left = [{path.name for path in (tmp_path / run).iterdir()} for run in ("killed", "straight")]
    assert left[0] == left[1]  # no half-written file stays


@pytest.mark.slow
def test_a_run_killed_before_its_first_checkpoint_begins_again(tmp_path):
    arguments = [*SMALL, *TOY, "sampler=aser", "steps=120", "checkpoint.every=60"]

    def begun(process: Process) -> None:
        assert process.wait_for((process.folder / "config.yaml").exists)
        time.sleep(0.1)

    assert killed_and_resumed(arguments, [begun], tmp_path / "killed") == 1
    assert train.main([*arguments, f"run_dir={tmp_path / 'straight'}"]) == 0
    assert differing(*(results(tmp_path / run) for run in ("killed", "straight"))) == []


def test_the_cases_hold_rings_that_wrap_and_trees():
    lanes = {"ring": 40, "tree": 110_000}
    kinds = {name: type(priorities.make(2, size)) for name, size in lanes.items()}
    assert kinds == {"ring": priorities.FlatPriorities, "tree": priorities.TreePriorities}
    assert 2 * lanes["ring"] < STEPS
    assert {name.split()[0] for name in CASES} == set(train.names(train.CONF, "sampler"))


def test_a_tree_that_is_loaded_is_the_tree_that_was_saved():
    """Draws go by its sums, so no rounding may differ either."""
    numbers = torch.Generator().manual_seed(0)
    tree, loaded = (priorities.TreePriorities(2, 110_000) for _ in range(2))

    def mass(*shape: int) -> torch.Tensor:
        return torch.rand(shape, dtype=torch.float64, generator=numbers) ** 0.3

    for item in range(300):
        tree.append(item, mass(2))
    for _ in range(50):
        tree.write(torch.randint(300, (2, 5), generator=numbers), mass(2, 5))
    loaded.load_state_dict({"mass": tree.mass.clone()})
    for level in ("sums", "most", "least"):
        assert differing(getattr(loaded, level), getattr(tree, level)) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_killed_four_times_and_resumed_is_as_if_nothing_had_happened(name, tmp_path):
    check(name, CASES[name], tmp_path, name)


@pytest.mark.slow
@pytest.mark.skipif(why_not_compiled() is not None, reason="no C++ compiler or no Python.h")
@pytest.mark.parametrize("name", COMPILED_CASES)
def test_compiled_runs_too(name, tmp_path):
    check(name, [*COMPILED_CASES[name], *COMPILED], tmp_path, f"{name} compiled")
