"""The samplers in Stable Baselines3 beside those of this project: the mean return over training.

    python benchmarks/sb3.py [SEEDS]

Both programs train in the large maze and in Pendulum with equal hyper-parameters and networks of 24
neurons, and evaluate the greedy policy every 500 of 5,000 steps. A finished run of a seed is a row
of results/benchmarks/sb3.csv and is not trained again. At the end, the table of docs/sb3.md goes to
the screen. It needs `pip install -e '.[sb3]'`.
"""

from __future__ import annotations

import csv
import sys
import tempfile
from pathlib import Path

import gymnasium
import numpy as np
import pandas as pd
import torch
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor

import aser.envs  # registers the maze
import train
from aser.integrations.sb3 import SAC
from aser.integrations.sb3.samplers import DEFAULTS
from aser.provenance import code_digest
from aser.settings.config import Config
from aser.study.report import markdown
from aser.study.statistics import comparisons

TABLE = Path(__file__).resolve().parent.parent / "results" / "benchmarks" / "sb3.csv"
COLUMNS = ["env", "sampler", "program", "seed", "area", "code"]
STEPS, EVERY = 5000, 500
ENVS = {
    "maze": ["env=maze", "hyper=thesis", "hyper.from=aser"],
    "pendulum": ["env=pendulum", "hyper=sb3", "hyper.lr=0.001"],
}
SAMPLERS = ["uniform", "aser", "outcome_spread"]
OURS, THEIRS = "this project", "Stable Baselines3"


def main() -> None:
    seeds = range(int(sys.argv[1]) if len(sys.argv) > 1 else 8)
    torch.set_num_threads(1)
    for env, words in ENVS.items():
        for sampler in SAMPLERS:
            wanted = [*words, f"sampler={sampler}", f"steps={STEPS}", f"eval.every={EVERY}"]
            if missing := [seed for seed in seeds if not done(env, sampler, OURS, seed)]:
                areas = ours(wanted, missing)
                write([[env, sampler, OURS, seed, areas[seed]] for seed in missing])
            for seed in seeds:
                if not done(env, sampler, THEIRS, seed):
                    area = theirs(train.settings(wanted), seed)
                    write([[env, sampler, THEIRS, seed, area]])
    print("\n".join(shown(pd.read_csv(TABLE))))


def ours(words: list[str], seeds: list[int]) -> dict[int, float]:
    """The mean return over training of each seed, in this project."""
    with tempfile.TemporaryDirectory() as folder:
        run = aser.train(*words, seeds=seeds, run_dir=f"{folder}/run")
        return run.returns.groupby("seed")["return"].mean().to_dict()


def theirs(config: Config, seed: int) -> float:
    """The mean return over training of one seed, in Stable Baselines3."""
    hyper = config.hyper.values
    names = DEFAULTS[config.sampler]
    model = SAC(
        "MlpPolicy",
        gymnasium.make(config.env.id, **config.env.kwargs),
        sampler=config.sampler,
        sampler_kwargs={name: hyper[name] for name in names if name in hyper},
        learning_rate=hyper["lr"],
        gamma=hyper["gamma"],
        tau=hyper["tau"],
        batch_size=config.batch,
        buffer_size=config.buffer,
        learning_starts=config.learning_starts,
        policy_kwargs={"net_arch": list(config.network.hidden)},
        seed=seed,
        device="cpu",
    )
    with tempfile.TemporaryDirectory() as folder:  # without one the callback keeps no returns
        looking = EvalCallback(
            Monitor(gymnasium.make(config.env.id, **config.env.kwargs)),
            n_eval_episodes=config.eval_episodes,
            eval_freq=EVERY,
            log_path=folder,
            verbose=0,
        )
        model.learn(STEPS, callback=looking)
    returns = np.array(looking.evaluations_results)  # (evaluations, episodes)
    assert len(returns) == STEPS // EVERY
    return float(returns.mean())


def done(env: str, sampler: str, program: str, seed: int) -> bool:
    if not TABLE.exists():
        return False
    rows = pd.read_csv(TABLE)[COLUMNS[:4]]
    return (rows == [env, sampler, program, seed]).all(axis=1).any()


def write(rows: list[list]) -> None:
    new = not TABLE.exists()
    with TABLE.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if new:
            writer.writerow(COLUMNS)
        for *place, area in rows:
            writer.writerow([*place, f"{area:.6g}", code_digest()])


def shown(rows: pd.DataFrame) -> list[str]:
    """A line for each environment and sampler: both mean returns, and theirs minus ours.

    Each program is resampled by itself: a seed has other random numbers in the other program.
    """
    lines = []
    for (env, sampler), some in rows.groupby(["env", "sampler"], sort=False):
        both = some.pivot(index="seed", columns="program", values="area").dropna()
        one, other = both[THEIRS].to_numpy(float), both[OURS].to_numpy(float)
        gain = comparisons.beside(one, other, paired=False)["difference"]
        means = [markdown.estimate(areas, np.mean) for areas in (one, other)]
        lines.append([env, sampler, str(len(both)), *means, markdown.interval(*gain)])
    head = ["environment", "sampler", "seeds", THEIRS, OURS, "difference"]
    return markdown.table(head, lines, words=2)


if __name__ == "__main__":
    main()
