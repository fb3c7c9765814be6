"""A study's life: who may begin it, more trials for a finished one, names, and where it writes."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import optuna
import pandas as pd
import pytest
from sqlalchemy.exc import OperationalError

import sweep as script
import train
from aser.errors import ConfigError
from aser.settings import compose
from aser.study.plots import sweep as pictures
from aser.sweep import jobs, study, tuned
from aser.sweep.queue import Queue, open_study, slot_of
from aser.sweep.settings import facts_of, listed, read, translated
from aser.sweep.study import tune
from aser.sweep.trials import Outcome, Trials

RESULTS = Path(__file__).parents[2] / "results"
TINY = ["env=maze", "env.layout=toy", "sampler=uniform", "at_once=2", "seeds=2", "batch=8"]
TINY += ["steps=130", "eval.every=65", "compile=false", "selection={trials: 2, seeds: 2}"]


class Quick:
    """In place of Trials: it trains nothing."""

    def __init__(self, config, conf, results, at_once):
        self.at_once = at_once

    def run(self, values, alive=lambda: False):
        alive()
        return [Outcome(-v["lr"], -v["lr"], 0) for v in values]


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The settings and the results of a checkout, where training takes no time."""
    monkeypatch.setattr(study, "Trials", Quick)
    monkeypatch.setattr(tuned, "Trials", Quick)
    monkeypatch.setattr(pictures, "draw", lambda folder: None)
    shutil.copytree(train.CONF, tmp_path / "conf")
    return tmp_path


def composed(*words):
    return compose.compose(translated([*TINY, *words]), train.CONF)


def sweep(place, *words):
    tune(composed(*words), place / "conf", place / "results")


def complete(place, name="maze-uniform"):
    path = place / "results" / "sweeps" / name / "study.db"
    trials = optuna.load_study(study_name=name, storage=f"sqlite:///{path}").get_trials()
    return Counter(slot_of(t) for t in trials if t.state == optuna.trial.TrialState.COMPLETE)


def refused(line, *arguments):
    with pytest.raises(ConfigError) as caught:
        sweep(*arguments)
    assert line in str(caught.value) and "\n" not in str(caught.value)


# Who may begin a study.


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["env=gym", "env.id=Nowhere-v0"], "env.id=Nowhere-v0"),
        (["tuner.name=TPSSampler"], "tuner.name=TPSSampler"),
    ],
)
def test_a_sweep_that_cannot_be_built_leaves_nothing_behind(words, line, tmp_path):
    settings = compose.compose(translated([*TINY[2:], *words]), train.CONF)
    with pytest.raises(ConfigError, match=line):
        tune(settings, train.CONF, tmp_path / "results")
    assert not (tmp_path / "results").exists()


def test_a_sweep_that_fails_before_its_first_trial_leaves_the_study_to_others(place, monkeypatch):
    class Failing(Quick):
        def run(self, values, alive=lambda: False):
            raise ConfigError("env.id=Mine-v0: no such file")

    monkeypatch.setattr(study, "Trials", Failing)
    refused("no such file", place, "trials=50", "steps=200")
    monkeypatch.setattr(study, "Trials", Quick)
    sweep(place, "trials=3", "steps=130")
    assert complete(place) == Counter(range(3))
    known = json.loads((place / "results/sweeps/maze-uniform/sweep.json").read_text())
    assert (known["steps"], known["trials"], known["complete"]) == (130, 3, 3)


def test_a_sweep_that_fails_after_a_trial_keeps_the_study(place, monkeypatch):
    class Failing(Quick):
        rounds = 0

        def run(self, values, alive=lambda: False):
            Failing.rounds += 1
            if Failing.rounds == 2:
                raise ConfigError("env.id=Mine-v0: no such file")
            return super().run(values)

    monkeypatch.setattr(study, "Trials", Failing)
    refused("no such file", place, "trials=5")
    refused("begun with other settings: steps was 130 and is 200", place, "trials=5", "steps=200")
    monkeypatch.setattr(study, "Trials", Quick)
    sweep(place, "trials=5")
    assert complete(place) == Counter(range(5))


@pytest.mark.parametrize(
    ("word", "line"),
    [
        ("sampler=aser criterion=entropy", "criterion.name=entropy: is not that of sampler=aser"),
        ("sampler=per prioritisation.over=batch", "prioritisation.over=batch: is not that of"),
        ("sampler=nstep bootstrap.path_entropy=stored", "bootstrap.path_entropy=stored: is not"),
        ("force=true", "force=true: is of single runs"),
        ("run_dir=here", "run_dir=here: is of single runs"),
    ],
)
def test_a_table_is_of_the_sampler_that_it_is_named_by(word, line, capsys):
    assert script.main([*TINY, *word.split(), "trials=3"]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"sweep: {line}") and said.count("\n") == 1


@pytest.mark.parametrize("name", ["../x", "/tmp/x", ".x", "a/b", "a b", "", "ä", "a" * 101, "1.5"])
def test_a_study_has_a_plain_name(name):
    words = compose.compose(translated(TINY), train.CONF)
    words["sweep"]["study"] = 1.5 if name == "1.5" else name
    with pytest.raises(ConfigError, match="study=.*: must be a plain name"):
        read(words, train.CONF)


@pytest.mark.parametrize("name", ["mine", "maze-uniform_2.b+c=d", "2024"])
def test_plain_names_of_studies(name):
    config, settings = read(composed(f"study='{name}'"), train.CONF)
    assert facts_of(config, settings)["study"] == name
    assert read(composed("study=2024"), train.CONF)[1].study == "2024"


def test_results_that_cannot_be_written_are_one_line(place):
    (place / "results").write_text("a file where the folder should be")
    refused("study=maze-uniform: ", place, "trials=3")


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OperationalError("INSERT", {}, Exception("disk full")), "storage=sqlite:.*disk full"),
        (OSError(28, "No space left on device"), "study=maze-uniform: .*No space left on device"),
    ],
)
def test_a_storage_that_fails_while_trials_run_is_one_line(place, monkeypatch, error, line):
    class Full(Quick):
        def run(self, values, alive=lambda: False):
            raise error

    monkeypatch.setattr(study, "Trials", Full)
    with pytest.raises(ConfigError, match=line) as caught:
        sweep(place, "trials=3")
    assert "\n" not in str(caught.value)


# More trials.


def test_a_finished_study_is_given_more_trials(place, capsys):
    sweep(place, "trials=3")
    folder, table = place / "results/sweeps/maze-uniform", place / "conf/hyper/tuned/maze"
    table = table / "uniform.yaml"
    first = {path.name: path.read_text() for path in folder.glob("*.*s*")}
    assert "of 3 of the study" in table.read_text()
    for trials in (2, 3):
        capsys.readouterr()
        sweep(place, f"trials={trials}")
        assert capsys.readouterr().out == f"maze-uniform: finished; its trials are in {folder}\n"
    sweep(place, "trials=7")
    assert complete(place) == Counter(range(7))
    rows = pd.read_csv(folder / "trials.csv")
    assert len(rows) == 7 and rows["trial"].is_unique
    assert [f"{x:.9g}" for x in rows["value"][:3]] == [
        f"{float(line.split(',')[1]):.9g}" for line in first["trials.csv"].splitlines()[1:]
    ]
    known = json.loads((folder / "sweep.json").read_text())
    assert known["trials"] == known["complete"] == 7
    best = rows.nlargest(2, "value")["trial"]
    assert set(pd.read_csv(folder / "selection.csv")["trial"]) == set(best)
    for path in (table, folder / "tuned.yaml"):
        assert "of 7 of the study maze-uniform" in path.read_text()
    refused("steps was 130 and is 140", place, "trials=9", "steps=140")


def test_trials_of_other_code_and_another_seed_are_told(place, monkeypatch):
    path = place / "results/sweeps/maze-uniform/sweep.json"
    here = study.provenance.code_digest()
    sweep(place, "trials=3", "seed=5")
    known = json.loads(path.read_text())
    assert (known["tuner_seed"], known["code"]) == ("5", here)
    monkeypatch.setattr(study.provenance, "code_digest", lambda: "0123456789ab")
    sweep(place, "trials=7", "seed=8")
    known = json.loads(path.read_text())
    assert (known["tuner_seed"], known["code"]) == ("5 8", f"{here} 0123456789ab")


def test_a_cursor_that_a_stop_left_open_is_no_traceback(tmp_path, capfd):
    """SQLAlchemy logs one where a stop falls into a query."""
    opened = open_study("a", f"sqlite:///{tmp_path}/a.db", {}, heartbeat=60, grace=120)
    pool = opened._storage._backend.engine.pool  # the one that logs
    try:
        raise RuntimeError("within a query")
    except RuntimeError:
        pool.logger.error("Error closing cursor", exc_info=True)
    assert capfd.readouterr().err == ""


def test_a_sweep_of_all_that_was_killed_is_no_success(monkeypatch):
    statuses = iter([0, -9, *[0] * 99])
    monkeypatch.setattr(
        script.subprocess, "Popen", lambda command: SimpleNamespace(wait=lambda: next(statuses))
    )
    monkeypatch.setattr(script.study, "compare", lambda *_: None)
    assert script.tune_all([]) == 1
    assert script.tune_all([]) == 0  # the others all end with 0


def test_more_trials_need_the_database(place):
    sweep(place, "trials=3")
    url = f"sqlite:///{place}/elsewhere.db"
    refused("which is not sqlite", place, "trials=4", f"storage={url}")
    (place / "results/sweeps/maze-uniform/study.db").unlink()
    refused("study=maze-uniform: is finished with 3 trials", place, "trials=4")
    assert not (place / "results/sweeps/maze-uniform/study.db").exists()
    sweep(place, "trials=3")


def test_a_committed_sweep_is_not_begun_anew_for_more_trials(place):
    shutil.copytree(RESULTS / "sweeps" / "corridor-per", place / "results/sweeps/corridor-per")
    words = translated(["env=corridor", "sampler=per", "trials=300"])
    with pytest.raises(ConfigError, match="is finished with 200 trials, and more of them need"):
        tune(compose.compose(words, train.CONF), place / "conf", place / "results")


def test_a_broken_sweep_json_is_one_line(place):
    path = place / "results/sweeps/maze-uniform/sweep.json"
    path.parent.mkdir(parents=True)
    for text in ("{", "[]", "{}", '{"trials": null}'):
        path.write_text(text)
        refused(f"{path}: cannot be read", place, "trials=3")


def test_returns_that_are_no_numbers_end_a_trial_and_count_as_worst(place, monkeypatch):
    """Optuna takes a NaN for a failure, and the trial would be run for ever."""
    trials = Trials(read(composed(), train.CONF)[0], train.CONF, RESULTS, 2)
    evaluate = trials._training.setup.evaluation.__class__.__call__

    def partly_nan(self, agents, poll):
        returns = evaluate(self, agents, poll)
        returns[2] = float("nan")  # the first seed of the second trial
        return returns

    monkeypatch.setattr(trials._training.setup.evaluation.__class__, "__call__", partly_nan)
    first, second = trials.run([{"lr": 0.01}, {"lr": 0.01}])
    assert first.value > -1e9 and second.value == second.final == -float("inf")


def test_a_trial_that_is_given_away_while_it_is_finished_is_no_failure(place, monkeypatch):
    """Another worker tells FAIL between the look at its state and the writing of its value."""
    real, given = Queue._state, []

    def late(queue, trial):
        before = real(queue, trial)
        if not given:
            given.append(trial.number)
            queue.study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
        return before

    monkeypatch.setattr(Queue, "_state", late)
    sweep(place, "trials=3")
    assert given and complete(place) == Counter(range(3))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_while_trials_are_taken_gives_them_back(number, place, monkeypatch):
    """The signal comes inside of Optuna's `ask`, where nobody holds the trial yet."""
    real, before = optuna.Study.ask, signal.getsignal(signal.SIGTERM)

    def ask(self, *arguments):
        trial = real(self, *arguments)
        signal.raise_signal(number)
        return trial

    def stop(number, _):
        raise SystemExit(128 + number)

    sweep(place, "trials=1")  # so that the study is there
    monkeypatch.setattr(optuna.Study, "ask", ask)
    signal.signal(signal.SIGTERM, stop)
    try:
        with pytest.raises((SystemExit, KeyboardInterrupt)):
            sweep(place, "trials=3")
        assert signal.getsignal(signal.SIGTERM) is stop
    finally:
        signal.signal(signal.SIGTERM, before)
    path = place / "results" / "sweeps" / "maze-uniform" / "study.db"
    same = optuna.load_study(study_name="maze-uniform", storage=f"sqlite:///{path}")
    states = Counter(trial.state.name for trial in same.get_trials())
    assert states["RUNNING"] == 0 and states["WAITING"] == 2 and states["COMPLETE"] == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_while_trials_run_waits_for_the_end_of_a_step(number, place, monkeypatch):
    """An exception that is raised inside of torch may become one of torch's own."""

    class Stopped(Trials):
        def run(self, values, alive=lambda: False):
            def noticed():
                at.append(self._training.step)
                if at[-1] == 21:
                    signal.raise_signal(number)
                return alive()

            return super().run(values, noticed)

    def stop(number, _):
        raise SystemExit(128 + number)

    at = []
    monkeypatch.setattr(study, "Trials", Stopped)
    before = {one: signal.signal(one, stop) for one in (signal.SIGINT, signal.SIGTERM)}
    try:
        with pytest.raises(SystemExit) as ended:
            sweep(place, "trials=3")
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)
    assert ended.value.code == 128 + number and at[-1] == 21 and complete(place) == Counter()


def test_a_round_without_complete_trials_is_no_failure(place):
    class Slow(Quick):
        """Taken for dead in its first round, so that another worker has its trials."""

        rounds = 0

        def run(self, values, alive=lambda: False):
            Slow.rounds += 1
            if Slow.rounds == 1:
                name = "maze-uniform"
                url = f"sqlite:///{place}/results/sweeps/{name}/study.db"
                same = optuna.load_study(study_name=name, storage=url)
                for trial in same.get_trials(states=(optuna.trial.TrialState.RUNNING,)):
                    same.tell(trial.number, state=optuna.trial.TrialState.FAIL)
            return super().run(values)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "Trials", Slow)
        sweep(place, "trials=3")
    assert complete(place) == Counter(range(3)) and Slow.rounds == 3


# Several sweeps of one command.


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["steps=130,140"], "steps=130 and steps=140: two jobs would share the study maze-uniform"),
        (["trials=3,4"], "trials=3 and trials=4"),
        (["env.layout=toy,large"], "env.layout=toy and env.layout=large"),
        (["sampler=uniform,per", "study=mine"], "sampler=uniform and sampler=per"),
        (["batch=8,16"], "batch=8 and batch=16"),
        (["seed=0,1"], "seed=0 and seed=1"),
    ],
)
def test_jobs_that_would_share_a_study_are_refused_before_any_begins(words, line, place):
    keys = [word.partition("=")[0] for word in words]
    given = [word for word in TINY if word.partition("=")[0] not in keys]
    with pytest.raises(ConfigError) as caught:
        jobs.launch(translated([*given, *words]), train.CONF, place / "results")
    assert line in str(caught.value) and "study=NAME-${" in str(caught.value)
    assert "\n" not in str(caught.value) and not (place / "results").exists()


def test_jobs_may_share_a_study_as_its_workers_or_have_one_each():
    def check(*words):
        words = translated(words)
        return jobs.check(
            [compose.compose(job, train.CONF) for job in compose.jobs(words, train.CONF)],
            train.CONF,
        )

    check(*TINY, "worker=0,1,2")
    steps = [word for word in TINY if not word.startswith("steps=")]
    check(*steps, "steps=130,140", "study=mine-${steps}")
    check("env=maze,corridor", "sampler=uniform,per")


# A place of one's own.


def test_a_sweep_draws_in_its_own_folder_only(tmp_path):
    sweeps = tmp_path / "results" / "sweeps"
    for name in ("maze-per", "maze-uniform"):
        shutil.copytree(RESULTS / "sweeps" / name, sweeps / name)
    own = shutil.copytree(sweeps / "maze-uniform", sweeps / "maze-mine")
    facts = json.loads((own / "sweep.json").read_text())
    (own / "sweep.json").write_text(json.dumps({**facts, "study": "maze-mine", "sampler": "mine"}))
    for name in ("empty", "broken"):
        (sweeps / name).mkdir()
    (sweeps / "broken" / "sweep.json").write_text("{")
    before = {path: path.read_bytes() for path in sweeps.rglob("*.png") if own not in path.parents}
    pictures.draw(own)
    assert {path: path.read_bytes() for path in before} == before
    assert (own / "sensitivity.png").read_bytes() != before[sweeps / "maze-uniform/sensitivity.png"]


@pytest.mark.parametrize("values", [[-3.0], [-3.0, -3.0], [-np.inf, -np.inf], [-2.0, -np.inf, -1]])
def test_few_and_bad_trials_are_drawn(values, tmp_path):
    folder = shutil.copytree(RESULTS / "sweeps" / "maze-per", tmp_path / "maze-per")
    rows = pd.read_csv(folder / "trials.csv").head(len(values)).assign(value=values)
    rows.to_csv(folder / "trials.csv", index=False)
    for path in folder.glob("*.png"):
        path.unlink()
    pictures.draw(folder)
    assert len(list(folder.glob("*.png"))) == 4


def test_comparing_draws_the_committed_pictures_and_no_ones_own(tmp_path):
    """What `all` and `report` draw is what is committed, whatever sweeps of one's own there are."""
    results = tmp_path / "results"
    for env, sampler in listed(train.CONF):
        shutil.copytree(RESULTS / f"sweeps/{env}-{sampler}", results / f"sweeps/{env}-{sampler}")
    own = shutil.copytree(results / "sweeps/maze-uniform", results / "sweeps/maze-mine")
    for path in results.rglob("sensitivity.png"):
        path.write_bytes(b"")
    study.compare(train.CONF, results)
    for env, sampler in listed(train.CONF):
        name = f"sweeps/{env}-{sampler}/sensitivity.png"
        assert (results / name).stat().st_size > 5000, name
    assert (own / "sensitivity.png").read_bytes() == b""


def test_sweeps_of_other_tasks_steps_seeds_or_agents_are_not_compared(tmp_path):
    facts = json.loads((RESULTS / "sweeps/maze-per/sweep.json").read_text())
    changes = {
        "same": {},
        "steps": {"steps": 300},
        "seeds": {"seeds": 16},  # the best of few seeds looks better
        "task": {"env_settings": facts["env_settings"] | {"layout": "toy"}},
        "agent": {"runs": facts["runs"] | {"agent": {"name": "dqn"}}},
    }
    assert {
        name: pictures._comparable({**facts, **change}) == pictures._comparable(facts)
        for name, change in changes.items()
    } == {"same": True, "steps": False, "seeds": False, "task": False, "agent": False}


def test_the_report_of_ones_own_sweep_is_in_a_place_of_its_own(place, monkeypatch):
    words = translated(["env=gym", "env.id=MountainCarContinuous-v0", *TINY[2:], "trials=3"])
    tune(compose.compose(words, train.CONF), place / "conf", place / "results")
    (folder,) = (place / "results" / "sweeps").iterdir()
    facts = json.loads((folder / "sweep.json").read_text())
    assert facts["env"] == "gym" and facts["default"]
    study.report(place / "conf", place / "results")
    assert not (place / "results/tables").exists()
    rows = pd.read_csv(place / "results/own/tables/tuned.csv")
    assert "tuned" in set(rows["set"]) and set(rows["sampler"]) == {"uniform"}
    study.report(place / "conf", place / "results")
    assert len(pd.read_csv(place / "results/own/tables/tuned.csv")) == len(rows)


def test_a_table_and_a_study_go_by_task(place, monkeypatch):
    """Two tasks of gymnasium share neither."""
    from aser.settings.config import EnvConfig

    monkeypatch.setattr(EnvConfig, "task", property(lambda env: f"{env.name}-{env.id}"))
    words = translated(["env=gym", "env.id=MountainCarContinuous-v0", *TINY[2:], "trials=3"])
    tune(compose.compose(words, train.CONF), place / "conf", place / "results")
    task = "gym-MountainCarContinuous-v0"
    assert [path.name for path in (place / "results/sweeps").iterdir()] == [f"{task}-uniform"]
    tables = place / "conf/hyper/tuned"
    assert (tables / task / "uniform.yaml").is_file() and not (tables / "gym").exists()


def test_pictures_that_a_kill_has_left_out_are_drawn_by_the_same_command(place, monkeypatch):
    def killed(folder):
        (folder / "history.png").touch()
        raise KeyboardInterrupt

    words = ("sampler=uniform", "trials=3")
    monkeypatch.setattr(pictures, "draw", killed)
    with pytest.raises(KeyboardInterrupt):
        sweep(place, *words)
    drawn = []
    monkeypatch.setattr(pictures, "draw", drawn.append)
    sweep(place, *words)
    folder = place / "results" / "sweeps" / "maze-uniform"
    assert drawn == [folder]
    for name in study.PICTURES:
        (folder / name).touch()
    sweep(place, *words)
    assert drawn == [folder]  # they are all there
    sweep(place, "sampler=uniform", "trials=4")
    assert drawn == [folder] * 2  # those of three trials are not kept


SLEEPER = """
import os, signal, sys, time
from pathlib import Path
signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
here = Path(__file__).parent / str(os.getpid())
try:
    here.touch()
    time.sleep(100)
finally:
    here.with_suffix(".ended").touch()
"""


def test_a_stop_of_all_sweeps_stops_each_of_them(tmp_path):
    (tmp_path / "sleeper.py").write_text(SLEEPER)
    pairs = [("maze", name) for name in ("uniform", "per", "aser", "oracle")]
    command = f"""
import signal, sys, sweep
signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
sweep.__file__, sweep.settings.listed = {str(tmp_path / "sleeper.py")!r}, lambda conf: {pairs}
sys.exit(sweep.main(["all"]))
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([sys.executable, "-c", command], env=environment)
    until, begun = time.monotonic() + 60, []
    while not begun:
        assert time.monotonic() < until
        time.sleep(0.5)
        begun = [path for path in tmp_path.iterdir() if path.name.isdigit()]
    process.terminate()
    assert process.wait(60) == 143
    begun = [path for path in tmp_path.iterdir() if path.name.isdigit()]
    assert all(path.with_suffix(".ended").exists() for path in begun)
