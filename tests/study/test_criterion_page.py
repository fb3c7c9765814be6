"""docs/criterion.md: what stands between its marks is what the tables say, and its words quote only such numbers."""

import re

import numpy as np
import pandas as pd
import pytest

import train
from aser.errors import ConfigError
from aser.study import specs
from aser.study.plots import criterion as criterion_figure
from aser.study.plots import differences as forest
from aser.study.report import claims, criterion_page

ROOT = train.CONF.parent
TABLES, PAGE, RULES = (
    ROOT / "results" / "tables",
    ROOT / "docs" / "criterion.md",
    train.CONF / "claims.yaml",
)
PARTS = ("answers", "mazes", "elsewhere", "criteria")
STEPS = (100, 200, 300)


@pytest.fixture
def tables(tmp_path):
    """Runs of known areas, of two mazes and five seeds: a sampler of number n has -n in every run, but for ASER's,
    which has -2 in the first maze and -3 in the second; in the last panel every sampler has -2.5."""
    for name in ("mazes", "elsewhere"):
        spec, rows = specs.load(train.CONF / "figure", name), []
        for place, _ in spec.runs():
            if place["maze"] > 1:
                continue
            number = 1 + list(spec.panels[0].runs).index(place["label"])
            level = -2.0 - place["maze"] if place["label"] == "aser" else -float(number)
            level = -2.5 if place["panel"] == spec.panels[-1].title else level
            env = "pendulum" if "Pendulum" in place["panel"] else "maze large"
            rows += [
                {**place, "env": env, "seed": seed, **dict.fromkeys(map(str, STEPS), level)}
                for seed in range(5)
            ]
        pd.DataFrame(rows).to_csv(tmp_path / f"{name}.csv", index=False)
    rows = [
        {
            "panel": "p",
            "maze": maze,
            "label": label,
            "env": "maze large",
            "seed": seed,
            "step": step,
            "over": over,
            "measure": measure,
            **{name: number + step / 1000 for number, name in enumerate(forest.CRITERIA)},
        }
        for maze in range(2)
        for label in ("uniform", "aser")
        for seed in range(5)
        for step in STEPS
        for over in ("visited", "path")
        for measure in ("auc", "spearman")
    ]
    pd.DataFrame(rows).to_csv(tmp_path / "separation.csv", index=False)
    pd.DataFrame(
        {
            "env": ["maze large", "pendulum"],
            "random": -9.0,
            "best": [-1.0, -1.0],
            "worst": -99.0,
            "solvable": [True, False],
        }
    ).to_csv(tmp_path / "references.csv", index=False)
    return tmp_path


def empty(path, parts=PARTS):
    path.write_text(
        "Words.\n" + "".join(f"<!-- {name}: made -->\nold\n<!-- end -->\nkept\n" for name in parts)
    )
    return path


def cells(text, start):
    """The cells of the first table row that starts so."""
    line = next(line for line in text.splitlines() if line.startswith(f"| {start} |"))
    return [cell.strip() for cell in line.strip("|").split("|")][1:]


def test_the_tables_say_what_the_runs_are(tables):
    page = empty(tables / "page.md")
    criterion_page.write(page, RULES, tables)
    text = page.read_text()
    assert "old" not in text and text.count("Words.") == 1 and text.count("kept") == len(PARTS)
    # Uniform is number 1: -1 everywhere is 1 and 2 more than ASER's -2 and -3, and the best return.
    assert cells(text, "SAC, uniform") == [
        "-1.00 [-1.00, -1.00]",
        "100%",
        "1.50 [1.50, 1.50]",
        "2",
        "0",
    ]
    assert cells(text, "ASER") == ["-2.50 [-2.50, -2.50]", "0%", "", "", ""]
    assert cells(text, "n-step SAC") == [
        "-3.00 [-3.00, -3.00]",
        "0%",
        "-0.50 [-0.50, -0.50]",
        "0",
        "1",
    ]
    assert cells(text, "ASER is better than uniform SAC.") == [
        "**no**: -1.50 [-1.50, -1.50]<br>2 no"
    ] * 2 + ["undecided: 0.000 [0.000, 0.000]<br>2 undecided"]
    assert cells(text, "Q range")[:2] == ["ASER", "4.30 [4.30, 4.30]"]  # the last step's
    assert cells(text, "Pendulum, each tuned") == [
        "1.00 [1.00, 1.00]",
        "0.000 [0.000, 0.000]",
        "-2.00 [-2.00, -2.00]",
        "-3.00 [-3.00, -3.00]",
        "-",
    ]
    again = page.read_text()
    criterion_page.write(page, RULES, tables)
    assert page.read_text() == again


def test_a_page_without_a_place_for_a_table_is_left_as_it_is(tables):
    page = empty(tables / "page.md", PARTS[:-1])
    before = page.read_text()
    with pytest.raises(ConfigError, match=r"page\.md: has no place <!-- criteria: \.\.\. -->"):
        criterion_page.write(page, RULES, tables)
    assert page.read_text() == before


def test_the_figure_shows_differences_to_aser(tables):
    own = claims.Tables(tables)
    figure = criterion_figure.draw(own("mazes"), own("separation"))
    gains, knows = figure.axes
    points = [
        line.get_xdata() for line in gains.lines if line.get_marker() in criterion_figure.MARKERS
    ]
    uniform = [float(x[0]) for x in points[:3]]
    assert uniform == pytest.approx([1.5, 1.5, 0.0])
    assert knows.lines[0].get_ydata() == pytest.approx(np.array(STEPS) / 1000)


def test_the_committed_page_is_what_the_tables_say(tmp_path):
    page = tmp_path / "criterion.md"
    page.write_text(PAGE.read_text())
    criterion_page.write(page, RULES, TABLES)
    assert page.read_text() == PAGE.read_text()


def test_the_words_quote_only_intervals_of_the_tables():
    text = PAGE.read_text()
    made = "\n".join(
        re.findall(r"<!-- (?:answers|mazes|elsewhere|criteria): .*?<!-- end -->", text, re.DOTALL)
    )
    made += (ROOT / "results" / "claims.md").read_text()
    words = re.sub(
        r"<!-- (?:answers|mazes|elsewhere|criteria): .*?<!-- end -->", "", text, flags=re.DOTALL
    )
    quoted = re.findall(r"-?[\d.]+ \[-?[\d.]+, -?[\d.]+\]", words)
    assert quoted, "the page says no number"
    for number in quoted:
        assert number in made, number
