"""The log mu of actions that a run stores, where a correction asks for it."""

import math

import pytest
import torch
from test_loop import fact, training

import train
from aser.agents.networks import log_density, policy
from aser.settings.config import parse
from aser.trees import take, tree_map


@pytest.mark.parametrize(
    ("env", "settings"),
    [
        (["env=maze", "env.layout=toy"], ["bootstrap.correction=retrace"]),
        (["env=corridor"], ["bootstrap=averaged", "bootstrap.correction=clipped"]),
        (["env=pendulum"], ["bootstrap=geometric", "hyper.lam=.9", "bootstrap.correction=clipped"]),
    ],
)
def test_a_run_stores_log_mu_of_each_action_when_it_was_taken(env, settings):
    words = [*env, "sampler=nstep", "hyper=thesis", "steps=40", "learning_starts=12", *settings]
    run = training(*words, "eval.every=null")
    agents = []
    while run.step < 30:
        agents.append(tree_map(torch.clone, run.state.agent))
        run.advance()
    obs, action, log_mu = (fact(run, name) for name in ("obs", "action", "log_mu"))
    assert log_mu[:, :12].eq(-action.shape[2] * math.log(2.0)).all()
    for step in range(12, 30):
        for lane in range(3):
            at = policy(take(agents[step], lane).actor, obs[lane, step, :, None])
            expected = log_density(at, action[lane, step, :, None])
            assert log_mu[lane, step].item() == pytest.approx(expected.item(), rel=1e-4, abs=1e-4)
    assert log_mu[:, 12:].unique().numel() == log_mu[:, 12:].numel()


def test_without_a_correction_nothing_more_is_stored_or_named():
    words = ("env=corridor", "sampler=nstep", "hyper=thesis")
    plain, own = training(*words), training(*words, "bootstrap.correction=clipped")
    layouts = [run.setup.buffer.sampler.layout for run in (plain, own)]
    assert layouts[1].width == layouts[0].width + 1 and "log_mu" not in layouts[0].columns
    named = train.settings(list(words))
    own = train.settings([*words, "bootstrap.correction=clipped"])
    assert "correction" not in named.to_dict()["bootstrap"]
    assert parse(own.to_dict()) == own and own != named == parse(named.to_dict())
