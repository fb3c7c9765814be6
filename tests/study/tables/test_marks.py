"""What criteria mark, against the run's own state and by hand."""

import numpy as np
import pytest
import torch

import train
from aser import build
from aser.checkpoint import load
from aser.errors import ConfigError
from aser.study import runs
from aser.study.tables.marks import marks

pytestmark = pytest.mark.xdist_group("marks")  # one worker trains the runs for all

TINY = ["env=maze", "env.layout=toy", "hyper=thesis", "hyper.from=aser", "seeds=[3,8,5]"]
TINY += ["steps=160", "learning_starts=40", "batch=23", "eval.every=80", "compile=false"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")

    def run(sampler):
        if not (folder / sampler).exists():
            train.run(train.settings([*TINY, f"sampler={sampler}", f"run_dir={folder}/{sampler}"]))
        return runs.load(folder / sampler)

    return run


def test_the_spread_is_that_of_the_saved_table(trained, tmp_path):
    run = trained("outcome_spread")
    words = [*TINY, "sampler=outcome_spread"]
    training = build.build(train.settings(words), train.CONF, tmp_path)
    training.load_state_dict(load(run.folder / "checkpoint.pt")["training"])
    criterion = training.setup.buffer.sampler.diagnosed
    states = training.setup.envs.states.observation
    obs = torch.from_numpy(states.T).expand(3, -1, -1)
    memory = training.setup.buffer.memory(training.setup.buffer.storage.clock(160, 160))
    agent, own = training.state
    p = criterion.anywhere(training.setup.agent, agent, own, memory, obs)
    rows = marks(run)
    np.testing.assert_allclose(rows["p"].to_numpy().reshape(3, -1), p.numpy(), rtol=1e-6)
    assert p.max() > 0 and list(rows["seed"].unique()) == [3, 8, 5]


@pytest.mark.parametrize("sampler", ["aser", "outcome_spread", "oracle"])
def test_ranks_and_auc_by_hand(sampler, trained):
    rows = marks(trained(sampler))
    for _, part in rows.groupby("seed"):
        known = part[part["visited"] & ~part["terminal"]]
        assert part["rank"].notna().sum() == len(known) > 10
        p, decision = known["p"].to_numpy(), known["decision"].to_numpy()
        below = (p[:, None] > p).sum(1) + ((p[:, None] == p).sum(1) - 1) / 2
        assert known["rank"].tolist() == pytest.approx((below / (len(p) - 1)).tolist())
        one, other = p[decision][:, None], p[~decision]
        chance = ((one > other) + 0.5 * (one == other)).mean()
        assert part["auc"].tolist() == pytest.approx([chance] * len(part))
    if sampler == "oracle":
        assert (rows["auc"] == 1.0).all()


def test_a_criterion_that_is_not_known_everywhere_is_refused(trained):
    with pytest.raises(ConfigError, match=r"^run folder .*: its criterion is td_error; allowed"):
        marks(trained("per"))
