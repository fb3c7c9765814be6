"""Tuning: the search space, an exact number of trials, trials as lanes, and the seeds that keep
apart.
"""

import json
import math
import subprocess
from collections import Counter
from pathlib import Path

import optuna
import pandas as pd
import pytest
import torch
from optuna.trial import TrialState

import train
from aser import build
from aser.compiled import why_not_compiled
from aser.errors import ConfigError
from aser.settings import compose
from aser.study.plots import sweep as sweeps
from aser.sweep import space, tuned
from aser.sweep.queue import Queue, check_same, open_study, slot_of
from aser.sweep.settings import (
    SELECTION_SEEDS,
    TUNING_SEEDS,
    facts_of,
    listed,
    read,
    seeds_from,
    translated,
)
from aser.sweep.space import Range
from aser.sweep.study import tuner, work
from aser.sweep.trials import Outcome, Trials
from aser.training import frozen

RESULTS = Path(__file__).parents[2] / "results"
SWEEPS = RESULTS / "sweeps"
PLANE = {"lr": Range(1e-4, 1e-1, "log"), "gamma": Range(0.9, 0.999, "log_1_minus")}
TPE = {"name": "TPESampler", "multivariate": True, "constant_liar": True}


class Known:
    """In place of Trials: a function whose best values are known, lr = 1e-2 and gamma = .99."""

    at_once = 5

    def __init__(self, before=lambda values: None):
        self.before = before

    def run(self, values, alive=lambda: None):
        self.before(values)
        alive()
        off = [(math.log10(v["lr"]) + 2, math.log10(1 - v["gamma"]) + 2) for v in values]
        return [Outcome(-(x**2) - y**2, 0.0, 0) for x, y in off]


def a_study(folder, name="known", **facts):
    return open_study(name, f"sqlite:///{folder / 'study.db'}", facts, heartbeat=1, grace=2)


def a_queue(folder, total, seed=3, settings=TPE, name="known", ranges=PLANE):
    study = a_study(folder, name)
    study.sampler = tuner(settings, seed, 0, 0)
    return Queue(study, ranges, total, heartbeat=1)


def params(queue):
    return [trial.params for trial in queue.complete()]


def sweep_settings(*words):
    """The settings of the runs, and those of the sweep, as the command line makes them."""
    return read(compose.compose(translated(words), train.CONF), train.CONF)


# The space.


def test_suggestions_lie_in_their_range_and_are_even_in_their_scale():
    ranges = {
        "lr": Range(1e-4, 1e-1, "log"),
        "gamma": Range(0.9, 0.999, "log_1_minus"),
        "h": Range(1, 20, "whole"),
        "alpha": Range(0.0, 1.5, "linear"),
    }
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    found = pd.DataFrame([space.suggest(study.ask(), ranges) for _ in range(800)])
    for key, own in ranges.items():
        assert found[key].between(own.low - 1e-12, own.high + 1e-12).all()
    assert set(found["h"]) == set(map(float, range(1, 21)))
    middles = {"lr": 10**-2.5, "gamma": 1 - 10**-2, "alpha": 0.75, "h": 10.5}
    for key, middle in middles.items():
        assert 0.44 < (found[key] < middle).mean() < 0.56, key


def test_a_finished_trials_parameters_give_its_values_back():
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    trial = study.ask()
    values = space.suggest(trial, {**PLANE, "h": Range(1, 20, "whole")})
    assert space.values_of(trial.params) == values


@pytest.mark.parametrize(
    ("key", "value", "line"),
    [
        (
            "lr",
            {"low": 0.1, "high": 0.01, "scale": "log"},
            "space.lr.high=0.01: must be > low, which is 0.1",
        ),
        (
            "lr",
            {"low": 0, "high": 0.01, "scale": "log"},
            "space.lr.low=0.0: must be > 0 where the scale is log",
        ),
        (
            "gamma",
            {"low": 0.5, "high": 1, "scale": "log_1_minus"},
            "space.gamma.high=1.0: must be < 1",
        ),
        ("lr", {"low": 0, "high": 1, "scale": "logarithmic"}, "space.lr.scale=logarithmic:"),
        ("lr", {"low": 0, "high": 1}, "space.lr.scale is missing"),
        (
            "lr",
            {"low": 0.2, "high": 1.5, "scale": "whole"},
            "space.lr.low=0.2: must be whole where the scale is whole",
        ),
        (
            "h",
            {"low": 0, "high": 9, "scale": "whole"},
            "space.h.low=0.0: must be a whole num",
        ),
        (
            "tau",
            {"low": 0.1, "high": 3, "scale": "log"},
            "space.tau.high=3.0: must be a finite num",
        ),
        (
            "h",
            {"low": 1, "high": "abc", "scale": "whole"},
            "space.h.high=abc: must be a finite num",
        ),
        ("h", None, "space.h=null: must be a group of settings"),
        ("tua", {"low": 0, "high": 1, "scale": "linear"}, "space.tua="),
    ],
)
def test_a_range_that_is_none_is_one_line(key, value, line):
    with pytest.raises(ConfigError) as caught:
        space.read({key: value})
    assert line in str(caught.value) and "\n" not in str(caught.value)


def test_a_hyper_parameter_that_is_given_is_not_searched():
    config, sweep = sweep_settings("env=maze", "sampler=nstep", "hyper.lr=.01", "hyper.h=3")
    assert set(sweep.space) == {"gamma", "tau"}
    assert config.hyper.values["lr"] == 0.01 and config.hyper.values["h"] == 3
    with pytest.raises(
        ConfigError, match=r"hyper=.*gamma.*tau.*: all that the space has are given"
    ):
        sweep_settings(
            "env=maze", "sampler=uniform", *(f"hyper.{k}=.9" for k in sweep.space), "hyper.lr=.1"
        )


def test_whole_numbers_may_be_written_as_powers_of_ten():
    _, sweep = sweep_settings("env=maze", "sampler=uniform", "trials=1e2", "selection.trials=5e0")
    assert (sweep.trials, sweep.selection["trials"]) == (100, 5)
    assert type(sweep.trials) is type(sweep.selection["trials"]) is int


def test_only_what_a_sampler_uses_is_searched():
    def searched(*words):
        return set(sweep_settings(*words)[1].space)

    assert searched("env=maze", "sampler=uniform") == {"lr", "gamma", "tau"}
    assert searched("env=maze", "sampler=per") == {"lr", "gamma", "tau", "alpha"}
    assert searched("env=maze", "sampler=nstep") == {"lr", "gamma", "tau", "h"}
    assert searched("env=maze", "sampler=oracle") == {"lr", "gamma", "tau", "alpha", "h"}
    assert searched("env=maze", "sampler=aser") == {
        "lr",
        "gamma",
        "tau",
        "alpha",
        "h",
        "k_m",
        "k_s",
    }
    assert searched("env=maze", "sampler=nstep_geometric") == {"lr", "gamma", "tau", "h", "lam"}
    assert searched("env=corridor", "sampler=uniform", "agent=dqn") == {"lr", "gamma"}
    assert searched("env=corridor", "sampler=aser", "agent=dqn") == {
        "lr",
        "gamma",
        "alpha",
        "h",
        "k_m",
        "k_s",
    }


def test_given_steps_win_over_those_of_the_sweep():
    assert sweep_settings("env=maze", "sampler=uniform")[0].steps == 3000
    assert sweep_settings("env=corridor", "sampler=uniform")[0].steps == 2000
    assert sweep_settings("env=maze", "sampler=uniform", "steps=700")[0].steps == 700
    assert sweep_settings("env=maze", "sampler=uniform", "debug=smoke")[0].steps == 300
    for job in compose.jobs(translated(["sampler=uniform,per", "steps=700"]), train.CONF):
        assert read(compose.compose(job, train.CONF), train.CONF)[0].steps == 700
    swept = compose.jobs(translated(["env=maze", "steps=700,800"]), train.CONF)
    found = [read(compose.compose(job, train.CONF), train.CONF)[0].steps for job in swept]
    assert found == [700, 800]


def test_the_agents_name_is_in_the_study_where_it_is_not_sac():
    assert facts_of(*sweep_settings("sampler=per"))["study"] == "maze-per"
    dqn = sweep_settings("env=corridor", "agent=dqn", "sampler=per")
    assert facts_of(*dqn)["study"] == "corridor-dqn-per"
    assert facts_of(*sweep_settings("study=mine"))["study"] == "mine"


# An exact number of trials.


def test_a_sweep_finds_a_known_optimum(tmp_path):
    queue = a_queue(tmp_path, 80)
    work(queue, Known())
    complete = queue.complete()
    best = max(complete, key=lambda trial: trial.value)
    assert len(complete) == 80 and best.value > -0.02
    values = space.values_of(best.params)
    assert 10**-2.2 < values["lr"] < 10**-1.8 and 1 - 10**-1.8 < values["gamma"] < 1 - 10**-2.2


def test_the_same_seed_is_the_same_sweep_trial_for_trial(tmp_path):
    for name in ("one", "two", "other"):
        (tmp_path / name).mkdir()
    one, two = (a_queue(tmp_path / name, 25) for name in ("one", "two"))
    other = a_queue(tmp_path / "other", 25, seed=4)
    for queue in (one, two, other):
        work(queue, Known())
    assert params(one) == params(two) != params(other)


def test_a_trial_that_ask_makes_of_its_own_is_not_counted(tmp_path):
    queue = a_queue(tmp_path, 2)
    queue.fill()
    assert len(queue.pop(5)) == 2 and queue.pop(5) == []
    with pytest.warns(UserWarning, match="Heartbeat"):
        stray = queue.study.ask()  # as by a worker that lost a race for the last trial
    assert slot_of(queue.study.get_trials()[-1]) == -1
    queue.study.tell(stray, -1.0)
    assert queue.complete() == []


def test_a_restarted_sweep_goes_on_where_it_was(tmp_path):
    class Stop(Exception):
        pass

    seen = []

    def before(values):
        if len(seen) == 10:
            raise Stop
        seen.extend(values)

    queue = a_queue(tmp_path, 23)
    with pytest.raises(Stop):
        work(queue, Known(before))
    assert len(queue.complete()) == 10
    again = a_queue(tmp_path, 23)
    work(again, Known())
    assert [slot_of(trial) for trial in again.complete()] == list(range(23))
    assert sum(space.values_of(p) in seen for p in params(again)) == 10
    states = Counter(trial.state for trial in again.study.get_trials())
    assert states[TrialState.RUNNING] == states[TrialState.WAITING] == 0


def test_what_a_dead_worker_held_is_run_by_another(tmp_path):
    import time

    dead = a_queue(tmp_path, 7)
    dead.fill()
    held = dead.pop(3)
    assert len(held) == 3  # and never a sign of life again
    time.sleep(2.5)
    alive = a_queue(tmp_path, 7)
    work(alive, Known())
    assert [slot_of(trial) for trial in alive.complete()] == list(range(7))
    dead.finish(held[0][0], 99.0, {"final": 0.0})  # it was only slow: too late
    assert len(alive.complete()) == 7 and max(trial.value for trial in alive.complete()) <= 0


class Disturbed:
    """A worker's storage where, just before the call number `when`, another fails what runs."""

    def __init__(self, storage, other, when):
        self.storage, self.other, self.when, self.calls = storage, other, when, 0

    def __getattr__(self, name):
        method = getattr(self.storage, name)

        def called(*arguments, **named):
            self.calls += 1
            if self.calls == self.when:
                for trial in self.other._trials((TrialState.RUNNING,)):
                    self.other._fail(trial)
            return method(*arguments, **named)

        return called


def test_another_worker_may_fail_a_trial_at_any_moment(tmp_path):
    """As it does with a slot that was enqueued twice, or with a worker that seems dead."""
    when, calls = 1, 1
    while when <= calls:
        queue, other = a_queue(tmp_path, when), a_queue(tmp_path, when)
        other.fill()
        storage = queue.study._storage = Disturbed(queue.study._storage, other, when)
        for trial, values in queue.pop(1):
            queue.finish(trial, -values["lr"], {"final": 0.0})
        when, calls = when + 1, storage.calls
    assert calls > 10
    work(other, Known())
    assert [slot_of(trial) for trial in other.complete()] == list(range(when - 1))
    assert all(trial.state.is_finished() for trial in other.study.get_trials())


def test_a_slot_enqueued_twice_is_completed_once(tmp_path):
    queue = a_queue(tmp_path, 4)
    queue.fill()
    for slot in range(4):
        queue.study.enqueue_trial({}, user_attrs={"slot": slot})
    work(queue, Known())
    done = [t for t in queue.study.get_trials() if t.state == TrialState.COMPLETE]
    assert sorted(map(slot_of, done)) == [0, 1, 2, 3]
    assert all(trial.state.is_finished() for trial in queue.study.get_trials())


def test_what_a_worker_held_that_died_before_its_first_sign_of_life_is_run_by_another(tmp_path):
    dead = a_queue(tmp_path, 7)
    dead.fill()
    with pytest.warns(UserWarning, match="Heartbeat"):
        held = dead.study.ask()  # killed here
    alive = a_queue(tmp_path, 7)
    alive.heartbeat = 0.1
    work(alive, Known())
    assert [slot_of(trial) for trial in alive.complete()] == list(range(7))
    assert alive.study.get_trials()[held.number].state == TrialState.FAIL


def test_a_finished_study_leaves_nothing_running(tmp_path):
    queue = a_queue(tmp_path, 2)
    queue.fill()
    queue.study.enqueue_trial({}, user_attrs={"slot": 1})
    work(queue, Known())
    queue.study.enqueue_trial({}, user_attrs={"slot": 0})
    with pytest.warns(UserWarning, match="Heartbeat"):
        left = queue.study.ask()  # by a worker that was killed before it saw that the slot is taken
    work(queue, Known())
    assert (
        queue.study.get_trials()[left.number].state == TrialState.FAIL
        and len(queue.complete()) == 2
    )


def test_workers_that_were_asked_for_different_numbers_complete_the_largest(tmp_path):
    few, many = a_queue(tmp_path, 3), a_queue(tmp_path, 7)
    work(few, Known())
    assert [slot_of(trial) for trial in many.complete()] == list(range(7))
    work(many, Known())
    assert few.total == many.total == 7 and len(many.complete()) == 7
    assert Counter(trial.state for trial in many.study.get_trials()) == {TrialState.COMPLETE: 7}


def test_a_worker_that_ends_leaves_alone_what_another_has_just_asked_for(tmp_path):
    few = a_queue(tmp_path, 3)
    work(few, Known())
    many = a_queue(tmp_path, 7)
    many.fill()
    taken = many.pop(2)
    few.close()  # it had seen that all 3 are complete, and not yet that there are 7
    for trial, values in taken:
        many.finish(trial, -values["lr"], {"final": 0.0, "diverged": 0, "seconds": 0.0})
    assert len(many.complete()) == 5
    work(many, Known())
    assert Counter(trial.state for trial in many.study.get_trials()) == {TrialState.COMPLETE: 7}


def test_a_study_with_other_settings_is_refused_in_one_line(tmp_path):
    a_study(tmp_path, steps=3000)
    with pytest.raises(
        ConfigError, match=r"study=known: was begun with other settings: steps was 3000 and is 5000"
    ):
        a_study(tmp_path, steps=5000)


@pytest.mark.parametrize(
    "url", ["nonsense", "sqlite:////nowhere/at/all.db", "postgresql+psycopg://127.0.0.1:1/x"]
)
def test_a_storage_that_cannot_be_opened_is_one_line(url):
    with pytest.raises(ConfigError) as caught:
        open_study("x", url, {}, 1, 2)
    assert str(caught.value).startswith(f"storage={url}: cannot be opened") and "\n" not in str(
        caught.value
    )


def test_an_unknown_tuner_is_one_line():
    with pytest.raises(ConfigError, match=r"tuner.name=TPSSampler"):
        tuner({"name": "TPSSampler"}, 0, 0, 0)
    with pytest.raises(ConfigError, match=r"tuner=RandomSampler: .*multivariate"):
        tuner({"name": "RandomSampler", "multivariate": True}, 0, 0, 0)


# Trials as lanes.

TOY = [
    "env=maze",
    "env.layout=toy",
    "steps=160",
    "eval.every=40",
    "batch=16",
    "hyper=thesis",
    "compile=false",
]
ONE = {"lr": 3e-2, "gamma": 0.95, "tau": 0.03, "alpha": 0.5, "h": 4.0, "k_m": 0.7, "k_s": 0.01}
TWO = {"lr": 1e-3, "gamma": 0.99, "tau": 0.01, "alpha": 1.2, "h": 9.0, "k_m": 0.4, "k_s": 0.1}


def settings(*overrides):
    return train.settings(
        [*TOY, "sampler=aser", "bootstrap.window=13", "seeds=[1000,1001,1002]", *overrides]
    )


@pytest.mark.parametrize(
    "sampler",
    [
        *("aser", "pretrained"),
        *(pytest.param(s, marks=pytest.mark.slow) for s in ("per", "oracle", "nstep_geometric")),
    ],
)
def test_a_trials_value_is_that_of_a_plain_run(sampler):
    """To the bit, at the same number of lanes and window; also of a trial after another."""
    window = [] if sampler == "per" else ["bootstrap.window=13"]
    base = ["seeds=[1000,1001,1002]", f"sampler={sampler}", *window]
    config = train.settings([*TOY, *base])
    values = {
        key: value for key, value in ({**ONE, "lam": 0.6}).items() if key in config.hyper.values
    }
    trials = Trials(config, train.CONF, RESULTS, 1)
    trials.run([{key: value for key, value in ({**TWO, "lam": 0.2}).items() if key in values}])
    outcome = trials.run([values])[0]
    given = [f"hyper.{key}={int(value) if key == 'h' else value}" for key, value in values.items()]
    plain = build.build(train.settings([*TOY, *base, *given]), train.CONF, RESULTS)
    plain.run()
    returns = [returns.mean() for _, returns in plain.history.returns]
    assert len(returns) == 4 and outcome.value == pytest.approx(sum(returns), abs=0)
    assert outcome.final == returns[-1]


@pytest.mark.skipif(why_not_compiled() is not None, reason="nothing can be compiled here")
def test_a_trial_is_the_same_wherever_it_stands_among_others():
    trials = Trials(settings("compile=true", "batch=16"), train.CONF, RESULTS, 2)
    both, turned, one = trials.run([ONE, TWO]), trials.run([TWO, ONE]), trials.run([TWO])
    assert both == turned[::-1] and one == turned[:1]


def test_a_sign_of_life_is_given_at_every_step_and_not_only_at_evaluations():
    steps = []
    trials = Trials(settings("eval.every=160"), train.CONF, RESULTS, 1)
    trials.run([ONE], alive=lambda: bool(steps.append(trials._training.step)))
    assert steps[:159] == list(range(1, 160))
    assert set(steps[159:]) == {160} and len(steps[159:]) > 20  # also within the evaluation


def test_a_sign_of_life_is_recorded_at_most_once_in_a_heartbeat(tmp_path, monkeypatch):
    queue = a_queue(tmp_path, 2)
    queue.fill()
    trials = [trial for trial, _ in queue.pop(2)]
    recorded = []
    monkeypatch.setattr(queue, "_record_heartbeat", recorded.append)
    with queue.holding(trials) as alive:
        assert not any(alive() for _ in range(1000))
    assert len(recorded) == 2  # of both trials once, far within the second of a heartbeat


def test_every_trial_meets_the_same_frozen_agents():
    config = train.settings(
        [*TOY, "sampler=pretrained", "bootstrap.window=13", "seeds=[1000,1001,1002]"]
    )
    values = {key: ONE[key] for key in config.hyper.values if key in ONE}
    training = build.build(config, train.CONF, RESULTS, [values, values])
    frozen = training.setup.buffer.sampler.drawing.function
    p = frozen(torch.rand(6, 4, 5))
    same = frozen(torch.ones(6, 4, 1))
    assert p.shape == (6, 5) and same[:3].equal(same[3:]) and not same[0].equal(same[1])


def test_a_diverged_trial_counts_as_the_worst_and_leaves_its_neighbour_alone():
    trials = Trials(settings(), train.CONF, RESULTS, 2)
    calm = trials.run([ONE, TWO])
    wild = trials.run([{**ONE, "lr": 1e30}, TWO])
    worst = build.build(settings(), train.CONF, RESULTS).setup.envs.worst_return
    assert wild[0].diverged == 3 and wild[0].final == worst
    assert wild[1] == calm[1] and calm[0].diverged == 0


# From the study to the files.


def test_the_best_on_fresh_seeds_is_kept_with_its_provenance(tmp_path, monkeypatch):
    class Fresh:
        def __init__(self, config, conf, results, at_once):
            assert config.seeds == (2000, 2001, 2002, 2003) and at_once == 3

        def run(self, values):
            # Another order than in the sweep.
            return [Outcome(-abs(v["lr"] - 0.02), 0.0, 0) for v in values]

    monkeypatch.setattr(tuned, "Trials", Fresh)
    queue = a_queue(tmp_path, 20)
    work(queue, Known())
    config = train.settings(["env=maze", "sampler=per", "hyper=sb3", "seeds=[1000,1001]"])
    among = {"trials": 3, "seeds": 4}
    row = tuned.select(tmp_path, config, train.CONF, RESULTS, queue.complete(), among)
    rows = pd.read_csv(tmp_path / "selection.csv")
    best = sorted(queue.complete(), key=lambda trial: -trial.value)[:3]
    assert sorted(rows["trial"]) == sorted(trial.number for trial in best)
    assert row["selection_value"] == pytest.approx(rows["selection_value"].max())
    facts = {"study": "known", "trials": 20, "seeds": 2, "selection": among, "steps": 3000}
    path = tmp_path / "hyper" / "tuned" / "maze" / "per.yaml"
    tuned.write_table([path], config, row, facts, train.CONF)
    text = path.read_text()
    assert f"Trial {row['trial']} of 20 of the study known" in text and "commit" in text
    from aser.settings import hyper

    table = hyper.read(path)
    assert (
        table["lr"] == pytest.approx(row["lr"], rel=1e-6)
        and table["alpha"] == config.hyper.values["alpha"]
    )
    assert table.pop("network") == [24]
    assert set(table) == set(config.hyper.values) - {"target_entropy"}
    assert all(isinstance(value, float | int) for value in table.values())


def test_a_tuned_table_has_the_thesis_values_of_what_was_not_used(tmp_path):
    config = train.settings(["env=corridor", "sampler=oracle", "hyper=sb3"])
    searched = {"lr": 0.0125, "gamma": 0.93, "tau": 0.02, "alpha": 0.5, "h": 4}
    row = {"trial": 3, "tuning_value": -1.0, "selection_value": -2.0, **searched}
    facts = {
        "study": "known",
        "trials": 5,
        "seeds": 2,
        "selection": {"trials": 2, "seeds": 3},
        "steps": 200,
    }
    path = tmp_path / "oracle.yaml"
    tuned.write_table([path], config, row, facts, train.CONF)
    from aser.settings import hyper

    table = hyper.read(path)
    assert {key: table[key] for key in searched} == searched
    assert (table["k_m"], table["k_s"], table["epsilon"]) == (0.8506, 0.4457, 0.01)  # Table 1; ours


def test_the_pictures_of_a_sweep_are_drawn_from_its_files_alone(tmp_path):
    ranges = {
        "lr": Range(1e-4, 1e-1, "log"),
        "gamma": Range(0.9, 0.999, "log_1_minus"),
        "h": Range(1, 20, "whole"),
    }
    for name, count in (("one", 30), ("two", 7)):
        (tmp_path / name).mkdir()
        queue = a_queue(tmp_path / name, count, ranges=ranges)
        work(queue, Known())
        tuned.write_trials(tmp_path / name / "trials.csv", queue.complete())
        facts = {"study": name, "env": "maze", "sampler": "per" if name == "one" else "uniform"}
        space_facts = {key: vars(value) for key, value in ranges.items()}
        tuned.write_facts(
            tmp_path / name / "sweep.json", {**facts, "space": space_facts}, queue.complete()
        )
    sweeps.draw(tmp_path / "two")
    assert not list((tmp_path / "one").glob("*.png"))  # it is read, and nothing is written there
    picture = tmp_path / "two" / "sensitivity.png"
    beside = picture.read_bytes()
    sweeps.sensitivity(tmp_path / "two", [])
    assert picture.read_bytes() != beside  # alone, without the other sweep
    assert {path.name for path in (tmp_path / "two").glob("*.png")} == {
        "history.png",
        "importance.png",
        "parallel.png",
        "sensitivity.png",
    }
    trials = pd.read_csv(tmp_path / "one" / "trials.csv")
    study = sweeps.as_study(trials, space_facts)
    first = study.trials[0].params
    assert (
        first["log lr"] == pytest.approx(math.log(trials["lr"][0])) and first["h"] == trials["h"][0]
    )
    assert first["-log(1 - gamma)"] == pytest.approx(-math.log(1 - trials["gamma"][0]))


def test_tuned_and_thesis_values_are_compared_on_the_reported_seeds(tmp_path, monkeypatch):
    seen = []

    class Fresh:
        def __init__(self, config, conf, results, at_once):
            seen.extend(config.seeds)

        def run(self, values):
            return [Outcome(v["lr"], v["tau"], 0) for v in values]

    monkeypatch.setattr(tuned, "Trials", Fresh)
    rows = tuned.reported(
        train.settings(["env=maze", "sampler=per", "seeds=[1000]"]),
        train.CONF,
        RESULTS,
        ("sb3", "thesis"),
    )
    assert seen == list(range(16)) and [row["set"] for row in rows] == ["sb3", "thesis"]
    # Table 1, Table 3.
    assert rows[1]["value"] == pytest.approx(5.192e-2) and rows[0]["value"] == 3e-4
    foreign = train.settings(
        ["env=gym", "env.id=MountainCarContinuous-v0", "sampler=per", "seeds=[1000]"]
    )
    rows = tuned.reported(foreign, train.CONF, RESULTS, ("thesis", "sb3"))
    assert [row["set"] for row in rows] == ["sb3"]


@pytest.mark.parametrize("value", [1e-4, 1.0, 0.1234567891, 20.0, 3.0e-12, 5e-5])
def test_numbers_in_a_table_are_numbers_to_yaml(value):
    import yaml

    assert yaml.safe_load(f"x: {tuned._number(value)}")["x"] == pytest.approx(value, rel=1e-6)


def test_seeds_of_different_use_never_meet():
    uses = {
        "reported": set(range(64)),
        "tuning": set(seeds_from(TUNING_SEEDS, 100)),
        "selection": set(seeds_from(SELECTION_SEEDS, 100)),
        "pretraining": set(frozen.SEEDS),
    }
    assert len(set.union(*uses.values())) == sum(map(len, uses.values()))
    assert max(train.settings(["env=maze"]).seeds) < 64


FINISHED = [
    path for path in sorted(SWEEPS.glob("*/sweep.json")) if json.loads(path.read_text())["default"]
]


def test_everything_that_make_sweep_tunes_is_committed():
    import yaml

    wanted = yaml.safe_load((train.CONF / "sweep" / "_all.yaml").read_text())
    there = {path.parent.name for path in FINISHED}
    assert {f"{env}-{sampler}" for env, samplers in wanted.items() for sampler in samplers} <= there


@pytest.mark.parametrize("path", FINISHED, ids=lambda path: path.parent.name)
def test_the_same_command_finds_a_committed_sweep_finished(path):
    known = json.loads(path.read_text())
    words = [f"{key}={known[key]}" for key in ("env", "sampler")]
    facts = facts_of(*sweep_settings(*words, f"agent={known['runs']['agent']['name']}"))
    check_same(facts["study"], {key: known.get(key) for key in facts}, facts)


@pytest.mark.parametrize("env", sorted({json.loads(path.read_text())["env"] for path in FINISHED}))
def test_the_committed_studies_of_an_environment_had_equal_budgets(env):
    facts = [json.loads(path.read_text()) for path in FINISHED]
    own = [fact for fact in facts if fact["env"] == env]
    budgets = {
        (f["trials"], f["complete"], f["seeds"], f["steps"], str(f["selection"]), str(f["tuner"]))
        for f in own
    }
    assert len(budgets) == 1, budgets
    assert all(f["complete"] == f["trials"] >= 200 and f["seeds"] >= 4 for f in own)
    assert len({json.dumps(f["env_settings"]) for f in own}) == 1
    for fact in own:
        rows = pd.read_csv(SWEEPS / fact["study"] / "trials.csv")
        assert len(rows) == fact["trials"] and rows["trial"].is_unique
        for key, limits in fact["space"].items():
            assert rows[key].between(limits["low"] - 1e-9, limits["high"] + 1e-9).all()
        for other in own:
            shared = set(fact["space"]) & set(other["space"])
            assert all(fact["space"][key] == other["space"][key] for key in shared)


@pytest.mark.parametrize("path", FINISHED, ids=lambda path: path.parent.name)
def test_a_committed_table_is_the_selected_trial_of_its_study(path):
    from aser.settings import hyper

    fact, rows = json.loads(path.read_text()), pd.read_csv(path.with_name("selection.csv"))
    best = rows.loc[rows["selection_value"].idxmax()]
    below = "dqn" if fact["runs"]["agent"]["name"] == "dqn" else ""
    table = hyper.read(
        train.CONF / "hyper" / "tuned" / below / fact["env"] / f"{fact['sampler']}.yaml"
    )
    for key in fact["space"]:
        assert table[key] == pytest.approx(best[key], rel=1e-6)
    assert table["network"] == fact["runs"]["network"]["hidden"]
    top = pd.read_csv(path.with_name("trials.csv")).nlargest(fact["selection"]["trials"], "value")
    assert sorted(top["value"]) == pytest.approx(sorted(rows["tuning_value"]))


def test_git_shows_the_committed_sweeps_and_no_ones_own():
    root = train.CONF.parent

    def ignored(*paths):
        command = ["git", "check-ignore", "--no-index", *paths]
        return subprocess.run(command, cwd=root, capture_output=True, text=True).stdout.split()

    committed = [f"results/sweeps/{env}-{name}/trials.csv" for env, name in listed(train.CONF)]
    committed += [f"conf/hyper/tuned/{env}/{name}.yaml" for env, name in listed(train.CONF)]
    assert ignored(*committed) == []
    own = ["results/sweeps/mine/trials.csv", "results/sweeps/PointMass-v0-aser/sweep.json"]
    own += ["results/sweeps/maze-novel/tuned.yaml", "results/sweeps/maze-aser/study.db"]
    own += ["conf/hyper/tuned/PointMass-v0/aser.yaml", "conf/hyper/tuned/maze/novel.yaml"]
    assert ignored(*own) == own
