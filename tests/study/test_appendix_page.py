"""docs/appendices.md: what stands between its marks is what the tables say, and its words quote only such numbers."""

import re

import numpy as np
import pandas as pd
import pytest
from test_criterion_page import cells

import train
from aser.study import specs
from aser.study.report import appendix_page
from aser.study.report.claims import Tables

ROOT = train.CONF.parent
TABLES, PAGE = ROOT / "results" / "tables", ROOT / "docs" / "appendices.md"
PARTS = ("corridor", "dqn", "dropoff", "curvature", "mode_prob", "cross", "halves", "neurons")
MADE = f"<!-- (?:{'|'.join(PARTS)}): .*?<!-- end -->"
STEPS, SEEDS = (100, 200), range(3)


def areas(folder, figure, of):
    """The figure's table where every run of a panel and label has `of(panel, label)` in all its evaluations."""
    rows = []
    for place, _ in specs.load(train.CONF / "figure", figure).runs():
        level = of(place["panel"], place["label"])
        rows += [
            {**place, "env": "maze", "seed": seed, **dict.fromkeys(map(str, STEPS), level)}
            for seed in SEEDS
        ]
    pd.DataFrame(rows).to_csv(folder / f"{figure}.csv", index=False)


@pytest.fixture
def tables(tmp_path):
    worst = {"env": ["maze"], "random": -9.0, "best": 0.0, "worst": -99.0, "solvable": True}
    pd.DataFrame(worst).to_csv(tmp_path / "references.csv", index=False)
    for figure in ("figB2", "figB3", "dqn", "figE1", "figE2"):
        areas(tmp_path, figure, lambda _, label: -1.0 - 0.5 * label.count("_"))
    known = ["mode_log_prob", "oracle", "shuffled"]  # 7, 8 and 9; all others have -10 in a half
    level = {name: -7.0 - number for number, name in enumerate(known)}
    areas(
        tmp_path,
        "cross",
        lambda draws, stops: level.get(draws, -10.0) + 2.0 * level.get(stops, -10.0),
    )
    areas(
        tmp_path,
        "capacity",
        lambda count, label: -100.0 / int(count) if label == "uniform" else 0.0,
    )
    return tmp_path


def row(lines, *start):
    return next(line for line in lines if line.startswith("| " + " | ".join(start) + " |"))


def test_areas_differences_and_shares_solved(tables):
    own = Tables(tables)
    dqn = cells("\n".join(appendix_page.dqn(own)), "DQN, ASER")
    assert dqn == ["-1.50 [-1.50, -1.50]", "0/3", "-0.50 [-0.50, -0.50]"]
    assert (
        cells("\n".join(appendix_page.corridor(own)), "PER") == ["-1.00 [-1.00, -1.00]", "0/3"] * 2
    )
    lines = appendix_page.mode_prob(own)
    assert (
        len(lines) == 2 + 1 + 4
    )  # one set of values in the maze; two in Pendulum, online and pretrained
    assert row(lines, "Pendulum", "tuned values", "ASER, pretrained").endswith(
        "| -1.00 [-1.00, -1.00] | -2.00 [-2.00, -2.00] | 1.00 [1.00, 1.00] |"
    )


def test_each_half_of_aser_over_all_criteria_of_the_other(tables):
    lines = appendix_page.cross(Tables(tables))
    others = np.mean([-7.0, -8.0, -9.0] + [-10.0] * 7)
    one = [f"{-7 + 2 * others:.2f}", f"{others - 14:.2f}", "-21.00", "2.00", "4.00", "6.00"]
    found = re.findall(r"(\S+) \[(\S+), (\S+)\]", row(lines, "mode log prob"))
    assert [cell[0] for cell in found] == one and all(len(set(cell)) == 1 for cell in found)
    assert row(lines, "shuffled").endswith("|  |  |  |")
    assert row(lines, "entropy").endswith(
        "-1.00 [-1.00, -1.00] | -2.00 [-2.00, -2.00] | -3.00 [-3.00, -3.00] |"
    )


def test_by_the_number_of_neurons(tables):
    lines = appendix_page.neurons(Tables(tables))
    assert lines[0].count("less uniform") == 3 and len(lines) == 2 + 7
    assert row(lines, "8").startswith(
        "| 8 | -12.50 [-12.50, -12.50], 0/3 | 0.000 [0.000, 0.000], 3/3 |"
    )
    assert row(lines, "8").endswith("| 12.50 [12.50, 12.50] |")


def test_what_learners_know_of_actions(tables):
    """Two gates and two other positions; of three actions one passes a gate, by one learner the best, by one not."""
    rows = []
    for label, best_ends in (("dqn", [False, True]), ("uniform", [True, True])):
        for seed in SEEDS:
            for position, gate, drops in (
                (0.0, False, [0, 1, 3]),
                (0.1, False, [0, 0, 2]),
                (0.2, True, [0, 4, 8]),
            ):
                for rank, drop in enumerate(drops, 1):
                    ends = gate and (best_ends[seed % 2] if rank == 1 else rank == 3)
                    rows.append(
                        {
                            "panel": "p",
                            "maze": 0,
                            "label": label,
                            "seed": seed,
                            "position": position,
                            "gate": gate,
                            "rank": rank,
                            "drop": drop,
                            "ends": ends,
                        }
                    )
    pd.DataFrame(rows).to_csv(tables / "figC1.csv", index=False)
    text = "\n".join(appendix_page.dropoff(Tables(tables)))
    passes, auc, wrong, aside = (cell.split()[0] for cell in cells(text, "DQN, uniform"))
    assert (passes, auc, wrong, aside) == ("0.67", "1.00", "8.00", "1.50")
    assert cells(text, "SAC, uniform")[0] == "0.000 [0.000, 0.000]"


def test_the_curvature_beside_the_log_probability(tables):
    at = np.arange(6.0)
    log_prob = {"log_prob": at, "mode_log_prob_unsquashed": -at}
    curvature = {
        "curvature_0.02": 0.0,
        "curvature": np.where(at > 3, at, 0.0),
        "curvature_0.3": at + 1,
    }
    one = pd.DataFrame(
        {"panel": "v", "maze": 0, "label": "uniform", "env": "e", **log_prob, **curvature}
    )
    everywhere = pd.concat([one.assign(seed=seed) for seed in SEEDS])
    grid = everywhere.assign(angle=np.tile(at, 3), speed=1.0, visited=True)
    flags = {"visited": np.tile(at < 5, 3), "decision": np.tile(at == 4, 3), "terminal": False}
    states = everywhere.assign(state=np.tile(at, 3), **flags)
    grid.to_csv(tables / "figD1.csv", index=False)
    states.to_csv(tables / "figD3.csv", index=False)
    lines = appendix_page.curvature(Tables(tables))
    assert row(lines, "Pendulum", "v", "0.02", "100%").count(" - |") == 5
    assert row(
        lines,
        "Pendulum",
        "v",
        "0.3",
        "0%",
        "1.00 [1.00, 1.00]",
        "1.00",
        "-1.00 [-1.00, -1.00]",
        "-1.00",
        "-",
    )
    assert "67%" in row(lines, "Pendulum", "v", "0.1")
    assert row(lines, "large maze", "v", "0.1", "80%").endswith("| 1.00 [1.00, 1.00] |")  # of five
    assert row(lines, "large maze", "v", "0.02", "100%").endswith("| 0.50 [0.50, 0.50] |")
    assert row(lines, "large maze", "v", "log-probability itself").endswith("| 1.00 [1.00, 1.00] |")


def test_the_committed_page_is_what_the_tables_say(tmp_path):
    page = tmp_path / "appendices.md"
    page.write_text(PAGE.read_text())
    appendix_page.write(page, TABLES)
    assert page.read_text() == PAGE.read_text()
    assert set(re.findall(r"<!-- (\w+): ", page.read_text())) == set(PARTS)


def test_the_words_quote_only_intervals_of_the_tables():
    text = PAGE.read_text()
    made = (
        "\n".join(re.findall(MADE, text, re.DOTALL)) + (ROOT / "results" / "claims.md").read_text()
    )
    quoted = re.findall(r"-?[\d.]+ \[-?[\d.]+, -?[\d.]+\]", re.sub(MADE, "", text, flags=re.DOTALL))
    assert quoted, "the page says no number"
    for number in quoted:
        assert number in made, number
