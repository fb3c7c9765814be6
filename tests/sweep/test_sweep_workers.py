"""Several workers on one study, as real processes: on a PostgreSQL, where two of them are killed;
beside those of another sweep; and by Hydra's launcher for clusters.
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

import train
from aser.compiled import why_not_compiled
from aser.settings import compose
from aser.sweep import settings, space
from aser.sweep.queue import slot_of
from aser.sweep.trials import Trials

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
            for _ in range(45):  # steps
                time.sleep(0.01)
                assert not alive()
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
    data = folder / "data"
    run = {"check": True, "capture_output": True, "cwd": folder}
    if os.getuid() == 0:  # the server refuses to run as root
        run |= {"user": "postgres", "group": "postgres", "extra_groups": []}
        shutil.chown(folder, "postgres")
    initdb = [postgres_binary("initdb"), "-D", data, "-A", "trust", "-U", "tuner", "--no-sync"]
    subprocess.run(initdb, **run)
    options = f"-p {port} -c listen_addresses=127.0.0.1 -c unix_socket_directories= -c fsync=off"
    server = [postgres_binary("pg_ctl"), "-D", data, "-w", "-l", folder / "log"]
    subprocess.run([*server, "-o", options, "start"], **run)
    try:
        yield f"postgresql+psycopg://tuner@127.0.0.1:{port}/postgres"
    finally:
        subprocess.run([*server, "-m", "immediate", "stop"], **run)
        shutil.rmtree(folder)


def test_four_workers_of_which_two_are_killed_complete_the_asked_number(postgres, tmp_path):
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
    time.sleep(0.7)
    workers[2].send_signal(signal.SIGKILL)
    for k, worker in enumerate(workers):
        _, error = worker.communicate(timeout=120)
        assert worker.returncode == (-signal.SIGKILL if k in (1, 2) else 0), error
    trials = study.get_trials()
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    assert Counter(map(slot_of, complete)) == Counter(range(TOTAL))  # none lost, none twice
    assert not [
        trial for trial in trials if trial.state in (TrialState.RUNNING, TrialState.WAITING)
    ]
    assert all(trial.value == -trial.params["lr"] for trial in complete)
    killed = [trial for trial in trials if trial.state == TrialState.FAIL]
    assert killed, "nothing was lost, so nothing was tested"


@pytest.fixture
def home(tmp_path):
    """A checkout without results, where commands run as their user runs them."""
    for name in ("conf", "src", "scripts"):
        shutil.copytree(ROOT / name, tmp_path / "home" / name)
    return tmp_path / "home"


def start_sweep(home, *words):
    environment = {**os.environ, "PYTHONPATH": str(home / "src"), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "scripts/sweep.py", *words]
    run = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=home, env=environment, **run)


def run_sweep(home, *words):
    process = start_sweep(home, *words)
    out, error = process.communicate(timeout=600)
    return subprocess.CompletedProcess(words, process.returncode, out, error)


def complete_trials(home, name):
    url = f"sqlite:///{home}/results/sweeps/{name}/study.db"
    trials = optuna.load_study(study_name=name, storage=url).get_trials()
    return [trial for trial in trials if trial.state == TrialState.COMPLETE]


SMALL = ["env=maze", "env.layout=toy", "seeds=2", "eval.every=40", "batch=8", "compile=false"]
SMALL += ["selection={trials: 2, seeds: 2}"]


@pytest.mark.slow
def test_what_each_worker_of_each_sweep_trains_is_what_was_asked(home):
    """The sampler, the steps and all else: every trial has the value of the same training here."""
    asked = [*SMALL, "steps=120", "trials=10", "at_once=1"]
    broken = home / "results" / "sweeps" / "maze-nstep"
    broken.mkdir(parents=True)
    (broken / "sweep.json").write_text("{")
    done = run_sweep(home, "-m", "sampler=uniform,per,nstep", "workers=2", *asked)
    # One job fails, at once and in one line, which is said again at the end. The others go on.
    line = f"{broken / 'sweep.json'}: cannot be read"
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    assert done.stderr.rstrip().splitlines()[-1].startswith(f"sweep: failed: {line}"), done.stderr
    workers = set()
    for sampler in ("uniform", "per"):
        trials = complete_trials(home, f"maze-{sampler}")
        assert Counter(map(slot_of, trials)) == Counter(range(10))
        workers |= {trial.user_attrs["worker"] for trial in trials}
        words = settings.translated([*asked, f"sampler={sampler}"])
        config, _ = settings.read(compose.compose(words, train.CONF), train.CONF)
        assert (config.sampler, config.steps, len(config.seeds)) == (sampler, 120, 2)
        here = Trials(config, train.CONF, ROOT / "results", 10)
        values = [space.values_of(trial.params) for trial in trials]
        used = {"lr", "gamma", "tau"} | ({"alpha"} if sampler == "per" else set())
        assert all(set(value) == used for value in values)
        expected = [outcome.value for outcome in here.run(values)]
        assert [trial.value for trial in trials] == expected and len(set(expected)) > 1
        table = home / "conf" / "hyper" / "tuned" / "maze" / f"{sampler}.yaml"
        assert f"study maze-{sampler}" in table.read_text()
    assert workers == {0, 1}


def test_a_stopped_sweep_stops_its_workers_and_gives_its_trials_back(home):
    words = [*SMALL, "sampler=uniform", "steps=120", "trials=400", "at_once=1", "workers=2"]
    process = start_sweep(home, *words)
    while "worker 1" not in (line := process.stdout.readline()):
        assert line, process.stderr.read()
    process.send_signal(signal.SIGTERM)  # to the first worker alone
    _, error = process.communicate(timeout=120)  # the other one's output has ended, too
    assert (process.returncode, error) == (143, "sweep: interrupted; the same command goes on\n")
    url = f"sqlite:///{home}/results/sweeps/maze-uniform/study.db"
    trials = optuna.load_study(study_name="maze-uniform", storage=url).get_trials()
    states = Counter(trial.state for trial in trials)
    assert not states[TrialState.RUNNING] and states[TrialState.COMPLETE]
    held = {slot_of(trial) for trial in trials if trial.state != TrialState.FAIL}
    assert held == set(range(400))


@pytest.mark.slow
def test_a_worker_process_that_fails_is_a_line_and_its_trials_are_done_by_others(home):
    """Its module is there for the first worker and gone when the second one starts."""
    source = home / "src" / "aser" / "sweep" / "trials.py"
    lost = """
    def __init__(self, config: Config, conf: Path, results: Path, at_once: int):
        import os, sys
        if sys.argv[0] == "-c":
            from aser.errors import ConfigError
            raise ConfigError("env.id=Mine-v0: there is no such file any more")
"""
    head = "\n    def __init__(self, config: Config, conf: Path, results: Path, at_once: int):\n"
    assert head in source.read_text()
    source.write_text(source.read_text().replace(head, lost))
    words = [*SMALL, "sampler=uniform", "steps=120", "trials=4", "at_once=2", "workers=2"]
    done = run_sweep(home, *words)
    assert done.returncode == 0 and len(complete_trials(home, "maze-uniform")) == 4
    assert done.stderr.splitlines() == [
        "sweep: env.id=Mine-v0: there is no such file any more",
        "sweep: worker 1 ended with status 1; others did its trials",
    ]


@pytest.mark.skipif(why_not_compiled() is not None, reason="eager training would take minutes")
@pytest.mark.slow
def test_workers_started_by_hydras_launcher_for_clusters(home):
    """Submitit's local executor: the same jobs as on Slurm, as processes here. The whole command,
    real training.
    """
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
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
    done = run_sweep(home, *words)
    assert done.returncode == 0, done.stdout + done.stderr
    folder = home / "results" / "sweeps" / "maze-uniform"
    assert len(pd.read_csv(folder / "trials.csv")) == 6
    assert Counter(map(slot_of, complete_trials(home, "maze-uniform"))) == Counter(range(6))
    assert (home / "conf" / "hyper" / "tuned" / "maze" / "uniform.yaml").exists()
