"""One update of the field's samplers against their authors' published lines, on the same numbers.

What is compared are the priorities that are written and the weights of what is drawn.
"""

import numpy as np
import pytest
import torch
from test_loop import training

from aser.agents.networks import q_values
from aser.trees import take, tree_map

ENV = ("env=corridor", "hyper=thesis", "steps=90", "learning_starts=20", "eval.every=null")


def at_an_update(*overrides, step=60, batch=8):
    """A run before its update of `step + 1`; a full ring, so it has come round."""
    run = training(*ENV, "buffer=35", *overrides, batch=batch)
    for _ in range(step):
        run.advance()
    return run


def read(run, name, lane, index):
    """A vector fact (features, B) of items of a lane."""
    return run.setup.buffer.sampler.layout.read_vector(run.setup.buffer.storage.rows[lane], name)[
        :, index
    ]


def assert_written(mass, index, expected):
    """The masses (N,) of the drawn items; one that was drawn twice has either of its new masses."""
    for item in set(index.tolist()):
        new = [m for i, m in zip(index.tolist(), expected, strict=True) if i == item]
        assert any(mass[item].item() == pytest.approx(m, rel=1e-4) for m in new), item


def test_relo():
    run = at_an_update("sampler=relo")
    buffer = run.setup.buffer
    before = tree_map(torch.clone, run.state.agent)
    run.advance()
    drawn, info = run._drawn, run._update.info
    positive = 0
    for lane in range(3):
        index = drawn[lane]
        obs, action = read(run, "obs", lane, index), read(run, "action", lane, index)
        target_q = q_values(take(before, lane).targets, obs, action).double().numpy()
        q, y = info.q[lane].double().numpy(), info.target[lane].double().numpy()
        loss = ((q[0] - y) ** 2 + (q[1] - y) ** 2) / 2
        irreducible = ((target_q[0] - y) ** 2 + (target_q[1] - y) ** 2) / 2
        priorities = (np.maximum(loss - irreducible, 0) + 1e-5) ** 0.5
        assert_written(buffer.priorities.mass[lane], index, priorities)
        positive += (loss > irreducible).sum()
    assert 0 < positive < drawn.numel()

    clock = buffer.storage.clock(70, 90)
    u = torch.rand(3, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    index, weight, *_ = buffer.draw(u, run.hyper, clock)
    for lane in range(3):
        probs = buffer.priorities.mass[lane, index[lane]] / buffer.priorities.total()[lane]
        beta = run.hyper["beta"][lane] * (1 - 70 / 90) + 70 / 90
        weights = (35 * probs) ** -beta
        expected = weights / weights.max()
        torch.testing.assert_close(weight[lane].double(), expected, rtol=1e-4, atol=0)


def test_a_new_item_of_relo_gets_the_largest_priority_ever():
    run = at_an_update("sampler=relo")
    mass = run.setup.buffer.priorities.mass
    newest = run.setup.buffer.storage.newest
    run.advance()
    assert (mass[:, (newest + 1) % 35] > 0).all()
    assert (run.setup.buffer.record >= mass.amax(1)).all()
    assert (run.setup.buffer.record >= 1).all()  # the first item's


def test_of_labers_large_batch_the_items_are_uniform_and_a_quarter_is_learned_from():
    run = at_an_update("sampler=laber", "network.hidden=[6]")
    run.advance()
    update = run._update
    assert update.info.q.shape == (3, 2, 32) and run._drawn.shape == update.n.shape == (3, 32)
    assert run.setup.buffer.priorities is None
    count = run.setup.buffer.storage.draw_count.sum(1)
    assert (count > 0).all()
    assert run._numbers(run.step)[12].shape == (3, 2, 8)  # of the redraw
