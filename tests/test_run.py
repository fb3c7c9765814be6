"""The run folder: its files, when they are written, and which folders are refused."""

import csv
import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml

import train
from aser import run as running
from aser.run import RunFolder, Saver
from aser.run_folder import name
from aser.training.loop import Training

TINY = [
    "debug=smoke",
    "hyper=thesis",
    "env.layout=toy",
    "batch=6",
    "learning_starts=10",
    "steps=30",
    "eval.every=12",
]
FILES = {
    "config.yaml",
    "returns.csv",
    "diagnostics.csv",
    "summary.json",
    "learning_curve.png",
    "checkpoint.pt",
}
BEGUN = FILES - {"summary.json", "learning_curve.png"}


def trained(*overrides, status=0):
    assert train.main([*TINY, "run_dir=run", *overrides]) == status
    return Path("run")


def table(path):
    header, *rows = csv.reader(path.read_text().splitlines())
    return header, [dict(zip(header, row, strict=True)) for row in rows]


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def summary(folder):
    return json.loads((folder / "summary.json").read_text())


def scores(monkeypatch, *rows):
    """Let the evaluations give these returns, one row each."""
    given = iter(rows)
    monkeypatch.setattr(
        "aser.training.evaluation.Evaluation.__call__",
        lambda self, state, poll: np.array(next(given)),
    )


def test_what_a_folder_holds(house, capsys):
    folder = trained(
        "seeds=[7,2,5]", "sampler=aser", "steps=230", "learning_starts=15", "eval.every=90"
    )
    assert {path.name for path in folder.iterdir()} == FILES
    saved = torch.load(folder / "checkpoint.pt", weights_only=True)
    history = saved["training"]["returns"]

    header, rows = table(folder / "returns.csv")
    assert header == ["seed", "step", "return"]
    written = [(int(row["seed"]), int(row["step"]), float(row["return"])) for row in rows]
    assert written == [
        (seed, step, float(values[lane]))
        for step, values in history
        for lane, seed in enumerate([7, 2, 5])
    ]
    assert [step for step, _ in history] == [90, 180, 230]

    header, rows = table(folder / "diagnostics.csv")
    assert {
        "temperature",
        "critic_loss",
        "actor_loss",
        "td_error",
        "unroll_mean",
        "unroll_max",
    } <= set(header)
    assert {"effective_sample_size", "age_mean", "never_drawn", "threshold", "roc_auc"} <= set(
        header
    )
    assert [(row["seed"], row["step"]) for row in rows] == [
        (seed, step) for step in ("90", "180", "230") for seed in ("7", "2", "5")
    ]
    assert all(math.isfinite(float(value)) for row in rows for value in row.values())
    last = saved["training"]["diagnostics"][-1][1]
    assert [float(row["td_error"]) for row in rows[-3:]] == pytest.approx(
        last["td_error"].tolist(), rel=1e-5
    )

    numbers = summary(folder)
    assert set(numbers) == {
        *("iqm_final", "auc_mean", "solved", "diverged", "lane_steps_per_second", "wall_seconds"),
        *("hyper", "versions", "commit", "code"),
    }
    assert numbers["hyper"] == "thesis/maze/aser"
    assert numbers["diverged"] == [] and numbers["wall_seconds"] > 0
    # 15 steps after 200 updates.
    assert 3 * 15 / numbers["wall_seconds"] < numbers["lane_steps_per_second"] < 3e5

    storage = saved["training"]["buffer"]["storage"]
    draws, unrolled = storage["draw_count"], storage["unroll_sum"]
    assert draws.shape == unrolled.shape == (3, 230)
    assert draws.sum(1).tolist() == [6 * (230 - 15)] * 3
    assert ((draws <= unrolled) & (unrolled <= 10 * draws)).all() and (unrolled > draws).any()
    assert saved["training"]["step"] == storage["stored"] == 230
    assert all(isinstance(leaf, torch.Tensor) and len(leaf) == 3 for leaf in saved["agent"])

    picture = (folder / "learning_curve.png").read_bytes()
    assert picture[:8] == b"\x89PNG\r\n\x1a\n" and len(picture) > 5000
    assert capsys.readouterr().out.splitlines()[-2] == "results in run"


def test_another_network_than_the_tuned_one_is_said(house, capsys):
    words = ["hyper=auto", "env=maze", "env.layout=toy", "sampler=uniform", "eval.every=null"]
    for hidden in ("[24]", "[8,8]"):
        trained(*words, f"network.hidden={hidden}", "force=true")
        said = "they were tuned with network.hidden=[24], and this run has [8, 8]"
        assert (said in capsys.readouterr().out) == (hidden == "[8,8]")


def test_the_summary_is_that_of_the_returns(house, monkeypatch):
    scores(
        monkeypatch,
        [0.0, -9.0, -3.0, -2.0, -1.0],
        [-4.0, 0.0, -5.0, -7.0, -0.1],
        [0.0, -5e-7, -3.0, 1 / 3 - 2, -2e-6],
    )
    numbers = summary(trained("seeds=[4,0,3,9,1]"))
    # Without the best and the worst.
    assert numbers["iqm_final"] == pytest.approx((-2e-6 - 5e-7 + 1 / 3 - 2) / 3)
    areas = [-4 / 3, (-9 - 5e-7) / 3, -11 / 3, (-9 + 1 / 3 - 2) / 3, (-1.1 - 2e-6) / 3]
    assert numbers["auc_mean"] == pytest.approx(np.mean(areas), rel=1e-12)
    assert numbers["solved"] == 2  # returns within 1e-6 of the best one, 0
    assert numbers["lane_steps_per_second"] is None  # there was no steady state
    _, rows = table(Path("run/returns.csv"))
    assert float(rows[-2]["return"]) == 1 / 3 - 2  # to the last digit


def test_the_best_return_is_the_environments(house, monkeypatch):
    best = [None, 0.0]
    scores(monkeypatch, *[best] * 3, *[[-1.0, 3.0]] * 3)
    config = train.settings(["env=maze_sparse", "env.layout=toy"])
    moves = len(running.build.make_envs(config, 1).states.shortest_path()) - 1
    best[0] = 1 - moves / 50
    assert summary(trained("env=maze_sparse"))["solved"] == 1
    arguments = [word for word in TINY if "layout" not in word]
    assert train.main([*arguments, "env=pendulum", "run_dir=swing"]) == 0
    numbers = summary(Path("swing"))
    assert (numbers["solved"], numbers["iqm_final"], numbers["auc_mean"]) == (None, 1.0, 1.0)


def test_lanes_that_diverge_are_counted(house):
    numbers = summary(trained("hyper.lr=1e38", "seeds=[7,2,5]", "steps=40"))
    assert numbers["diverged"] == [{"seed": seed, "step": 12} for seed in (7, 2, 5)]
    assert (numbers["solved"], numbers["iqm_final"]) == (0, -25.0)
    _, rows = table(Path("run/returns.csv"))
    assert {float(row["return"]) for row in rows} == {-25.0}


def test_without_evaluations_there_is_all_the_rest(house):
    folder = trained("eval.every=null", "steps=115")
    assert {path.name for path in folder.iterdir()} == FILES
    assert (folder / "returns.csv").read_text() == "seed,step,return\n"
    assert [row["step"] for row in table(folder / "diagnostics.csv")[1]] == [
        "100",
        "100",
        "115",
        "115",
    ]
    numbers = summary(folder)
    assert (numbers["iqm_final"], numbers["auc_mean"], numbers["solved"]) == (None, None, None)


# Training again, and resuming


def test_force_trains_again_in_an_empty_folder(house):
    folder = trained()
    before = contents(folder)
    (folder / "returns.csv").write_text("old")
    (folder / "learning_curve.pdf").write_text("old")
    trained("force=true")
    after = contents(folder)
    assert set(after) == FILES
    assert (
        after["returns.csv"] == before["returns.csv"]
        and after["diagnostics.csv"] == before["diagnostics.csv"]
    )
    trained("force=true", "env.layout=nowhere", status=1)  # a refused run deletes nothing
    assert contents(folder) == after


def test_resume_where_there_is_nothing_starts_afresh(house, capsys):
    straight = contents(trained())
    capsys.readouterr()
    for folder in ("new", "only_begun"):
        if folder == "only_begun":  # it stopped before its first checkpoint
            Path(folder).mkdir()
            (Path(folder) / "config.yaml").write_bytes(Path("new/config.yaml").read_bytes())
        assert train.main([*TINY, f"run_dir={folder}", "resume=true"]) == 0
        assert "resumed" not in capsys.readouterr().out
        assert (Path(folder) / "returns.csv").read_bytes() == straight["returns.csv"]
    trained("resume=true")
    assert "not trained again" in capsys.readouterr().out


def unfinished(*overrides):
    """A run that stopped after its checkpoint at step 20."""
    patch = pytest.MonkeyPatch()

    def run_a_while(training, after_step, after_evaluation, poll):
        while training.step < 20:
            training.advance()
            after_step(training)
        raise RuntimeError

    with patch.context() as context:
        context.setattr(Training, "run", run_a_while)
        with pytest.raises(RuntimeError):
            train.main([*TINY, "run_dir=run", "checkpoint.every=20", *overrides])
    assert {path.name for path in Path("run").iterdir()} == BEGUN
    return Path("run")


def test_an_unfinished_run_is_refused_and_both_ways_out_are_named(house, capsys):
    folder = unfinished()
    before = contents(folder)
    trained(status=1)
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and "resume=true" in message and "force=true" in message
    assert contents(folder) == before
    trained("force=true")
    assert "resumed" not in capsys.readouterr().out and set(contents(folder)) == FILES


@pytest.mark.parametrize(
    ("other", "named"),
    [
        ("hyper.gamma=.5", "hyper.gamma=0.9673, not 0.5"),
        ("seeds=[3]", "seeds=[0, 1], not [3]"),
        ("steps=29", "steps=30, not 29"),
        ("sampler=per", "sampler=aser, not per"),
        ("eval.every=11", "eval.every=12, not 11"),
        ("env=maze_sparse", "env.name=maze, not maze_sparse"),
        ("network.hidden=[7]", "network.hidden=[24], not [7]"),
        ("prioritisation=uniform", "prioritisation.name=proportional, not uniform"),
    ],
)
def test_other_settings_do_not_go_on_with_a_run(other, named, house, capsys):
    folder = unfinished()
    before = contents(folder)
    trained("resume=true", other, status=1)
    message = capsys.readouterr().err
    line = (
        f"train: run_dir=run: was begun with {named}; allowed: the same settings, or force=true\n"
    )
    assert message == line
    assert contents(folder) == before


def test_a_finished_folder_is_no_answer_to_other_settings(house, capsys):
    trained("seeds=1", "steps=25")
    before = contents(Path("run"))
    trained("seeds=1", "steps=25", "hyper.gamma=.5", status=1)
    assert "was begun with hyper.gamma=0.9673, not 0.5" in capsys.readouterr().err
    assert contents(Path("run")) == before


def test_what_changes_no_result_may_change_on_the_way(house, capsys):
    folder = unfinished()
    trained("resume=true", "checkpoint.every=auto", "threads=2")
    assert "resumed at step 20\n" in capsys.readouterr().out and set(contents(folder)) == FILES
    torch.set_num_threads(1)


@pytest.mark.parametrize("damage", ["config.yaml", "config.yaml is a list", "checkpoint.pt"])
def test_a_damaged_folder_is_one_line(damage, house, capsys):
    folder = unfinished()
    (folder / damage.partition(" ")[0]).write_text("[1, 2]" if "list" in damage else "{")
    before = contents(folder)
    trained("resume=true", status=1)
    message = capsys.readouterr().err
    assert (
        message.startswith("train: ")
        and message.count("\n") == 1
        and "allowed" in message
        and "run" in message
    )
    assert contents(folder) == before


def test_a_run_that_ended_while_its_results_were_written_writes_them_again(house, capsys):
    folder = trained("sampler=oracle")
    before = contents(folder)
    for lost in ("summary.json", "returns.csv", "learning_curve.png"):
        (folder / lost).unlink()
    trained("sampler=oracle", "resume=true")
    assert "resumed at step 30\n" in capsys.readouterr().out
    after = contents(folder)
    assert set(after) == FILES
    assert (
        after["returns.csv"] == before["returns.csv"]
        and after["diagnostics.csv"] == before["diagnostics.csv"]
    )


# Writing files


def test_a_reader_sees_the_old_file_or_the_new_one(house, monkeypatch):
    folder = RunFolder(train.settings([*TINY, "run_dir=run"]), house)
    folder.begin()
    folder.write("summary.json", "old")
    seen = []
    replace = running.checkpoint.os.replace

    def watch(source, target):
        seen.append(
            (
                Path(source).read_text(),
                Path(target).read_text(),
                Path(source).parent == Path(target).parent,
            )
        )
        replace(source, target)

    monkeypatch.setattr("os.replace", watch)
    folder.write("summary.json", "new")
    assert seen == [("new", "old", True)]
    assert {path.name for path in folder.path.iterdir()} == {"config.yaml", "summary.json"}


def test_a_folder_that_cannot_be_made_is_one_line(house, capsys):
    (house / "results").write_text("a file where the results should be")
    for where in (
        [],
        [f"run_dir={house / 'results' / 'below'}"],
        ["run_dir=/proc/1/below"],
        [f"run_dir={'x' * 300}"],
    ):
        assert train.main([*TINY, *where]) == 1
        printed = capsys.readouterr()
        assert (
            printed.err.startswith("train: run_dir=")
            and printed.err.count("\n") == 1
            and "allowed" in printed.err
        )
        assert "lanes of" not in printed.out
    assert sorted(path.name for path in house.iterdir()) == ["conf", "results"]


def test_snapshots_hold_the_agent_as_it_was(house):
    from aser import checkpoint

    folder = trained("seeds=2", "snapshots=[20,30]")
    last = checkpoint.load(folder / "checkpoint.pt")["agent"]
    early, late = (checkpoint.load(folder / f"agent-{step}.pt")["agent"] for step in (20, 30))
    assert all(torch.equal(a, b) for a, b in zip(late, last, strict=True))
    assert any(not torch.equal(a, b) for a, b in zip(early, last, strict=True))
    trained("seeds=2", "steps=20", "force=true")
    plain = checkpoint.load(folder / "checkpoint.pt")["agent"]
    assert all(torch.equal(a, b) for a, b in zip(early, plain, strict=True))


@pytest.mark.parametrize("value", ["5", "[0]", "[31]", "[2.5]", "[a]"])
def test_snapshots_are_steps_of_the_run(value, house, capsys):
    trained(f"snapshots={value}", status=1)
    assert capsys.readouterr().err.startswith("train: snapshots=")


def saved_at(monkeypatch, every, cost, steps, step_seconds=0.001):
    """Return the steps at which a Saver saves, on a simulated clock."""
    clock, steps_saved = SimpleNamespace(now=50.0), []

    def save(path, content):
        clock.now += cost
        steps_saved.append(content["training"]["step"])

    monkeypatch.setattr(running, "perf_counter", lambda: clock.now)
    monkeypatch.setattr(running.checkpoint, "save", save)
    training = SimpleNamespace(step=0, sizes={"obs": 4, "action": 2})
    training.state_dict = lambda: {"step": training.step, "agent": []}
    folder = SimpleNamespace(
        config=SimpleNamespace(checkpoint_every=every, snapshots=()),
        checkpoint=None,
        origin=dict,
    )
    saver = Saver(training, folder, clock.now)
    for training.step in range(1, steps + 1):
        clock.now += step_seconds
        saver.step()
    return steps_saved


def test_when_it_saves(monkeypatch):
    assert saved_at(monkeypatch, 40, cost=9.0, steps=130) == [40, 80, 120]
    assert saved_at(monkeypatch, "auto", cost=0.01, steps=3500) == [1000, 2000, 3000]
    steps_saved = saved_at(monkeypatch, "auto", cost=0.1, steps=12500)
    assert steps_saved[0] == 1000 and len(steps_saved) == 3  # then 0.1 s at most every 5 s
    assert all(
        5000 <= later - earlier <= 5002
        for earlier, later in zip(steps_saved, steps_saved[1:], strict=False)
    )


# The name of the folder


def test_a_runs_name_tells_what_varies(house):
    def named(*overrides):
        return name(train.settings(list(overrides)))

    plain = named("env=maze", "sampler=aser", "hyper=thesis")
    assert plain.startswith("maze-aser-thesis-")
    same = [["run_dir=x"], ["resume=true"], ["force=true"], ["threads=2"], ["checkpoint.every=7"]]
    assert {named("sampler=aser", *extra) for extra in same} == {named("sampler=aser")}
    others = [
        "seeds=3",
        "steps=300",
        "hyper.gamma=.5",
        "device=cpu",
        "compile=false",
        "eval.every=7",
        "env=corridor",
    ]
    others += [
        "env.layout=toy",
        "env.layout=a/b.txt",
        "sampler=aser_q",
        "bootstrap.batch=prioritised",
    ]
    names = [named("sampler=aser", *other.split(" ")) for other in others]
    names += [
        named("env=gym", "env.id=MountainCarContinuous-v0"),
        named("env=gym", "env.id=aser/Maze-v0"),
    ]
    assert len({*names, plain}) == len(others) + 3
    assert all(Path(one).name == one and " " not in one for one in names)
    assert "MountainCarContinuous" in names[-2] and "-toy-" in names[others.index("env.layout=toy")]
    assert train.main(TINY) == 0
    (only,) = (house / "results" / "runs").iterdir()
    assert only.name == named(*TINY)
    assert yaml.safe_load((only / "config.yaml").read_text())["run_dir"] is None
