"""What `make reproduce` does: train the runs that figures lack, and write their tables.

Tables of the committed figures are in results/tables, those of one's own figures and reproductions
in results/own/tables.

Finished runs lie in results/runs/DIGEST/NAME, under the digest of the code that trained them. A run
of other code counts where `make same` has found that code to be the same (results/same_code.csv).
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
from filelock import FileLock
from joblib import Parallel, cpu_count, delayed
from tqdm import tqdm

from aser import build, run_folder
from aser.envs import SHIPPED
from aser.files import replacing
from aser.provenance import code_digest, same_code
from aser.run import run
from aser.script import end_with
from aser.settings import compose
from aser.settings.config import Config, parse
from aser.settle import settled
from aser.study import figures, runs
from aser.study.runs import Run
from aser.study.specs import Spec
from aser.study.tables import returns, scores
from aser.training.evaluation import random_return

RANDOM_EPISODES = 1000  # for the return of a random policy
RANDOM_EPISODES_ELSEWHERE = 100  # in other libraries' environments, where each needs a copy
BAR = "{desc} {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"


@dataclass(frozen=True)
class Wanted:
    """A run that a figure shows."""

    place: dict[str, Any]  # its panel, maze and label
    settings: list[str]  # as on train's command line
    config: Config  # with the folder of the run

    @property
    def folder(self) -> Path:
        return Path(str(self.config.run_dir))


def reproduce(specs: Sequence[Spec], conf: Path, results: Path) -> list[str]:
    """Train what `specs` lack and write their tables. They must have tables of their own.

    `conf` and `results` are the folders of the settings and of results. It may be stopped and
    started again at any time. Returns the names of all figures whose tables have changed: others
    are among them where the best known return, to which scores are relative, has risen.
    """
    wanted = [wanted_runs(spec, conf, results) for spec in specs]
    by_folder = {one.folder: one.config for ones in wanted for one in ones}
    train([config for path, config in by_folder.items() if not finished(path)], conf, results)
    loaded = {path: runs.load(path) for path in by_folder}
    rewritten = []
    for home in dict.fromkeys(spec.home for spec in specs):
        here = [ones for spec, ones in zip(specs, wanted, strict=True) if spec.home == home]
        paths = dict.fromkeys(one.folder for ones in here for one in ones)
        known = [(by_folder[path], loaded[path]) for path in paths]
        with tabulating(results / home / "tables"):
            rewritten += _references(known, results, home)
    for spec, ones in zip(specs, wanted, strict=True):
        found = [loaded[one.folder] for one in ones]
        places = [one.place for one in ones]
        with tabulating(results / spec.home / "tables"):
            figures.tabulate(spec, list(zip(places, found, strict=True)), results)
            _list_runs(spec, ones, found, results / spec.home / "tables")
    return list(dict.fromkeys([*rewritten, *(spec.name for spec in specs)]))


@contextlib.contextmanager
def tabulating(tables: Path) -> Iterator[None]:
    """Hold the tables that figures share: two commands at once would lose rows of each other."""
    tables.mkdir(parents=True, exist_ok=True)
    with FileLock(tables / ".lock"):
        yield


def wanted_runs(spec: Spec, conf: Path, results: Path) -> list[Wanted]:
    """The runs of a figure. Runs that figures share have one folder."""
    digest = code_digest()
    digests = [digest, *sorted(same_code(digest, results / "same_code.csv") - {digest})]
    wanted = []
    for place, settings in spec.runs():
        config = settled(parse(compose.compose(settings, conf), conf))
        paths = [run_folder.place(config, results / "runs" / code) for code in digests]
        path = next(filter(finished, paths), paths[0])
        wanted.append(Wanted(place, settings, replace(config, run_dir=str(path), resume=True)))
    return wanted


def finished(folder: Path) -> bool:
    return (folder / "summary.json").exists()


def train(missing: Sequence[Config], conf: Path, results: Path) -> None:
    """Train runs side by side, the longest first, with one progress line for all."""
    if not missing:
        return
    # The longest first, so that no core has to finish a long one alone at the end.
    ordered = sorted(missing, key=seconds, reverse=True)
    jobs = (delayed(_train_quietly)(config, conf, results, os.getpid()) for config in ordered)
    workers = min(cpu_count(), len(ordered))
    done = Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=1)(jobs)
    with tqdm(total=sum(map(seconds, ordered)), bar_format=BAR) as bar:
        bar.set_description(f"0 of {len(ordered)} runs")
        for number, spent in enumerate(done, 1):
            bar.update(spent)
            bar.set_description(f"{number} of {len(ordered)} runs")


def _train_quietly(config: Config, conf: Path, results: Path, parent: int) -> float:
    """One run in a worker of `parent`, with its messages in FOLDER.log; its `seconds`."""
    end_with(parent)
    log = Path(f"{config.run_dir}.log")
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
        run(config, conf, results)
    return seconds(config)


def seconds(config: Config) -> float:
    """About how long a run takes on one core: for the order and the progress line only."""
    criteria = {config.criterion.name, config.bootstrap.criterion.name}
    if config.bootstrap.name == "one_step":
        factor = 1.2
    elif "q_range" in criteria:
        factor = 6.9
    elif "shuffled" in criteria:
        factor = 3.6
    else:
        factor = 2.4 if config.bootstrap.name.startswith("threshold") else 1.5
    if max(config.network.hidden) > 64:
        factor *= 60.0
    return 4.0 + len(config.seeds) * config.steps / 18000.0 * factor


def _references(known: Sequence[tuple[Config, Run]], results: Path, home: str) -> list[str]:
    """Write references.csv: the return of a random policy in each environment, best and worst.

    `home` is that of the figures whose runs are known. A table outside of the committed ones begins
    with their returns. Returns the names of figures whose scores had to be rewritten.
    """
    tables, path = results / home / "tables", results / home / "tables" / "references.csv"
    before = returns.references(tables) if path.exists() else pd.DataFrame(columns=["best"])
    rows = before.to_dict("index")
    if (results / "tables" / "references.csv").exists():
        used = {trained.environment for _, trained in known} - set(rows)
        committed = returns.references(results / "tables").to_dict("index")
        rows |= {env: row for env, row in committed.items() if env in used}
    for config, trained in known:
        if trained.environment not in rows:
            rows[trained.environment] = reference(config)
    table = pd.DataFrame.from_dict(rows, orient="index").rename_axis("env")
    table = scores.best_known(table, [trained for _, trained in known])
    with replacing(path) as draft:  # the last: a kill before it leaves the scores to the next time
        returns.write(draft, table.reset_index())
        return scores.rewrite(before, returns.references(draft), tables)


def reference(config: Config) -> dict[str, Any]:
    """An environment's row of references.csv: the return of a random policy, best and worst.

    The best one is there only if the environment states it.
    """
    shipped = config.env.id in SHIPPED
    envs: Any = build.make_envs(config, RANDOM_EPISODES if shipped else RANDOM_EPISODES_ELSEWHERE)
    best = getattr(envs, "best_return", None)
    row = {"random": random_return(envs), "best": best, "worst": envs.worst_return}
    envs.close()
    solvable = best is not None
    return {**row, "solvable": solvable, "source": "exact" if solvable else ""}


def _list_runs(spec: Spec, wanted: Sequence[Wanted], loaded: Sequence[Run], tables: Path) -> None:
    """Write into figure_runs.csv of which runs, of which code, the table of a figure is made."""
    path = tables / "figure_runs.csv"
    text = dict.fromkeys(("panel", "label", "code", "commit"), str)
    listed = pd.read_csv(path, dtype=text) if path.exists() else pd.DataFrame({"figure": []})
    rows = pd.DataFrame(
        {
            "figure": spec.name,
            **one.place,
            "overrides": " ".join(one.settings),
            "folder": trained.folder.name,
            "commit": trained.summary["commit"],
            "code": trained.summary["code"],
            "diverged": len(trained.summary["diverged"]),
            "seconds": round(trained.summary["wall_seconds"], 1),
        }
        for one, trained in zip(wanted, loaded, strict=True)
    )
    others = listed[listed["figure"] != spec.name]
    returns.write(path, pd.concat([others, rows]).sort_values("figure", kind="stable"))
