"""A priority that overflows in one lane of a training changes nothing in the other lanes."""

from itertools import product

import pytest
import torch

import train
from aser import build
from aser.compiled import why_not_compiled
from aser.replay import priorities
from aser.replay.priorities import FlatPriorities, TreePriorities
from aser.trees import tree_leaves

WORDS = ["env.layout=toy", "sampler=per", "seeds=[3,8,5]", "batch=16", "steps=60"]
WORDS += ["learning_starts=20", "eval.every=null"]
SIZES = {"ring": (60, FlatPriorities), "tree": (120_000, TreePriorities)}


def own(poison):
    """A prioritisation that is not finite in the lanes with a large alpha."""

    def mass(p, hyper):
        return torch.where(hyper["alpha"] > 5.0, poison, p + 1.0)

    return mass


def trained(alpha, buffer, compile, steps=45):
    """A training of three lanes whose second has another alpha and a large epsilon."""
    config = train.settings([*WORDS, f"buffer={buffer}", f"compile={compile}"])
    training = build.build(config, train.CONF, train.CONF.parent / "results")
    training.hyper["alpha"][1] = alpha
    training.hyper["epsilon"][1] = 2.0
    with torch.no_grad():
        for _ in range(steps):
            training.advance()
    training.setup.buffer.check()  # an overflow is no error
    return training


def everything(training):
    buffer = training.setup.buffer
    tree = training.state, buffer.priorities.mass, buffer.storage.rows, buffer.storage.draw_count
    share = priorities.effective_sample_size(buffer.priorities.mass, buffer.storage.size)
    return [*tree_leaves(tree), training._drawn, share]


def cases():
    """All but one of the compiled ones are slow tests."""
    for poison, size, compile in product([None, torch.inf, torch.nan], SIZES, [False, True]):
        slow = compile and (poison, size) != (None, "ring")
        yield pytest.param(poison, size, compile, marks=[pytest.mark.slow] if slow else [])


@pytest.mark.parametrize(("poison", "size", "compile"), [*cases()])
def test_an_overflow_stays_in_its_lane(poison, size, compile, monkeypatch):
    if compile and why_not_compiled():
        pytest.skip(why_not_compiled())
    if poison is not None:
        monkeypatch.setitem(priorities.PRIORITISATIONS, "proportional", own(poison))
    buffer, kind = SIZES[size]
    wild, calm = (trained(alpha, buffer, compile) for alpha in (3000.0, 0.6))
    assert type(wild.setup.buffer.priorities) is kind
    assert wild.step == calm.step == 45
    for one, other in zip(everything(wild), everything(calm), strict=True):
        assert one[[0, 2]].equal(other[[0, 2]])
        assert one[1].isfinite().all()  # its weights are finite, so it goes on learning
    mass = wild.setup.buffer.priorities.mass[1]
    assert (mass == priorities.LARGEST).any() or torch.isnan(torch.tensor(poison or 0.0))
    assert not mass.equal(calm.setup.buffer.priorities.mass[1])
