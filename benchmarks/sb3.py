"""The samplers in Stable Baselines3 beside those of this project: the mean return over training.

    python benchmarks/sb3.py [ENVIRONMENT [SEED ...]]

It trains what results/benchmarks/sb3.csv lacks: the runs of all environments, of one, or of some of
its seeds. Both programs have equal hyper-parameters and networks, and evaluate the greedy policy at
the same steps. A finished run of a seed is a row of the file. Where a figure has our runs, they are
read from its table. At the end, the table of docs/sb3.md goes to the screen. It needs
`pip install -e '.[sb3,mujoco]'`.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from pathlib import Path
from typing import NamedTuple

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
from aser.study.tables import returns

RESULTS = Path(__file__).resolve().parent.parent / "results"
TABLE = RESULTS / "benchmarks" / "sb3.csv"
COLUMNS = ["env", "sampler", "program", "seed", "area", "code"]
OURS, THEIRS = "this project", "Stable Baselines3"


class Setting(NamedTuple):
    """What both programs train in one environment."""

    words: list[str]  # as on train's command line
    samplers: list[str]
    seeds: int
    steps: int
    every: int  # steps from one evaluation to the next
    table: Path | None = None  # of the figure that has our runs, labelled by their samplers


SETTINGS = {
    "maze": Setting(
        ["env=maze", "hyper=thesis", "hyper.from=aser"],
        ["uniform", "aser", "outcome_spread"],
        seeds=8,
        steps=5000,
        every=500,
    ),
    "pendulum": Setting(
        ["env=pendulum", "hyper=sb3", "hyper.lr=0.001"],
        ["uniform", "aser", "outcome_spread"],
        seeds=8,
        steps=5000,
        every=500,
    ),
    "hopper": Setting(
        ["env=gym", "env.id=Hopper-v5", "hyper=sb3", "network=large"],
        ["uniform"],
        seeds=4,
        steps=100_000,
        every=5000,
        table=RESULTS / "tables" / "beyond" / "field_large_networks.csv",
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("environment", nargs="?", choices=SETTINGS)
    parser.add_argument("seed", nargs="*", type=int)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    for env in [chosen.environment] if chosen.environment else SETTINGS:
        setting = SETTINGS[env]
        seeds = chosen.seed or range(setting.seeds)
        evaluations = [f"steps={setting.steps}", f"eval.every={setting.every}"]
        for sampler in setting.samplers:
            words = [*setting.words, f"sampler={sampler}", *evaluations]
            missing = [seed for seed in seeds if not done(env, sampler, OURS, seed)]
            if missing and setting.table is None:
                areas = ours(words, missing)
                write([[env, sampler, OURS, seed, areas[seed]] for seed in missing])
            for seed in seeds:
                if not done(env, sampler, THEIRS, seed):
                    area = theirs(train.settings(words), setting, seed)
                    write([[env, sampler, THEIRS, seed, area]])
    print("\n".join(shown(pd.concat([pd.read_csv(TABLE), *of_figures()]))))


def ours(words: list[str], seeds: list[int]) -> dict[int, float]:
    """The mean return over training of each seed, in this project."""
    with tempfile.TemporaryDirectory() as folder:
        run = aser.train(*words, seeds=seeds, run_dir=f"{folder}/run")
        return run.returns.groupby("seed")["return"].mean().to_dict()


def of_figures() -> list[pd.DataFrame]:
    """Our rows of the environments whose runs are a figure's, as far as its table is there."""
    found = []
    for env, setting in SETTINGS.items():
        if setting.table is not None and setting.table.exists():
            rows = returns.read(setting.table)
            rows = rows[(rows["panel"] == env) & rows["label"].isin(setting.samplers)]
            steps = range(setting.every, setting.steps + 1, setting.every)
            areas = rows[list(steps)].mean(axis=1)
            place = {"env": env, "sampler": rows["label"], "program": OURS, "seed": rows["seed"]}
            found.append(pd.DataFrame(place | {"area": areas}))
    return found


def theirs(config: Config, setting: Setting, seed: int) -> float:
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
            eval_freq=setting.every,
            log_path=folder,
            verbose=0,
        )
        model.learn(setting.steps, callback=looking)
    found = np.array(looking.evaluations_results)  # (evaluations, episodes)
    assert len(found) == setting.steps // setting.every
    return float(found.mean())


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
        both = some.pivot(index="seed", columns="program", values="area")
        if not {OURS, THEIRS} <= set(both):
            continue  # one program's runs are still to come
        both = both.dropna()
        one, other = both[THEIRS].to_numpy(float), both[OURS].to_numpy(float)
        gain = comparisons.beside(one, other, paired=False)["difference"]
        means = [markdown.estimate(areas, np.mean) for areas in (one, other)]
        lines.append([env, f"`{sampler}`", str(len(both)), *means, markdown.interval(*gain)])
    head = ["environment", "sampler", "seeds", THEIRS, OURS, "difference"]
    return markdown.table(head, lines, words=2)


if __name__ == "__main__":
    main()
