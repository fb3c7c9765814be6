"""What is drawn of a finished run: by the script, on a criterion of one's own too."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import show
from PIL import Image

import aser
import train
from aser import checkpoint, settle
from aser.show import SLOWEST, SOFT_VALUE, p_of
from aser.study.plots import axes
from aser.study.runs import load
from aser.study.tables import checkpoint as tables
from aser.study.tables.marks import marks, ranked

TOY = {"env": "maze", "env__layout": "toy", "hyper": "thesis", "hyper__from": "aser"}
TOY |= {"debug": "smoke", "learning_starts": 20, "batch": 6, "steps": 110, "eval__every": 40}
OWN = '''
import torch


def eastern(state, obs, gaussian):
    return obs[0] + 2.0


class Far:
    """How far a state lies from the mean of what was drawn."""

    def init(self, key, obs_dim, action_dim):
        return {"mean": torch.zeros(obs_dim)}

    def update(self, own, transitions, state, hyper, noise):
        return {"mean": 0.9 * own["mean"] + 0.1 * transitions.obs.mean(1)}

    def p(self, own, state, obs, gaussian):
        return (obs - own["mean"][:, None]).square().sum(0).sqrt()
'''


@pytest.fixture
def place(house, monkeypatch):
    """A checkout where a module with criteria of one's own lies."""
    Path("shown_criteria.py").write_text(OWN)
    monkeypatch.syspath_prepend(house)
    monkeypatch.delitem(sys.modules, "shown_criteria", raising=False)  # of another test
    return house


def trained(**settings):
    aser.train(**TOY, seeds=[4, 7], run_dir="run", **settings)
    return load("run")


def lines(capsys, *words):
    capsys.readouterr()
    assert show.main(["run", *words]) == 0
    return capsys.readouterr().out.splitlines()


def test_the_script_says_where_the_pictures_are(house, capsys):
    aser.train(**TOY, sampler="aser", seeds=[4], keep="best", run_dir="run")
    files = ["learning_curve.png", "maps.png", "criterion.png", "episode_seed4.gif"]
    assert lines(capsys, "--best") == [f"picture in run/show/{file}" for file in files]
    assert {path.name for path in Path("run/show").iterdir()} == set(files)
    with Image.open("run/show/episode_seed4.gif") as gif:
        for frame in range(gif.n_frames - 1):
            gif.seek(frame)
            assert gif.info["duration"] <= SLOWEST
    assert show.main(["run", "--seed", "9"]) == 1
    assert capsys.readouterr().err == "show: seed=9: is not a seed of run; allowed: 4\n"
    settings = {"sampler": "aser", "keep": "best", "run_dir": "run", "force": True}
    aser.train(**TOY, seeds=[4], **settings)
    assert len(list(Path("run/show").iterdir())) == len(files)  # what is ours stays


def test_the_last_line_of_a_run_is_the_command_that_shows_it(house, capsys):
    words = ["env=maze", "sampler=uniform", "debug=smoke", "steps=110", "compile=false"]
    assert train.main([*words, "run_dir=my run"]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    named = shlex.split(last.removeprefix("next: python "))
    root = Path(__file__).parent.parent
    assert [Path(named[0]), *named[1:]] == [root / "scripts" / "show.py", "my run"]
    assert show.main(named[1:]) == 0


def test_the_map_names_the_soft_value(house, capsys, monkeypatch):
    trained(sampler="uniform")
    named = set()

    def save(page, path):
        named.update(text for ax in page.axes for text in (ax.get_ylabel(), ax.get_xlabel()))
        return path

    monkeypatch.setattr(axes, "save", save)
    lines(capsys)
    assert SOFT_VALUE in named and "value" not in named


@pytest.mark.parametrize("sampler", ["aser", "oracle", "outcome_spread"])
def test_p_is_that_of_the_committed_figure(sampler, house):
    run = trained(sampler=sampler)
    ours, theirs = ranked(run, p_of(run)), marks(run)
    np.testing.assert_allclose(ours["p"], theirs["p"], rtol=1e-4)
    assert ours["auc"].tolist() == pytest.approx(theirs["auc"].tolist(), abs=0.02)


def test_p_of_a_function_of_ones_own(place, capsys):
    run = trained(sampler="aser", criterion__name="shown_criteria.eastern")
    states = tables.maze(run).states
    np.testing.assert_allclose(p_of(run), np.tile(states.observation[:, 0] + 2.0, (2, 1)))
    assert "picture in run/show/criterion.png" in lines(capsys)


def test_p_of_a_class_of_ones_own_has_what_each_seed_has_learned(place, capsys, monkeypatch):
    run = trained(sampler="aser", criterion__name="shown_criteria.Far")
    (mean,) = checkpoint.load(run.folder / checkpoint.NAME)["training"]["criteria"]
    states = tables.maze(run).states.observation
    by_hand = np.linalg.norm(states[None] - mean.numpy()[:, None], axis=2)
    assert not np.allclose(by_hand[0], by_hand[1])
    np.testing.assert_allclose(p_of(run), by_hand, rtol=1e-5)
    assert "picture in run/show/criterion.png" in lines(capsys)
    # The same file with another formula would draw what never trained.
    Path("shown_criteria.py").write_text(OWN.replace("0.9", "0.8"))
    monkeypatch.setattr(settle, "_LOADED", {})  # as in a new process
    said = "shown_criteria has changed since the run; allowed: as it was then"
    assert f"no map of p: {said}" in lines(capsys)


def test_where_an_environment_does_not_draw_itself_a_line_says_so(house, monkeypatch, capsys):
    page = (Path(__file__).parent.parent / "docs" / "own.md").read_text()
    example = re.search(r"<!-- example: my_envs.py -->\n```python\n(.*?)```", page, re.DOTALL)[1]
    Path("shown_envs.py").write_text(example.replace("my_envs", "shown_envs"))
    monkeypatch.syspath_prepend(house)
    words = {"env": "gym", "env__id": "shown_envs:PointMass-v0", "sampler": "uniform"}
    sizes = {"debug": "smoke", "steps": 110, "learning_starts": 100, "network": "small"}
    aser.train(**words, **sizes, compile=False, run_dir="run")
    curve, episode = lines(capsys)
    assert curve == "picture in run/show/learning_curve.png"
    assert episode.startswith("no episode: env.id=shown_envs:PointMass-v0 cannot be drawn: ")


def test_ours_draw_themselves_in_gymnasium_as_the_docs_say():
    page = (Path(__file__).parent.parent / "docs" / "python.md").read_text()
    said = re.search(r"after `(import .*?)`, so does `(gymnasium\.make.*?)`\.", page)
    code = f"import gymnasium\n{said[1]}\nenv = {said[2]}\nenv.reset()\nprint(env.render().shape)"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.stdout == "(120, 388, 3)\n", ended.stderr


@pytest.mark.parametrize(
    ("sampler", "why"),
    [
        ("uniform", "sampler=uniform uses no criterion"),
        ("per", "the criterion td_error is known for drawn items, and for no state"),
    ],
)
def test_where_p_is_no_function_of_the_state_a_line_says_so(sampler, why, house, capsys):
    trained(sampler=sampler)
    said = lines(capsys)
    assert f"no map of p: {why}" in said and not Path("run/show/criterion.png").exists()
    assert len(said) == 4
