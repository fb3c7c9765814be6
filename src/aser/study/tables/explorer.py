"""A recording for the maze explorer: what a run knows and replays in every state, over training.

L lanes, n states of the maze, S items in the buffer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from aser.envs.maze import MazeVectorEnv
from aser.envs.maze_states import HEADINGS, MazeStates
from aser.errors import ConfigError
from aser.lanes import batched
from aser.scores import roc_auc
from aser.study.tables import agents, exact, marks, maze_states
from aser.study.tables.checkpoint import expected_draws
from aser.training.loop import Training

NO_MOVE = "-"  # in place of a heading: T, where nothing is chosen


def maze(env: MazeVectorEnv, gamma: float) -> dict[str, Any]:
    """What the page must know of a maze to draw it.

    `columns` and `rows` of cells. For each state, `column`, `row`, `last_move`, `ways` as in
    `maze_states.table`, and `decision` and `terminal` as 0 or 1. `best` has the headings, letters
    of ENSW, that are best by the exact values of the actions.
    """
    states = env.states
    table = maze_states.table(states, [0])
    q = exact.action_values(states, gamma, env.reward, env.time_limit)
    with np.errstate(invalid="ignore"):
        best = q >= np.where(np.isnan(q), -np.inf, q).max(axis=1, keepdims=True) - 1e-9
    named = {name: table[name].tolist() for name in ("column", "row", "last_move", "ways")}
    marks = {name: table[name].astype(int).tolist() for name in ("decision", "terminal")}
    letters = np.array(list("ENSW"))
    return {
        "columns": states.layout.columns,
        "rows": states.layout.rows,
        **named,
        **marks,
        "best": ["".join(letters[row]) for row in best],
    }


def record(training: Training, steps: Sequence[int]) -> dict[str, Any]:
    """Train to the end, and look at every state of the maze after each of `steps`.

    By the names of `_look`, lists of what it gives: one for each seed, then one for each step.
    `returns` are those of the run's evaluations, a list for each seed, at `evaluated`. Raises
    ConfigError where the environment is no maze, where the buffer is too small to hold all items,
    or where a step is none of the run.
    """
    setup = training.setup
    if not isinstance(setup.envs, MazeVectorEnv):
        raise ConfigError(f"env={type(setup.envs).__name__}: allowed here: a maze")
    if setup.buffer.storage.capacity < setup.steps:
        raise ConfigError(
            f"buffer={setup.buffer.storage.capacity}: must hold all {setup.steps} steps here"
        )
    if outside := [step for step in steps if not setup.learning_starts < step <= setup.steps]:
        raise ConfigError(
            f"steps={outside[0]}: allowed: above {setup.learning_starts}, at most {setup.steps}"
        )
    looks: list[dict[str, list[Any]]] = []
    counts = Counts(training)

    def after_step(training: Training) -> bool:
        if training.step in steps:
            looks.append(_look(training, counts))
        return False

    training.run(after_step)
    seeds = range(len(setup.seeds))
    recorded = {name: [[look[name][seed] for look in looks] for seed in seeds] for name in looks[0]}
    evaluated = training.history.returns
    return {
        **recorded,
        "evaluated": [step for step, _ in evaluated],
        "returns": [[round(float(values[seed]), 2) for _, values in evaluated] for seed in seeds],
    }


class Counts:
    """How often each state was drawn, and how far it was unrolled, since the last question."""

    def __init__(self, training: Training):
        self.setup = training.setup
        storage = self.setup.buffer.storage
        self.drawn = np.zeros((len(storage.rows), storage.capacity), np.int64)
        self.unrolled = np.zeros_like(self.drawn)
        self.expected = np.zeros(storage.capacity)

    def since(self, step: int, number: np.ndarray, n: int) -> dict[str, np.ndarray]:
        """`draws`, `relative` and `unroll`, (L, n) each, by the items' states `number` (L, S).

        `relative` is the number of draws over that under uniform replay on average, NaN where the
        buffer has no item. `unroll` is the mean length of the unrolls, NaN where there is no draw.
        """
        storage, size = self.setup.buffer.storage, number.shape[1]
        drawn = storage.draw_count.cpu().numpy().astype(np.int64)
        unrolled = storage.unroll_sum.cpu().numpy().astype(np.int64)
        expected = np.zeros_like(self.expected)
        stored_at = np.arange(1, size + 1)
        setup = self.setup
        parts = [part.sampler for part in setup.before] + [setup.buffer.sampler]
        volume = sum(sampler.batch for sampler in parts) * setup.updates
        expected[:size] = expected_draws(
            stored_at, step, setup.learning_starts, volume, storage.capacity
        )

        def by_state(values: np.ndarray) -> np.ndarray:
            values = np.broadcast_to(values, drawn.shape)[:, :size]
            return np.stack([np.bincount(at, of, n) for at, of in zip(number, values, strict=True)])

        draws, steps = by_state(drawn - self.drawn), by_state(unrolled - self.unrolled)
        uniform = by_state(expected - self.expected)
        self.drawn, self.unrolled, self.expected = drawn, unrolled, expected
        with np.errstate(invalid="ignore", divide="ignore"):
            return {"draws": draws, "relative": draws / uniform, "unroll": steps / draws}


def _look(training: Training, counts: Counts) -> dict[str, list[Any]]:
    """What each lane knows now, a list of one entry for each lane.

    `visited` is a text with 1 where the buffer holds an item of the state, and 0 elsewhere;
    `heading` a text with the greedy move of each state, a letter of ENSW. `value` is min Q of the
    greedy action and `p` the criterion, None where there is none; `auc` is the ROC AUC of p for
    decision points over the visited states that are not terminal. `draws`, `relative` and `unroll`
    are those of `Counts.since`.
    """
    setup = training.setup
    states, storage = setup.envs.states, setup.buffer.storage  # type: ignore[attr-defined]
    stored = storage.layout.read_vector(storage.rows[:, : storage.size], "obs").movedim(0, -1)
    number = states.of_observations(stored.cpu().numpy())  # (L, S)
    visited = np.zeros((len(number), len(states)), bool)
    np.put_along_axis(visited, number, True, axis=1)
    obs = torch.from_numpy(states.observation.T)  # (O, n)
    kept = batched(setup.agent.kept)(training.state.agent)
    value = agents.evaluate(kept, obs, [])["value"]
    action = batched(setup.agent.greedy, (0, None))(training.state.agent, obs)  # (L, A, n)
    p = marks.criterion(training, obs)
    none = np.full(value.shape, np.nan)
    known = visited & ~states.terminal
    columns = {"value": value, "p": none if p is None else p}
    columns |= counts.since(training.step, number, len(states))
    looked: dict[str, list[Any]] = {
        name: [_rounded(lane) for lane in values] for name, values in columns.items()
    }
    if p is None:
        looked |= {"p": [None] * len(value), "auc": [None] * len(value)}
    else:
        pairs = [(one[at], states.decision[at]) for one, at in zip(p, known, strict=True)]
        looked["auc"] = _rounded(np.array([roc_auc(*pair) for pair in pairs]))
    looked["visited"] = ["".join(map(str, lane.astype(int))) for lane in visited]
    looked["heading"] = [_moves(states, lane) for lane in action.cpu().numpy()]
    return looked


def _moves(states: MazeStates, action: np.ndarray) -> str:
    """The move of each state, as the maze reads the actions (2, n): the nearest allowed heading."""
    closeness = np.where(states.allowed, action.T @ HEADINGS.T, -np.inf)  # (n, 4)
    moves = np.array(list("ENSW"))[closeness.argmax(axis=1)]
    return "".join(np.where(states.terminal, NO_MOVE, moves))


def _rounded(values: np.ndarray) -> list[float | int | None]:
    """Numbers with three digits that count, as JSON writes them; None for what is not finite."""
    return [_short(float(value)) if np.isfinite(value) else None for value in values.tolist()]


def _short(value: float) -> float | int:
    short = float(f"{value:.3g}")
    return int(short) if short.is_integer() else short
