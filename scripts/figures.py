"""Figures, tables and the ledger of claims: python scripts/figures.py draw|reproduce|claims [FIGURE ...]

  reproduce   trains what is missing, side by side on the cores, and writes results/tables/ and results/figures/;
              may be stopped and started again at any time
  draw        draws from the committed tables, training nothing
  claims      results/claims.md and the tables in docs/*.md from the committed tables

A figure is a file of conf/figure/; without any, all are meant. `reproduce` then leaves out those that take long, fig09,
figE1, mazes, separation, elsewhere, cross, halves and capacity: name them.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "src"))

import pandas as pd  # noqa: E402

import train  # noqa: E402
from aser.errors import ConfigError  # noqa: E402
from aser.settings.config import Config  # noqa: E402
from aser.study import figures as pages  # noqa: E402
from aser.study import specs  # noqa: E402
from aser.study.report import hyper as hyper_tables  # noqa: E402
from aser.study.specs import Spec  # noqa: E402
from aser.study.tables import returns as records  # noqa: E402

SPECS, TABLES, FIGURES = (
    ROOT / "conf" / "figure",
    ROOT / "results" / "tables",
    ROOT / "results" / "figures",
)
LONG = ("fig09", "figE1", "mazes", "separation", "elsewhere", "cross", "halves", "capacity")
Place = dict[str, Any]


def main(arguments: Sequence[str]) -> int:
    words = list(arguments)
    if not words or set(words) & {"-h", "--help"}:
        print(__doc__)
        return 0
    try:
        commands = {"draw": draw, "reproduce": reproduce, "claims": claims}
        if words[0] not in commands:
            raise ConfigError(
                f"{words[0]}: there is no such command; these are: {', '.join(commands)}"
            )
        commands[words[0]](words[1:])
    except ConfigError as error:
        print(f"figures: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("figures: interrupted; the same command goes on", file=sys.stderr)
        return 130
    return 0


def draw(names: Sequence[str]) -> None:
    chosen = [specs.load(SPECS, name) for name in names or specs.names(SPECS)]
    for spec in chosen:
        if names or (TABLES / f"{spec.table}.csv").exists():
            pages.draw(spec, TABLES, FIGURES)
    if not names and all((TABLES / f"{name}.csv").exists() for name in ("mazes", "separation")):
        pages.criterion(TABLES, FIGURES)
    pages.captions([specs.load(SPECS, name) for name in specs.names(SPECS)], TABLES, FIGURES)
    hyper_tables.write(train.CONF, TABLES)
    print(f"pictures in {FIGURES.relative_to(ROOT)}")


def claims(names: Sequence[str]) -> None:
    from aser.study.report import appendix_page, criterion_page, ledger

    if names:
        raise ConfigError(
            f"claims {' '.join(names)}: takes no figures; all claims are decided together"
        )
    rules = ROOT / "conf" / "claims.yaml"
    ledger.write(rules, TABLES, ROOT / "results" / "claims.md")
    criterion_page.write(ROOT / "docs" / "criterion.md", rules, TABLES)
    appendix_page.write(ROOT / "docs" / "appendices.md", TABLES)
    print(
        "the ledger is in results/claims.md, the tables in docs/criterion.md and docs/appendices.md"
    )


def reproduce(names: Sequence[str]) -> None:
    from aser.provenance import code_digest

    chosen = [
        specs.load(SPECS, name) for name in names or sorted(set(specs.names(SPECS)) - set(LONG))
    ]
    folder = ROOT / "results" / "runs" / code_digest()
    runs = {spec.name: list(configs(spec, folder)) for spec in chosen}
    everything = {config.run_dir: config for own in runs.values() for _, _, config in own}
    train_missing([config for config in everything.values() if not finished(config)])
    for name in references(everything.values()):
        pages.draw(specs.load(SPECS, name), TABLES, FIGURES)
    for table in dict.fromkeys(spec.table for spec in chosen):
        tabulate(
            specs.load(SPECS, table),
            next(runs[spec.name] for spec in chosen if spec.table == table),
        )
    for spec in chosen:
        pages.draw(spec, TABLES, FIGURES)
        print(f"{spec.name}: drawn")
    pages.captions([specs.load(SPECS, name) for name in specs.names(SPECS)], TABLES, FIGURES)


def configs(spec: Spec, folder: Path) -> Iterable[tuple[Place, list[str], Config]]:
    """Each run of a figure: its place there, its overrides, its settings. Runs that figures share have one folder."""
    from dataclasses import replace

    from aser.run_folder import name

    for place, overrides in spec.runs():
        config = train.settings(overrides)
        yield place, overrides, replace(config, run_dir=str(folder / name(config)), resume=True)


def finished(config: Config) -> bool:
    return (Path(str(config.run_dir)) / "summary.json").exists()


def train_missing(missing: Sequence[Config]) -> None:
    """Train side by side, the longest first; one line says how far the whole is."""
    from joblib import Parallel, cpu_count, delayed
    from tqdm import tqdm

    # A frozen agent's run waits while another process trains the agents; those go first, and so do long runs.
    ordered = sorted(missing, key=lambda config: -cost(config))
    workers = max(1, min(cpu_count(), len(ordered)))
    look = "{desc} {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"
    bar = tqdm(total=sum(map(cost, ordered)), bar_format=look)
    with bar:
        bar.set_description(f"0 of {len(ordered)} runs")
        jobs = (delayed(train_quietly)(config) for config in ordered)
        done = (
            Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=1)(jobs)
            if ordered
            else ()
        )
        for number, own in enumerate(done, 1):
            bar.update(own)
            bar.set_description(f"{number} of {len(ordered)} runs")


def train_quietly(config: Config) -> float:
    """One run in a process of its own, its words in FOLDER.log."""
    from aser.run import run

    log = Path(f"{config.run_dir}.log")
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
        run(config, train.CONF)
    return cost(config)


def cost(config: Config) -> float:
    """About how long a run takes, in seconds of one core: for the order and the progress line only."""
    rule, criterion = (
        config.bootstrap.name,
        {config.criterion.name, config.bootstrap.criterion.name},
    )
    dear = (
        6.9
        if "q_range" in criterion
        else 3.6
        if "shuffled" in criterion
        else 2.4
        if rule == "threshold"
        else 1.5
    )
    wide = 60.0 if max(config.network.hidden) > 64 else 1.0
    return (
        4.0
        + len(config.seeds) * config.steps / 18000.0 * (dear if rule != "one_step" else 1.2) * wide
    )


def references(known: Iterable[Config]) -> list[str]:
    """results/tables/references.csv: a random policy's return in each environment, the best and the worst one. Figures
    of before whose best known has risen are scored anew; their names."""
    from aser.build import make_envs
    from aser.study.runs import load
    from aser.study.tables import makers as probes_tables
    from aser.training.evaluation import random_return

    path = TABLES / "references.csv"
    before = pd.read_csv(path, index_col="env") if path.exists() else pd.DataFrame(columns=["best"])
    rows = before.to_dict("index")
    runs = [load(str(config.run_dir)) for config in known]
    for config, run in zip(known, runs, strict=True):
        if run.environment not in rows:
            envs = make_envs(config, 1000)
            best = getattr(envs, "best_return", None)
            rows[run.environment] = {
                "random": random_return(envs),
                "best": best,
                "worst": envs.worst_return,
                "solvable": best is not None,
            }
    table = probes_tables.best_known(pd.DataFrame.from_dict(rows, "index").rename_axis("env"), runs)
    records.write(path, table.reset_index())
    return probes_tables.score_again(before, pd.read_csv(path, index_col="env"), TABLES)


def tabulate(spec: Spec, runs: Sequence[tuple[Place, list[str], Config]]) -> None:
    """A figure's tables: what it shows, and where that comes from."""
    from aser.study.runs import load
    from aser.study.tables import makers as probes_tables

    loaded = [(place, load(str(config.run_dir))) for place, _, config in runs]
    probes_tables.write(spec, loaded, TABLES)
    path = TABLES / "figure_runs.csv"
    known = (
        pd.read_csv(path, dtype={"code": str, "commit": str})
        if path.exists()
        else pd.DataFrame(columns=["figure"])
    )
    own = pd.DataFrame(
        {
            "figure": spec.name,
            **place,
            "overrides": " ".join(overrides),
            "folder": run.folder.name,
            "commit": run.summary["commit"],
            "code": run.summary["code"],
            "diverged": len(run.summary["diverged"]),
            "seconds": round(run.summary["wall_seconds"], 1),
        }
        for (place, overrides, _), (_, run) in zip(runs, loaded, strict=True)
    )
    whole = pd.concat([known[known["figure"] != spec.name], own]).sort_values(
        "figure", kind="stable"
    )
    records.write(path, whole)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    began = time.perf_counter()
    status = main(sys.argv[1:])
    if len(sys.argv) > 1 and status == 0:
        print(f"{time.perf_counter() - began:.0f} s")
    sys.exit(status)
