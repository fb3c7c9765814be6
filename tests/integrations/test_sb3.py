"""Stable Baselines3's SAC with the project's samplers, as its users meet it."""

import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import stable_baselines3
import torch
import yaml
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

import aser.envs  # noqa: F401  (registers the maze)
from aser.errors import ConfigError
from aser.integrations.sb3 import SAC, ReplayBuffer, samplers, unrolls
from aser.trees import tree_leaves

ROOT = Path(__file__).parent.parent.parent
SMALL = {
    "policy_kwargs": {"net_arch": [8]},
    "buffer_size": 200,
    "batch_size": 8,
    "learning_starts": 20,
    "seed": 3,
    "device": "cpu",
}
OBS, ACTION = gymnasium.spaces.Box(-np.inf, np.inf, (1,)), gymnasium.spaces.Box(-1.0, 1.0, (1,))


def weights(model):
    return [x.detach() for x in (*model.policy.parameters(), model.log_ent_coef or torch.zeros(1))]


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"train_freq": 4, "gradient_steps": 3, "target_update_interval": 2, "ent_coef": 0.1},
        {"n_steps": 3, "use_sde": True},
    ],
    ids=["defaults", "more", "n_steps"],
)
def test_uniform_sampling_is_stable_baselines3s_to_the_bit(settings):
    models = [
        kind("MlpPolicy", "Pendulum-v1", **SMALL, **settings).learn(60)
        for kind in (SAC, stable_baselines3.SAC)
    ]
    mine, theirs = (weights(model) for model in models)
    assert len(mine) == len(theirs) > 10
    assert all(torch.equal(x, y) for x, y in zip(mine, theirs, strict=True))
    mine, theirs = (model.logger.name_to_value for model in models)
    assert {k: v for k, v in mine.items() if "train/" in k} == {
        k: v for k, v in theirs.items() if "train/" in k
    }


@pytest.mark.parametrize("env", ["Pendulum-v1", "aser/Maze-v0"])
@pytest.mark.parametrize("sampler", [name for name in samplers.DEFAULTS if name != "uniform"])
def test_every_sampler_trains(sampler, env):
    envs = make_vec_env(env, n_envs=2 if env == "Pendulum-v1" else 1, seed=0)
    given = {"k_s": 1.0} if sampler in ("aser", "outcome_spread") else {}
    model = SAC("MlpPolicy", envs, sampler=sampler, sampler_kwargs=given, **SMALL)
    before = [x.clone() for x in weights(model)]
    model.learn(70)
    after = weights(model)
    assert all(x.isfinite().all() for x in after)
    assert sum(not torch.equal(x, y) for x, y in zip(before, after, strict=True)) > 10
    said, buffer = model.logger.name_to_value, model.replay_buffer
    assert (said["replay/steps"] > 1.0) == (sampler in ("nstep", "aser", "outcome_spread"))
    assert ("replay/threshold" in said) == (sampler in ("aser", "outcome_spread"))
    if sampler != "nstep":
        mass = buffer.priorities.mass[0, : buffer.size() * buffer.n_envs]
        assert (mass > 0).all() and (len(mass.unique()) > 5 or sampler == "lap")


@pytest.mark.parametrize("h", [1, 2, 5])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_unrolls_against_a_loop(n_envs, h):
    """The item before a terminal state does not bootstrap; time limits and the newest item do."""
    slots, count, gamma = 11, 28, 0.9
    buffer = ReplayBuffer(
        slots * n_envs, OBS, ACTION, "cpu", n_envs, sampler="nstep", sampler_kwargs={"h": h}
    )
    random = np.random.default_rng(h)
    histories = [[] for _ in range(n_envs)]  # of each environment: (state, reward, end)
    obs = np.arange(n_envs, dtype=np.float32)[:, None] * 1000
    for _ in range(count):
        end = random.choice(["", "", "", "terminal", "limit", "reset"], size=n_envs)
        reward, next_obs = random.normal(size=n_envs), obs + 1
        done = (end == "terminal") | (end == "limit")
        infos = [{"TimeLimit.truncated": bool(x)} for x in end == "limit"]
        buffer.add(obs, next_obs, np.zeros((n_envs, 1)), reward, done, infos)
        for e in range(n_envs):
            histories[e].append((obs[e, 0], reward[e], end[e]))
        # After "reset", an episode that is not over does not go on: a second `learn` does that.
        obs = np.where((end != "")[:, None], next_obs + 7, next_obs).astype(np.float32)
    index = np.arange(slots * n_envs)
    chance, temperature = unrolls.chance(buffer, len(index)), torch.zeros(())
    result = unrolls.unroll(buffer, index, chance, StandardNormal(), temperature, gamma, 0)
    samples = result.samples
    kinds = set()
    for i, (slot, e) in enumerate((i // n_envs, i % n_envs) for i in index):
        first = max(t for t in range(count) if t % slots == slot)
        t, total = first, 0.0
        while True:
            state, reward, end = histories[e][t]
            total += gamma ** (t - first) * reward
            last = t == count - 1
            if end or last or t - first + 1 == h:
                break
            t += 1
        kinds.add((end, last))
        assert result.n[i] == t - first + 1
        assert samples.observations[i, 0] == histories[e][first][0]
        assert samples.next_observations[i, 0] == state + 1
        assert samples.rewards[i, 0].item() == pytest.approx(total, rel=1e-5)
        discount = 0.0 if end == "terminal" else gamma ** (t - first + 1)
        assert samples.discounts[i, 0].item() == pytest.approx(discount)
        assert samples.dones[i, 0] == (end == "terminal")
    assert {end for end, _ in kinds} >= {"terminal", "limit", "reset"}
    assert any(last for _, last in kinds)


class StandardNormal:
    """The part of an actor that unrolls read."""

    def get_action_dist_params(self, obs):
        return torch.zeros(len(obs), 1), torch.zeros(len(obs), 1), {}


def test_a_second_learn_unrolls_into_no_other_episode():
    model = SAC("MlpPolicy", "Pendulum-v1", sampler="nstep", **SMALL)
    model.learn(30)
    model.learn(30)
    assert np.flatnonzero(model.replay_buffer.timeouts[:60, 0]).tolist() == [29]
    assert model.replay_buffer.window(np.array([28]), 4).last[:, 0].tolist()[:2] == [False, True]


def test_a_saved_model_and_its_buffer_go_on(tmp_path):
    """With a capacity above which priorities are a tree, whose levels share memory."""
    settings = SMALL | {"buffer_size": 150_000}
    model = SAC("MlpPolicy", "Pendulum-v1", sampler="outcome_spread", **settings).learn(50)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = SAC.load(tmp_path / "model", env=gymnasium.make("Pendulum-v1"))
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.sampler == "outcome_spread"
    assert all(torch.equal(x, y) for x, y in zip(weights(model), weights(loaded), strict=True))
    one, two = model.replay_buffer, loaded.replay_buffer
    assert type(one.priorities).__name__ == "TreePriorities"
    assert torch.equal(one.priorities.total(), two.priorities.total())
    pairs = zip(tree_leaves(one.seen), tree_leaves(two.seen), strict=True)
    assert all(torch.equal(x, y) for x, y in pairs)
    two.write_back(np.array([4]), torch.tensor([1e6]))
    drawn = np.concatenate([two.draw(8, 0.0)[0] for _ in range(32)])
    assert (drawn == 4).mean() > 0.9  # by its mass it has 3,981 of about 4,030
    loaded.learn(30, reset_num_timesteps=False)
    assert loaded.num_timesteps == 80 and two.size() == 80


def test_normalised_observations_and_rewards_are_what_it_learns_from():
    envs = VecNormalize(make_vec_env("Pendulum-v1", n_envs=2, seed=0))
    model = SAC("MlpPolicy", envs, sampler="aser", **SMALL).learn(60)
    buffer, index = model.replay_buffer, np.arange(10)
    raw = buffer.obs(index)
    assert torch.equal(buffer.obs(index, envs), torch.from_numpy(envs.normalize_obs(raw.numpy())))
    plain, scaled = buffer.window(index, 3), buffer.window(index, 3, envs)
    assert torch.equal(scaled.reward, torch.from_numpy(envs.normalize_reward(plain.reward.numpy())))
    with pytest.raises(ConfigError, match="norm_obs=True.*allowed: norm_obs=False"):
        SAC("MlpPolicy", envs, sampler="outcome_spread", **SMALL).learn(60)


@pytest.mark.parametrize(
    ("sampler", "given", "settings", "message"),
    [
        ("asr", {}, {}, "sampler=asr: must be one of .*did you mean aser"),
        ("aser", {"hh": 3}, {}, "sampler_kwargs.hh=3: there is no such key; did you mean"),
        ("per", {"h": 3}, {}, "sampler_kwargs.h=3: there is no such key"),
        ("uniform", {"h": 3}, {}, "sampler=uniform takes none"),
        ("aser", {"h": 0}, {}, "sampler_kwargs.h=0: must be a whole number >= 1"),
        ("aser", {"k_m": 1.5}, {}, r"sampler_kwargs.k_m=1.5: .*in \[0, 1\]"),
        ("outcome_spread", {"width": 0}, {}, "sampler_kwargs.width=0: must be"),
        ("outcome_spread", {"of": "colour"}, {}, "sampler_kwargs.of=colour: must be one of"),
        ("aser", {}, {"n_steps": 3}, "n_steps=3: only sampler=uniform allows it"),
        ("aser", {}, {"use_sde": True}, "use_sde=True: only sampler=uniform"),
        ("per", {}, {"optimize_memory_usage": True}, "optimize_memory_usage=True: sampler=per"),
        (
            "per",
            {},
            {"replay_buffer_class": stable_baselines3.HerReplayBuffer},
            "replay_buffer_class=HerReplayBuffer: only sampler=uniform",
        ),
        (
            "outcome_spread",
            {},
            {"policy_kwargs": {"activation_fn": torch.nn.Tanh}},
            "allowed: MlpPolicy with its own activation_fn, or sampler_kwargs.of=state",
        ),
    ],
)
def test_a_wrong_input_is_one_line(sampler, given, settings, message):
    with pytest.raises(ConfigError, match=message) as error:
        arguments = SMALL | settings
        SAC("MlpPolicy", "Pendulum-v1", sampler=sampler, sampler_kwargs=given, **arguments)
    assert "\n" not in str(error.value)


def test_networks_of_another_kind_serve_where_no_value_is_asked():
    kind = {"policy_kwargs": {"net_arch": [8], "activation_fn": torch.nn.Tanh}}
    given = {"of": "state", "width": 9.0, "noise": "keep"}
    arguments = SMALL | kind
    model = SAC(
        "MlpPolicy", "Pendulum-v1", sampler="outcome_spread", sampler_kwargs=given, **arguments
    )
    assert model.learn(40).replay_buffer.seen.level > 0


def test_a_buffer_of_another_sampler_is_refused(tmp_path):
    SAC("MlpPolicy", "Pendulum-v1", sampler="per", **SMALL).save_replay_buffer(tmp_path / "per")
    model = SAC("MlpPolicy", "Pendulum-v1", sampler="aser", **SMALL)
    kept = model.replay_buffer
    with pytest.raises(ConfigError, match="it is of sampler=per.*allowed: sampler=aser"):
        model.load_replay_buffer(tmp_path / "per")
    assert model.replay_buffer is kept


def test_other_learners_are_refused():
    model = stable_baselines3.SAC(
        "MlpPolicy", "Pendulum-v1", replay_buffer_class=ReplayBuffer, **SMALL
    )
    with pytest.raises(ConfigError, match="serves aser.integrations.sb3.SAC"):
        model.learn(40)


def test_defaults_are_those_of_the_table():
    table = yaml.safe_load((ROOT / "conf/hyper/sb3/any/any.yaml").read_text())
    for name, defaults in samplers.DEFAULTS.items():
        for key in set(defaults) & set(table):
            assert float(table[key]) == defaults[key] or (name, key) == ("lap", "alpha"), key


def test_without_stable_baselines3_it_says_so():
    code = "import sys; sys.modules['stable_baselines3'] = None; import aser.integrations.sb3"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    last = result.stderr.strip().splitlines()[-1]
    assert result.returncode == 1 and "pip install 'stable-baselines3>=2.9,<2.10'" in last


def test_the_page_is_what_the_code_is():
    page = (ROOT / "docs/sb3.md").read_text()
    assert f"```python\n{(ROOT / 'examples/sb3_pendulum.py').read_text()}```" in page
    rows = re.findall(r"^\| `(\w+)` \|.*\| (.*) \|$", page, re.MULTILINE)
    assert [name for name, _ in rows] == list(samplers.DEFAULTS)
    for name, cell in rows:
        for key, said in re.findall(r"`(\w+)` ([\w.]+)", cell):
            assert said == str(samplers.DEFAULTS[name][key]), (name, key)
