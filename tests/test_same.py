"""The tool that compares two commits finds what differs, and nothing else."""

import subprocess

import pytest
import torch

from aser import checkpoint, same
from aser.errors import ConfigError

# Stands for a whole project: a train.py that leaves a run's files, with one number to change.
PROJECT = """
import pathlib
import torch

def main(words):
    folder = pathlib.Path(words[-1].removeprefix("run_dir="))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "returns.csv").write_text("seed,step,return\\n3,45,-1.5\\n")
    (folder / "diagnostics.csv").write_text("seed,step,loss\\n3,45,0.25\\n")
    torch.save({"agent": [torch.tensor([1.0, 2.0])]}, folder / "checkpoint.pt")
    (folder / "summary.json").write_text('{"code": "abc"}')
    return 0
"""
RUNS = {"first": ["sampler=uniform"], "second": ["sampler=per"], "third": ["sampler=aser"]}


def run_folder(path, loss="0.25", agent=(1.0, 2.0), **more):
    path.mkdir()
    (path / "returns.csv").write_text("seed,step,return\n3,45,-1.5\n")
    (path / "diagnostics.csv").write_text(f"seed,step,loss\n3,45,{loss}\n")
    content = {"agent": [torch.tensor(agent)], "training": {"steady": [0.5, 3], "step": 7}, **more}
    checkpoint.save(path / checkpoint.NAME, content)
    return path


def test_equal_runs_differ_in_nothing(tmp_path):
    nan = torch.tensor([float("nan"), 0.0])
    one, two = (
        run_folder(tmp_path / name, threshold=nan, seconds=time)
        for name, time in (("a", 1.0), ("b", 2.0))
    )
    assert list(same.differences(one, two)) == []


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"loss": "0.26"}, "diagnostics.csv: column loss differs"),
        ({"agent": (1.0, 2.0000002)}, "checkpoint.pt: agent.0 differs"),
        ({"agent": (1.0, 2.0, 3.0)}, "checkpoint.pt: agent.0 differs"),
        ({"training": {"step": 8}}, "checkpoint.pt: training.step differs"),
        ({"training": {}}, "checkpoint.pt: training.step is not there any more"),
    ],
)
def test_one_changed_number_is_found(tmp_path, change, line):
    assert list(
        same.differences(run_folder(tmp_path / "a"), run_folder(tmp_path / "b", **change))
    ) == [line]


def test_what_only_the_newer_run_has_is_no_difference(tmp_path):
    newer = run_folder(tmp_path / "b", sizes={"obs": 4})
    (newer / "diagnostics.csv").write_text("seed,step,loss,entropy\n3,45,0.25,1\n")
    assert list(same.differences(run_folder(tmp_path / "a"), newer)) == []


def test_a_renamed_part_is_compared_under_its_new_name(tmp_path, monkeypatch):
    monkeypatch.setattr(same, "RENAMED", {"agent.0": "agent.actor"})
    old = run_folder(tmp_path / "a")
    for name, value, expected in (("b", 2.0, []), ("c", 2.5, ["checkpoint.pt: agent.0 differs"])):
        new = run_folder(tmp_path / name, agent=())
        agent = {"actor": torch.tensor([1.0, value])}
        checkpoint.save(
            new / checkpoint.NAME, {"agent": agent, "training": {"steady": [1.0, 3], "step": 7}}
        )
        assert list(same.differences(old, new)) == expected


def test_two_commits_are_compared_by_their_own_code(tmp_path):
    source = tmp_path / "src" / "train.py"
    source.parent.mkdir()
    source.write_text(PROJECT)
    identity = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    for words in (["init", "-q"], ["add", "src"], [*identity, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", "-C", str(tmp_path), *words], check=True)
    assert same.compare("HEAD", tmp_path, RUNS) == []
    folders = same.folders("HEAD", tmp_path)
    other = folders[1] / "of_an_older_comparison" / "summary.json"
    other.parent.mkdir()
    other.write_text('{"code": "xyz"}')
    assert [same.code_of(folder, RUNS) for folder in folders] == [{"abc"}, {"abc"}]
    source.write_text(PROJECT.replace("-1.5", "-2.5"))
    assert same.compare("HEAD", tmp_path, RUNS) == [
        f"{name}: returns.csv: column return differs" for name in RUNS
    ]
    worktrees = subprocess.run(
        ["git", "-C", str(tmp_path), "worktree", "list"], capture_output=True, text=True
    )
    assert len(worktrees.stdout.splitlines()) == 1  # nothing is left behind
    with pytest.raises(ConfigError, match="allowed: a commit of this checkout"):
        same.compare("no-such-commit", tmp_path, RUNS)


def test_samplers_that_the_commit_lacks_are_left_out(tmp_path):
    sampler = tmp_path / "conf" / "sampler" / "old.yaml"
    sampler.parent.mkdir(parents=True)
    sampler.write_text("sampler: old\n")
    identity = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    for words in (["init", "-q"], ["add", "conf"], [*identity, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", "-C", str(tmp_path), *words], check=True)
    sampler.with_name("new.yaml").write_text("sampler: new\n")
    runs = {"one": ["sampler=old"], "two": ["sampler=new"], "three": ["steps=3"]}
    runs["four"] = ["sampler=old", "bootstrap=new"]
    assert list(same.known("HEAD", tmp_path, runs)) == ["one", "three"]
    with pytest.raises(ConfigError, match="allowed: a commit of this checkout"):
        same.known("no-such-commit", tmp_path, runs)


def test_the_runs_hold_every_sampler_agent_and_environment():
    import train

    words = {word for run in same.RUNS.values() for word in run}
    for group in ("sampler", "agent", "env", "bootstrap", "criterion"):
        named = {word.partition("=")[2] for word in words if word.startswith(f"{group}=")}
        implied = {"sac", "one_step", "fixed", "geometric", "threshold_or_zero"}  # by samplers
        implied |= {"averaged", "preferential", "auto", "uniform", "td_error", "reducible_loss"}
        implied |= {"mode_log_prob", "q_range", "q_dropoff", "oracle", "pretrained", "shuffled"}
        implied |= {"outcome_spread", "outcome_spread_shuffled"}
        implied |= {"outcome_model", "outcome_model_shuffled"}
        of_gym = {"mujoco", "box2d", "dmc"}  # env=gym, where a package is installed
        left_out = set(train.names(train.CONF, group)) - named - implied - of_gym
        assert not left_out, f"no run of `make same` has {group}={', '.join(left_out)}"
    assert sum("compile=true" in run for run in same.RUNS.values()) == 5
