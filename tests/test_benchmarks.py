"""The speed measurements: their command line, their names and their picture."""

import ast
import importlib
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from aser import provenance

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
        "speed: there is no such part; allowed: peers, rejax, steps, breakdown, update, ceiling, "
        "environments, stepping, replay, cores, process, startup, scaling, gpu, picture"
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


def test_the_file_of_a_worker_is_found_behind_its_decorator(measure):
    for worker in (measure.workers.ours, measure.workers.breakdown):  # the second has one
        assert measure.source(worker) == str(FOLDER / "workers.py")


def test_a_worker_that_fails_says_why(measure):
    with pytest.raises(SystemExit, match="(?s)benchmark: ours.*sampler=nosuch: must be one of"):
        measure.work(measure.workers.ours, overrides=["sampler=nosuch"])


def test_the_picture_is_drawn_from_the_committed_tables(measure, tmp_path):
    for table in ("rejax", "peers", "steps", "breakdown", "scaling"):
        shutil.copy(ROOT / "results" / "benchmarks" / f"{table}.csv", tmp_path)
    path = measure.picture.draw(tmp_path)
    assert path == tmp_path / "speed.png" and path.stat().st_size > 10_000


def test_every_part_of_a_step_is_in_the_picture(measure):
    """A part that it does not know would be missing from the bars."""
    parts = pd.read_csv(ROOT / "results" / "benchmarks" / "breakdown.csv")["part"]
    known = [part for parts in measure.picture.WHERE.values() for part in parts]
    assert sorted(known) == sorted(set(parts) - {"whole step"})


def test_the_parts_of_an_update_have_all_its_work(measure):
    workers = measure.workers
    # By hand, with 3 units, 256 items, 4 + 2 inputs of a critic and 4 outputs of the actor.
    actor, critic = 2 * 256 * 3 * (4 + 4), 2 * 256 * 3 * (6 + 1)
    to_hidden = {"critic": 2 * 256 * 3 * 1, "actor": 2 * 256 * 3 * 4}
    flops = {part: workers.update_flops([3], parts=[part]) for part in workers.PASSES}
    assert flops["targets"] == actor + 2 * critic
    assert flops["critics"] == 2 * (2 * critic + to_hidden["critic"])
    assert flops["actor"] == 2 * actor + to_hidden["actor"] + 2 * 2 * critic
    assert sum(flops.values()) == workers.update_flops([3])


def test_the_page_on_speed_has_the_table_of_the_samplers(measure):
    page = (ROOT / "docs" / "speed.md").read_text()
    rows = pd.read_csv(ROOT / "results" / "benchmarks" / "steps.csv")
    assert "\n".join(measure.picture.shown(rows)) in page


def test_two_trainings_take_turns_in_one_process(measure, monkeypatch):
    words = ["seeds=2", "batch=8", "compile=false"]
    one, other = ([f"sampler={name}", *words] for name in ("nstep", "uniform"))
    monkeypatch.setattr(measure.workers, "SETTLED", 2)
    result = measure.workers.in_turns(one, other, turns=3, steps=2)
    assert len(result["ratios"]) == 3 and min(result["ratios"]) > 0


@pytest.mark.parametrize(("step", "status"), [(11, 0), pytest.param(99, 1, marks=pytest.mark.slow)])
def test_a_run_ends_at_its_first_update(measure, tmp_path, step, status):
    words = ["env=maze", "env.layout=toy", "sampler=uniform", "seeds=2", "batch=8", "steps=20"]
    words += ["learning_starts=10", "compile=false", "eval.every=null", f"run_dir={tmp_path}"]
    line = [sys.executable, "-c", measure.FIRST_UPDATE, str(step), *words]
    done = subprocess.run(line, capture_output=True, text=True)
    assert done.returncode == status, done.stderr
    assert ("ended before its first update" in done.stderr) == bool(status)
    assert (tmp_path / "summary.json").exists() == bool(status)


def test_the_table_names_the_code_of_the_workers(measure):
    assert measure.work(measure.workers.code)["code"] == provenance.code_digest()


def test_the_page_on_stable_baselines3_has_the_table_of_its_runs(monkeypatch):
    pytest.importorskip("stable_baselines3")
    monkeypatch.syspath_prepend(FOLDER)
    sb3 = importlib.import_module("sb3")
    page = (ROOT / "docs" / "sb3.md").read_text()
    rows = pd.concat([pd.read_csv(sb3.TABLE), *sb3.of_figures()])
    assert set(rows["env"]) == set(sb3.SETTINGS)
    assert "\n".join(sb3.shown(rows)) in page
    first = rows[(rows["env"] == "maze") & (rows["sampler"] == "uniform") & (rows["seed"] < 8)]
    assert "1.17 [0.18, 2.16]" in sb3.shown(first)[-1] and "1.17 [0.18, 2.16]" in page


@pytest.fixture
def cliffwalk(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module("cliffwalk")


@pytest.mark.parametrize("n", [1, 2, 5])
def test_the_memory_of_the_cliffwalk_holds_all_sequences(cliffwalk, n):
    memory = cliffwalk.chain(n)
    assert len(memory.state) == 2 ** (n + 1) - 2
    pays = (memory.state == n - 1) & (memory.right == 1)
    assert pays.sum() == 1
    starts = (memory.state == 0).sum()
    assert starts == 2**n  # one for each sequence


def test_the_true_values_of_the_cliffwalk_have_no_td_error(cliffwalk):
    memory = cliffwalk.chain(4)
    values = memory.values()
    assert values[:, 1].tolist() == [0.75**3, 0.75**2, 0.75, 1.0]
    error = cliffwalk.td_errors(values[None], memory.state[None], memory.right[None], memory.gamma)
    assert error.abs().max() < 1e-12


def test_per_helps_in_the_cliffwalk_and_the_oracle_more(cliffwalk):
    needed = {name: np.median(cliffwalk.updates(name, 5, 9)) for name in cliffwalk.SAMPLERS}
    assert needed["oracle"] < 0.7 * needed["per"] < 0.7**2 * needed["uniform"]


def test_the_committed_cliffwalk_is_what_the_page_says(cliffwalk):
    rows = pd.read_csv(cliffwalk.FOLDER / "cliffwalk.csv")
    medians = rows[rows["states"] == 12].groupby("sampler")["updates"].median()
    page = (ROOT / "docs" / "validation.md").read_text()
    for sampler in cliffwalk.SAMPLERS:
        assert f"{medians[sampler]:,.0f}" in page, sampler
