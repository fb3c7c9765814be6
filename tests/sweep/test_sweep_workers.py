"""Several workers on one study: on a real PostgreSQL, one of them killed; and by Hydra's launcher
for clusters.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import textwrap
import time
from collections import Counter
from pathlib import Path

import optuna
import pandas as pd
import pytest
from optuna.trial import TrialState

from aser.compiled import why_not_compiled
from aser.sweep.queue import slot_of

ROOT = Path(__file__).parents[2]
TOTAL = 40
WORKER = """
    import sys, time
    from aser.sweep.queue import Queue, open_study
    from aser.sweep.space import Range
    from aser.sweep.trials import Outcome
    from aser.sweep.study import tuner, work

    class Slow:
        at_once = 3
        def run(self, values, alive):
            for _ in range(3):
                time.sleep(0.15)
                alive()
            return [Outcome(-v["lr"], 0.0, 0) for v in values]

    study = open_study("shared", sys.argv[1], {"steps": 1}, heartbeat=1, grace=3)
    settings = {"name": "TPESampler", "multivariate": True, "constant_liar": True}
    study.sampler = tuner(settings, 0, int(sys.argv[2]), 0)
    print("ready", flush=True)
    work(Queue(study, {"lr": Range(1e-4, 1e-1, "log")}, int(sys.argv[3]), 1), Slow())
"""


def postgres_binary(name):
    folders = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    return shutil.which(name, path=os.pathsep.join([*map(str, folders), os.environ["PATH"]]))


@pytest.fixture(scope="module")
def postgres():
    """The URL of a server that is started for these tests, on a free port of the loopback."""
    if postgres_binary("initdb") is None:
        pytest.skip("PostgreSQL is not installed (Debian: postgresql)")
    pytest.importorskip("psycopg")
    folder = Path(tempfile.mkdtemp(prefix="aser-postgres-"))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    as_user = []
    if os.getuid() == 0:  # the server refuses to run as root
        as_user = ["runuser", "-u", "postgres", "--"]
        shutil.chown(folder, "postgres")
    data = folder / "data"
    run = {"check": True, "capture_output": True, "cwd": folder}
    initdb = [postgres_binary("initdb"), "-D", data, "-A", "trust", "-U", "tuner", "--no-sync"]
    subprocess.run([*as_user, *initdb], **run)
    options = f"-p {port} -c listen_addresses=127.0.0.1 -c unix_socket_directories= -c fsync=off"
    server = [*as_user, postgres_binary("pg_ctl"), "-D", data, "-w", "-l", folder / "log"]
    subprocess.run([*server, "-o", options, "start"], **run)
    try:
        yield f"postgresql+psycopg://tuner@127.0.0.1:{port}/postgres"
    finally:
        subprocess.run([*server, "-m", "immediate", "stop"], **run)
        shutil.rmtree(folder)


def test_four_workers_of_which_one_is_killed_complete_the_asked_number(postgres, tmp_path):
    script = tmp_path / "worker.py"
    script.write_text(textwrap.dedent(WORKER))
    command = [sys.executable, str(script), postgres]
    workers = [
        subprocess.Popen(
            [*command, str(k), str(TOTAL)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for k in range(4)
    ]
    storage = optuna.storages.RDBStorage(postgres)
    for worker in workers:
        assert worker.stdout.readline() == "ready\n", worker.stderr.read()
    study = optuna.load_study(study_name="shared", storage=storage)
    patience = time.monotonic() + 60
    while not any(trial.state == TrialState.COMPLETE for trial in study.get_trials()):
        assert time.monotonic() < patience
        time.sleep(0.05)
    time.sleep(0.2)  # now every worker is in the middle of something
    workers[1].send_signal(signal.SIGKILL)
    for k, worker in enumerate(workers):
        _, error = worker.communicate(timeout=120)
        assert worker.returncode == (-signal.SIGKILL if k == 1 else 0), error
    trials = study.get_trials()
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    assert Counter(map(slot_of, complete)) == Counter(range(TOTAL))  # none lost, none twice
    assert not [
        trial for trial in trials if trial.state in (TrialState.RUNNING, TrialState.WAITING)
    ]
    assert all(trial.value == -trial.params["lr"] for trial in complete)


@pytest.mark.skipif(why_not_compiled() is not None, reason="eager training would take minutes")
def test_workers_started_by_hydras_launcher_for_clusters(tmp_path):
    """Submitit's local executor: the same jobs as on Slurm, as processes here. The whole command,
    real training.
    """
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    home = tmp_path / "home"
    home.mkdir()
    for name in ("conf", "src", "scripts"):
        shutil.copytree(ROOT / name, home / name)
    words = [
        "-m",
        "hydra/launcher=submitit_local",
        "worker=0,1",
        "env=maze",
        "env.layout=toy",
        "sampler=uniform",
        "trials=6",
        "at_once=2",
        "seeds=2",
        "steps=130",
        "eval.every=65",
        "batch=16",
        "compile=false",
        "selection.trials=2",
        "selection.seeds=2",
        "hydra.launcher.timeout_min=5",
    ]
    environment = {**os.environ, "PYTHONPATH": str(home / "src"), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "scripts/sweep.py", *words],
        cwd=home,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    folder = home / "results" / "sweeps" / "maze-uniform"
    assert len(pd.read_csv(folder / "trials.csv")) == 6
    study = optuna.load_study(study_name="maze-uniform", storage=f"sqlite:///{folder}/study.db")
    complete = [trial for trial in study.get_trials() if trial.state == TrialState.COMPLETE]
    assert Counter(map(slot_of, complete)) == Counter(range(6))
    assert (home / "conf" / "hyper" / "tuned" / "maze" / "uniform.yaml").exists()
