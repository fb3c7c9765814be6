"""The tables of docs/field.md, from made-up runs of known areas."""

import pandas as pd
import pytest

import train
from aser.study import specs
from aser.study.plots.field import field as picture
from aser.study.report import claims, field
from aser.study.tables import returns, scores

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


@pytest.fixture
def elsewhere(tmp_path, few_resamples):
    """Two environments, one without a best return. There, the runs of number n have -100 n."""
    spec = specs.load(train.CONF / "figure", "field_elsewhere")
    (tmp_path / "beyond").mkdir()
    rows = []
    for where, _ in spec.runs():
        sparse = where["panel"] == "sparse"
        number = list(spec.panels[0].runs).index(where["label"])
        env = "maze_sparse large" if sparse else "pendulum"
        level = 0.0 if sparse else -100.0 * number
        rows += [
            {**where, "env": env, "seed": seed, **dict.fromkeys(STEPS, level)} for seed in SEEDS
        ]
    pd.DataFrame(rows).to_csv(tmp_path / f"{spec.path}.csv", index=False)
    known = {"env": ["maze_sparse large", "pendulum"], "best": [0.0, -50.0], "worst": -9e3}
    references = pd.DataFrame({**known, "random": -4e3, "solvable": [True, False]})
    references.to_csv(tmp_path / "references.csv", index=False)
    found = claims.Tables(train.CONF, tmp_path)
    scores.write(found.path(spec.name), found.references, tmp_path)
    return spec, found


def test_where_no_best_return_is_known_no_run_is_called_solved(elsewhere):
    _, tables = elsewhere
    lines = field.page(tables, QUESTIONS, claims.outcomes(QUESTIONS, tables))["field_elsewhere"]
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ")]
    solved = {row[2] for row in rows if row[0] != "sampler" and "---" not in row[0]}
    assert solved == {"100%", "-"}
    (recent,) = [row for row in rows if row[0] == "Recent items" and row[2] == "-"]
    assert recent[1:5] == ["-100 [-100, -100]", "-", "-100 [-100, -100]", "**no**"]


def test_panels_of_other_environments_share_no_axis(elsewhere, tables):
    for spec, known, shared in ((*elsewhere, False), (None, tables, True)):
        spec = spec or specs.load(train.CONF / "figure", "replay_volume")
        rows = returns.read(known.path(spec.name))
        if shared:  # a second panel of the same environments
            rows = pd.concat([rows, rows.assign(panel=spec.panels[1].key)])
        measured = returns.read(known.folder / scores.FOLDER / f"{spec.name}.csv")
        second = measured.assign(panel=spec.panels[1].key)
        measured = pd.concat([measured, second]) if shared else measured
        page = picture(spec, rows, measured)
        first, below = page.axes[0], page.axes[2]
        assert first.get_shared_x_axes().joined(first, below) == shared


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
