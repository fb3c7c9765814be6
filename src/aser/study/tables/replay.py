"""What was replayed, from a run's own buffer: how often, and how far it was unrolled.

L lanes, S items in the buffer, n states of the maze.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from aser.envs.maze_states import MazeStates
from aser.errors import ConfigError
from aser.lanes import batched
from aser.replay import bootstrap
from aser.replay.storage import read_window
from aser.study.runs import Run
from aser.study.tables import checkpoint, maze_states
from aser.study.tables.checkpoint import Items

ON_POLICY = 0.1  # the newest share of the buffer, which counts as on-policy
ORACLE_THRESHOLD = 0.5  # the oracle is 0 or 1


def replay(run: Run) -> pd.DataFrame:
    """How often each maze state was replayed and how far unrolled (thesis, figures 6 and 7).

    There is a row for each seed and state. Besides the columns of `maze_states.table`: `items`,
    transitions from this state in the buffer at the end; `draws` of them; `expected`, their number
    of draws under uniform replay on average; `relative` = draws / expected, NaN where there is no
    item; `unroll`, the mean number of steps to the bootstrap target over those draws, NaN where
    there is none. Draws of items that the ring has overwritten count neither as draws nor as
    expected.
    """
    states, items = checkpoint.maze(run).states, checkpoint.items(run)
    number = numbers(run, states, items, "obs")
    ones = np.ones(number.shape)
    count = _sum_by_state(number, ones, len(states))
    draws = _sum_by_state(number, items.draws, len(states))
    expected = _sum_by_state(number, ones * items.expected, len(states))
    unrolled = _sum_by_state(number, items.unrolled, len(states))
    with np.errstate(invalid="ignore"):
        relative, unroll = draws / expected, unrolled / draws
    columns = {"items": count.astype(int), "draws": draws.astype(int), "expected": expected}
    columns |= {"relative": relative, "unroll": unroll}
    rows = maze_states.table(states, run.config["seeds"])
    return rows.assign(**{name: values.ravel() for name, values in columns.items()})


def replayed(run: Run) -> pd.DataFrame:
    """Which states three kinds of replay replay from one buffer (thesis, figure 1).

    There is a row for each seed and state. Besides the columns of `maze_states.table`, the share of
    replayed items with this state: `share_uniform`, of the whole buffer; `share_on_policy`, of its
    newest tenth; `share_decision`, of the items at decision points. Each sums to 1 over the states
    of a seed, or is NaN where nothing is left to replay.
    """
    states, items = checkpoint.maze(run).states, checkpoint.items(run)
    number = numbers(run, states, items, "obs")
    newest = max(1, round(ON_POLICY * len(items.stored_at)))
    recent = items.stored_at > items.stored_at.max() - newest
    kinds = {
        "share_uniform": np.ones(number.shape),
        "share_on_policy": np.broadcast_to(recent, number.shape),
        "share_decision": states.decision[number],
    }
    rows = maze_states.table(states, run.config["seeds"])
    for name, kept in kinds.items():
        count = _sum_by_state(number, kept, len(states))
        with np.errstate(invalid="ignore"):
            rows[name] = (count / count.sum(axis=1, keepdims=True)).ravel()
    return rows


def unrolls(run: Run) -> pd.DataFrame:
    """Where transitions bootstrap to (thesis, figure 3): the buffer's trajectories under two rules.

    `rule` is "one_step", or "threshold", the oracle's, which goes on until a decision point, an
    episode's end, the newest item or the run's h. There is a row for each seed, rule, state,
    `target` (the state that is bootstrapped to, with `target_column` and `target_row`) and `n` (the
    steps until there); `items` counts the transitions that do so. A state that no transition leaves
    has one row, with 0 items, the rule "none" and the target -1.

    Raises ConfigError where the run has no h.
    """
    states, items = checkpoint.maze(run).states, checkpoint.items(run)
    h = run.config["hyper"].get("h")
    if h is None:
        raise ConfigError(
            f"run folder {run.folder}: {run.sampler} unrolls nothing; "
            "allowed here: a run with a hyper.h"
        )
    number, following = (numbers(run, states, items, name) for name in ("obs", "next_obs"))
    oracle = torch.from_numpy(states.decision[following].astype(np.float32))  # (L, S) p(s')
    n_threshold, last_threshold = _unrolled(items, oracle, int(h))
    here = np.broadcast_to(np.arange(number.shape[1]), number.shape)
    rules = {
        "one_step": (np.ones_like(last_threshold), here),
        "threshold": (n_threshold, last_threshold),
    }
    seeds = np.broadcast_to(np.array(run.config["seeds"])[:, None], number.shape)
    parts = []
    for rule, (n, last) in rules.items():
        target = np.take_along_axis(following, last, axis=1)
        keys = {"seed": seeds, "state": number, "target": target, "n": n}
        items_of = pd.DataFrame({name: values.ravel() for name, values in keys.items()})
        counted = items_of.value_counts(sort=False).rename("items").reset_index()
        parts.append(counted.assign(rule=rule))
    counts = pd.concat(parts, ignore_index=True)
    row, column = np.divmod(states.cell, states.layout.columns)
    counts = counts.assign(target_column=column[counts["target"]], target_row=row[counts["target"]])
    rows = maze_states.table(states, run.config["seeds"])
    rows = rows.merge(counts, on=["seed", "state"], how="left")
    never_left = {"target": -1, "target_column": -1, "target_row": -1, "n": 0, "items": 0}
    rows = rows.fillna({"rule": "none", **never_left})
    return rows.astype(dict.fromkeys(never_left, int))


def numbers(run: Run, states: MazeStates, items: Items, name: str) -> np.ndarray:
    """The states (L, S) that the items' `obs` or `next_obs` show."""
    number = states.of_observations(items.read(name))
    if (number < 0).any():
        raise ConfigError(
            f"run folder {run.folder}: its buffer holds states that are not in its maze's layout; "
            "allowed: the layout that it was trained on"
        )
    return number


def _unrolled(items: Items, p_next: Tensor, h: int) -> tuple[np.ndarray, np.ndarray]:
    """For each item by the threshold rule: steps n (L, S), and the last item's index (L, S)."""

    def unroll(rows: Tensor, p_next: Tensor) -> tuple[Tensor, Tensor]:
        index = torch.arange(len(rows))
        window = read_window(rows, items.layout, index, h, torch.tensor(items.newest))
        go_on = p_next[window.at[:-1]] < ORACLE_THRESHOLD  # (H-1, S)
        n = bootstrap.unroll_lengths(go_on, window.last, torch.tensor(h))
        return n, window.at.gather(0, n[None] - 1)[0]

    n, last = batched(unroll)(items.rows, p_next)
    return n.numpy(), last.numpy()


def _sum_by_state(number: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Sums (L, n) of values (L, S) over the items of each of n states."""
    lane = np.arange(len(number))[:, None]
    sums = np.bincount(
        (lane * count + number).ravel(), np.asarray(values, float).ravel(), len(number) * count
    )
    return sums.reshape(len(number), count)
