"""From Python: the same runs as the command's, and agents that act as they were evaluated."""

import os
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from PIL import Image

import aser
import train
from aser import build
from aser.api import _written
from aser.errors import ConfigError
from aser.training.evaluation import EVALUATION_SEED

ROOT = Path(__file__).parent.parent
TINY = {"debug": "smoke", "learning_starts": 20, "batch": 6, "steps": 110, "eval__every": 40}
TOY = {**TINY, "env": "maze", "env__layout": "toy", "sampler": "aser", "hyper": "thesis"}
CORRIDOR = {**TINY, "env": "corridor", "sampler": "uniform", "hyper": "thesis"}


def command(**settings):
    """The settings as words of the command line."""
    return [f"{key.replace('__', '.')}={_written(key, value)}" for key, value in settings.items()]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run in the corridor that has kept its best agents."""
    folder = tmp_path_factory.mktemp("api") / "run"
    return aser.train(**CORRIDOR, seeds=[3, 5], keep="best", run_dir=folder)


def episode(run, policy):
    """The return of the first episode of an evaluation, by one observation after the other."""
    env = gymnasium.make(run.config["env"]["id"])
    obs, _ = env.reset(seed=EVALUATION_SEED + 1000 * policy.seed)
    total, over = 0.0, False
    while not over:
        obs, reward, terminated, truncated, _ = env.step(policy.act(obs))
        total, over = total + reward, terminated or truncated
    return total


# Training


@pytest.mark.parametrize("path", ["2024", "1e3", "null", "true", "runs/a b", "x"])
def test_a_path_is_a_text_whatever_it_looks_like(path):
    for value in (path, Path(path)):
        (word,) = command(run_dir=value)
        assert train.settings([word]).run_dir == path
    assert train.settings(["run_dir=2024"]).run_dir == "2024"


def test_train_does_what_the_command_does(house, capsys):
    run = aser.train("env.layout=toy", **{**TOY, "env__layout": "toy"}, seeds=range(2))
    assert capsys.readouterr().out.endswith(f"results in {run.folder}\n")
    assert train.main(command(**TOY, seeds=2)) == 0
    assert f"finished before, not trained again (force=true does): {run.folder}" in (
        capsys.readouterr().out
    )
    assert train.main([*command(**TOY, seeds=2), "run_dir=other"]) == 0
    for file in ("returns.csv", "diagnostics.csv"):
        assert (run.folder / file).read_bytes() == Path("other", file).read_bytes()
    other = aser.load("other")
    assert run.returns.equals(other.returns) and run.returns.columns[2] == "return"
    assert run.diagnostics.equals(other.diagnostics)
    assert run.summary["iqm_final"] == other.summary["iqm_final"]
    assert run.config["seeds"] == [0, 1] and "2 seeds, final IQM return" in repr(run)
    (ax,) = run.plot().axes
    assert ax.get_xlabel() == "environment steps"


@pytest.mark.parametrize("text", ["a b", "x,y=[1]", 'say "a"', "it's", "a\\", 'b\\"', "ä", "{c}"])
def test_any_text_is_a_value(text):
    assert train.settings(command(run_dir=text)).run_dir == text


def test_values_are_those_of_the_command_line():
    words = command(hyper__lr=1e-5, seeds=np.arange(2), eval__every=None, resume=True, steps="4e3")
    assert words == ["hyper.lr=1e-05", "seeds=[0,1]", "eval.every=null", "resume=true", "steps=4e3"]
    assert command(env__gates=[[0.4, -1, 1]]) == ["env.gates=[[0.4,-1,1]]"]
    assert train.settings(words).hyper.values["lr"] == 1e-5


@pytest.mark.parametrize(
    "settings",
    [{"sampler": "azer"}, {"hyper__gama": 0.9}, {"seeds": [1, 1]}, {"env__layout": "nowhere"}],
    ids=str,
)
def test_errors_are_the_lines_of_the_command(settings, house, capsys):
    with pytest.raises(aser.ConfigError) as error:
        aser.train(**{**TINY, **settings})
    assert train.main(command(**{**TINY, **settings})) == 1
    assert capsys.readouterr().err == f"train: {error.value}\n"


def test_what_is_no_value_is_refused():
    with pytest.raises(ConfigError, match="^seeds=<object.*: must be a text, a number"):
        aser.train(seeds=object())
    with pytest.raises(ConfigError, match="^train=.*: must be a text such as 'env=maze'"):
        aser.train({"env": "maze"})
    with pytest.raises(ConfigError, match="^-m: there is no such option"):
        aser.train("-m", sampler="aser")
    with pytest.raises(ConfigError, match="no config.yaml in it"):
        aser.load(ROOT / "docs")
    with pytest.raises(ConfigError, match="there is no such folder"):
        aser.load(ROOT / "dogs")
    with pytest.raises(ConfigError, match=r"^sampler=\[aser,per\]: one choice; several runs need"):
        aser.train(sampler=["aser", "per"])
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        aser.trian  # noqa: B018


def test_a_train_module_of_ones_own_is_not_taken_for_the_command(tmp_path):
    (tmp_path / "train.py").write_text("raise SystemExit('the wrong module')\n")
    (tmp_path / "mine.py").write_text(
        "import aser, aser.show\n"
        "run = aser.train('debug=smoke', env='maze', env__layout='toy', run_dir='run')\n"
        "print(len(run.returns))\n"
    )
    command = [sys.executable, "mine.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.splitlines()[-1]) > 0


def test_what_is_public_is_offered_for_completion():
    assert set(aser.__all__) == set(dir(aser))


def test_import_aser_is_light():
    code = "import sys, aser; print(sorted({'torch', 'pandas', 'hydra'} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout == "[]\n"


# Policies


@pytest.mark.parametrize("seed", [3, 5])
def test_a_policy_acts_as_it_was_evaluated(run, seed):
    returns = run.returns[run.returns["seed"] == seed].set_index("step")["return"]
    last, best = run.policy(seed), run.policy(seed, best=True)
    assert (last.seed, last.step) == (seed, 110)
    assert episode(run, last) == returns.iloc[-1]
    assert best.step == returns.idxmax() and episode(run, best) == returns.max()


def test_actions_of_many_observations_are_those_of_each(run):
    policy = run.policy()
    obs = np.linspace(-1, 1, 7)[:, None]
    actions = policy.act(obs)
    assert policy.seed == 3 and actions.shape == (7, 1) and actions.dtype == np.float32
    one = np.stack([policy.act(each) for each in obs])
    np.testing.assert_allclose(one, actions, rtol=1e-6, atol=1e-7)
    for wrong in (np.zeros(2), np.zeros((1, 1, 1)), 0.0):
        with pytest.raises(ValueError, match="allowed: \\(1,\\) or \\(N, 1\\)"):
            policy.act(wrong)


def test_weights_have_names_and_are_copies(run):
    policy = run.policy(5)
    weights = policy.parameters()
    shapes = {name: weight.shape for name, weight in weights.items()}
    assert shapes["actor.0.weight"] == (24, 1) and shapes["actor.1.bias"] == (2,)
    assert shapes["critics.0.weight"] == (2, 24, 2) and len(shapes) == 8
    obs = np.array([0.3])
    hidden = np.maximum(weights["actor.0.weight"] @ obs + weights["actor.0.bias"], 0)
    mean = (weights["actor.1.weight"] @ hidden + weights["actor.1.bias"])[:1]
    np.testing.assert_allclose(policy.act(obs), np.tanh(mean), rtol=1e-5)
    weights["actor.0.weight"][:] = 0
    assert run.policy(5).act(obs) == policy.act(obs)


def test_the_tensors_of_a_checkpoint_have_names(run):
    import torch

    training = torch.load(run.folder / "checkpoint.pt", weights_only=True)["training"]
    stored = dict(zip(training["names"], training["agent"], strict=True))
    assert len(stored) == len(training["names"])  # no name stands twice
    for name, weight in run.policy(5).parameters().items():
        np.testing.assert_array_equal(stored[name][1], weight)  # seed 5 is the second lane
    assert {"critics.1.bias", "actor_moments.first.0.bias"} <= set(stored)


def test_actions_are_in_the_range_of_the_environment(tmp_path):
    settings = {**TINY, "env": "pendulum", "sampler": "uniform", "seeds": 1, "eval__episodes": 1}
    run = aser.train(**{**settings, "steps": 60}, run_dir=tmp_path / "run")
    obs = np.random.default_rng(0).normal(size=(50, 3)) * 20
    weights = run.policy().parameters()
    hidden = np.maximum(obs @ weights["actor.0.weight"].T + weights["actor.0.bias"], 0)
    means = (hidden @ weights["actor.1.weight"].T + weights["actor.1.bias"])[:, :1]
    np.testing.assert_allclose(run.policy().act(obs), 2 * np.tanh(means), atol=1e-5)
    theirs, _ = run.to_sb3().predict(obs.astype(np.float32), deterministic=True)
    np.testing.assert_allclose(theirs, run.policy().act(obs), atol=1e-5)


def test_who_is_not_there_is_refused(run, tmp_path):
    with pytest.raises(ConfigError, match="^seed=4: is not .*; allowed: 3, 5$"):
        run.policy(4)
    settings = {**CORRIDOR, "agent": "dqn", "hyper": "sb3", "seeds": 1}
    other = aser.train(**settings, run_dir=tmp_path / "run")
    with pytest.raises(ConfigError, match="keeps the last agents only; .* keep=best$"):
        other.policy(best=True)
    with pytest.raises(ConfigError, match="^to_sb3: the run's agent is agent=dqn; allowed"):
        other.to_sb3()
    assert set(other.policy().parameters()) >= {"network.0.weight", "network.1.bias"}
    assert other.policy().act(np.zeros((4, 1))).shape == (4, 1)


def test_a_stable_baselines3_agent_holds_the_weights(run, monkeypatch):
    import torch

    model, policy = run.to_sb3(5), run.policy(5)
    obs = np.linspace(-1, 1, 9, dtype=np.float32)[:, None]
    actions, _ = model.predict(obs, deterministic=True)
    np.testing.assert_allclose(actions, policy.act(obs), atol=1e-6)
    weights, inputs = policy.parameters(), np.concatenate([obs, actions], axis=1)
    with torch.no_grad():
        values = model.critic(torch.from_numpy(obs), torch.from_numpy(actions))
        targets = model.critic_target(torch.from_numpy(obs), torch.from_numpy(actions))
    for number, (value, target) in enumerate(zip(values, targets, strict=True)):
        first, last = (
            [weights[f"critics.{i}.{x}"][number] for x in ("weight", "bias")] for i in "01"
        )
        ours = np.maximum(inputs @ first[0].T + first[1], 0) @ last[0].T + last[1]
        np.testing.assert_allclose(value.numpy(), ours, atol=1e-5)
        assert torch.equal(value, target)
    temperature = run.diagnostics.query("seed == 5")["temperature"].iloc[-1]
    assert model.log_ent_coef.exp().item() == pytest.approx(temperature)
    model.learn(2)
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(ConfigError, match="pip install 'stable-baselines3"):
        run.to_sb3()


# Pictures


def test_a_video_is_the_episode(run, tmp_path, monkeypatch):
    path = run.video(tmp_path / "x.gif", seed=5)
    with Image.open(path) as gif:
        assert gif.size == (388, 120) and 2 <= gif.n_frames <= 21
        frames = gif.n_frames
    monkeypatch.setattr("aser.show.LONGEST", 0)  # is for environments that have no limit
    with Image.open(run.video(tmp_path / "again.gif", seed=5)) as gif:
        assert gif.n_frames == frames > 1
    with pytest.raises(ConfigError, match="allowed is a name that ends in .gif"):
        run.video(tmp_path / "x.mp4")


@pytest.mark.parametrize(
    "script",
    [
        "show.py run",
        pytest.param("sweep.py env=gym env.id=my_envs:None-v0", marks=pytest.mark.slow),
    ],
)
def test_scripts_find_an_environment_where_they_are_started(script, house):
    Path("my_envs.py").write_text("raise ValueError('found it')\n")
    aser.train(**TOY, seeds=[4], run_dir="run")
    config = Path("run/config.yaml")
    config.write_text(config.read_text().replace("aser/Maze-v0", "my_envs:None-v0"))
    name, *words = script.split()
    line = [sys.executable, ROOT / "scripts" / name, *words]
    apart = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    apart["PYTHONPATH"] = str(ROOT / "src")
    ended = subprocess.run(line, capture_output=True, text=True, env=apart)
    assert ended.returncode == 1 and "found it" in ended.stderr, ended.stderr


# The page


def test_the_page_names_every_public_name():
    page = (ROOT / "docs" / "python.md").read_text()
    names = set(aser.__all__) | {one.name for one in fields(aser.Run)}
    for kind in (aser.Run, aser.Policy):
        names |= {name for name in vars(kind) if not name.startswith("_")}
    for name in names:
        assert re.search(rf"`[^`\n]*\b{name}\b[^`\n]*`", page), name


def test_the_first_lines_of_the_page_run(house, capsys, monkeypatch):
    page = (ROOT / "docs" / "python.md").read_text()
    code = re.search(r"```python\n(.*?)```", page, re.DOTALL)[1]
    small = "".join(f", {key}={value!r}" for key, value in TINY.items())
    exec(code.replace("seeds=16", f"seeds=4{small}"), {})
    assert Path("episode.gif").is_file()


def test_states_are_built_from_the_run_that_init_from_names(run, house):
    config = train.settings(command(**{**CORRIDOR, "sampler": "per"}, seeds=[5], init_from=run))
    training = build.build(config, train.CONF, house / "results")
    agent = training.state.agent
    weights = run.policy(5).parameters()
    assert (agent.actor[0].weight[0].numpy() == weights["actor.0.weight"]).all()
    assert (agent.critics[1].bias[0].numpy() == weights["critics.1.bias"]).all()
    assert agent.log_temperature.item() != 0 and agent.updates.item() == 0
    assert not agent.actor_moments.first[0].weight.any()
