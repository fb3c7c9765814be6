"""Is PER's gain seen where it must be? The blind cliffwalk of Schaul et al. (2016), section 3.1.

    python benchmarks/cliffwalk.py

A chain of n states. One action goes on, the other one ends the episode; only the last state's right
action pays, with 1. The memory holds every transition of all 2^n sequences of n actions, so the one
that pays is there once among 2^(n+1) - 2. Q-learning in a table replays one transition at a time,
drawn by this project's priorities, until the mean squared error of the table is below 0.001. All
32 trials are in results/benchmarks/cliffwalk.csv, and cliffwalk.png shows their median. It takes
two minutes.

Step size 1/4, gamma = 1 - 1/n, and a table that begins with normal numbers of deviation 0.1 are
what we remember of the paper's appendix; the median is over more trials than there.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import matplotlib
import pandas as pd
import torch
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from aser.replay import priorities
from aser.study.plots.axes import figure, legend_beside, save
from aser.study.plots.style import LOOK, style
from aser.study.tables import returns

FOLDER = Path(__file__).resolve().parent.parent / "results" / "benchmarks"
STATES, TRIALS, SOLVED, MOST = range(2, 13), 32, 1e-3, 1_000_000
STEP_SIZE, DEVIATION = 0.25, 0.1
SAMPLERS = {
    "uniform": "uniform",
    "per": "PER",
    "oracle": "oracle: what helps most",
}
HYPER = {"alpha": torch.tensor(0.6), "epsilon": torch.tensor(0.01)}  # as hyper=sb3
CHUNK = 1000  # updates between two looks at whether all trials are solved


class Chain(NamedTuple):
    """The memory: transition i goes from state[i] by right[i], 1 or 0."""

    state: Tensor  # (N,)
    right: Tensor  # (N,)
    n: int

    @property
    def gamma(self) -> float:
        return 1.0 - 1.0 / self.n

    def values(self) -> Tensor:
        """The true action values (n, 2), of the wrong and of the right action."""
        right = self.gamma ** torch.arange(self.n - 1, -1, -1, dtype=torch.float64)
        return torch.stack([torch.zeros_like(right), right], dim=1)


def chain(n: int) -> Chain:
    """All transitions of all sequences of n actions, each followed until its episode ends."""
    pairs = []
    for number in range(2**n):
        for state in range(n):
            right = number >> state & 1
            pairs.append((state, right))
            if not right:
                break
    state, right = torch.tensor(pairs).T
    return Chain(state, right, n)


def td_errors(q: Tensor, state: Tensor, right: Tensor, gamma: float) -> Tensor:
    """The TD errors (T, K) of K transitions in each trial's table q (T, n, 2)."""
    n = q.shape[1]
    last = state == n - 1
    trial = torch.arange(len(q))[:, None]
    after = q.amax(2)[trial, (state + 1).clamp(max=n - 1)]  # (T, K)
    target = torch.where(last, 1.0, gamma * after) * right  # a wrong action ends with 0
    return target - q[trial, state, right]


def updates(sampler: str, n: int, trials: int = TRIALS, most: int = MOST) -> list[int]:
    """How many updates each trial needs until it is solved; `most` where it is not."""
    generator = torch.Generator().manual_seed(n)
    memory = chain(n)
    q = torch.randn(trials, n, 2, generator=generator, dtype=torch.float64) * DEVIATION
    needed = torch.full((trials,), most)
    drawn_by = priorities.make(trials, len(memory.state))
    items = torch.arange(len(memory.state)).expand(trials, -1)
    drawn_by.write(items, torch.ones_like(items, dtype=torch.float64))
    lane, values = torch.arange(trials)[:, None], memory.values()
    every = torch.arange(2 * n).expand(trials, -1)  # the 2 n transitions that differ
    for step in range(most):
        if sampler == "oracle":
            one = best(q, every, memory.gamma, values)  # (T, 1)
            state, right = one // 2, one % 2
        else:
            u = torch.rand(trials, 1, generator=generator, dtype=torch.float64)
            index = (u * len(memory.state)).long() if sampler == "uniform" else drawn_by.draw(u)[0]
            state, right = memory.state[index], memory.right[index]
        error = td_errors(q, state, right, memory.gamma)
        q[lane, state, right] += STEP_SIZE * error
        if sampler == "per":
            drawn_by.write(index, priorities.proportional(error.abs(), HYPER))
        solved = ((q - values) ** 2).mean((1, 2)) < SOLVED
        needed = torch.where(solved & (needed == most), step + 1, needed)
        if step % CHUNK == 0 and (needed < most).all():
            break
    return needed.tolist()


def best(q: Tensor, every: Tensor, gamma: float, values: Tensor) -> Tensor:
    """Of each trial the transition (T, 1) whose replay makes the table's error smallest."""
    state, right = every // 2, every % 2
    error = td_errors(q, state, right, gamma)
    distance = q.flatten(1) - values.flatten()  # (T, 2n), in the order of `every`
    gain = distance**2 - (distance + STEP_SIZE * error) ** 2
    return gain.argmax(1, keepdim=True)


@matplotlib.rc_context(LOOK)
def draw(rows: pd.DataFrame, path: Path) -> Path:
    page, (ax,) = figure(columns=1, width=4.6)
    medians = rows.groupby(["sampler", "states"], sort=False)["updates"].median()
    for sampler, name in SAMPLERS.items():
        line = medians[sampler]
        ax.plot(line.index, line, color=style(sampler).colour, marker=".", label=name)
    ax.set_yscale("log")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("states of the chain")
    ax.set_ylabel("updates until solved, median")
    legend_beside(ax)
    return save(page, path)


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    for n in STATES:
        for sampler in SAMPLERS:
            needed = updates(sampler, n)
            rows += [(n, sampler, trial, count) for trial, count in enumerate(needed)]
            print(f"{n} states, {sampler}: {pd.Series(needed).median():,.0f} updates", flush=True)
    table = pd.DataFrame(rows, columns=["states", "sampler", "trial", "updates"])
    returns.write(FOLDER / "cliffwalk.csv", table)
    print(f"picture in {draw(table, FOLDER / 'cliffwalk.png')}")


if __name__ == "__main__":
    main()
