"""Several runs of one command: what is said before, and what a failure or Ctrl-C leaves."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import train

ROOT = Path(train.__file__).resolve().parent.parent
TINY = ["debug=smoke", "hyper=thesis", "env.layout=toy"]
TINY += ["batch=6", "learning_starts=10", "steps=30"]


def test_different_sets_of_hyper_parameters_are_said():
    def configs(*lines):
        return [train.settings(line.split()) for line in lines]

    alike = configs("sampler=uniform hyper=thesis", "sampler=per hyper=thesis")
    assert list(train._different_sets(alike)) == []
    mixed = configs(
        "sampler=uniform hyper=sb3", "sampler=aser hyper=thesis", "sampler=per hyper=thesis"
    )
    line = "maze: the jobs take their hyper-parameters from different sets (sb3: uniform; "
    assert list(train._different_sets(mixed)) == [line + "thesis: aser, per)"]
    elsewhere = configs("sampler=uniform hyper=thesis", "env=pendulum sampler=per hyper=sb3")
    assert list(train._different_sets(elsewhere)) == []


def test_one_failing_job_stops_no_other(tmp_path):
    (tmp_path / "per").mkdir()
    (tmp_path / "per" / "thesis.tex").write_text("years")
    # In a process of its own: Hydra closes the log handlers of the one that it runs in.
    words = [*TINY, "sampler=uniform,per,nstep", "run_dir=${sampler}", "hydra/launcher=basic"]
    process = subprocess.run(
        [sys.executable, "-m", "train", "-m", *words], cwd=tmp_path, capture_output=True, text=True
    )
    assert process.returncode == 1
    message = process.stderr.splitlines()[-1]
    assert message.startswith("train: 1 of 3 jobs failed: run_dir=per: holds other files than")
    *_, head, uniform, per, nstep, after = process.stdout.splitlines()
    assert head.split() == ["overrides", "score", "folder"]
    assert re.fullmatch(r"sampler=uniform +-\d+(\.\d+)?  uniform", uniform)
    assert re.match(r"sampler=per + -  failed: run_dir=per: holds other files than", per)
    assert re.fullmatch(r"sampler=nstep +-\d+(\.\d+)?  nstep", nstep)
    assert after == f"next: python {ROOT}/scripts/compare.py uniform nstep"
    assert (tmp_path / "uniform/summary.json").exists()
    assert (tmp_path / "nstep/summary.json").exists()
    assert [path.name for path in (tmp_path / "per").iterdir()] == ["thesis.tex"]


def test_after_ctrl_c_every_job_has_saved_and_goes_on(tmp_path):
    words = [*TINY, "steps=20000", "sampler=uniform,per", f"run_dir={tmp_path}/${{sampler}}"]
    folders = [tmp_path / sampler for sampler in ("uniform", "per")]
    process = subprocess.Popen(
        [sys.executable, "-m", "train", "-m", *words, "checkpoint.every=20"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    began = time.monotonic()
    while not all((folder / "checkpoint.pt").exists() for folder in folders):
        assert process.poll() is None and time.monotonic() - began < 120
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in err
    assert out.count("stopped at step ") == 2 and out.count("resume=true goes on") == 2
    assert err.splitlines()[-1] == "train: interrupted; the same command with resume=true goes on"
    for folder in folders:
        begun = {"config.yaml", "checkpoint.pt", "returns.csv", "diagnostics.csv"}
        assert {path.name for path in folder.iterdir()} == begun


ON_A_CLUSTER = """
import os, sys
from pathlib import Path

import train
from aser.settings import compose

def job(composed):
    if composed["sampler"] == "per":
        raise SystemExit(143)
    return {"score": 1.5, "folder": "x"}

words = ["sampler=uniform,per,nstep", "hydra/launcher=basic", "hydra.sweep.dir=here"]
try:
    for one in compose.launch(job, words, Path(sys.argv[1]), "train"):
        print(one.number, one.overrides, one.failed, one.returned)
except KeyboardInterrupt:
    print("interrupted")
"""


def test_on_a_cluster_one_stopped_job_stops_no_other(house):
    def said(**more):
        command = [sys.executable, "-c", ON_A_CLUSTER, str(house / "conf")]
        environment = {**os.environ, **more}
        return subprocess.run(
            command, cwd=house, env=environment, capture_output=True, text=True, check=True
        ).stdout.splitlines()

    assert said(SUBMITIT_EXECUTOR="slurm")[-3:] == [
        "0 ['sampler=uniform'] None {'score': 1.5, 'folder': 'x'}",
        "1 ['sampler=per'] stopped; the same command with resume=true goes on None",
        "2 ['sampler=nstep'] None {'score': 1.5, 'folder': 'x'}",
    ]
    assert said()[-1] == "interrupted"


A_DEATH = """
import os, signal, sys
from pathlib import Path

from aser.settings import compose

def job(composed):
    if composed["sampler"] == "per":
        os.kill(os.getpid(), signal.SIGKILL)
    return {"score": 1.5, "folder": "x"}

words = ["sampler=per,uniform", "hydra/launcher=submitit_local", "hydra.sweep.dir=here"]
for one in compose.launch(job, words, Path(sys.argv[1]), "train"):
    print(one.number, one.overrides, one.failed, one.returned)
"""


@pytest.mark.slow
def test_on_a_cluster_a_killed_job_is_told_and_the_others_are_awaited(house):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    command = [sys.executable, "-c", A_DEATH, str(house / "conf")]
    done = subprocess.run(command, cwd=house, capture_output=True, text=True)
    killed, other = done.stdout.splitlines()[-2:]
    assert re.match(
        r"0 \['sampler=per'\] ended without a result \(\w+; its log is \S+_log.err\); "
        "the same command with resume=true goes on None",
        killed,
    ), done.stderr
    assert other == "1 ['sampler=uniform'] None {'score': 1.5, 'folder': 'x'}"
    assert "Traceback" not in done.stderr
