"""The tables of docs/field.md, from made-up runs of known areas."""

import pandas as pd
import pytest

import train
from aser.study import specs
from aser.study.report import claims, field
from aser.study.tables import scores

QUESTIONS = claims.load(train.CONF / "claims")["beyond"]
STEPS = (100, 200)
SEEDS = range(3)


@pytest.fixture(scope="module")
def tables(tmp_path_factory, few_resamples):
    """Two mazes, three seeds: the sampler of number n has -n, but PER has uniform's return.

    Retrace's target is 1 above the same sampler without it, and the weights change nothing.
    """
    tmp_path = tmp_path_factory.mktemp("tables")
    volume, corrections = (
        specs.load(train.CONF / "figure", name) for name in ("replay_volume", "corrections")
    )
    labels = list(volume.panels[0].runs)
    levels = {label: -float(n) for n, label in enumerate(labels)} | {"per": 0.0}
    (tmp_path / "beyond").mkdir()
    _write(tmp_path, volume, levels)
    corrected = {label: float("retrace" in label) for label in corrections.panels[0].runs}
    _write(tmp_path, corrections, corrected)
    known = {"random": -9.0, "best": 0.0, "worst": -99.0, "solvable": True}
    envs = [f"maze {maze}" for maze in volume.mazes[:2]]
    pd.DataFrame({"env": envs, **known}).to_csv(tmp_path / "references.csv", index=False)
    found = claims.Tables(train.CONF, tmp_path)
    scores.write(found.path(volume.name), found.references, tmp_path)
    return found


def _write(folder, spec, levels):
    rows = []
    for where, _ in spec.runs():
        if where["maze"] <= spec.mazes[1] and where["panel"] == spec.panels[0].key:
            env, level = {"env": f"maze {where['maze']}"}, levels[where["label"]]
            rows += [
                {**where, **env, "seed": seed, **dict.fromkeys(STEPS, level)} for seed in SEEDS
            ]
    pd.DataFrame(rows).to_csv(folder / f"{spec.path}.csv", index=False)


def test_samplers_stand_beside_uniform_the_best_one_first(tables):
    page = field.page(tables, QUESTIONS, claims.outcomes(QUESTIONS, tables))
    assert page["field"] == ["Not run yet."]
    lines = page["replay_volume"]
    assert lines[0] == "*a quarter, 64 items a step*"
    first = [line.strip("| ").split(" | ") for line in lines[4:9]]
    assert [row[0] for row in first][2:] == ["Recent items", "LAP", "ASER, outcome spread"]
    by_name = {row[0]: row[1:] for row in first}
    assert by_name["SAC, uniform"][:2] == ["0.000 [0.000, 0.000]", "100%"]
    level = ["0.000 [0.000, 0.000]", "100%", "0.000 [0.000, 0.000]", "undecided"]
    assert by_name["PER"] == [*level, "0.50 [0.50, 0.50]"]
    behind = ["-3.00 [-3.00, -3.00]", "0%", "-3.00 [-3.00, -3.00]", "**no**"]
    assert by_name["LAP"] == [*behind, "0.000 [0.000, 0.000]"]


def test_each_correction_stands_beside_the_same_sampler_without_it(tables):
    page = field.page(tables, QUESTIONS, claims.outcomes(QUESTIONS, tables))
    rows = [line.strip("| ").split(" | ") for line in page["corrections"][2:]]
    found = {row[0]: (row[2], row[3]) for row in rows}
    assert len(found) == 7
    assert found["ASER with Retrace's target is better than without."] == (
        "1.00 [1.00, 1.00]",
        "yes",
    )
    assert found["ASER with SACn's weights is better than without."] == (
        "0.000 [0.000, 0.000]",
        "undecided",
    )
