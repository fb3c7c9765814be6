"""Frozen agents: trained once and kept, taken from any run, and what is made of them."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import yaml

import train
from aser import build, checkpoint, envs
from aser.agents import dqn, sac
from aser.agents.networks import policy
from aser.errors import ConfigError
from aser.replay import criteria
from aser.replay.kinds import Frozen
from aser.settings.config import parse
from aser.training import frozen
from aser.trees import take

CPU = torch.device("cpu")
SHORT = [
    "debug=smoke",
    "env=corridor",
    "env.steps=112",
    "batch=5",
    "steps=40",
    "learning_starts=30",
    "eval.every=null",
]
PRETRAINED = [*SHORT, "sampler=pretrained"]


def built(*overrides):
    return build.build(train.settings(list(overrides)), train.CONF, train.CONF.parent / "results")


def kept(house):
    return sorted(path.name for path in (house / "results" / "pretrained").glob("[!.]*.pt"))


def function(run):
    """The function of a run's one frozen criterion, p (L, K) at obs (L, O, K)."""
    (criterion,) = run.setup.buffer.sampler.criteria
    assert isinstance(criterion, Frozen)
    return criterion.function


def same(one, two):
    one, two = checkpoint.leaves(one), checkpoint.leaves(two)
    return len(one) == len(two) and all(
        a.dtype == b.dtype and torch.equal(a, b) for a, b in zip(one, two, strict=True)
    )


def test_the_first_use_trains_and_keeps_what_the_settings_say(house, capsys):
    run = built(*PRETRAINED, "network.hidden=[5]", "hyper.gamma=.5", "criterion.of=entropy")
    assert capsys.readouterr().out.startswith("training the frozen agents")
    (name,) = kept(house)
    path = house / "results" / "pretrained" / name
    before = path.stat().st_mtime_ns
    assert name.startswith("corridor-") and not list((house / "results").glob("runs/*"))

    again = built(*PRETRAINED, "criterion.of=entropy", "seeds=[16,33,2]", "hyper.lr=.5")
    other = built(*PRETRAINED, "criterion.of=entropy", "bootstrap.criterion.name=q_std")
    assert (
        capsys.readouterr().out == ""
        and path.stat().st_mtime_ns == before
        and kept(house) == [name]
    )
    obs = torch.linspace(-1, 1, 6)[None, None]  # (1, 1, 6)
    of_two, of_three = function(run)(obs.expand(2, 1, 6)), function(again)(obs.expand(3, 1, 6))
    assert torch.equal(of_two, of_three[:2])
    drawing, stopping = other.setup.buffer.sampler.criteria
    assert torch.equal(drawing.function(obs.expand(2, 1, 6)), of_two) and stopping.key == "q_std"

    content = torch.load(path, weights_only=True)
    origin = json.loads(content["origin"])
    assert {"config", "code", "commit", "versions"} == set(origin)
    config = parse(origin["config"])
    assert config.seeds == tuple(range(3000, 3016)) and (config.steps, config.learning_starts) == (
        112,
        100,
    )
    assert (config.sampler, config.criterion.name, config.bootstrap.name) == ("uniform",) * 2 + (
        "one_step",
    )
    assert (config.network.hidden, config.batch, config.hyper.set) == ((24,), 256, "thesis")
    assert config.hyper == train.settings(["env=corridor", "sampler=uniform", "hyper=thesis"]).hyper
    training = build.build(config, train.CONF, house / "results")
    training.run()
    agents = frozen.shipped(path, sac, lambda: pytest.fail("it is there"), CPU)
    assert isinstance(agents.kept, sac.Kept) and agents.agent is sac
    assert same(agents.kept, sac.Kept(training.state.agent.actor, training.state.agent.critics))
    assert agents.sizes == content["sizes"] == {"obs": 1, "action": 1}


def test_pretraining_is_for_the_environment_and_not_for_the_run():
    overrides = ["env=corridor", "sampler=aser", "criterion=entropy", "agent.actor_batch=uniform"]
    overrides += ["bootstrap.correction=retrace"]
    plain = frozen.pretraining(train.settings(overrides), train.CONF)
    other = ["env=corridor", "sampler=per", "seeds=[4,2]", "network.hidden=[7]", "steps=900"]
    other += ["buffer=50", "batch=9", "learning_starts=11", "eval.every=33", "hyper.gamma=.5"]
    other += ["updates=3"]
    assert frozen.pretraining(train.settings(other), train.CONF).to_dict() == plain.to_dict()
    assert plain.agent.actor_batch == "prioritised" and plain.eval_every is None
    assert plain.hyper.set == "thesis" and plain.buffer == plain.steps == plain.env.steps == 2000
    assert not plain.bootstrap.reads_criterion and plain.bootstrap.keys == ("window",)
    of_dqn = frozen.pretraining(train.settings(["env=corridor", "agent=dqn"]), train.CONF)
    assert of_dqn.hyper.source.split("/")[1] == "dqn" and of_dqn.agent.actions == 21
    elsewhere = ["env=gym", "env.id=MountainCarContinuous-v0"]
    assert frozen.pretraining(train.settings(elsewhere), train.CONF).hyper.set == "sb3"
    assert parse(plain.to_dict()).to_dict() == plain.to_dict()


def test_the_agents_that_are_shipped_are_found_and_tell_how_they_were_trained():
    results = train.CONF.parent / "results"
    there = {path.name: path for path in (results / "pretrained").glob("*.pt")}
    found = set()
    for words in [
        ["env=corridor"],
        ["env=corridor", "agent=dqn"],
        ["env=maze"],
        ["env=maze", "env.layout=toy"],
        ["env=maze_sparse"],
        ["env=pendulum"],
        ["env=pendulum", "agent=dqn"],
    ]:
        plain = frozen.pretraining(train.settings(words), train.CONF)
        vector = build.make_envs(plain, 1)
        path = frozen.path_of(plain, results, vector)
        assert path.name in there, (words, path.name)
        found.add(path.name)
        agent = dqn if "agent=dqn" in words else sac
        agents = frozen.shipped(path, agent, lambda: pytest.fail("it is there"), CPU)
        frozen.check_sizes(agents, build.sizes_of(vector), "criterion")
        assert {len(leaf) for leaf in checkpoint.leaves(agents.kept)} == {len(frozen.SEEDS)}
        assert all(leaf.isfinite().all() for leaf in checkpoint.leaves(agents.kept))
    assert found == set(there)


def agents_of(count, obs_dim=1, action_dim=1, hidden=(3,)):
    """What a training gives: fresh agents that differ, and settings."""
    keys = torch.arange(2 * count, dtype=torch.int32).reshape(count, 2) + 7
    agents = torch.func.vmap(lambda key: sac.init(key, obs_dim, action_dim, hidden))(keys)
    sizes, state = {"obs": obs_dim, "action": action_dim}, SimpleNamespace(agent=agents)
    settings = {"name": "sac", "actor_batch": "prioritised", "td_error": "min"}
    config = {"agent": settings, "network": {"hidden": hidden}, "seeds": list(range(count))}
    return SimpleNamespace(state=state, sizes=sizes), config


def test_a_training_that_fails_leaves_nothing_and_the_next_one_can(tmp_path):
    path = tmp_path / "below" / "agents.pt"
    with pytest.raises(ZeroDivisionError):
        frozen.shipped(path, sac, lambda: 1 / 0, CPU)
    assert not path.exists()
    training, config = agents_of(3, obs_dim=5, action_dim=2, hidden=(4, 6))
    found = frozen.shipped(path, sac, lambda: (training, config), CPU)
    assert len(found.kept.actor) == len(found.kept.critics) == 3
    assert same(found.kept, sac.kept(training.state.agent))
    assert found.sizes == {"obs": 5, "action": 2}
    again = frozen.shipped(path, sac, lambda: 1 / 0, CPU)
    assert same(again.kept, found.kept) and again.sizes == found.sizes


def test_a_folder_that_cannot_be_written_to_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file" / "below", Path("/proc/below")):
        with pytest.raises(
            ConfigError, match=r"^criterion=pretrained: .*allowed: a folder to write to$"
        ):
            frozen.shipped(folder / "agents.pt", sac, lambda: pytest.fail("too late"), CPU)


PROCESS = """
import sys, time
from pathlib import Path
from test_frozen import CPU, agents_of, frozen, sac

def training():
    with open("trained", "a") as log:
        log.write("once\\n")
    time.sleep(1.0)
    return agents_of(2)

print("ready", flush=True)
sys.stdin.readline()
agents = frozen.shipped(Path("agents.pt"), sac, training, CPU)
print(float(agents.kept.actor[0].weight.sum()))
"""


def test_two_processes_at_once_train_once(tmp_path):
    command = [
        sys.executable,
        "-c",
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n{PROCESS}",
    ]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    processes = [subprocess.Popen(command, cwd=tmp_path, **pipes) for _ in range(2)]
    assert [process.stdout.readline() for process in processes] == ["ready\n"] * 2
    for process in processes:
        process.stdin.write("go\n")
        process.stdin.flush()
    said = [process.communicate(timeout=60)[0].splitlines()[-1] for process in processes]
    assert [process.returncode for process in processes] == [0, 0] and said[0] == said[1]
    assert (tmp_path / "trained").read_text() == "once\n"


def digest(id="aser/Maze-v0", **kwargs):
    return frozen.environment_digest(id, kwargs, envs.make(id, 1, **kwargs))


def test_another_layout_has_agents_of_its_own():
    mazes = [
        {"layout": "large"},
        {"layout": "toy"},
        {"layout": "toy", "reward": "sparse"},
        {"layout": "random", "layout_seed": 1},
        {"layout": "random", "layout_seed": 2},
        {"layout": "random", "layout_seed": 1, "size": [6, 5]},
    ]
    corridors = [{}, {"length": 1.7}, {"length": 1.7, "gates": [[0.4, 0.3, 0.7]]}]
    digests = [digest(**kwargs) for kwargs in mazes]
    digests += [digest("aser/Corridor-v0", **kwargs) for kwargs in corridors] + [
        digest("aser/Pendulum-v0")
    ]
    assert len(set(digests)) == 10 and {len(one) for one in digests} == {8}
    assert (
        digest(layout="random", layout_seed=1)
        == digest(layout="random", layout_seed=1)
        == digests[3]
    )


@pytest.mark.parametrize("size", [(5, 4), (25, 20)])
def test_a_layouts_file_that_has_changed_is_another_layout(size, tmp_path):
    path = tmp_path / "maze.txt"
    text = envs.layouts.draw(envs.layouts.generate(1, size))
    path.write_text(text)
    before = digest(layout=str(path))
    lines = text.splitlines()
    middle = size[1] // 2 * 2 + 1  # a line of cells
    wall = lines[middle].index("#", 1)
    lines[middle] = lines[middle][:wall] + " " + lines[middle][wall + 1 :]
    path.write_text("\n".join(lines) + "\n")
    assert digest(layout=str(path)) != before


@pytest.fixture
def runs(house, capsys):
    """Two small runs to take agents from: three lanes in the corridor, one in the toy maze."""
    common = ["debug=smoke", "batch=5", "steps=40", "learning_starts=30", "eval.every=null"]
    corridor = [
        "env=corridor",
        "sampler=aser",
        "network.hidden=[5,3]",
        "seeds=[6,1,9]",
        "run_dir=corridor",
    ]
    assert train.main([*common, *corridor]) == 0
    assert train.main([*common, "env=maze", "env.layout=toy", "seeds=1", "run_dir=maze"]) == 0
    capsys.readouterr()
    return house


@pytest.mark.parametrize("of", ["mode_log_prob", "entropy", "curvature", "q_range"])
def test_any_run_lends_its_agents_and_seed_i_has_number_i_mod_n(of, runs):
    run = built(
        *PRETRAINED, "criterion.checkpoint=corridor", f"criterion.of={of}", "seeds=[2,4,6,9,10]"
    )
    assert not (runs / "results" / "pretrained").exists()
    content = torch.load("corridor/checkpoint.pt", weights_only=True)
    agents = frozen.of_run(Path("corridor"))
    assert same([*agents.kept.actor, *agents.kept.critics], content["agent"][:12])
    assert agents.agent is sac and agents.sizes == content["sizes"] == {"obs": 1, "action": 1}
    other = frozen.lent(Path("corridor"), "sac", CPU, "criterion.checkpoint")
    assert same(other.kept, agents.kept)
    obs = torch.rand(5, 1, 6, generator=torch.Generator().manual_seed(4)) * 2 - 1  # (L, O, K)
    for some in (obs[:, :, :1], obs):
        found = function(run)(some)
        for lane, number in enumerate([2, 1, 0, 0, 1]):  # the seed mod 3
            agent = take(agents.kept, number)
            alone = criteria.function(of)(agent, some[lane], policy(agent.actor, some[lane]))
            torch.testing.assert_close(found[lane], alone, rtol=1e-3, atol=1e-4)
    assert (found[0] != found[1]).any()


@pytest.mark.parametrize(
    "overrides",
    [
        ["sampler=pretrained", "criterion.checkpoint=corridor"],
        ["sampler=oracle"],
        [
            "sampler=oracle",
            "bootstrap.criterion.name=pretrained",
            "bootstrap.criterion.checkpoint=corridor",
        ],
    ],
)
def test_frozen_criteria_are_kept_from_their_arrival_on(overrides, runs):
    run = built(*SHORT, *overrides, "seeds=[2,4,6]", "buffer=28")  # the ring wraps
    run.run()
    buffer, storage = run.setup.buffer, run.setup.buffer.storage
    drawing, stopping = buffer.sampler.drawing, buffer.sampler.unroll.criterion
    assert isinstance(drawing, Frozen) and isinstance(stopping, Frozen)
    read = storage.layout.read_vector
    p = drawing.function(read(storage.rows, "obs").movedim(0, 1))  # (L, N)
    expected = (p.double() + run.hyper["epsilon"][:, None]) ** run.hyper["alpha"][:, None]
    torch.testing.assert_close(buffer.priorities.mass, expected, rtol=1e-4, atol=1e-6)
    p_next = stopping.function(read(storage.rows, "next_obs").movedim(0, 1))
    torch.testing.assert_close(
        storage.layout.read(storage.rows, "p_next"), p_next, rtol=1e-4, atol=1e-6
    )
    assert p_next.std(1).max() > 0 and storage.draw_count.sum() > 0


def test_two_runs_may_lend_agents_to_one(runs):
    names = ["criterion.checkpoint=corridor", "bootstrap.criterion.name=pretrained"]
    assert train.main([*SHORT, "sampler=uniform", "seeds=[5]", "run_dir=other"]) == 0
    run = built(*PRETRAINED, *names, "bootstrap.criterion.checkpoint=other")
    drawing, stopping = run.setup.buffer.sampler.criteria
    assert drawing.key != stopping.key
    obs = torch.rand(2, 1, 4)
    assert (drawing.function(obs) != stopping.function(obs)).all()


def test_agents_of_another_environment_are_refused(runs, capsys):
    before = sorted(runs.rglob("*"))
    assert train.main([*PRETRAINED, "criterion.checkpoint=maze", "run_dir=new"]) == 1
    said = capsys.readouterr()
    assert said.out == "" and said.err == (
        "train: criterion.checkpoint=maze: its agents have 4 observations and 2 actions; "
        "allowed: 1 and 1, as here\n"
    )
    assert sorted(runs.rglob("*")) == before


@pytest.mark.parametrize(
    "broken", ["no checkpoint", "config cut", "config of something else", "another network"]
)
def test_a_run_folder_that_is_damaged_is_one_line(broken, runs, capsys):
    folder = Path("corridor")
    text = (folder / "config.yaml").read_text()
    if broken == "no checkpoint":
        (folder / "checkpoint.pt").unlink()
    elif broken == "config cut":
        (folder / "config.yaml").write_text(text[: text.index("network")] + "network: {hidden: [")
    elif broken == "config of something else":
        (folder / "config.yaml").write_text("name: a thing\n")
    else:
        (folder / "config.yaml").write_text(text.replace("- 5\n", "- 6\n", 1))
    assert train.main([*PRETRAINED, "criterion.checkpoint=corridor", "run_dir=new"]) == 1
    said = capsys.readouterr()
    assert said.err.startswith("train: ") and said.err.count("\n") == 1 and "allowed" in said.err
    assert not Path("new").exists()


@pytest.mark.parametrize(
    "content",
    [
        {},
        {"agent": 3, "sizes": {"obs": 4, "action": 2}},
        {"agent": [1], "sizes": {"obs": 4, "action": 2}},
        {"agent": [torch.zeros(2)], "sizes": 3},
        {"agent": [torch.zeros(2)], "sizes": {"obs": 4}},
    ],
)
def test_a_checkpoint_without_an_agent_is_one_line(content, tmp_path):
    config = {"network": {"name": "small", "hidden": [24]}, "seeds": [0], "env": {}}
    agent = {"name": "sac", "actor_batch": "prioritised", "td_error": "min"}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({**config, "agent": agent}))
    checkpoint.save(tmp_path / "checkpoint.pt", content)
    with pytest.raises(ConfigError, match="holds no agent and its sizes; allowed: "):
        frozen.of_run(tmp_path)


@pytest.mark.parametrize("wrong", [{"network": 3}, {"agent": 3}, {"seeds": "x"}])
def test_a_config_that_tells_of_no_agent_is_one_line(wrong, tmp_path):
    agent = {"name": "sac", "actor_batch": "prioritised", "td_error": "min"}
    config = {"network": {"name": "small", "hidden": [24]}, "seeds": [0], "agent": agent, **wrong}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    with pytest.raises(ConfigError, match="no run there; allowed: a run folder"):
        frozen.of_run(tmp_path)
