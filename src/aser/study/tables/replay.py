"""What was replayed, from a run's own buffer: how often, over how many steps, and to which state it bootstraps."""

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
from aser.study.tables import checkpoint as probes_run
from aser.study.tables import maze_states as probes_states
from aser.study.tables.checkpoint import Items

ON_POLICY = 0.1  # the share of the buffer, the newest, that counts as on-policy
THRESHOLD = 0.5  # of the oracle, which is 0 or 1


def replay(run: Run) -> pd.DataFrame:
    """How often each maze state was replayed and how far unrolled (thesis, figures 6 and 7), per seed and state.

    Besides the columns of `probes_states.table`: `items`, transitions from this state in the buffer at the end;
    `draws` of them; `expected`, their draws under uniform replay on average; `relative` = draws / expected, NaN where
    there is no item; `unroll`, the mean steps to the bootstrap target over those draws, NaN without any. Draws of items
    that the ring has overwritten are forgotten, on both sides of the ratio.
    """
    states, items = probes_run.maze(run).states, probes_run.items(run)
    number = numbers(run, states, items, "obs")
    table = probes_states.table(states, run.config["seeds"])
    ones = np.ones(number.shape)
    count = _sum_by_state(number, ones, len(states))
    draws = _sum_by_state(number, items.draws, len(states))
    expected = _sum_by_state(number, ones * items.expected, len(states))
    unrolled = _sum_by_state(number, items.unrolled, len(states))
    with np.errstate(invalid="ignore"):
        relative, unroll = draws / expected, unrolled / draws
    columns = {"items": count.astype(int), "draws": draws.astype(int), "expected": expected}
    columns |= {"relative": relative, "unroll": unroll}
    return table.assign(**{name: values.ravel() for name, values in columns.items()})


def replayed(run: Run) -> pd.DataFrame:
    """Which states three kinds of replay replay from one buffer (thesis, figure 1), per seed and state.

    Besides the columns of `probes_states.table`, the share of replayed items with this state: `share_uniform`, over the
    whole buffer; `share_on_policy`, over its newest tenth; `share_decision`, over the items at decision points. Each
    sums to 1 over the states of a seed, or is NaN where nothing is left to replay.
    """
    states, items = probes_run.maze(run).states, probes_run.items(run)
    number = numbers(run, states, items, "obs")
    recent = items.stored_at > items.stored_at.max() - max(
        1, round(ON_POLICY * len(items.stored_at))
    )
    kinds = {
        "share_uniform": np.ones(number.shape),
        "share_on_policy": np.broadcast_to(recent, number.shape),
        "share_decision": states.decision[number],
    }
    table = probes_states.table(states, run.config["seeds"])
    for name, replayed in kinds.items():
        count = _sum_by_state(number, replayed, len(states))
        with np.errstate(invalid="ignore"):
            table[name] = (count / count.sum(axis=1, keepdims=True)).ravel()
    return table


def unrolls(run: Run) -> pd.DataFrame:
    """Where transitions bootstrap to (thesis, figure 3): the buffer's own trajectories under two rules.

    `rule` is one_step, or threshold: the oracle's, which goes on until a decision point, an episode's end, the newest
    item or the run's h. One row per seed, rule, state, `target` (the state that is bootstrapped to, with
    `target_column`, `target_row`) and `n` (the steps until there); `items` counts the transitions that do so. A state
    that no transition leaves has one row, with 0 items, the rule "none" and the target -1.
    """
    states, items = probes_run.maze(run).states, probes_run.items(run)
    h = run.config["hyper"].get("h")
    if h is None:
        raise ConfigError(
            f"run folder {run.folder}: {run.sampler} unrolls nothing; allowed here: a run with a hyper.h"
        )
    number, following = (numbers(run, states, items, name) for name in ("obs", "next_obs"))
    oracle = torch.from_numpy(states.decision[following].astype(np.float32))  # (L, S) p(s')
    n_threshold, final = _unrolled(items, oracle, int(h))
    here = np.broadcast_to(np.arange(number.shape[1]), number.shape)
    seeds = np.array(run.config["seeds"])
    parts = []
    for rule, n, last in (
        ("one_step", np.ones_like(final), here),
        ("threshold", n_threshold, final),
    ):
        target = np.take_along_axis(following, last, axis=1)
        keys = {
            "seed": np.broadcast_to(seeds[:, None], number.shape),
            "state": number,
            "target": target,
            "n": n,
        }
        counted = pd.DataFrame(
            {name: values.ravel() for name, values in keys.items()}
        ).value_counts(sort=False)
        parts.append(counted.rename("items").reset_index().assign(rule=rule))
    row, column = np.divmod(states.cell, states.layout.columns)
    found = pd.concat(parts, ignore_index=True)
    found = found.assign(target_column=column[found["target"]], target_row=row[found["target"]])
    whole = probes_states.table(states, run.config["seeds"]).merge(
        found, on=["seed", "state"], how="left"
    )
    never_left = {
        "rule": "none",
        "target": -1,
        "target_column": -1,
        "target_row": -1,
        "n": 0,
        "items": 0,
    }
    return whole.fillna(never_left).astype({name: int for name in list(never_left)[1:]})


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
    """Steps n (L, S) of every item under the threshold rule, and the index (L, S) of the item that holds s_n."""

    def unroll(rows: Tensor, p_next: Tensor) -> tuple[Tensor, Tensor]:
        index = torch.arange(len(rows))
        window = read_window(rows, items.layout, index, h, torch.tensor(items.newest))
        go_on = p_next[window.at[:-1]] < THRESHOLD  # (H-1, S)
        n = bootstrap.unroll_lengths(go_on, window.last, torch.tensor(h))
        return n, window.at.gather(0, n[None] - 1)[0]

    n, final = batched(unroll)(items.rows, p_next)
    return n.numpy(), final.numpy()


def _sum_by_state(number: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Sums (L, n) of values (L, S) over the items of each of n states."""
    lane = np.arange(len(number))[:, None]
    sums = np.bincount(
        (lane * count + number).ravel(), np.asarray(values, float).ravel(), len(number) * count
    )
    return sums.reshape(len(number), count)
