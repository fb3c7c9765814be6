"""scripts/figures.py as its user calls it: train what is missing, draw without training, go on
where it was stopped.
"""

import figures
import pandas as pd
import pytest
import yaml

import train
from aser import build
from aser.training.evaluation import random_return

TINY = [
    "env=maze",
    "env.layout=toy",
    "hyper=thesis",
    "steps=40",
    "learning_starts=10",
    "batch=6",
    "eval.every=20",
    "compile=false",
]
SPEC = {
    "title": "Two samplers",
    "plot": "curves",
    "caption": "A test.",
    "seeds": 3,
    "common": TINY,
    "panels": [{"title": "only"}],
    "runs": {"uniform": ["sampler=uniform"], "per": ["sampler=per"]},
}


@pytest.fixture
def house(tmp_path, monkeypatch):
    for name in ("SPECS", "TABLES", "FIGURES"):
        monkeypatch.setattr(figures, name, tmp_path / name.lower())
    monkeypatch.setattr(figures, "ROOT", tmp_path)
    for name in ("specs", "tables", "figures"):
        (tmp_path / name).mkdir()
    (tmp_path / "specs" / "own.yaml").write_text(yaml.safe_dump(SPEC, sort_keys=False))
    return tmp_path


def summaries(house):
    return {path: path.stat().st_mtime_ns for path in house.glob("results/runs/*/*/summary.json")}


def test_reproduce_trains_what_is_missing_once(house, capfd):
    assert figures.main(["reproduce", "own"]) == 0
    first = summaries(house)
    assert len(first) == 2
    for name in ("own.png", "own.pdf", "own_aggregates.png", "README.md"):
        assert (house / "figures" / name).stat().st_size > 300
    rows = pd.read_csv(house / "tables" / "own.csv")
    assert list(rows.columns) == [
        "panel",
        "maze",
        "label",
        "sampler",
        "h",
        "env",
        "seed",
        "20",
        "40",
    ]
    assert len(rows) == 6
    made = pd.read_csv(house / "tables" / "figure_runs.csv")
    assert set(made["label"]) == {"uniform", "per"} and made["code"].notna().all()
    returns = pd.read_csv(
        next(path.with_name("returns.csv") for path in first if "per" in path.parent.name)
    )
    own = rows[rows["label"] == "per"].set_index("seed")
    for row in returns.to_dict("records"):
        assert own.loc[row["seed"], str(int(row["step"]))] == pytest.approx(row["return"], rel=1e-5)

    # One of the two is lost half-way: only that one is trained again, and the table comes out the
    # same.
    lost = next(iter(first))
    lost.unlink()
    before = (house / "tables" / "own.csv").read_bytes()
    assert figures.main(["reproduce", "own"]) == 0
    again = summaries(house)
    assert again.keys() == first.keys() and [
        path for path in first if first[path] != again[path]
    ] == [lost]
    assert (house / "tables" / "own.csv").read_bytes() == before

    # Drawing reads the tables alone.
    for path in first:
        path.unlink()
    pictures = (house / "figures" / "own.png").read_bytes()
    (house / "figures" / "own.png").unlink()
    (house / "tables" / "tuned.csv").write_text("env,sampler,set,value,steps,lr\n")
    assert figures.main(["draw", "own"]) == 0
    assert (house / "figures" / "own.png").read_bytes() == pictures
    assert not summaries(house)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["redraw"],
            "figures: redraw: there is no such command; these are: draw, reproduce, claims\n",
        ),
        (["draw", "ownn"], "figures: FIGURE=ownn: must be one of own; did you mean own?\n"),
    ],
)
def test_wrong_words_are_one_line(house, words, said, capsys):
    assert figures.main(words) == 1
    assert capsys.readouterr().err == said


def test_drawing_without_a_table_says_how_to_make_it(house, capsys):
    assert figures.main(["draw", "own"]) == 1
    assert "make reproduce FIGURE=own" in capsys.readouterr().err


def test_the_random_policy_in_the_corridor_is_what_the_gates_let_through():
    """Four gates of width .4 in [-1, 1]: .2 each, so .2^4 of the episodes reach the end."""
    envs = build.make_envs(
        train.settings(["env=corridor", "sampler=uniform", "hyper=thesis"]), 4000
    )
    expected = -(1 - 0.2**4)
    assert random_return(envs) == pytest.approx(expected, abs=4 * (0.2**4 / 4000) ** 0.5)
    assert random_return(envs) == random_return(envs)
