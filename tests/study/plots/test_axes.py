"""What is drawn equals what was computed; pictures are written whole or not at all."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgba
from PIL import Image

from aser.errors import ConfigError
from aser.study.plots import axes
from aser.study.plots.style import style
from aser.study.statistics import estimates


def returns(runs=6, steps=(100, 200, 300, 400)):
    random = np.random.default_rng(0)
    rows = [(seed, step, random.normal()) for seed in range(runs) for step in steps]
    return pd.DataFrame(rows, columns=["seed", "step", "return"])


class TestLearningCurve:
    def test_line_and_band_are_the_statistics(self):
        _, (ax,) = axes.figure()
        axes.learning_curve(ax, returns(), style("oracle"), "label")
        expected = estimates.learning_curve(returns())
        (line,) = ax.get_lines()
        np.testing.assert_array_equal(line.get_xydata(), expected[["step", "iqm"]])
        (band,) = ax.collections
        corners = {tuple(point) for point in band.get_paths()[0].vertices}
        for row in expected.itertuples():
            assert {(row.step, row.low), (row.step, row.high)} <= corners
        assert line.get_color() == style("oracle").colour and line.get_label() == "label"
        assert tuple(band.get_facecolor()[0][:3]) == to_rgba(line.get_color())[:3]

    def test_lanes_stand_behind_the_curve(self):
        _, (ax,) = axes.figure()
        data = returns(runs=5)
        axes.learning_curve(ax, data, style("aser"), "label", lanes=True)
        *lanes, middle = ax.get_lines()
        assert len(lanes) == 5 and all(lane.get_zorder() < middle.get_zorder() for lane in lanes)
        np.testing.assert_array_equal(lanes[3].get_ydata(), data.loc[data["seed"] == 3, "return"])

    def test_one_run_and_one_evaluation_show_a_point_and_no_band(self):
        _, (ax,) = axes.figure()
        axes.learning_curve(ax, returns(runs=1, steps=(50,)), style("aser"), "label")
        assert ax.get_lines()[0].get_marker() == "o"
        assert not np.isfinite(ax.collections[0].get_datalim(ax.transData).get_points()).any()

    def test_the_band_of_diverged_runs_goes_down_to_the_lowest_return(self):
        data = returns(runs=8)
        data.loc[data["seed"] < 3, "return"] = np.nan
        _, (ax,) = axes.figure()
        axes.learning_curve(ax, data, style("aser"), "label", lanes=True)
        corners = ax.collections[0].get_paths()[0].vertices
        assert np.isfinite(corners).all() and corners[:, 1].min() == data["return"].min()


class TestSave:
    def test_png_of_150_dots_an_inch_and_pdf_and_nothing_else(self, tmp_path):
        page, _ = axes.figure(width=4, height=3)
        assert axes.save(page, tmp_path / "new" / "x.png", pdf=True) == tmp_path / "new" / "x.png"
        assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["x.pdf", "x.png"]
        assert Image.open(tmp_path / "new" / "x.png").size == (600, 450)

    def test_same_data_same_bytes(self, tmp_path):
        for name in ("a", "b"):
            page, (ax,) = axes.figure()
            axes.learning_curve(ax, returns(), style("aser"), "label")
            axes.save(page, tmp_path / f"{name}.png", pdf=True)
        for end in ("png", "pdf"):
            assert (tmp_path / f"a.{end}").read_bytes() == (tmp_path / f"b.{end}").read_bytes()

    def test_a_failure_leaves_the_old_picture_and_no_draft(self, tmp_path, monkeypatch):
        page, _ = axes.figure()
        (tmp_path / "x.png").write_bytes(b"old")

        def half(draft, **_):
            Path(draft).write_bytes(b"half a pict")
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(page, "savefig", half)
        with pytest.raises(ConfigError, match="x.png.*No space left"):
            axes.save(page, tmp_path / "x.png")
        assert [path.name for path in tmp_path.iterdir()] == ["x.png"]
        assert (tmp_path / "x.png").read_bytes() == b"old"

    def test_other_endings_and_folders_that_cannot_be_are_refused(self, tmp_path):
        page, _ = axes.figure()
        with pytest.raises(ConfigError, match="ends in .png"):
            axes.save(page, tmp_path / "x.jpg")
        (tmp_path / "file").write_text("")
        with pytest.raises(ConfigError, match="cannot be written"):
            axes.save(page, tmp_path / "file" / "x.png")


def test_importing_the_study_loads_nothing_that_trains_and_no_window_toolkit():
    unwanted = {"torch", "hydra", "omegaconf", "matplotlib.pyplot"}
    code = f"import sys, aser.study.figures; print({unwanted} & set(sys.modules))"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout
        == "set()\n"
    )
