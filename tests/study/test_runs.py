"""Synthetic run folders are read back as they were written; broken ones are refused in one line."""

import json

import numpy as np
import pandas as pd
import pytest
import yaml

import train
from aser.errors import ConfigError
from aser.study import runs

STEPS = (100, 200, 300)


def config(sampler="aser", **changes):
    whole = {
        "env": {"name": "maze", "id": "aser/Maze-v0", "layout": "large", "layout_seed": 0},
        "sampler": sampler,
        "hyper": {"set": "thesis", "source": "thesis/maze", "lr": 0.003, "h": 10.0},
        "bootstrap": {"name": "threshold", "batch": "uniform"},
        "steps": 300,
        "seeds": [0, 1],
        "run_dir": None,
    }
    return whole | changes


def write_run(folder, config, seeds=(0, 1), summary=None, best=0.0):
    """A synthetic finished run: seed s has the return best - s - 1 / step."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    rows = [(seed, step, best - seed - 1 / step) for step in STEPS for seed in seeds]
    for name, column in (("returns", "return"), ("diagnostics", "temperature")):
        pd.DataFrame(rows, columns=["seed", "step", column]).to_csv(
            folder / f"{name}.csv", index=False
        )
    (folder / "summary.json").write_text(
        json.dumps({"solved": None} if summary is None else summary)
    )
    return folder


class TestLoad:
    def test_reads_what_was_written_to_the_last_bit(self, tmp_path):
        run = runs.load(
            write_run(tmp_path / "a", config(), summary={"solved": 1, "iqm_final": -0.5})
        )
        assert run.sampler == "aser" and run.environment == "maze large"
        assert run.config["hyper"]["h"] == 10 and run.summary["solved"] == 1
        assert run.returns["return"].tolist() == [
            0.0 - seed - 1 / step for step in STEPS for seed in (0, 1)
        ]
        assert list(run.diagnostics.columns) == ["seed", "step", "temperature"]

    def test_a_run_going_on_is_read_only_when_asked_for(self, tmp_path):
        folder = write_run(tmp_path / "a", config())
        (folder / "summary.json").unlink()
        (folder / "diagnostics.csv").unlink()
        with pytest.raises(ConfigError, match="not finished.*resume=true"):
            runs.load(folder)
        run = runs.load(folder, finished=False)
        assert run.summary == {} and len(run.diagnostics) == 0 and len(run.returns) == 6

    @pytest.mark.parametrize("more", ["", "0", "0,400", "0,400,-1\n", "0,400,-1\n1,400,-"])
    def test_a_step_that_is_half_written_may_still_come(self, tmp_path, more):
        folder = write_run(tmp_path / "a", config())
        (folder / "summary.json").unlink()
        whole = runs.load(folder, finished=False).returns
        with (folder / "returns.csv").open("a") as file:
            file.write(more)
        pd.testing.assert_frame_equal(runs.load(folder, finished=False).returns, whole)

    def test_a_run_that_has_only_begun_has_no_returns(self, tmp_path):
        folder = write_run(tmp_path / "a", config())
        for file in ("summary.json", "returns.csv", "diagnostics.csv"):
            (folder / file).unlink()
        assert runs.load(folder, finished=False).returns.empty
        (folder / "returns.csv").write_text("seed,step,return\n")
        assert runs.load(folder, finished=False).returns.empty

    @pytest.mark.parametrize(
        ("name", "content", "says"),
        [
            ("config.yaml", None, "no config.yaml"),
            ("config.yaml", "a: [", "cannot be read"),
            ("config.yaml", "- 1", "not the config of a run"),
            ("returns.csv", None, "missing"),
            ("returns.csv", "", "cannot be read"),
            ("returns.csv", "seed,step\n0,100\n", "lacks the column return"),
            ("returns.csv", "seed,step,return\n0,100,-1\n1,100,-", "was cut off"),
            ("returns.csv", "seed,step,return\n0,100,-1\n1,100", "was cut off"),
            ("returns.csv", "seed,step,return\n0,100,-1\n1,100\n", "line 3 lacks a cell"),
            ("returns.csv", "seed,step,return\n0,100,-1\n1,100,\n", "line 3 lacks a cell"),
            ("returns.csv", "seed,step,return\n0,100,-1\n\n1,100,-1\n", "line 3 lacks a cell"),
            ("returns.csv", "seed,step,return\n0,100,-1,7\n", "line 2 .* one too many"),
            ("returns.csv", "seed,step,return\n0,100,-\n", "column return, .* a number"),
            ("returns.csv", "seed,step,return\n0,nan,1\n", "column step, .* a whole number"),
            ("returns.csv", "seed,step,return\n0.5,100,1\n", "column seed, .* a whole number"),
            (
                "returns.csv",
                "seed,step,return\n0,100,1\n1,100,1\n1,200,1\n",
                "seed 0 has 0 rows at step 200",
            ),
            ("returns.csv", "seed,step,return\n0,100,1\n0,100,1\n", "seed 0 has 2 rows"),
            ("diagnostics.csv", "seed,step,x\n0,100,", "was cut off"),
            ("diagnostics.csv", None, "missing"),
            ("summary.json", None, "not finished"),
            ("summary.json", "{", "cannot be read"),
        ],
    )
    def test_broken_folders_are_refused_in_one_line(self, tmp_path, name, content, says):
        folder = write_run(tmp_path / "a", config())
        (folder / name).unlink()
        if content is not None:
            (folder / name).write_text(content)
        with pytest.raises(ConfigError, match=says) as caught:
            runs.load(folder)
        assert "\n" not in str(caught.value) and str(folder) in str(caught.value)

    def test_nan_is_a_return_as_a_run_writes_it(self, tmp_path):
        folder = write_run(tmp_path / "a", config())
        (folder / "returns.csv").write_text("seed,step,return\n0,100,nan\n1,100,-inf\n2,100,-3\n")
        values = runs.load(folder).returns["return"].to_numpy()
        assert np.isnan(values[0]) and values[1] == -np.inf and values[2] == -3

    @pytest.mark.parametrize(
        ("file", "text"),
        [
            ("config.yaml", "sampler: per\nenv: maze"),
            ("config.yaml", "sampler: per\nenv: {layout: toy}"),
            ("config.yaml", "- sampler"),
            ("summary.json", "[1, 2]"),
        ],
    )
    def test_files_of_another_shape_are_one_line(self, tmp_path, file, text):
        folder = write_run(tmp_path / "run", config())
        runs.load(folder)
        (folder / file).write_text(text)
        with pytest.raises(ConfigError, match=rf"{file}: not the \w+ of a run [^\n]*$"):
            runs.load(folder)

    def test_a_missing_folder_is_named(self, tmp_path):
        with pytest.raises(ConfigError, match="nowhere"):
            runs.load(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("env", "name"),
    [
        ({"name": "maze", "layout": "toy", "layout_seed": 5}, "maze toy"),
        ({"name": "maze_sparse", "layout": "random", "layout_seed": 5}, "maze_sparse random 5"),
        ({"name": "maze", "layout": "my/own.txt"}, "maze my/own.txt"),
        ({"name": "maze", "layout": "your/own.txt"}, "maze your/own.txt"),
        ({"name": "maze", "layout": "large.txt"}, "maze large.txt"),
        ({"name": "maze", "layout": "large", "slip": 0.0}, "maze large"),
        ({"name": "maze", "layout": "large", "slip": 0.1}, "maze large slip=0.1"),
        (
            {"name": "maze", "layout": "random", "layout_seed": 3, "size": [6, 5]},
            "maze random 3 size=[6,5]",
        ),
        ({"name": "maze", "layout": "random", "size": [12, 10]}, "maze random 0"),
        (
            {"name": "corridor", "length": 1.0, "gates": runs.AS_SHIPPED["gates"]},
            "corridor length=1.0",
        ),
        (
            {"name": "corridor", "length": 2.0, "gates": [[0.4, 0.3, 0.7]]},
            "corridor gates=[[0.4,0.3,0.7]]",
        ),
        ({"name": "pendulum"}, "pendulum"),
        ({"name": "gym", "id": "Hopper-v5", "steps": 9, "eval_episodes": 1}, "Hopper-v5"),
        (
            {"name": "gym", "id": "Hopper-v5", "xml": 2, "frame_skip": 1},
            "Hopper-v5 frame_skip=1 xml=2",
        ),
    ],
)
def test_environments_that_differ_have_different_names(tmp_path, env, name):
    assert runs.load(write_run(tmp_path / "a", config(env=env))).environment == name


def test_names_leave_out_what_ships():
    corridor = yaml.safe_load((train.CONF / "env" / "corridor.yaml").read_text())
    assert {key: corridor[key] for key in ("length", "gates")} | {
        "size": [12, 10]
    } == runs.AS_SHIPPED
    assert "null takes [12, 10]" in (train.CONF / "env" / "maze.yaml").read_text()


class TestLabels:
    def label(self, tmp_path, *configs):
        return runs.labels(
            [runs.load(write_run(tmp_path / f"run{i}", c)) for i, c in enumerate(configs)]
        )

    def test_the_sampler_is_enough_where_each_has_one_run(self, tmp_path):
        assert self.label(tmp_path, config("aser", steps=5), config("per")) == ["aser", "per"]

    def test_what_follows_from_other_settings_is_not_told(self, tmp_path):
        parts = [
            {
                "criterion": {"name": name, "squashed": squashed},
                "bootstrap": {"name": "threshold", "criterion": {"name": name}},
                "steps": steps,
                "buffer": steps,
                "sources": {"my_criteria": digest},
            }
            for name, squashed, steps, digest in (
                ("mode_log_prob", True, 50, "a1"),
                ("q_range", None, 30, "b2"),
            )
        ]
        assert self.label(tmp_path, *(config("aser", **part) for part in parts)) == [
            "aser criterion.name=mode_log_prob criterion.squashed=True steps=50",
            "aser criterion.name=q_range steps=30",
        ]

    def test_a_criterion_of_ones_own_is_part_of_the_name(self, tmp_path):
        own = {"criterion": {"name": "my_criteria.regret"}}
        shuffled = {"criterion": {"name": "shuffled", "of": "my_criteria.regret"}}
        stops = {"criterion": {"name": "uniform"}}
        stops["bootstrap"] = {"name": "threshold", "criterion": {"name": "my_criteria.far"}}
        configs = [config("aser", **own), config("aser"), config("aser_shuffled", **shuffled)]
        configs += [config("aser", **stops), config("mine", **own), config("aser", **shuffled)]
        assert self.label(tmp_path, *configs) == [
            "aser (my_criteria.regret)",
            "aser",
            "aser_shuffled (my_criteria.regret)",
            "aser (my_criteria.far)",
            "mine",
            "aser (shuffled my_criteria.regret)",
        ]

    def test_settings_tell_two_runs_of_one_criterion_apart(self, tmp_path):
        own = {"criterion": {"name": "my_criteria.regret"}}
        configs = [config("aser", **own, steps=steps) for steps in (30, 50)]
        assert self.label(tmp_path, *configs) == [
            "aser (my_criteria.regret) steps=30",
            "aser (my_criteria.regret) steps=50",
        ]

    def test_what_differs_is_told_where_a_sampler_has_two_runs(self, tmp_path):
        other = config(
            bootstrap={"name": "threshold", "batch": "prioritised"}, run_dir="x", seeds=[7]
        )
        names = self.label(tmp_path, config(), other, config("per"))
        assert names == ["aser bootstrap.batch=uniform", "aser bootstrap.batch=prioritised", "per"]

    def test_values_are_named_as_on_the_command_line(self, tmp_path):
        other = config(hyper={"set": "thesis", "source": "thesis/maze", "lr": 0.01, "h": 10.0})
        assert self.label(tmp_path, config(), other) == [
            "aser hyper.lr=0.003",
            "aser hyper.lr=0.01",
        ]

    def test_another_set_of_hyper_parameters_is_told_by_its_name(self, tmp_path):
        other = config(hyper={"set": "sb3", "source": "sb3/any", "lr": 0.0003, "h": 10.0})
        assert self.label(tmp_path, config(), other) == [
            "aser hyper.set=thesis",
            "aser hyper.set=sb3",
        ]

    def test_one_sampler_in_two_environments_needs_no_more_words(self, tmp_path):
        other = config(env={"name": "pendulum"})
        assert self.label(tmp_path, config(), other) == ["aser", "aser"]

    def test_equal_configs_are_told_apart_by_their_folders(self, tmp_path):
        assert self.label(tmp_path, config(), config(seeds=[5])) == ["aser run0", "aser run1"]


def test_a_run_has_the_name_that_its_reader_gives(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path / "a", config())
    write_run(tmp_path / "x=b", config())
    words = ["SAC, small=a", "a", "x=b", "./x=b"]
    found = [runs.load_named(word) for word in words]
    assert [run.name for run in found] == ["SAC, small", None, None, None]
    assert runs.labels(found[:2])[0] == "SAC, small"
    assert set(runs.tidy(found[:1])["label"]) == {"SAC, small"}
    with pytest.raises(ConfigError, match="=a: has no name; allowed is NAME=FOLDER"):
        runs.load_named("=a")
    with pytest.raises(ConfigError, match="run folder runs/x=3: there is no such folder"):
        runs.load_named("runs/x=3")
    assert [run.name for run in runs.load_several(["a", "mine=x=b"])] == [None, "mine"]
    with pytest.raises(ConfigError, match=r"/x=b is given twice; allowed: each run once"):
        runs.load_several(["x=b", "a", "mine=./x=b"])


def test_tidy_is_one_long_table(tmp_path):
    folders = [
        write_run(tmp_path / "a", config("aser"), seeds=(0, 1)),
        write_run(tmp_path / "b", config("per", env={"name": "pendulum"}), seeds=(3, 4, 5)),
    ]
    table = runs.tidy([runs.load(folder) for folder in folders])
    assert list(table.columns) == ["label", "env", "sampler", "seed", "step", "return"]
    assert table.groupby(["label", "env", "sampler"]).size().to_dict() == {
        ("aser", "maze large", "aser"): 6,
        ("per", "pendulum", "per"): 9,
    }
    row = table[(table["seed"] == 4) & (table["step"] == 200)]
    assert row["return"].tolist() == [-4 - 1 / 200]
