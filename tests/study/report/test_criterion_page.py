"""The tables of docs/criterion.md and docs/nine_mazes.md, from made-up runs of known areas."""

import numpy as np
import pandas as pd
import pytest

import train
from aser.study import specs
from aser.study.plots.style import CRITERIA
from aser.study.report import claims, criterion

STEPS = (100, 200, 300)
SEEDS = range(5)


@pytest.fixture
def tables(tmp_path):
    """Two mazes and five seeds.

    The sampler of number n has -n in every run. Only ASER has -2 in the first maze and -3 in the
    second. In the last panel every sampler has -2.5.
    """
    (tmp_path / "beyond").mkdir()
    for name in ("nine_mazes", "other_environments"):
        spec, rows = specs.load(train.CONF / "figure", name), []
        labels, last = list(spec.panels[0].runs), spec.panels[-1].key
        for where, _ in spec.runs():
            if where["maze"] > 1:
                continue
            level = -1.0 - labels.index(where["label"])
            if where["panel"] == last:
                level = -2.5
            elif where["label"] == "aser":
                level = -2.0 - where["maze"]
            env = "pendulum" if where["panel"].startswith("pendulum") else "maze large"
            returns = dict.fromkeys(STEPS, level)
            rows += [{**where, "env": env, "seed": seed, **returns} for seed in SEEDS]
        pd.DataFrame(rows).to_csv(tmp_path / f"{spec.path}.csv", index=False)
    columns = ["maze", "label", "seed", "step", "over", "measure"]
    options = range(2), ("uniform", "aser"), SEEDS, STEPS, ("visited", "path"), ("auc", "spearman")
    known = pd.MultiIndex.from_product(options, names=columns).to_frame(index=False)
    known = known.assign(panel="thesis", env="maze large")
    for number, name in enumerate(CRITERIA):
        known[name] = number + known["step"] / 1000
    known.to_csv(tmp_path / "beyond" / "criterion_separation.csv", index=False)
    references = {
        "env": ["maze large", "pendulum"],
        "random": -9.0,
        "best": -1.0,
        "worst": -99.0,
        "solvable": [True, False],
    }
    pd.DataFrame(references).to_csv(tmp_path / "references.csv", index=False)
    return claims.Tables(train.CONF, tmp_path)


def cells(lines, start):
    """The cells behind `start` in the first row that starts so."""
    line = next(line for line in lines if line.startswith(f"| {start} |"))
    return [cell.strip() for cell in line.strip("|").split("|")][1:]


def test_every_sampler_in_the_mazes(tables):
    lines = criterion.mazes(tables, "nine_mazes")
    # Uniform is number 1. It has -1 everywhere, which is the best return, and 1 and 2 over ASER.
    gain = ["-1.00 [-1.00, -1.00]", "100%", "1.50 [1.50, 1.50]", "2", "0"]
    assert cells(lines, "SAC, uniform") == gain
    assert cells(lines, "ASER") == ["-2.50 [-2.50, -2.50]", "0%", "", "", ""]
    loss = ["-3.00 [-3.00, -3.00]", "0%", "-0.50 [-0.50, -0.50]", "0", "1"]
    assert cells(lines, "n-step SAC") == loss
    samplers = [line.split(" | ")[0] for line in lines if line.startswith("| ")]
    assert samplers[:3] == ["| sampler", "| ---", "| SAC, uniform"]  # the best one first


def test_the_answers_with_each_set_of_hyper_parameters(tables):
    questions = claims.load(train.CONF / "claims")["beyond"]
    chosen = [question for question in questions if question.name == "aser_beats_one_step"]
    lines = criterion.answers(tables, chosen, claims.outcomes(chosen, tables))
    no, level = "**no**: -1.50 [-1.50, -1.50]<br>2 no", "undecided: 0.000 [0.000, 0.000]"
    assert cells(lines, "ASER is better than uniform SAC.") == [no, no, f"{level}<br>2 undecided"]


def test_other_environments_lack_some_samplers(tables):
    lines = criterion.elsewhere(tables, "other_environments")
    titles = tables.spec("other_environments").titles
    differences = ["1.00 [1.00, 1.00]", "0.000 [0.000, 0.000]"]
    differences += ["-2.00 [-2.00, -2.00]", "-3.00 [-3.00, -3.00]", "-"]
    assert cells(lines, titles["pendulum_tuned"]) == differences


def test_what_criteria_know_at_the_last_step(tables):
    number = list(CRITERIA).index("q_range")
    value = f"{number + 0.3:.2f}"
    lines = criterion.criteria(tables)
    assert cells(lines, "Q range") == ["ASER", *[f"{value} [{value}, {value}]"] * 3]
    assert len(lines) == 2 + 2 * len(CRITERIA)
    assert np.unique([line.count("|") for line in lines]) == [6]


def test_figures_that_were_not_run_are_said_to_be(tables):
    questions = claims.load(train.CONF / "claims")["beyond"]
    asked = [question for question in questions if question.figure.startswith("outcome_spread")]
    page = criterion.page(tables, asked, claims.outcomes(asked, tables))
    assert page["outcome_spread"] == page["outcome_spread_elsewhere"] == ["Not run yet."]
    for name in ("outcome_spread", "outcome_spread_elsewhere", "outcome_spread_halves"):
        lines = page[f"{name}_answers"]
        members = [question for question in asked if question.family == name]
        assert len(lines) == 2 + len(members) and "not run" in lines[2]
