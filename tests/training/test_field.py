"""One update of the field's samplers against their authors' published lines, on the same numbers.

What is compared are the priorities that are written and the weights of what is drawn.
"""

import numpy as np
import pytest
import torch
from test_loop import training

import train
from aser.agents import sac, with_loss
from aser.agents.batch import Batch
from aser.agents.networks import q_values
from aser.noise import Stream
from aser.trees import take, tree_leaves, tree_map

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


def test_a_new_item_of_relo_gets_the_largest_priority_ever(monkeypatch):
    run, masses = at_an_update("sampler=relo"), []
    buffer, record = run.setup.buffer, run.setup.buffer.record.clone()
    assert (record >= buffer.priorities.mass.amax(1)).all()
    assert (record >= 1).all()  # the first item's
    append = buffer.append

    def then_read(*facts):  # the update that follows may give the new item another one
        append(*facts)
        masses.append(buffer.priorities.mass[:, buffer.storage.newest].clone())

    monkeypatch.setattr(buffer, "append", then_read)
    run.advance()
    assert len(masses) == 1 and masses[0].equal(record)


def test_reaper():
    """The weights of a draw, by the lines of the authors' buffer, from the stored TD errors."""
    run = at_an_update("sampler=reaper")
    buffer, layout = run.setup.buffer, run.setup.buffer.sampler.layout
    clock = buffer.storage.clock(60, 90)
    u = torch.rand(3, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    index, weight, *_ = buffer.draw(u, run.hyper, clock)
    oldest = (int(clock.newest) + 1) % 35
    for lane in range(3):
        rows = buffer.storage.rows[lane].roll(-oldest, 0)
        td_errors = buffer.priorities.mass[lane].roll(-oldest).numpy()
        done = torch.maximum(*(layout.read(rows, n) for n in ("terminated", "truncated"))) > 0.5
        episodes = np.concatenate([[0], done.numpy().cumsum()[:-1]])
        cum_tds = np.array(
            [td_errors[: i + 1][episodes[: i + 1] == e].sum() for i, e in enumerate(episodes)]
        )
        sum_tds = np.array([td_errors[episodes == e].sum() for e in episodes])
        current = episodes == episodes[-1] if not done[-1] else np.zeros(35, bool)
        sum_tds[current] = sum_tds.max()
        reliability = 1 - (sum_tds - cum_tds) / sum_tds
        sampling_weights = td_errors**0.3 * reliability**0.3
        assert 2 < len(set(episodes)) < 30 and sampling_weights.std() > 0.01
        probas = sampling_weights / sampling_weights.sum()
        beta = run.hyper["beta"][lane].item() / 3 + 2 / 3
        weights = (probas * 35) ** -beta / (probas.min() * 35) ** -beta
        places = ((index[lane] - oldest) % 35).numpy()
        np.testing.assert_allclose(weight[lane].numpy(), weights[places], rtol=1e-4)


def huber(x):
    return np.where(x < 1, 0.5 * x**2, x).mean()


def pal(x):
    return np.where(np.abs(x) < 1, 0.5 * x**2, np.abs(x) ** 1.4 / 1.4).mean()


@pytest.mark.parametrize(
    ("batch", "fraction", "parts"),
    [(256, 0.5, (128, 128)), (256, 0.3, (179, 77)), (100, 0.9, (10, 90)), (10, 0.9, (1, 9))],
)
def test_la3ps_parts_are_the_batch(batch, fraction, parts):
    config = train.settings(
        ["sampler=la3p", f"batch={batch}", f"prioritisation.fraction={fraction}"]
    )
    assert config.prioritisation.parts(batch) == parts and sum(parts) == batch


def test_la3p():
    """Both updates of a step by the lines of the authors' LA3P_SAC.py.

    Their Huber's loss lacks the constant 1/2 beyond the knee. It changes no gradient.
    """
    run = at_an_update("sampler=la3p", batch=16)
    buffer, told = run.setup.buffer, []
    write = buffer.write_back

    def noted(index, n, measured, mass, *rest):
        drawn_from = buffer.priorities.mass.clone()
        write(index, n, measured, mass, *rest)
        told.append((index, mass, drawn_from, buffer.priorities.mass.clone()))

    buffer.write_back = noted
    before = tree_map(torch.clone, run.state.agent)
    learned, learn = [], run._learn
    run._learn = lambda *given: learned.append((given[-1], given[3])) or learn(*given)
    run.advance()
    ((numbers, clock),) = learned
    assert len(told) == 2 and run.state.agent.updates.tolist() == [82.0] * 3  # two a step

    uniform, mass, _, after = told[0]
    assert torch.equal(uniform, (numbers[0][Stream.DRAW] * 35).long()) and uniform.shape == (3, 8)
    for lane in range(3):
        batch = one_step(run, lane, uniform[lane])
        state, hyper = take(before, lane), take(run.hyper, lane)
        _, info = sac.update(state, batch, hyper, take(numbers[0], lane))
        error = (info.q - info.target).numpy()
        scale = np.maximum(np.abs(error[0]), np.abs(error[1])).clip(min=1)
        priority = scale**0.4
        qf_loss = (pal(error[0]) + pal(error[1])) / priority.mean()
        assert_written(after[lane], uniform[lane], priority)
        np.testing.assert_allclose(mass[lane].numpy(), priority, rtol=1e-4)
        state, other = with_loss(sac, "pal").update(state, batch, hyper, take(numbers[0], lane))
        assert other.critic_loss.item() == pytest.approx(qf_loss, rel=1e-4)

        critic, mass_now, drawn_from, _ = (x[lane] for x in told[1])
        cumulative = drawn_from.cumsum(0)
        u = numbers[1][Stream.DRAW][lane]
        assert critic.tolist() == [int((cumulative <= x * cumulative[-1]).sum()) for x in u]
        reversed_priorities = drawn_from.sum() / (drawn_from + 1e-6)
        cumulative, v = reversed_priorities.cumsum(0), numbers[1][Stream.UNIFORM][lane]
        actor = torch.tensor([int((cumulative <= x * cumulative[-1]).sum()) for x in v])
        batch = one_step(run, lane, critic)
        batch = batch._replace(actor_obs=read(run, "obs", lane, actor))
        agent = with_loss(sac, "huber")
        state, info = agent.update(state, batch, hyper, take(numbers[1], lane))
        error = np.abs((info.q - info.target).numpy())
        priority = np.maximum(error[0], error[1]).clip(min=1) ** 0.4
        np.testing.assert_allclose(mass_now.numpy(), priority, rtol=1e-4)
        constant = sum((row >= 1).mean() / 2 for row in error)
        assert info.critic_loss.item() == pytest.approx(
            huber(error[0]) + huber(error[1]) - constant, rel=1e-4
        )
        for one, two in zip(
            tree_leaves(take(run.state.agent, lane)), tree_leaves(state), strict=True
        ):
            torch.testing.assert_close(one, two, rtol=1e-3, atol=1e-5)


def one_step(run, lane, index):
    """The one-step batch of these items of a lane."""
    layout, rows = run.setup.buffer.sampler.layout, run.setup.buffer.storage.rows[lane, index]
    gamma = run.hyper["gamma"][lane]
    obs = layout.read_vector(rows, "obs")
    return Batch(
        obs=obs,
        action=layout.read_vector(rows, "action"),
        reward=layout.read(rows, "reward"),
        discount=gamma * (1 - layout.read(rows, "terminated")),
        boot_obs=layout.read_vector(rows, "next_obs"),
        weight=torch.ones(len(index)),
        actor_obs=obs,
    )


def test_the_numbers_of_la3ps_two_updates_differ():
    run = at_an_update("sampler=la3p", batch=16)
    one, two = (supply(60) for supply in (*run._supplies, run._numbers))
    for stream in one.keys() & two.keys():
        assert not torch.isclose(one[stream], two[stream]).any()


def test_of_labers_large_batch_the_items_are_uniform_and_a_quarter_is_learned_from():
    run = at_an_update("sampler=laber", "network.hidden=[6]")
    run.advance()
    update = run._update
    assert update.info.q.shape == (3, 2, 32) and run._drawn.shape == update.n.shape == (3, 32)
    assert run.setup.buffer.priorities is None
    count = run.setup.buffer.storage.draw_count.sum(1)
    assert (count > 0).all()
    assert run._numbers(run.step)[Stream.REDRAW].shape == (3, 2, 8)
