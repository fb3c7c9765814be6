"""Prioritisations and rules of one's own that read facts: as what is shipped, and by hand."""

import numpy as np
import pytest
import torch
from test_loop import everything, same, training

import train
from aser import checkpoint
from aser.errors import ConfigError
from aser.replay import draws
from aser.replay.facts import TD_ERROR

ENV = ("env=corridor", "hyper=sb3", "steps=90", "learning_starts=20", "buffer=35")
ENV += ("eval.every=null",)
SHAPE = ("hyper.alpha=0.4", "hyper.epsilon=0")
PER = ("sampler=per", "prioritisation=proportional", "prioritisation.weights=false", *SHAPE)
LAP = ("sampler=per", "prioritisation=lap", "prioritisation.new=current_max")
AGAIN = ("prioritisation.name=own.proportional", *SHAPE)


def lap(facts):
    return facts.p.clamp(min=1.0) ** facts.hyper["alpha"]


def lap_of_td_error(facts):
    return facts.td_error.clamp(min=1.0) ** facts.hyper["alpha"]


def proportional(facts):
    return (facts.p + facts.hyper["epsilon"]) ** facts.hyper["alpha"]


def rank(facts):
    order = torch.where(facts.there, facts.p, -1.0).argsort(descending=True, stable=True)
    ranks = torch.empty_like(order).scatter(0, order, torch.arange(1, len(order) + 1))
    return ranks.double() ** -facts.hyper["alpha"].double()


def recent(facts):
    return 0.9**facts.age


def by_all(facts):
    ends = 4.0 * facts.terminated + 2.0 * facts.truncated
    return facts.reward.abs() + facts.td_error + 1.0 / (1.0 + facts.age) + ends


def negative_when_old(facts):
    return 30.0 - facts.age


def nan_when_old(facts):
    return torch.where(facts.age > 3.0, torch.nan, 1.0)


def fixed(path):
    return torch.ones_like(path.p, dtype=torch.bool)


def threshold(path):
    return path.p < path.b


def of_facts(path):
    """Passes s_j where the transition from it is young, or surprising, or cut off."""
    assert isinstance(path.truncated, torch.Tensor)
    return (path.age[1:] < 12.0) | (path.td_error[1:] > 0.9) | path.truncated[1:]


def of_own(*words):
    return [word.replace("own.", "test_own_rules.") for word in words]


def advanced(*words, step=60, **more):
    run = training(*ENV, *of_own(*words), **more)
    for _ in range(step):
        run.advance()
    return run


def learned(run):
    """What a run has come to, without its masses, which differ in what is stored."""
    storage = run.setup.buffer.storage.state_dict()
    state = checkpoint.leaves(run.state.agent)
    return [state, storage["draw_count"], storage["unroll_sum"], run._actions, run._drawn]


SHIPPED = {
    "lap": (LAP, [*PER, "prioritisation.name=own.lap"]),
    "lap of the TD error": (
        LAP,
        ["sampler=uniform", "prioritisation.name=own.lap_of_td_error", *SHAPE],
    ),
    "ever_max": (
        LAP[:2],
        [*PER, "prioritisation.name=own.lap", "prioritisation.new=ever_max"],
    ),
    "proportional": (["sampler=per", *SHAPE], ["sampler=per", *AGAIN]),
    "over the batch": (
        ["sampler=per", "prioritisation.over=batch", *SHAPE],
        ["sampler=per", "prioritisation.over=batch", *AGAIN],
    ),
    "rank": (
        ["sampler=rank", "prioritisation.alpha=0.4"],
        ["sampler=per", "prioritisation.name=own.rank", *SHAPE],
    ),
    "of a state": (["sampler=aser", *SHAPE], ["sampler=aser", *AGAIN]),
    "fixed": (["sampler=nstep"], ["sampler=uniform", "bootstrap.name=own.fixed"]),
    "threshold": (["sampler=aser"], ["sampler=aser", "bootstrap.name=own.threshold"]),
}


@pytest.mark.parametrize(
    "name",
    [
        name
        if name in ("ever_max", "rank", "threshold")
        else pytest.param(name, marks=pytest.mark.slow)
        for name in SHIPPED
    ],
)
def test_one_that_repeats_a_shipped_one_gives_the_same_run(name):
    shipped, own = (advanced(*words) for words in SHIPPED[name])
    assert same(learned(shipped), learned(own))
    assert (shipped._drawn != shipped._drawn[0, 0]).any()


def test_powers_of_the_age_are_the_chances_of_recent():
    run = advanced("sampler=uniform", "prioritisation.name=own.recent")
    clock = run._clock
    mass = run.setup.buffer.mass_of_all(run.setup.buffer.sampler, clock, run.hyper)
    age = (int(clock.newest) - torch.arange(35)) % 35
    other = training(*ENV, "sampler=recent", "prioritisation.q=0.9")
    chances = draws.chances(other.setup.buffer.sampler.draw, clock, 7)[age]
    torch.testing.assert_close(mass[:, :35] / mass.sum(1, keepdim=True), chances.expand(3, -1))


@pytest.mark.parametrize("step", [24, 60])  # a buffer with places without an item, and a full one
def test_masses_by_hand(step):
    run = advanced("sampler=uniform", "prioritisation.name=own.by_all", step=step)
    buffer = run.setup.buffer
    rows, columns = buffer.storage.rows, buffer.storage.layout.columns
    rows[:, 3::7, columns["truncated"]] = 1.0
    rows[1, 5, columns["terminated"]] = 1.0
    mass = buffer.mass_of_all(buffer.sampler, run._clock, run.hyper)
    for lane in range(3):
        for place in range(35):
            fact = {name: rows[lane, place, part.start].item() for name, part in columns.items()}
            age = (step - 1 - place) % 35
            wanted = abs(fact["reward"]) + fact[TD_ERROR] + 1.0 / (1.0 + age)
            wanted += 4.0 * fact["terminated"] + 2.0 * fact["truncated"]
            wanted = wanted if place < step else 0.0
            assert mass[lane, place].item() == pytest.approx(wanted, rel=1e-12)
    assert (mass[:, 35:] == 0.0).all() and (buffer._lowest == 0.0).all()


def test_td_errors_are_kept_from_update_to_update():
    run = advanced("sampler=uniform", "prioritisation.name=own.by_all", step=20)
    storage = run.setup.buffer.storage
    column = storage.layout.columns[TD_ERROR].start
    assert (storage.rows[:, :20, column] == 1.0).all()
    for step in range(20, 60):
        before = storage.rows[:, :, column].clone()
        run.advance()
        before[:, step % 35] = before.amax(1)  # a new item has the largest one
        info = run._update.info
        error = (info.target - info.q.amin(1)).abs()
        for lane in range(3):
            drawn = run._drawn[lane]
            for item in range(35):
                now, new = storage.rows[lane, item, column], error[lane][drawn == item]
                assert now in (new if len(new) else before[lane, item : item + 1])
    assert storage.rows[:, :, column].unique().numel() > 60


def test_what_is_not_read_is_not_kept():
    run = advanced("sampler=aser", "prioritisation.name=own.recent", step=22)
    buffer = run.setup.buffer
    assert TD_ERROR not in buffer.storage.layout.columns and not buffer.sampler.unroll.reads_facts
    assert not buffer.sampler.rewrites and not isinstance(run._update.mass, torch.Tensor)
    assert not isinstance(run._update.td_error, torch.Tensor)


def test_unrolls_by_hand():
    """A rule that reads the facts of its windows, from the rows before the update."""
    run = advanced("sampler=nstep", "bootstrap.name=own.of_facts", "hyper.h=4", batch=31)
    storage, layout = run.setup.buffer.storage, run.setup.buffer.sampler.layout
    lengths = set()
    for _ in range(20):
        kept = storage.rows.clone()
        run.advance()
        kept[:, storage.newest] = storage.rows[:, storage.newest]
        drawn, n = run._drawn, run._update.n
        read = {name: layout.read(kept, name) for name in ("terminated", "truncated", TD_ERROR)}
        for lane, place in np.ndindex(3, 31):
            item, steps = int(drawn[lane, place]), 1
            while steps < 4:
                ends = read["terminated"][lane, item] + read["truncated"][lane, item] > 0
                if ends or item == storage.newest:
                    break
                item = (item + 1) % 35
                age = (storage.newest - item) % 35
                young = age < 12 or read[TD_ERROR][lane, item] > 0.9
                if not (young or read["truncated"][lane, item] > 0):
                    break
                steps += 1
            assert n[lane, place] == steps
            lengths.add(steps)
    assert lengths == {1, 2, 3, 4}


@pytest.mark.parametrize("by", ["lap_of_td_error", "by_all"])
def test_a_resumed_run_is_the_same(by):
    words = ["sampler=aser", f"prioritisation.name=own.{by}", "bootstrap.name=own.of_facts"]
    whole, half = advanced(*words, step=70), advanced(*words, step=41)
    again = training(*ENV, *of_own(*words))
    again.load_state_dict(checkpoint.plain(half.state_dict()))
    for _ in range(29):
        again.advance()
    assert same(everything(whole), everything(again))


def test_a_criterion_that_learns_is_refused_where_no_function_reads_its_p():
    own = "prioritisation.name=own.by_all"
    words = of_own("sampler=outcome_spread", own, "bootstrap=one_step")
    with pytest.raises(ConfigError) as caught:
        training(*ENV, *words)
    assert str(caught.value) == (
        "criterion=outcome_spread: prioritisation=test_own_rules.by_all reads no facts.p, so it "
        "would not learn; allowed: uniform"
    )
    training(*ENV, *of_own("sampler=outcome_spread", own))  # the unrolls read it


def test_a_rule_that_reads_p_needs_a_criterion():
    words = of_own("sampler=uniform", "bootstrap.name=own.threshold", "hyper.h=4")
    with pytest.raises(ConfigError) as caught:
        training(*ENV, *words)
    said = (
        "bootstrap=test_own_rules.threshold: it depends on p or b, which a rule without a criterion"
    )
    assert str(caught.value).startswith(said)


def nothing_yet(facts):
    return (facts.reward > 100.0).float()


def test_where_all_masses_are_zero_draws_are_uniform():
    run = advanced("sampler=uniform", "prioritisation.name=own.nothing_yet", batch=31)
    counts = run.setup.buffer.storage.state_dict()["draw_count"]  # of 35 places
    assert (counts > 0).sum(1).min() > 30 and counts.max() < 0.1 * counts.sum(1).min()


def test_a_negative_mass_is_found_and_one_that_is_no_number_is_none():
    run = advanced("sampler=uniform", "prioritisation.name=own.negative_when_old", step=31)
    run.setup.buffer.check()
    run.advance()  # the oldest item has the age 31
    with pytest.raises(ConfigError) as caught:
        run.setup.buffer.check()
    assert str(caught.value) == (
        "prioritisation=test_own_rules.negative_when_old: a mass was negative in lane 0, 1, 2; "
        "allowed: at least 0"
    )
    run = training(*ENV, *of_own("sampler=uniform", "prioritisation.name=own.recent"))
    buffer = run.setup.buffer
    object.__setattr__(buffer.sampler, "by_facts", nan_when_old)
    for _ in range(60):
        run.advance()
    assert ((run._clock.newest - run._drawn) % 35 <= 3).all()
    buffer.check()


def test_it_is_compiled(capsys):
    from aser.compiled import why_not_compiled

    if why_not_compiled():
        pytest.skip(why_not_compiled())
    words = ["sampler=aser", "prioritisation.name=own.by_all", "bootstrap.name=own.of_facts"]
    one, two = advanced(*words), advanced(*words, "compile=true")
    assert "could not be compiled" not in capsys.readouterr().out
    buffers = [run.setup.buffer for run in (one, two)]
    masses = [
        b.mass_of_all(b.sampler, run._clock, run.hyper)
        for b, run in zip(buffers, (one, two), strict=True)
    ]
    torch.testing.assert_close(*masses, rtol=0.05, atol=0.05)
    assert (one._drawn == two._drawn).double().mean() > 0.9


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ("sampler=uniform", "criterion=entropy"),
            "criterion=entropy is read by the diagnostics alone",
        ),
        (
            ("sampler=aser", "bootstrap=one_step", "prioritisation.name=own_rules.recent"),
            "criterion=mode_log_prob is not read: prioritisation.name=own_rules.recent reads "
            "other facts",
        ),
        (("sampler=aser", "bootstrap=one_step"), None),
        (("sampler=aser", "prioritisation.name=own_rules.recent"), None),
    ],
)
def test_a_criterion_that_nothing_reads_is_said(house, monkeypatch, capsys, words, line):
    (house / "own_rules.py").write_text("def recent(facts):\n    return 0.9 ** facts.age\n")
    monkeypatch.syspath_prepend(house)
    common = ["env=corridor", "steps=30", "debug=smoke", "learning_starts=20", "batch=5"]
    assert train.main([*common, "hyper=sb3", *words, "run_dir=here"]) == 0
    said = [one for one in capsys.readouterr().out.splitlines() if one.startswith("criterion=")]
    assert said == ([line] if line else [])
