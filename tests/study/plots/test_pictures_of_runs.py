"""The picture of a run, the comparison of runs, and the script that draws it."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from PIL import Image

from aser.study.plots import axes
from aser.study.plots import runs as pictures
from aser.study.runs import load, load_named
from aser.study.statistics import estimates


def config(sampler="aser", **changes):
    env = {"name": "maze", "layout": "large"}
    return {"env": env, "sampler": sampler, "hyper": {"h": 10.0}} | changes


def write_run(folder, config, seeds=(0, 1), solved=None):
    """A finished run: seed s has the return -s - 1 / step."""
    folder.mkdir()
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    rows = [(seed, step, -seed - 1 / step) for step in (100, 200, 300) for seed in seeds]
    for name, column in (("returns", "return"), ("diagnostics", "temperature")):
        table = pd.DataFrame(rows, columns=["seed", "step", column])
        table.to_csv(folder / f"{name}.csv", index=False)
    (folder / "summary.json").write_text(json.dumps({"solved": solved}))
    return folder


class TestPictures:
    def pages(self, monkeypatch):
        """A list that receives every figure that is saved."""
        pages, save = [], axes.save

        def keep(page, *rest, **more):
            pages.append(page)
            return save(page, *rest, **more)

        monkeypatch.setattr(axes, "save", keep)
        return pages

    def test_run_picture_shows_the_curve_the_lanes_and_their_number(self, tmp_path, monkeypatch):
        pages = self.pages(monkeypatch)
        folder = write_run(tmp_path / "a", config("nstep"), seeds=range(5))
        (folder / "summary.json").unlink()  # the picture is drawn before the run counts as finished
        assert pictures.run_picture(folder) == folder / "learning_curve.png"
        assert Image.open(folder / "learning_curve.png").size[0] > 500
        (ax,) = pages[0].axes
        assert ax.get_title("left") == "Maze, large" and ax.get_title("right") == "5 runs"
        assert len([line for line in ax.get_lines() if len(line.get_xdata())]) == 5 + 1
        assert "10-step SAC" in ax.get_legend().get_texts()[0].get_text()

    def test_divergence_is_said_in_the_pictures(self, tmp_path, monkeypatch):
        pages = self.pages(monkeypatch)
        folders = [
            write_run(tmp_path / name, config(sampler), seeds=range(5), solved=1)
            for name, sampler in (("a", "uniform"), ("b", "per"))
        ]
        lost = [{"seed": 1, "step": 200}, {"seed": 3, "step": 300}]
        (folders[0] / "summary.json").write_text(json.dumps({"solved": 1, "diverged": lost}))
        pictures.run_picture(folders[0])
        pictures.run_picture(folders[1])
        (folders[1] / "summary.json").unlink()
        pictures.run_picture(folders[1], diverged=4)
        assert [page.axes[0].get_title("right") for page in pages] == [
            "5 runs, 2 of 5 diverged",
            "5 runs",
            "5 runs, 4 of 5 diverged",
        ]
        (folders[1] / "summary.json").write_text("{}")
        pictures.comparison_of([load(folder) for folder in folders], tmp_path / "x.png")
        assert [text.get_text() for text in pages[-1].axes[0].get_legend().get_texts()] == [
            "SAC, uniform\n  solved 1 of 5\n  2 of 5 diverged",
            "PER",
        ]

    def test_long_labels_are_cut_in_the_middle(self, tmp_path, monkeypatch):
        pages = self.pages(monkeypatch)
        long = "a_module_of_ones_own.with_a_very_long_name_of_a_function"
        folders = [
            write_run(tmp_path / name, config("aser", criterion={"name": value}))
            for name, value in (("a", long), ("b", "entropy"))
        ]
        pictures.comparison_of([load(folder) for folder in folders], tmp_path / "x.png")
        assert [text.get_text() for text in pages[-1].axes[0].get_legend().get_texts()] == [
            "ASER\n  (a_module_of_ones_own.wi...f_a_function)",
            "ASER",
        ]

    def test_a_name_with_dollars_is_no_formula(self, tmp_path):
        folder = write_run(tmp_path / "a", config("per"))
        named = [load_named(f"{name}={folder}") for name in (r"$\foo_$", "plain")]
        path = pictures.comparison_of(named, tmp_path / "x.png")
        assert path.stat().st_size > 5000

    def test_run_picture_without_evaluations_says_so(self, tmp_path, monkeypatch):
        pages = self.pages(monkeypatch)
        folder = write_run(tmp_path / "a", config())
        (folder / "returns.csv").write_text("seed,step,return\n")
        pictures.run_picture(folder)
        texts = [text.get_text() for text in pages[-1].axes[0].texts]
        assert any("no evaluations" in text for text in texts), texts

    def test_comparison_has_an_axes_per_environment_and_counts_the_solved(
        self, tmp_path, monkeypatch
    ):
        pages = self.pages(monkeypatch)
        folders = [
            write_run(tmp_path / "a", config("uniform"), seeds=range(4), solved=1),
            write_run(tmp_path / "b", config("aser"), seeds=range(6), solved=3),
            write_run(tmp_path / "c", config("aser", env={"name": "pendulum", "kwargs": {}})),
        ]
        assert pictures.comparison_of(
            [load(folder) for folder in folders], tmp_path / "out" / "x.png"
        ).is_file()
        assert (tmp_path / "out" / "x.pdf").is_file()
        maze, pendulum = pages[0].axes
        assert [text.get_text() for text in maze.get_legend().get_texts()] == [
            "SAC, uniform\n  solved 1 of 4",
            "ASER\n  solved 3 of 6",
        ]
        assert maze.get_title("right").endswith("4 to 6 runs each")
        assert pendulum.get_title("left") == "Pendulum"
        assert [text.get_text() for text in pendulum.get_legend().get_texts()] == ["ASER"]
        expected = estimates.learning_curve(load(folders[1]).returns)
        np.testing.assert_array_equal(maze.get_lines()[1].get_ydata(), expected["iqm"])


class TestCompareScript:
    def main(self, *argv):
        path = Path(__file__).parents[3] / "scripts" / "compare.py"
        spec = importlib.util.spec_from_file_location("compare", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.main([str(word) for word in argv])

    def test_writes_picture_and_table_and_prints_markdown(self, tmp_path, capsys):
        one = write_run(tmp_path / "a", config("uniform"), solved=1)
        two = write_run(tmp_path / "b", config("aser"), seeds=(4, 5, 6))
        out, table = tmp_path / "x" / "y.png", tmp_path / "z" / "y.csv"
        assert self.main(one, two, "--out", out, "--table", table) == 0
        assert out.is_file() and out.with_suffix(".pdf").is_file()
        assert pd.read_csv(table).groupby("sampler").size().to_dict() == {"uniform": 6, "aser": 9}
        assert "| uniform | 2 |" in capsys.readouterr().out

    def test_without_a_place_it_prints_and_writes_nothing(self, tmp_path, capsys):
        folders = [write_run(tmp_path / name, config(name)) for name in ("uniform", "per")]
        (folders[1] / "summary.json").unlink()
        before = sorted(tmp_path.rglob("*"))
        assert self.main(*folders) == 0
        said = capsys.readouterr().out
        assert "| per - uniform | 0.000 [0.000, 0.000] | 0.50 [" in said
        assert said.splitlines()[-1].endswith("per is not finished: evaluated up to 300 of 0.")
        assert self.main(*folders, "--latex") == 0
        said = capsys.readouterr().out
        assert said.count("tabular") == 4 and said.splitlines()[-1].startswith("% ")
        assert sorted(tmp_path.rglob("*")) == before

    def test_runs_that_share_no_evaluation_are_one_line_and_write_nothing(self, tmp_path, capsys):
        one, two = (write_run(tmp_path / name, config(name)) for name in ("uniform", "per"))
        table = pd.read_csv(two / "returns.csv")
        table.assign(step=table["step"] + 50).to_csv(two / "returns.csv", index=False)
        assert self.main(one, two, "--out", tmp_path / "x" / "y.png") == 1
        printed = capsys.readouterr()
        assert printed.out == "" and printed.err.count("\n") == 1
        assert printed.err.startswith("compare: maze large: uniform is evaluated at 100, 200, 300")
        assert not (tmp_path / "x").exists()

    def test_a_missing_folder_is_one_line_and_writes_nothing(self, tmp_path, capsys):
        assert self.main(tmp_path / "nowhere", "--out", tmp_path / "y.png") == 1
        printed = capsys.readouterr()
        assert (
            printed.out == ""
            and printed.err.startswith("compare: ")
            and printed.err.count("\n") == 1
        )
        assert list(tmp_path.iterdir()) == []
