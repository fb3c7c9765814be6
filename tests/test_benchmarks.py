"""The speed measurements: their command line, their names and their picture."""

import ast
import importlib
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "benchmarks"


@pytest.fixture
def measure(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module("measure")


def command(*arguments):
    line = [sys.executable, str(FOLDER / "measure.py"), *arguments]
    return subprocess.run(line, capture_output=True, text=True)


def test_help_lists_every_part(measure):
    shown = command("--help")
    assert shown.returncode == 0, shown.stderr
    for part in [*measure.PARTS, "picture"]:
        assert f"  {part} " in shown.stdout


def test_an_unknown_part_is_one_clear_line():
    refused = command("speed")
    assert refused.returncode == 2
    assert refused.stderr.splitlines()[-1].endswith(
        "speed: there is no such part; allowed: peers, steps, breakdown, ceiling, replay, cores, "
        "process, scaling, gpu, picture"
    )


def test_every_worker_that_is_measured_exists(measure):
    tree = ast.parse((FOLDER / "measure.py").read_text())
    names = {
        (node.value.id, node.attr)
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id in ("workers", "peers")
    }
    assert {("workers", "ours"), ("peers", "sb3")} <= names
    for module, name in names:
        assert hasattr(getattr(measure, module), name), f"{module}.{name}"


def test_a_worker_runs_in_a_process_of_its_own(measure):
    overrides = ["sampler=uniform", "seeds=2", "compile=false"]
    result = measure.work(measure.workers.ours, overrides=overrides, steps=2, warm=1)
    assert result["per_second"] > 0 and result["bytes_per_step"] > 0


def test_a_worker_that_fails_says_why(measure):
    with pytest.raises(SystemExit, match="(?s)benchmark: ours.*sampler=nosuch: must be one of"):
        measure.work(measure.workers.ours, overrides=["sampler=nosuch"])


def test_the_picture_is_drawn_from_the_committed_tables(measure, tmp_path):
    for table in ("peers", "steps", "scaling"):
        shutil.copy(ROOT / "results" / "benchmarks" / f"{table}.csv", tmp_path)
    path = measure.picture.draw(tmp_path)
    assert path == tmp_path / "speed.png" and path.stat().st_size > 10_000
