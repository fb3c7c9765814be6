"""What the README shows is what runs."""

import re
import shlex
import shutil
from pathlib import Path

import pytest

import train
from aser.settings import compose

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
COMMANDS = [
    shlex.split(line, comments=True)
    for line in README.splitlines()
    if line.startswith("python -m train ")
]


def test_the_criterion_of_ones_own_trains(tmp_path, monkeypatch, capsys):
    examples = re.findall(r"<!-- example: (\S+) -->\n```\w+\n(.*?)```", README, re.DOTALL)
    assert [name for name, _ in examples] == ["my_criteria.py", "conf/criterion/regret.yaml"]
    shutil.copytree(ROOT / "conf", tmp_path / "conf")
    for name, text in examples:
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
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
    assert (
        last["step"] == "130" and float(last["threshold"]) > 0.0
    )  # the regret, not a constant, sets b
    capsys.readouterr()


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_command_names_settings_that_exist(command):
    overrides = [word for word in command[3:] if "=" in word]
    several = "-m" in command
    for job in compose.jobs(overrides, train.CONF) if several else [overrides]:
        train.settings(job)


def test_the_commands_are_found():
    assert len(COMMANDS) >= 5


def test_the_count_of_claims_is_the_ledgers():
    ledger = (ROOT / "results" / "claims.md").read_text()
    total, counts = re.search(
        r"Of (\d+), each by its first set of values: (.*?)\.", ledger
    ).groups()
    assert f"of {total}, with 16 seeds at tuned values: {counts})" in README
