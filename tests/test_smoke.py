"""Does it run? Every sampler in every environment that can serve it, through the command line.

Quick are the runs in the toy maze, and those of a few samplers elsewhere. The others are slow
tests, and `.ci/run` trains each of them by a command.
"""

import csv
import itertools
import json
import math

import pytest
import torch
import yaml

import train

ENVS = {
    "maze": ["env=maze", "env.layout=toy"],
    "maze_sparse": ["env=maze_sparse", "env.layout=toy"],
    "corridor": ["env=corridor"],
    "corridor, dqn": ["env=corridor", "agent=dqn"],
    "pendulum": ["env=pendulum", "eval.episodes=1"],
    "gym": ["env=gym", "env.id=Pendulum-v1", "eval.episodes=1", "network=small"],
}
SAMPLERS = train.names(train.CONF, "sampler")
SMALL = ["debug=smoke", "steps=125", "batch=16"]
UPDATES = 25
EVERYWHERE = ("aser", "per", "outcome_spread")
DQN = "corridor, dqn"
SAC_ONLY = {  # and their criteria
    "aser_q": "q_range",
    "cvs": "q_range",
    "preferential": "q_range",
    "outcome_spread": "outcome_spread",
    "outcome_spread_shuffled": "outcome_spread_shuffled",
    "outcome_model": "outcome_model",
    "outcome_model_shuffled": "outcome_model_shuffled",
}
LOSSES = {
    "lap": "huber",
    "la3p": "huber",
    "pal": "pal",
}  # of samplers that name one, which are for SAC alone


def able(sampler, env):
    if env == DQN:
        return sampler not in {*SAC_ONLY, *LOSSES}
    return not (sampler.startswith("oracle") and env in ("pendulum", "gym"))


def test_the_environments_here_are_all_there_are():
    standard = {"mujoco", "box2d", "dmc"}  # env=gym with other defaults: envs/test_standard.py
    assert {*ENVS, *standard} - {DQN} == set(train.names(train.CONF, "env"))
    assert len(SAMPLERS) >= 15


def cases():
    for env, sampler in itertools.product(ENVS, SAMPLERS):
        quick = env == "maze" or sampler in EVERYWHERE or not able(sampler, env)
        yield pytest.param(sampler, env, marks=[] if quick else pytest.mark.slow)


@pytest.mark.parametrize(("sampler", "env"), [*cases()])
def test_smoke(sampler, env, house, capsys):
    # Its frozen agents are trained for env.steps.
    extra = ["env.steps=110"] if sampler == "pretrained" else []
    if sampler.startswith("outcome_spread"):
        # So few updates visit only wide cells twice, and a low quantile of so few spreads is 0.
        extra = ["criterion.width=2", "hyper.k_s=1"] if env != DQN else []
    values = [] if env in ("gym", DQN) else ["hyper=thesis"]
    arguments = [*SMALL, *ENVS[env], f"sampler={sampler}", *values, *extra]
    if not able(sampler, env):
        assert train.main(arguments) == 1
        said = capsys.readouterr().err
        words = ["criterion=oracle", "maze, maze_sparse, corridor"]
        if env == DQN:
            words = [f"criterion={SAC_ONLY.get(sampler)}: is not for agent=dqn", "q_dropoff"]
            if sampler in LOSSES:
                words = [f"agent.loss={LOSSES[sampler]}: agent=dqn always has Huber's loss"]
        assert said.count("\n") == 1 and all(word in said for word in words)
        assert not (house / "results").exists()
        return
    assert train.main(arguments) == 0
    (folder,) = (house / "results" / "runs").iterdir()
    assert capsys.readouterr().out.splitlines()[-2] == f"results in {folder}"

    with (folder / "returns.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["seed"], row["step"]) for row in rows] == [
        (s, t) for t in ("100", "125") for s in "01"
    ]
    assert all(math.isfinite(float(row["return"])) for row in rows)
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["diverged"] == [] and math.isfinite(summary["iqm_final"])

    with (folder / "diagnostics.csv").open() as file:
        (*_, last) = csv.DictReader(file)
    config = train.parse(yaml.safe_load((folder / "config.yaml").read_text()))
    unrolls = config.bootstrap.name != "one_step"
    even = config.prioritisation.name in ("uniform", "laber", "ere")  # here ERE draws from all
    prioritised = config.prioritisation.by_criterion
    for name, value in last.items():
        unknown = name == "threshold" and not config.bootstrap.name.startswith("threshold")
        nowhere = ("uniform", "td_error", "reducible_loss")  # known at no arbitrary state
        judged = config.criterion.name not in nowhere and env not in ("pendulum", "gym")
        assert math.isfinite(float(value)) != (unknown or (name == "roc_auc" and not judged)), name
    assert (
        1
        <= float(last["unroll_mean"])
        <= float(last["unroll_max"])
        <= config.hyper.values.get("h", 1)
    )
    if sampler != "relo":  # so early, no loss may be reducible
        for name in ("effective_sample_size", "draw_entropy"):
            assert (float(last[name]) > 1 - 1e-9) == even

    content = torch.load(folder / "checkpoint.pt", weights_only=True)["training"]
    storage = content["buffer"]["storage"]
    drawn = config.batch * config.prioritisation.large
    assert storage["draw_count"].sum(1).tolist() == [drawn * UPDATES] * 2
    assert (storage["unroll_sum"] > storage["draw_count"]).any() == unrolls
    assert ("priorities" in content["buffer"]) == prioritised
    parameters = content["agent"]
    assert all(leaf.isfinite().all() for leaf in parameters)
    assert not torch.equal(parameters[0][0], parameters[0][1])
