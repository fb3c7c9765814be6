"""The pages in prose: commands run, numbers are those of the tables, links lead somewhere."""

import re
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

import train
from aser.settings import compose

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
LINES = [line for page in PAGES for line in page.read_text().replace("\\\n", " ").splitlines()]
COMMANDS = [
    shlex.split(line, comments=True) for line in LINES if line.startswith("python -m train ")
]
# A row of a table, a mark, a line that is one link or image: these may be longer.
FREE = r"\||<!--|!?\[[^]]*\]\([^)]*\)$|\[\w+\]: "
TABLES = ROOT / "results" / "tables"
LABELS = {  # as in the pages: as in the tables
    "oracle": "oracle",
    "n-step SAC": "nstep",
    "PER": "per",
    "ASER": "aser",
    "pretrained": "pretrained",
    "PER without weights": "per_unweighted",
    "uniform SAC": "uniform",
}


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


THESIS_AGAIN = [
    name
    for name, claim in yaml.safe_load((ROOT / "conf/claims/thesis.yaml").read_text()).items()
    if claim.get("again") == "nine_mazes"
]


def test_the_readme_is_one_page():
    assert len(README.split()) <= 1500
    assert len(README.splitlines()) <= 150
    assert README.count("![") <= 4


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_lines_are_no_longer_than_100_columns(page):
    long = [
        line
        for line in page.read_text().splitlines()
        if len(line) > 100 and not re.match(FREE, line)
    ]
    assert not long, long[0]


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_link_leads_somewhere(page):
    text = without_code(page.read_text())
    targets = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(
        r"^\[\w+\]: (\S+)", text, re.MULTILINE
    )
    for target in targets:
        path, _, anchor = target.partition("#")
        if re.match(r"\w+:", target):
            continue
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), target
        if anchor:
            assert anchor in anchors(file.read_text()), target


def without_code(text: str) -> str:
    return re.sub(r"`[^`\n]*`(?!\])", "", re.sub(r"```.*?```", "", text, flags=re.DOTALL))


def anchors(text: str) -> set[str]:
    """The headings of a page, as GitHub makes anchors of them."""
    headings = re.findall(
        r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE
    )
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_the_criterion_of_ones_own_trains(tmp_path, monkeypatch, capsys):
    examples = re.findall(r"<!-- example: (\S+) -->\n```\w+\n(.*?)```", README, re.DOTALL)
    assert [name for name, _ in examples] == ["my_criteria.py", "conf/criterion/regret.yaml"]
    shutil.copytree(ROOT / "conf", tmp_path / "conf")
    for name, text in examples:
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_criteria", raising=False)  # of another page
    monkeypatch.setattr(train, "CONF", tmp_path / "conf")
    arguments = [
        "sampler=aser",
        "criterion=regret",
        "debug=smoke",
        "steps=130",
        "batch=16",
        f"run_dir={tmp_path}/run",
    ]
    assert train.main(arguments) == 0
    rows = (tmp_path / "run" / "diagnostics.csv").read_text().splitlines()
    last = dict(zip(rows[0].split(","), rows[-1].split(","), strict=True))
    # The regret, not a constant, sets b.
    assert last["step"] == "130" and float(last["threshold"]) > 0.0
    capsys.readouterr()


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_command_names_settings_that_exist(command):
    overrides = [word for word in command[3:] if "=" in word]
    several = "-m" in command
    for job in compose.jobs(overrides, train.CONF) if several else [overrides]:
        train.settings(job)


def test_the_commands_are_found():
    assert len(COMMANDS) >= 8


def test_the_count_of_claims_is_the_ledgers():
    ledger = (ROOT / "results" / "claims.md").read_text()
    total, counts = re.search(r"Of (\d+), [^:]*: (.*?)\.", ledger).groups()
    words = " ".join(README.split())
    assert (
        f"decides {total} claims of the thesis" in words and f"hyper-parameters: {counts}." in words
    )


def test_the_claims_that_are_asked_again_are_counted():
    rows = pd.read_csv(TABLES / "claims.csv")
    rows = rows[rows["claim"].isin(again := [*THESIS_AGAIN])]
    pooled = rows[(rows["figure"] == "nine_mazes") & (rows["maze"] == -1)]
    before = rows[rows["figure"] != "nine_mazes"].drop_duplicates("claim").set_index("claim")
    after = pooled.drop_duplicates("claim").set_index("claim")["verdict"]
    changed = sum(before.loc[claim, "verdict"] != after[claim] for claim in before.index)
    assert (len(again), len(after), changed) == (16, 16, 6)
    words = " ".join(README.split())
    assert "Sixteen are asked again in nine mazes with 64 seeds, and six answers change" in words


def test_the_table_of_results_is_what_the_runs_are():
    """Mean area with its interval, and runs at the best return: figures 4 and 5, both panels."""
    runs = pd.concat([pd.read_csv(TABLES / f"{figure}.csv") for figure in ("fig04", "fig05")])
    runs = runs.drop_duplicates(["panel", "label", "seed"])  # both figures have uniform SAC
    rows = re.findall(
        r"^\| (" + "|".join(LABELS) + r") \| (-.+) \|$",
        (ROOT / "docs" / "reproduce.md").read_text(),
        re.MULTILINE,
    )
    assert len(rows) == 7
    for sampler, cells in rows:
        panels = runs[runs["label"] == LABELS[sampler]].groupby("panel", sort=False)
        expected = [cell for _, panel in panels for cell in (area(panel), solved(panel))]
        assert cells.split(" | ") == expected, sampler


def returns(rows: pd.DataFrame) -> np.ndarray:
    """(seeds, evaluations)"""
    return rows[[column for column in rows if column.isdigit()]].to_numpy(float)


def area(rows: pd.DataFrame) -> str:
    areas = returns(rows).mean(1)
    means = areas[np.random.default_rng(0).integers(len(areas), size=(2000, len(areas)))].mean(1)
    low, high = (
        np.quantile(means, 0.025, method="lower"),
        np.quantile(means, 0.975, method="higher"),
    )
    return f"{areas.mean():.2f} [{low:.2f}, {high:.2f}]"


def solved(rows: pd.DataFrame) -> str:
    last = returns(rows)[:, -1]
    return f"{(last >= -1e-6).sum()}/{len(last)}"  # the best return is 0
