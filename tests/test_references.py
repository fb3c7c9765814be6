"""The random policy's returns in standard tasks: the script, the table and the page."""

import re
from pathlib import Path

import pandas as pd
import pytest
import references

from aser.study.tables import returns, scores

ROOT = Path(__file__).parent.parent
TABLE = returns.references(ROOT / "results" / "tables")


def test_every_standard_task_has_a_reference():
    assert set(references.TASKS) <= set(TABLE.index)
    rows = TABLE.loc[references.TASKS]
    assert rows["random"].notna().all() and not rows["solvable"].any()


def test_the_page_has_the_numbers_of_the_table():
    page = (ROOT / "docs" / "tasks.md").read_text()
    cells = re.findall(r"`([\w/-]+-v\d)` \| (-?[\d,.]+)", page)
    assert sorted(name for name, _ in cells) == sorted(references.TASKS)
    for name, shown in cells:
        assert float(shown.replace(",", "")) == pytest.approx(TABLE.loc[name, "random"], rel=6e-3)


def test_every_best_return_names_its_run():
    """It is the mean over seeds of that run at that step, in the table of some figure."""
    listed = pd.read_csv(ROOT / "results" / "tables" / "figure_runs.csv", dtype={"panel": str})
    assert (TABLE["source"] == "exact").equals(TABLE["solvable"])
    for env, row in TABLE[~TABLE["solvable"]].iterrows():
        assert bool(row["source"]) == pd.notna(row["best"]), env
        if row["source"]:
            named = re.fullmatch(r"(\S+) of (\w+) at step (\d+)", row["source"])
            folder, code, step = named.groups()
            run = listed[(listed["folder"] == folder) & (listed["code"] == code)].iloc[0]
            (table,) = (ROOT / "results" / "tables" / "beyond").glob(f"{run['figure']}.csv")
            seeds = returns.read(table)
            of = (seeds["panel"] == run["panel"]) & (seeds["label"] == run["label"])
            assert seeds.loc[of, int(step)].mean() == pytest.approx(row["best"], rel=1e-5), env


def test_a_reference_is_measured_again_and_kept(tmp_path, monkeypatch, capsys):
    """MountainCar pays -0.1 times the square of the action, and 999 steps of it are -33.3."""
    monkeypatch.setattr(references, "TABLES", tmp_path)
    monkeypatch.setattr("aser.reproduce.RANDOM_EPISODES_ELSEWHERE", 3)
    table = tmp_path / "references.csv"
    table.write_text("env,random,best,worst,solvable\nmaze toy,-3.874,0,-25,True\n")
    assert references.main(["MountainCarContinuous-v0", "Nowhere-v0"]) == 1
    said = capsys.readouterr()
    assert "left out: env.id=Nowhere-v0 is unknown to gymnasium" in said.err
    rows = pd.read_csv(table, index_col="env")
    assert rows.loc["maze toy"].tolist()[:4] == [-3.874, 0, -25, True]
    random = rows.loc["MountainCarContinuous-v0", "random"]
    assert random == pytest.approx(-33.3, abs=0.5)
    table.write_text(table.read_text().replace(f"v0,{random}", "v0,77"))
    assert references.main(["MountainCarContinuous-v0"]) == 0
    assert pd.read_csv(table, index_col="env").equals(rows)


def test_scores_of_a_standard_task_count_from_its_reference():
    """Best returns are those of one's own runs, as no task here can be solved for certain."""

    class Run:
        environment = "Hopper-v5"
        folder = Path("Hopper_v5-per-sb3-0123abcd")
        summary = {"code": "fedc9876"}
        returns = pd.DataFrame({"step": [1, 1, 2, 2], "return": [20.0, 40.0, 9000.0, 11000.0]})

    class Worse(Run):
        folder = Path("worse")
        returns = pd.DataFrame({"step": [1], "return": [900.0]})

    known = scores.best_known(TABLE, [Run(), Worse()])
    assert known.loc["Hopper-v5", "best"] == 10000.0
    assert known.loc["Hopper-v5", "source"] == "Hopper_v5-per-sb3-0123abcd of fedc9876 at step 2"
    random = TABLE.loc["Hopper-v5", "random"]
    assert scores.normalise(random, "Hopper-v5", known) == 0.0
    assert scores.normalise((random + 10000) / 2, "Hopper-v5", known) == pytest.approx(0.5)
