"""The loop: what it stores, when it learns, and that nothing from outside changes what it does."""

import copy
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import torch
from torch.nn.functional import softplus

import train
from aser import build, checkpoint, noise
from aser.agents import sac
from aser.agents.batch import Batch
from aser.agents.networks import mode_log_density, policy
from aser.checkpoint import leaves
from aser.envs.single import Corridor, Maze, Pendulum
from aser.noise import Stream, lane_keys
from aser.training.learning import Part, Supply
from aser.trees import take

TOY = ("env=maze", "env.layout=toy")
SINGLE = {TOY: lambda: Maze(layout="toy"), ("env=corridor",): Corridor, ("env=pendulum",): Pendulum}


def training(*overrides, seeds=(3, 8, 5), batch=7):
    """A training at step 0: three lanes, nothing compiled."""
    own = ["compile=false", f"seeds={list(seeds)}", f"batch={batch}", *overrides]
    config = train.settings([word.replace(" ", "") for word in own])
    return build.build(config, train.CONF, train.CONF.parent / "results")


def fact(run, name):
    """What every lane stored so far under a name, (L, T) or (L, T, features)."""
    storage = run.setup.buffer.storage
    columns = storage.layout.columns[name]
    values = storage.rows[:, : storage.size, columns]
    return values if name in ("obs", "action", "next_obs") else values[..., 0]


def everything(run):
    """All that training has made: parameters, moments, buffer, the environments' states, the next
    action.
    """
    state = run.state_dict()
    for name in ("returns", "diagnostics", "steady"):
        del state[name]
    return state


def same(one, two):
    """Whether two trees are equal to the bit."""
    if isinstance(one, dict):
        return one.keys() == two.keys() and all(same(one[key], two[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(two) and all(map(same, one, two))
    if isinstance(one, torch.Tensor | np.ndarray):
        one, two = np.asarray(one), np.asarray(two)
        return one.dtype == two.dtype and one.shape == two.shape and one.tobytes() == two.tobytes()
    return one == two


@pytest.mark.parametrize(
    ("env", "starts", "steps"),
    [(TOY, 130, 140), (("env=corridor",), 60, 75), (("env=pendulum",), 405, 410)],
)
def test_what_is_stored_is_what_the_environment_gave(env, starts, steps):
    run = training(*env, f"learning_starts={starts}", f"steps={steps}")
    given = []
    step = run.setup.envs.step
    run.setup.envs.step = lambda actions: step(given.append(np.array(actions)) or actions)
    run.run()
    for lane, seed in enumerate(run.setup.seeds):
        env_alone = SINGLE[env]()
        obs, _ = env_alone.reset(seed=seed)
        ends = 0
        for t in range(steps):
            next_obs, reward, terminated, truncated, _ = env_alone.step(given[t][lane])
            stored = {
                name: fact(run, name)[lane, t].numpy()
                for name in run.setup.buffer.sampler.layout.columns
            }
            np.testing.assert_array_equal(stored["obs"], obs)
            np.testing.assert_array_equal(stored["next_obs"], next_obs)
            assert stored["reward"] == np.float32(reward)
            assert (stored["terminated"], stored["truncated"]) == (terminated, truncated)
            reach = 2.0 if env == ("env=pendulum",) else 1.0
            np.testing.assert_array_equal(reach * stored["action"], given[t][lane])
            assert (np.abs(stored["action"]) <= 1).all()
            obs = next_obs
            if terminated or truncated:
                ends += 1
                obs, _ = env_alone.reset()
        assert ends >= 2  # or the end of an episode was not tested
    assert len(given) == steps == run.step


def test_learning_begins_after_exactly_learning_starts_random_steps():
    starts, steps = 11, 21
    run = training(*TOY, f"learning_starts={starts}", f"steps={steps}")
    fresh = [leaf.clone() for leaf in leaves(run.state)]
    for step in range(1, steps + 1):
        run.advance()
        assert run.step == run.setup.buffer.storage.stored == step
        assert run.state.agent.updates.tolist() == [max(step - starts, 0)] * 3
        assert same(leaves(run.state), fresh) == (step <= starts)
    drawn = run.setup.buffer.storage.draw_count.sum(1)
    assert drawn.tolist() == [7 * (steps - starts)] * 3
    actions = fact(run, "action")  # (L, T, A)
    for lane, keys in enumerate(lane_keys(run.setup.seeds)):
        random = 2 * noise.uniform(keys[Stream.WARM_UP], (starts, 2)) - 1
        assert torch.equal(actions[lane, :starts], random)
        assert not torch.isin(actions[lane, starts:], random).any()


def lone_lane(sampler, seed, steps, starts, batch, hyper, updates):
    """Algorithm 1 with one-step targets on one Pendulum, in lists: state, actions, masses."""
    keys = lane_keys([seed])[0]
    env = Pendulum()
    obs, _ = env.reset(seed=seed)
    state = sac.init(keys[Stream.INIT], 3, 1, [24])
    items, mass, actions = [], [], []

    def numbers(kind, stream, step, *shape):
        return kind(noise.at_step(keys[stream], torch.tensor(step, dtype=torch.int32)), shape)

    for t in range(steps):
        if t < starts:
            action = 2 * noise.uniform(keys[Stream.WARM_UP], (starts, 1))[t] - 1
        else:
            last = t * updates  # the number of the last update so far
            exploring = {Stream.ACTION: numbers(noise.normal, Stream.ACTION, last, 1, 1)}
            action = sac.act(state, torch.from_numpy(obs)[:, None], {}, exploring)[:, 0]
        actions.append(action)
        next_obs, reward, terminated, truncated, _ = env.step(2 * action.numpy())
        items.append((obs, action.numpy(), np.float32(reward), next_obs, terminated))
        mass.append(max(mass) if mass else 1.0)
        obs = env.reset()[0] if terminated or truncated else next_obs
        if t + 1 <= starts:
            continue
        for now in range(t * updates + 1, (t + 1) * updates + 1):
            u = numbers(noise.uniform_double, Stream.DRAW, now, batch).numpy()
            if sampler == "uniform":
                index = (u * len(items)).astype(int)
            else:
                index = np.searchsorted(np.cumsum(mass), u * sum(mass), side="right")
            weight = np.ones(batch)
            if sampler == "per":
                beta = hyper["beta"] + (1 - hyper["beta"]) * (t + 1) / steps
                weight = (np.array(mass)[index] / min(mass)) ** -beta
            seen, acted, got, then, over = (
                np.array(column) for column in zip(*(items[i] for i in index), strict=True)
            )
            seen, then = torch.from_numpy(seen.T), torch.from_numpy(then.T)
            drawn = Batch(
                obs=seen,
                action=torch.from_numpy(acted.T),
                reward=torch.from_numpy(got),
                discount=torch.from_numpy(np.where(over, 0, hyper["gamma"])).float(),
                boot_obs=then,
                weight=torch.from_numpy(weight).float(),
                actor_obs=seen,
            )
            epsilons = {
                s: numbers(noise.normal, s, now, 1, batch) for s in (Stream.POLICY, Stream.TARGET)
            }
            values = {key: torch.tensor(value) for key, value in hyper.items()}
            state, info = sac.update(state, drawn, values, epsilons)
            if sampler == "per":
                p = (info.target - info.q.amin(0)).abs()
            else:
                p = softplus(mode_log_density(policy(state.actor, seen)))  # of the updated policy
            for i, value in zip(index, p.double().tolist(), strict=True):
                if sampler != "uniform":
                    mass[i] = (value + hyper["epsilon"]) ** hyper["alpha"]
    return state, torch.stack(actions), mass


@pytest.mark.parametrize(
    ("sampler", "updates"),
    [
        *(("per", 1), ("aser_no_bootstrap", 1), ("uniform", 3)),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("uniform", 1), ("per", 2))),
    ],
)
def test_each_lane_is_what_a_plain_loop_does_alone(sampler, updates):
    starts, steps, batch = 190, 190 + 30 // updates, 5
    overrides = [
        "env=pendulum",
        f"sampler={sampler}",
        f"learning_starts={starts}",
        f"steps={steps}",
        f"updates={updates}",
    ]
    run = training(*overrides, batch=batch)
    run.run()
    hyper = {key: float(value[0]) for key, value in run.hyper.items()}
    assert hyper["target_entropy"] == -1
    for lane, seed in enumerate(run.setup.seeds):
        state, actions, mass = lone_lane(sampler, seed, steps, starts, batch, hyper, updates)
        torch.testing.assert_close(fact(run, "action")[lane], actions, rtol=1e-3, atol=1e-4)
        for found, expected in zip(leaves(take(run.state.agent, lane)), leaves(state), strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)
        if sampler != "uniform":
            found = run.setup.buffer.priorities.mass[lane]
            torch.testing.assert_close(
                found, torch.tensor(mass, dtype=torch.float64), rtol=1e-3, atol=1e-4
            )


@pytest.mark.parametrize(
    ("env", "sampler"),
    [
        (TOY, "aser"),
        (("env=corridor",), "nstep"),
        pytest.param(TOY, "oracle", marks=pytest.mark.slow),
        pytest.param(("env=pendulum", "eval.episodes=2"), "per", marks=pytest.mark.slow),
    ],
)
def test_evaluation_changes_nothing(env, sampler):
    overrides = [*env, f"sampler={sampler}", "learning_starts=12", "steps=45"]
    runs = [training(*overrides, f"eval.every={every}") for every in ("null", "7", "45")]
    for run in runs:
        run.run()
    quiet, often, once = runs
    assert [step for step, _ in often.history.returns] == [7, 14, 21, 28, 35, 42, 45]
    assert [step for step, _ in once.history.returns] == [45]
    assert quiet.history.returns == []
    assert same(everything(quiet), everything(often)) and same(everything(quiet), everything(once))
    assert same(often.history.returns[-1], once.history.returns[-1])


@pytest.mark.parametrize(
    "sampler",
    [
        *("per", "aser"),
        *(pytest.param(s, marks=pytest.mark.slow) for s in ("uniform", "aser_q", "oracle")),
    ],
)
def test_a_diverged_lane_counts_as_the_worst_and_the_others_go_on(sampler):
    overrides = [*TOY, f"sampler={sampler}", "learning_starts=10", "steps=40", "eval.every=10"]
    healthy, ill = training(*overrides), training(*overrides)

    def poison(run):
        if run.step == 13:
            run.state.agent.actor[0].weight[1] = torch.nan
        return False

    healthy.run()
    assert ill.run(after_step=poison)
    assert ill.history.diverged == {1: 20} and healthy.history.diverged == {}
    for (step, returns), (_, expected) in zip(
        ill.history.returns, healthy.history.returns, strict=True
    ):
        np.testing.assert_array_equal(returns[[0, 2]], expected[[0, 2]])
        # A dead end at every other of 50 steps.
        assert returns[1] == (expected[1] if step <= 10 else -25.0)
    for found, expected in zip(leaves(ill.state), leaves(healthy.state), strict=True):
        assert same(found[[0, 2]], expected[[0, 2]])
    assert same(ill.setup.buffer.storage.rows[[0, 2]], healthy.setup.buffer.storage.rows[[0, 2]])
    assert not ill.state.agent.actor[0].weight[1].isfinite().any()


def test_where_no_worst_return_is_known_it_is_the_lowest_seen():
    overrides = ["env=gym", "env.id=MountainCarContinuous-v0", "network=small", "eval.episodes=1"]
    run = training(*overrides, "learning_starts=10", "steps=12", "eval.every=4", seeds=(3, 8))
    scores = iter([[-7.0, -20.0], [-9.0, -3.0], [-4.0, -11.0]])
    run.setup = replace(run.setup, evaluation=lambda state, poll: np.array(next(scores)))

    def poison(run):
        if run.step == 6:
            run.state.agent.critics[1].bias[0] = torch.inf
        return False

    run.run(after_step=poison)
    assert run.history.diverged == {0: 8}
    assert [returns.tolist() for _, returns in run.history.returns] == [
        [-7, -20],
        [-20, -3],
        [-20, -11],
    ]
    # A return that is NaN hides no other one.
    assert run._worst_return(np.array([-500.0, np.nan])) == -500
    run.history.returns.insert(0, (2, np.array([np.nan, -600.0])))
    assert run._worst_return(np.array([np.nan, -3.0])) == -600


def test_a_run_stops_where_it_is_asked_and_goes_on_from_there():
    overrides = [*TOY, "sampler=aser", "learning_starts=9", "steps=30", "eval.every=10"]
    straight, halting = training(*overrides), training(*overrides)
    assert straight.run() is True
    places = []
    while not halting.run(after_step=lambda run: run.step in (5, 9, 10, 17)):
        places.append(halting.step)
    assert places == [5, 9, 10, 17]
    assert same(everything(halting), everything(straight))
    assert same(halting.history.returns, straight.history.returns)


def test_a_training_that_begins_again_is_a_fresh_one_with_other_hyper_parameters():
    overrides = [*TOY, "sampler=aser", "learning_starts=9", "steps=30", "eval.every=10"]
    fresh, again = training(*overrides, "hyper.lr=.01", "hyper.gamma=.5"), training(*overrides)
    start = copy.deepcopy(checkpoint.plain(again.state_dict()))
    again.run()
    assert not same(everything(again), everything(fresh))
    again.begin_again(copy.deepcopy(start), fresh.hyper)
    assert again.step == 0 and again.history.returns == [] and again.history.diagnostics == []
    for run in (fresh, again):
        run.run()
    assert same(everything(again), everything(fresh))
    assert same(again.history.returns, fresh.history.returns)
    again.begin_again(start, again.setup.hyper)
    again.run()
    assert not same(everything(again), everything(fresh))


def test_what_a_run_is_made_of_is_fixed_and_its_hyper_parameters_are_the_trainings_own():
    run = training(*TOY)
    with pytest.raises(FrozenInstanceError):
        run.setup.hyper = {}
    assert run.hyper is run.setup.hyper and run.state is run.setup.state


def test_the_sizes_are_those_of_the_environment():
    assert training(*TOY).sizes == {"obs": 4, "action": 2}
    assert training("env=pendulum").sizes == {"obs": 3, "action": 1}
    assert training("env=corridor", "agent=dqn").sizes == {"obs": 1, "action": 1}


@pytest.mark.parametrize(
    ("overrides", "kept"),
    [
        (["sampler=uniform"], []),
        (["sampler=per"], []),
        (["sampler=aser"], []),
        (["sampler=aser_shuffled"], []),
        (["sampler=oracle"], ["p_next"]),
        (["sampler=oracle_no_prioritisation"], ["p_next"]),
        (["sampler=oracle_no_bootstrap"], []),
        (["sampler=aser", "bootstrap.criterion.name=td_error"], ["td_error"]),
        (["sampler=oracle", "bootstrap.criterion.name=td_error"], ["td_error"]),
        (["sampler=aser", "bootstrap.criterion.name=oracle"], ["p_next"]),
    ],
    ids=" ".join,
)
def test_beside_a_transition_is_kept_what_the_rules_criterion_needs(overrides, kept):
    layout = training(*TOY, *overrides).setup.buffer.sampler.layout
    facts = ["obs", "action", "reward", "next_obs", "terminated", "truncated"]
    assert list(layout.columns) == [*facts, *kept]


def test_a_steps_numbers_do_not_depend_on_the_block_they_are_made_in():
    run = training(*TOY, "sampler=aser", "steps=200")
    buffer = run.setup.buffer
    supply = Supply(Part(run.setup.agent, buffer.sampler), buffer.keys, run.setup.compile)
    wanted = {**run.setup.buffer.sampler.wanted(2), **sac.wanted(2, 7)}
    for step in (0, 15, 16, 33, 34, 3):
        found = supply(step)
        assert found.keys() == wanted.keys()
        for lane, keys in enumerate(run.setup.buffer.keys):
            alone = noise.numbers(
                noise.at_step(keys, torch.tensor(step, dtype=torch.int32)), wanted
            )
            for stream in wanted:
                torch.testing.assert_close(found[stream][lane], alone[stream])


def test_an_evaluation_that_was_cut_off_is_repeated_after_a_resume():
    overrides = [*TOY, "sampler=aser", "learning_starts=9", "steps=30", "eval.every=10"]
    straight, halting, resumed = (training(*overrides) for _ in range(3))
    straight.run()
    calls = []

    def poll():
        """Stop within the second evaluation, after some of its steps."""
        calls.append(halting.step)
        return calls.count(20) == 5

    assert halting.run(poll=poll) is False and halting.step == 20
    assert [step for step, _ in halting.history.returns] == [10]
    resumed.load_state_dict(checkpoint.plain(halting.state_dict()))
    followed = []
    assert resumed.run(after_step=lambda run: followed.append(run.step)) is True
    assert followed == list(range(20, 31))  # a snapshot of step 20 is not lost
    for (step, returns), (other, expected) in zip(
        resumed.history.returns, straight.history.returns, strict=True
    ):
        assert step == other and returns.tolist() == expected.tolist()
    assert len(resumed.history.diagnostics) == len(straight.history.diagnostics) == 3
