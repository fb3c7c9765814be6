"""The same random settings everywhere, and mixtures of the best of them, from plan to picture."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import yaml

import train
from aser import provenance
from aser.errors import ConfigError
from aser.study.plots import axes
from aser.study.plots import sensitivity as pictures
from aser.study.statistics import sensitivity as statistics
from aser.study.tables import sensitivity as tables
from aser.sweep import sensitivity
from aser.sweep.trials import Trials

WORDS = ("env.layout=toy", "steps=60", "eval.every=20", "learning_starts=10", "batch=5")
WORDS += ("compile=false", "network.hidden=[3]")


@pytest.fixture
def plan():
    mazes = {"still": ("env=maze", *WORDS), "slips": ("env=maze", "env.slip=0.2", *WORDS)}
    whole = sensitivity.load(train.CONF)
    few = replace(whole, settings=3, seeds=2, again=1, again_seeds=3, fresh_seeds=2, at_once=2)
    return replace(few, environments=mazes, samplers=("uniform", "nstep"))


def test_settings_are_the_same_for_all_and_do_not_depend_on_their_number(plan):
    settings = sensitivity.drawn(replace(plan, settings=9), train.CONF)
    assert settings[:3] == sensitivity.drawn(plan, train.CONF)
    assert len({row["lr"] for row in settings}) == 9
    space = yaml.safe_load((train.CONF / "sweep" / "tpe.yaml").read_text())["space"]
    assert set(settings[0]) == set(space)
    for key, limits in space.items():
        high = 10 if key == "h" else limits["high"]
        assert all(limits["low"] <= row[key] <= high for row in settings)


def test_from_the_plan_to_the_picture_and_nothing_is_trained_twice(plan, tmp_path, monkeypatch):
    folders = sensitivity.Folders(train.CONF, tmp_path, tmp_path / "out")
    settings = sensitivity.drawn(plan, train.CONF)

    def everything():
        for part in (sensitivity.random_settings, sensitivity.best_again):
            for env in plan.environments:
                for sampler in plan.samplers:
                    part(plan, env, sampler, settings, folders)
        for sampler in plan.samplers:
            sensitivity.mixtures(plan, sampler, settings, folders)

    everything()
    table = tables.read(folders.out, tables.RANDOM, plan)
    assert len(table) == 2 * 2 * 3 * 2  # environments, samplers, settings, seeds
    one = table[(table["env"] == "slips") & (table["sampler"] == "nstep") & (table["setting"] == 2)]
    assert one["seed"].tolist() == [1000, 1001] and one["value"].between(-300, 0).all()
    for key in ("lr", "gamma", "tau", "h"):
        assert one[key].tolist() == pytest.approx([settings[2][key]] * 2)
    assert table.loc[table["sampler"] == "uniform", "h"].isna().all()

    # The best setting in each environment, and the best over both, with other seeds.
    again = tables.read(folders.out, tables.AGAIN, replace(plan, samplers=("nstep",)))
    first = tables.scored(folders.out, tables.RANDOM, plan)
    best = statistics.candidates(first[first["sampler"] == "nstep"], 1)
    for env, rows in again.groupby("env"):
        assert sorted(set(rows["setting"])) == best[env] and len(best[env]) <= 2
        assert set(rows["seed"]) == {1002, 1003, 1004} and len(rows) == 3 * len(best[env])

    mixed = tables.read_mixtures(folders.out / "mixtures" / "nstep.csv", plan.environments)
    keys = frozenset(("lr", "gamma", "tau", "h"))
    assert {frozenset(), keys} <= set(mixed["own"])
    assert set(mixed["seed"]) == {2000, 2001}
    for row in mixed.to_dict("records"):
        own, common = settings[row["best"]], settings[row["common"]]
        for key in keys:
            assert row[key] == pytest.approx(own[key] if key in row["own"] else common[key])
    runs = tables.everything(folders.out, plan)
    common, own = statistics.best(runs.again[runs.again["sampler"] == "nstep"])
    assert set(mixed["common"]) == {common}
    assert dict(zip(mixed["env"], mixed["best"], strict=True)) == own
    summary = tables.summary(runs)
    assert summary["sampler"].tolist() == ["uniform", "nstep"]
    assert summary["keys"].tolist() == [3, 4]
    assert (summary["dimensions"] <= summary["keys"]).all()
    page = pictures.sensitivity(summary, runs)
    axes.save(page, folders.out / "sensitivity.png")
    assert (folders.out / "sensitivity.png").stat().st_size > 5000

    # A sampler that is no longer in the plan is not in the tables either.
    left = tables.everything(folders.out, replace(plan, samplers=("nstep",)))
    assert set(left.mixtures) == {"nstep"} == set(left.again["sampler"])

    monkeypatch.setattr(Trials, "run", lambda *_: pytest.fail("trained twice"))
    everything()
    left = tables.summary(tables.everything(folders.out, plan))
    pd.testing.assert_frame_equal(left, summary)

    # Rows of other code are trained again, unless make same has found that code to be the same.
    paths = (f"{tables.RANDOM}/still-nstep.csv", f"{tables.MIXTURES}/nstep.csv")
    for path in [folders.out / one for one in paths]:
        kept = path.read_text()
        pd.read_csv(path).assign(code="0123456789ab").to_csv(path, index=False)
        with pytest.raises(pytest.fail.Exception, match="trained twice"):
            everything()
        if path.parent.name == tables.RANDOM:
            path.write_text(kept)
    same = f"code,same_as,shown_by\n{provenance.code_digest()},0123456789ab,make same\n"
    (tmp_path / provenance.SAME_CODE).write_text(same)
    everything()


class Bowls:
    """In the place of Runs: the value is 0 at the best setting of an environment and falls from
    there, steeply in lr and hardly in tau.
    """

    keys, centre = (
        ("lr", "gamma", "tau"),
        {"still": (-3.0, 0.99, -2.0), "slips": (-1.5, 0.99, -1.5)},
    )

    def __init__(self, plan, env, sampler, seeds, folders):
        self.env, self.seeds = env, seeds

    def train(self, settings, at_once):
        lr, gamma, tau = self.centre[self.env]
        found = []
        for row in settings:
            value = -((math.log10(row["lr"]) - lr) ** 2) - (row["gamma"] - gamma) ** 2
            value -= 0.01 * (math.log10(row["tau"]) - tau) ** 2
            kept = {key: row[key] for key in self.keys}
            found.append([{"seed": seed, "value": value, **kept} for seed in self.seeds])
        return found


def test_keys_are_added_in_the_order_of_their_gain(plan, tmp_path, monkeypatch):
    monkeypatch.setattr(sensitivity, "Runs", Bowls)
    plan = replace(plan, settings=60, samplers=("uniform",))
    folders = sensitivity.Folders(train.CONF, tmp_path, tmp_path / "out")
    settings = sensitivity.drawn(plan, train.CONF)
    for part in (sensitivity.random_settings, sensitivity.best_again):
        for env in plan.environments:
            part(plan, env, "uniform", settings, folders)
    sensitivity.mixtures(plan, "uniform", settings, folders)
    mixed = tables.read_mixtures(folders.out / "mixtures" / "uniform.csv", plan.environments)
    one = {frozenset([key]) for key in Bowls.keys}
    assert set(mixed["own"]) == {frozenset(), frozenset(Bowls.keys)} | one
    row = tables.summary(tables.everything(folders.out, plan)).iloc[0]
    assert row["dimensions"] == 1 and row["phi"] == pytest.approx(row["tuned"] - row["common"])
    # Without noise, fresh seeds give the formula of the paper.
    scores = tables.scored(folders.out, tables.RANDOM, plan)
    means = scores.pivot_table(index="setting", columns="env", values="score")
    assert row["phi"] == pytest.approx(means.max().mean() - means.mean(axis=1).max()) != 0
    assert row["chosen"] == pytest.approx(row["phi"]) == row["random"]

    # Other random settings choose other best ones, and their mixtures are trained anew.
    fewer = replace(plan, settings=10)
    for env in plan.environments:
        sensitivity.random_settings(fewer, env, "uniform", settings[:10], folders)
    for env in plan.environments:
        sensitivity.best_again(fewer, env, "uniform", settings[:10], folders)
    assert tables.read(folders.out, tables.AGAIN, plan)["setting"].max() < 10
    sensitivity.mixtures(fewer, "uniform", settings[:10], folders)
    again = tables.read_mixtures(folders.out / "mixtures" / "uniform.csv", plan.environments)
    assert again["best"].max() < 10 and again["common"].max() < 10

    # With another number of seeds, too, they are trained anew.
    more = replace(fewer, again_seeds=5, fresh_seeds=4)
    for env in plan.environments:
        sensitivity.best_again(more, env, "uniform", settings[:10], folders)
    sensitivity.mixtures(more, "uniform", settings[:10], folders)
    assert set(tables.read(folders.out, tables.AGAIN, plan)["seed"]) == set(range(1002, 1007))
    mixed = tables.read_mixtures(folders.out / "mixtures" / "uniform.csv", plan.environments)
    assert set(mixed["seed"]) == set(range(2000, 2004))

    # So they are with other ranges, where the best settings may have the same numbers.
    scaled = [{**row, "tau": row["tau"] / 2} for row in settings[:10]]
    for part in (sensitivity.random_settings, sensitivity.best_again):
        for env in plan.environments:
            part(more, env, "uniform", scaled, folders)
    sensitivity.mixtures(more, "uniform", scaled, folders)
    for row in tables.read(folders.out, tables.AGAIN, plan).to_dict("records"):
        assert row["tau"] == pytest.approx(scaled[row["setting"]]["tau"])
    mixed = tables.read_mixtures(folders.out / "mixtures" / "uniform.csv", plan.environments)
    for row in mixed.to_dict("records"):
        assert any(row["tau"] == pytest.approx(one["tau"]) for one in scaled)

    # An environment that has left the plan is in no table, nor among the mixtures.
    less = replace(more, environments={"still": plan.environments["still"]})
    sensitivity.mixtures(less, "uniform", scaled, folders)
    left = tables.everything(folders.out, less)
    for part in (left.random, left.again, left.mixtures["uniform"]):
        assert set(part["env"]) == {"still"}


def test_names_in_the_picture_are_apart():
    heights = pictures.apart(np.array([0.7, 0.0, 0.01, 1.0, 0.02]), 0.1)
    assert heights == pytest.approx([0.7, 0.0, 0.1, 1.0, 0.2])


def test_a_broken_plan_is_one_line(tmp_path):
    (tmp_path / "sweep").mkdir()
    known = yaml.safe_load((train.CONF / "sweep" / "_sensitivity.yaml").read_text())
    path = tmp_path / "sweep" / "_sensitivity.yaml"
    path.write_text(yaml.safe_dump({**known, "settings": 0}))
    with pytest.raises(ConfigError, match="settings=0"):
        sensitivity.load(tmp_path)
    path.write_text(yaml.safe_dump({**known, "seed": 1}))
    with pytest.raises(ConfigError, match="did you mean seeds"):
        sensitivity.load(tmp_path)
