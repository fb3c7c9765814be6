"""What is drawn equals what was computed; files are written whole; samplers keep their looks."""

import importlib.util
import subprocess
import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgba
from PIL import Image
from test_runs import config, write_run

from aser.errors import ConfigError
from aser.study.plots import axes as plots
from aser.study.plots import runs as figures
from aser.study.plots import style as styles
from aser.study.runs import load
from aser.study.statistics import estimates as statistics

SHIPPED = {
    *("uniform", "per", "nstep", "nstep_geometric"),
    *("aser", "aser_shuffled", "aser_q", "pretrained", "oracle"),
    *(
        "aser_no_prioritisation",
        "aser_no_bootstrap",
        "oracle_no_prioritisation",
        "oracle_no_bootstrap",
    ),
}
TOGETHER = [  # the samplers that stand in one picture
    ["uniform", "per", "nstep", "aser", "aser_shuffled", "aser_q", "oracle"],
    ["uniform", "pretrained", "oracle"],
    ["uniform", "per", "aser", "pretrained"],
    ["uniform", "oracle", "oracle_no_prioritisation", "oracle_no_bootstrap"],
    ["uniform", "aser", "aser_no_prioritisation", "aser_no_bootstrap"],
    ["uniform", "per", "per_unweighted", "nstep", "aser"],
    ["uniform", "per", "aser_mode_prob", "pretrained_mode_prob", "aser", "pretrained"],
    ["dqn", "dqn_per", "dqn_aser", "dqn_oracle"],
]


def returns(runs=6, steps=(100, 200, 300, 400)):
    random = np.random.default_rng(0)
    rows = [(seed, step, random.normal()) for seed in range(runs) for step in steps]
    return pd.DataFrame(rows, columns=["seed", "step", "return"])


class TestStyles:
    def test_every_shipped_sampler_has_a_look_of_its_own(self):
        assert (
            set(styles.STYLES) >= SHIPPED
        )  # and what figures show besides: variants, and DQN's runs
        looks = list(styles.STYLES.values())
        assert len({look[1:] for look in looks}) == len(looks) == len({look.name for look in looks})

    @pytest.mark.parametrize("samplers", TOGETHER, ids=" ".join)
    def test_in_one_picture_the_colours_differ_and_so_do_the_lines_without_colour(self, samplers):
        for one, two in combinations(map(styles.style, samplers), 2):
            assert one.colour != two.colour
            assert (one.dashes, one.marker) != (two.dashes, two.marker)

    def test_an_unknown_sampler_keeps_its_look_and_its_name(self):
        assert styles.style("my_own") == styles.style("my_own")
        assert styles.style("my_own").name == "my own"

    def test_second_runs_and_unknown_samplers_get_looks_that_the_picture_lacks(self):
        looks = styles.for_picture(["my_own", "aser", "aser", "uniform", "other", "aser"])
        assert looks[1] == styles.style("aser") and looks[3] == styles.style("uniform")
        assert len({look.colour for look in looks}) == 6
        assert looks[2].name == looks[5].name == "ASER" and looks[4].name == "other"

    def test_even_thirty_runs_of_one_sampler_all_differ(self):
        assert len({look[1:] for look in styles.for_picture(["aser"] * 30)}) == 30


class TestLearningCurve:
    def test_line_and_band_are_the_statistics(self):
        _, (ax,) = plots.figure()
        plots.learning_curve(ax, returns(), "label", "oracle")
        expected = statistics.learning_curve(returns())
        (line,) = ax.get_lines()
        np.testing.assert_array_equal(line.get_xydata(), expected[["step", "iqm"]])
        (band,) = ax.collections
        corners = {tuple(point) for point in band.get_paths()[0].vertices}
        for row in expected.itertuples():
            assert {(row.step, row.low), (row.step, row.high)} <= corners
        assert line.get_color() == styles.style("oracle").colour and line.get_label() == "label"
        assert tuple(band.get_facecolor()[0][:3]) == to_rgba(line.get_color())[:3]

    def test_lanes_stand_behind_the_curve(self):
        _, (ax,) = plots.figure()
        data = returns(runs=5)
        plots.learning_curve(ax, data, "label", "aser", lanes=True)
        *lanes, middle = ax.get_lines()
        assert len(lanes) == 5 and all(lane.get_zorder() < middle.get_zorder() for lane in lanes)
        np.testing.assert_array_equal(lanes[3].get_ydata(), data.loc[data["seed"] == 3, "return"])

    def test_one_run_and_one_evaluation_show_a_point_and_no_band(self):
        _, (ax,) = plots.figure()
        plots.learning_curve(ax, returns(runs=1, steps=(50,)), "label", "aser")
        assert ax.get_lines()[0].get_marker() == "o"
        assert not np.isfinite(ax.collections[0].get_datalim(ax.transData).get_points()).any()

    def test_the_band_of_diverged_runs_goes_down_to_the_lowest_return(self):
        data = returns(runs=8)
        data.loc[data["seed"] < 3, "return"] = np.nan
        _, (ax,) = plots.figure()
        plots.learning_curve(ax, data, "label", "aser", lanes=True)
        corners = ax.collections[0].get_paths()[0].vertices
        assert np.isfinite(corners).all() and corners[:, 1].min() == data["return"].min()


class TestSave:
    def test_png_of_150_dots_an_inch_and_pdf_and_nothing_else(self, tmp_path):
        page, _ = plots.figure(width=4, height=3)
        assert plots.save(page, tmp_path / "new" / "x.png", pdf=True) == tmp_path / "new" / "x.png"
        assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["x.pdf", "x.png"]
        assert Image.open(tmp_path / "new" / "x.png").size == (600, 450)

    def test_same_data_same_bytes(self, tmp_path):
        for name in ("a", "b"):
            page, (ax,) = plots.figure()
            plots.learning_curve(ax, returns(), "label", "aser")
            plots.save(page, tmp_path / f"{name}.png", pdf=True)
        for end in ("png", "pdf"):
            assert (tmp_path / f"a.{end}").read_bytes() == (tmp_path / f"b.{end}").read_bytes()

    def test_a_failure_leaves_the_old_picture_and_no_draft(self, tmp_path, monkeypatch):
        page, _ = plots.figure()
        (tmp_path / "x.png").write_bytes(b"old")

        def half(draft, **_):
            Path(draft).write_bytes(b"half a pict")
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(page, "savefig", half)
        with pytest.raises(ConfigError, match="x.png.*No space left"):
            plots.save(page, tmp_path / "x.png")
        assert [path.name for path in tmp_path.iterdir()] == ["x.png"]
        assert (tmp_path / "x.png").read_bytes() == b"old"

    def test_other_endings_and_folders_that_cannot_be_are_refused(self, tmp_path):
        page, _ = plots.figure()
        with pytest.raises(ConfigError, match="ends in .png"):
            plots.save(page, tmp_path / "x.jpg")
        (tmp_path / "file").write_text("")
        with pytest.raises(ConfigError, match="cannot be written"):
            plots.save(page, tmp_path / "file" / "x.png")


class TestFigures:
    def drawn(self, monkeypatch):
        """A list that receives every figure that is saved."""
        pages, save = [], plots.save

        def keep(page, *rest, **more):
            pages.append(page)
            return save(page, *rest, **more)

        monkeypatch.setattr(plots, "save", keep)
        return pages

    def test_run_picture_shows_the_curve_the_lanes_and_their_number(self, tmp_path, monkeypatch):
        pages = self.drawn(monkeypatch)
        folder = write_run(tmp_path / "a", config("nstep"), seeds=range(5))
        (folder / "summary.json").unlink()  # the picture is drawn before the run counts as finished
        assert figures.run_picture(folder) == folder / "learning_curve.png"
        assert Image.open(folder / "learning_curve.png").size[0] > 500
        (ax,) = pages[0].axes
        assert ax.get_title("left") == "Maze, large" and ax.get_title("right") == "5 runs"
        assert len([line for line in ax.get_lines() if len(line.get_xdata())]) == 5 + 1
        assert "10-step SAC" in ax.get_legend().get_texts()[0].get_text()

    def test_run_picture_without_evaluations_says_so(self, tmp_path):
        folder = write_run(tmp_path / "a", config())
        (folder / "returns.csv").write_text("seed,step,return\n")
        assert figures.run_picture(folder).is_file()

    def test_comparison_has_an_axes_per_environment_and_counts_the_solved(
        self, tmp_path, monkeypatch
    ):
        pages = self.drawn(monkeypatch)
        folders = [
            write_run(tmp_path / "a", config("uniform"), seeds=range(4), summary={"solved": 1}),
            write_run(tmp_path / "b", config("aser"), seeds=range(6), summary={"solved": 3}),
            write_run(tmp_path / "c", config("aser", env={"name": "pendulum", "kwargs": {}})),
        ]
        assert figures.comparison(folders, tmp_path / "out" / "x.png").is_file()
        assert (tmp_path / "out" / "x.pdf").is_file()
        maze, pendulum = pages[0].axes
        assert [text.get_text() for text in maze.get_legend().get_texts()] == [
            "SAC, uniform\n  solved 1 of 4",
            "ASER\n  solved 3 of 6",
        ]
        assert maze.get_title("right").endswith("4 to 6 runs each")
        assert pendulum.get_title("left") == "Pendulum"
        assert [text.get_text() for text in pendulum.get_legend().get_texts()] == ["ASER"]
        expected = statistics.learning_curve(load(folders[1]).returns)
        np.testing.assert_array_equal(maze.get_lines()[1].get_ydata(), expected["iqm"])


class TestCompareScript:
    def main(self, *argv):
        path = Path(__file__).parents[2] / "scripts" / "compare.py"
        spec = importlib.util.spec_from_file_location("compare", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.main([str(word) for word in argv])

    def test_writes_picture_and_table_and_prints_markdown(self, tmp_path, capsys):
        one = write_run(tmp_path / "a", config("uniform"), summary={"solved": 1})
        two = write_run(tmp_path / "b", config("aser"), seeds=(4, 5, 6))
        out, table = tmp_path / "x" / "y.png", tmp_path / "z" / "y.csv"
        assert self.main(one, two, "--out", out, "--table", table) == 0
        assert out.is_file() and out.with_suffix(".pdf").is_file()
        assert pd.read_csv(table).groupby("sampler").size().to_dict() == {"uniform": 6, "aser": 9}
        assert "| uniform | 2 |" in capsys.readouterr().out

    def test_a_missing_folder_is_one_line_and_writes_nothing(self, tmp_path, capsys):
        assert self.main(tmp_path / "nowhere", "--out", tmp_path / "y.png") == 1
        printed = capsys.readouterr()
        assert (
            printed.out == ""
            and printed.err.startswith("compare: ")
            and printed.err.count("\n") == 1
        )
        assert list(tmp_path.iterdir()) == []


def test_importing_the_study_loads_nothing_that_trains_and_no_window_toolkit():
    unwanted = {"torch", "hydra", "omegaconf", "matplotlib.pyplot"}
    code = f"import sys, aser.study.figures; print({unwanted} & set(sys.modules))"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout
        == "set()\n"
    )
