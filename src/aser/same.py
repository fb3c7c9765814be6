"""Shows that a refactoring changed no result: small runs at two commits are compared bit for bit.

Both commits train by `train.main`, in processes of their own. Of each run, every number of
returns.csv and diagnostics.csv and every tensor and number of checkpoint.pt is compared, by name.
"""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from aser import checkpoint
from aser.errors import ConfigError

SMALL = [
    "seeds=[3,5,8]",
    "steps=137",
    "learning_starts=41",
    "batch=29",
    "eval.every=45",
    "force=true",
]
EAGER, COMPILED = ["compile=false"], ["compile=true"]
MAZE = ["env=maze", "env.layout=toy", "hyper=thesis"]
DQN = ["env=corridor", "agent=dqn", "agent.target_interval=30", "hyper=sb3"]
SAMPLERS = (
    "uniform",
    "per",
    "rank",
    "relo",
    "laber",
    "la3p",
    "reaper",
    "lap",
    "pal",
    "recent",
    "cer",
    "ere",
    "nstep",
    "nstep_geometric",
    "cvs",
    "mmddpg",
    "preferential",
    "aser",
    "aser_shuffled",
    "aser_q",
    "outcome_spread",
    "outcome_spread_shuffled",
    "outcome_model",
    "outcome_model_shuffled",
    "oracle",
    "aser_no_prioritisation",
    "aser_no_bootstrap",
    "oracle_no_prioritisation",
    "oracle_no_bootstrap",
)
VARIANTS = {
    "entropy": ["sampler=aser", "criterion=entropy"],
    "mode_prob": ["sampler=aser", "criterion=mode_prob", "criterion.squashed=false"],
    "curvature": ["sampler=aser", "criterion=curvature"],
    "visit_count": ["sampler=aser", "criterion=visit_count"],
    "successor_count": ["sampler=outcome_spread", "criterion=successor_count"],
    "q_std": ["sampler=aser", "criterion=q_std", "bootstrap.path_entropy=stored"],
    "two_criteria": [
        "sampler=aser",
        "criterion=oracle",
        "bootstrap.criterion=mode_log_prob",
        "bootstrap.window=13",
    ],
    "td_threshold": [
        "sampler=per",
        "bootstrap=threshold",
        "bootstrap.path_entropy=none",
        "hyper.from=aser",
        "hyper.beta=.4",
    ],
    "switches": [
        "sampler=aser",
        "bootstrap.batch=prioritised",
        "agent.actor_batch=uniform",
        "prioritisation.new=ever_max",
        "prioritisation.weights=true",
        "hyper.beta=.5",
    ],
    "over_batch": ["sampler=rank", "prioritisation.over=batch"],
    "td_mean": ["sampler=per", "agent.td_error=mean"],
    "cumulative": ["sampler=aser_q", "bootstrap=cumulative"],
    "retrace": ["sampler=aser", "bootstrap.correction=retrace"],
    "clipped": ["sampler=mmddpg", "bootstrap.correction=clipped"],
    "quantile": ["sampler=oracle", "bootstrap.threshold=quantile"],
    "updates": ["sampler=per", "updates=3"],
    "wrapped": ["sampler=aser", "buffer=60"],
    "large_buffer": ["sampler=per", "buffer=120000"],
    "snapshots": ["sampler=uniform", "snapshots=[90]", "network.hidden=[11,7]"],
}
RUNS: dict[str, list[str]] = {
    **{f"maze-{name}": [*MAZE, f"sampler={name}", *EAGER] for name in SAMPLERS},
    **{f"maze-{name}": [*MAZE, *words, *EAGER] for name, words in VARIANTS.items()},
    **{
        f"{env}-{name}": [f"env={env}", "hyper=thesis", f"sampler={name}", *EAGER]
        for env, name in (
            ("maze", "pretrained"),
            ("maze_sparse", "aser"),
            ("corridor", "oracle"),
            ("pendulum", "aser"),
            ("pendulum", "pretrained"),
        )
    },
    "gym-aser": [
        "env=gym",
        "env.id=MountainCarContinuous-v0",
        "network=small",
        "sampler=aser",
        "eval.every=null",
        *EAGER,
    ],
    **{
        f"dqn-{name}": [*DQN, f"sampler={name}", *EAGER]
        for name in ("uniform", "per", "relo", "laber", "aser")
    },
    "dqn-pretrained": ["env=corridor", "agent=dqn", "sampler=pretrained", *EAGER],
    "compiled-aser": [*MAZE, "sampler=aser", *COMPILED],
    "compiled-per": [*MAZE, "sampler=per", *COMPILED],
    "compiled-spread": [*MAZE, "sampler=outcome_spread", *COMPILED],
    "compiled-shuffled": ["env=pendulum", "hyper=thesis", "sampler=aser_shuffled", *COMPILED],
    "compiled-dqn": [*DQN, "sampler=aser", *COMPILED],
}

# Renamed parts of the checkpoint: {old: new}, where each is the start of the name.
RENAMED: dict[str, str] = {}
NO_RESULTS = ("seconds", "training.steady", "origin")  # the time that a run took, and its code

DRIVER = """
import contextlib, io, json, sys
import train
for name, words in json.load(sys.stdin).items():
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        status = train.main([*words, f"run_dir={sys.argv[1]}/{name}"])
    if status:
        sys.exit(f"{name}: {output.getvalue()}")
"""


def compare(revision: str, root: Path, runs: Mapping[str, Sequence[str]] = RUNS) -> list[str]:
    """Train `runs` at `revision` of the checkout `root` and with its files as they are now.

    The runs of a revision are kept in .same/COMMIT and not trained again. Returns one line for each
    difference. Raises ConfigError where git does not know the revision, or where a run fails.
    """
    before, now = folders(revision, root)
    missing = {
        name: words for name, words in runs.items() if not (before / name / "summary.json").exists()
    }
    if missing:
        with tempfile.TemporaryDirectory() as folder:
            _git(root, "worktree", "add", "--detach", folder, before.name)
            try:
                train(Path(folder), missing, before)
            finally:
                _git(root, "worktree", "remove", "--force", folder)
    train(root, runs, now)
    return [f"{name}: {line}" for name in runs for line in differences(before / name, now / name)]


def known(
    revision: str, root: Path, runs: Mapping[str, Sequence[str]] = RUNS
) -> dict[str, Sequence[str]]:
    """Those of `runs` whose samplers, criteria and rules the revision has.

    Raises ConfigError as `compare` does.
    """
    _git(root, "rev-parse", "--verify", f"{revision}^{{commit}}")
    groups = ("sampler", "criterion", "prioritisation", "bootstrap")
    folders = [f"conf/{group}/" for group in groups]
    there = set(_git(root, "ls-tree", "--name-only", revision, *folders).splitlines())

    def has(words: Sequence[str]) -> bool:
        named = [word.partition("=") for word in words]
        files = [f"conf/{key}/{value}.yaml" for key, _, value in named if key in groups]
        return all(file in there for file in files)

    return {name: words for name, words in runs.items() if has(words)}


def folders(revision: str, root: Path) -> tuple[Path, Path]:
    """The folders of the runs of `revision`, and of the files as they are now."""
    commit = _git(root, "rev-parse", "--verify", f"{revision}^{{commit}}")
    return root / ".same" / commit[:12], root / ".same" / "now"


def train(source: Path, runs: Mapping[str, Sequence[str]], out: Path) -> None:
    """Train `runs` into out/NAME with the code of the checkout `source`, on all cores."""
    out.mkdir(parents=True, exist_ok=True)
    paths = os.pathsep.join([str(source / "src"), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
    names, workers = list(runs), min(os.cpu_count() or 1, len(runs))
    processes = []
    for k in range(workers):
        share = {name: [*SMALL, *runs[name]] for name in names[k::workers]}
        process = subprocess.Popen(
            [sys.executable, "-c", DRIVER, str(out)],
            cwd=source,
            env=environment,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        assert process.stdin is not None
        process.stdin.write(json.dumps(share))
        process.stdin.close()
        processes.append(process)
    try:
        for process in processes:
            assert process.stderr is not None
            words = process.stderr.read()
            if process.wait():
                raise ConfigError(f"same: a run failed at {source}: {words.strip()[-500:]}")
    finally:
        for process in processes:
            process.kill()  # none trains on beside the next try
            process.wait()


def code_of(folder: Path, runs: Collection[str]) -> set[str]:
    """The digests of the code that trained the named runs in `folder`."""
    return {json.loads((folder / name / "summary.json").read_text())["code"] for name in runs}


def differences(before: Path, now: Path) -> Iterator[str]:
    """Yields what differs between two run folders, one line for each column or tensor.

    Columns and tensors that only the newer run has are no difference.
    """
    for file in ("returns.csv", "diagnostics.csv"):
        old, new = _columns(before / file), _columns(now / file)
        yield from (
            f"{file}: column {name} {_fault(name, new)}"
            for name in old
            if old[name] != new.get(name)
        )
    old, new = (dict(_named(checkpoint.load(folder / checkpoint.NAME))) for folder in (before, now))
    for name, value in old.items():
        start = next((start for start in RENAMED if name.startswith(start)), "")
        new_name = RENAMED.get(start, "") + name.removeprefix(start)
        equal = new_name in new and _equal(value, new[new_name])
        if not equal and not name.startswith(NO_RESULTS):
            yield f"{checkpoint.NAME}: {name} {_fault(new_name, new)}"


def _fault(name: str, new: Mapping[str, Any]) -> str:
    return "differs" if name in new else "is not there any more"


def _columns(path: Path) -> dict[str, list[str]]:
    with path.open() as file:
        rows = list(csv.reader(file))
    return {name: [row[column] for row in rows[1:]] for column, name in enumerate(rows[0])}


def _named(tree: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Every leaf of nested dictionaries and lists with its path, such as training.agent.0."""
    if isinstance(tree, dict | list):
        for key, part in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield from _named(part, f"{name}.{key}" if name else str(key))
    else:
        yield name, tree


def _equal(one: Any, other: Any) -> bool:
    if not hasattr(one, "dtype"):
        return bool(one == other)
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    both_nan = (one != one) & (other != other)
    return bool(((one == other) | both_nan).all())


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True)
    if done.returncode:
        reason = "".join(done.stderr.strip().splitlines()[-1:])
        raise ConfigError(
            f"same: git {' '.join(words)}: {reason}; allowed: a commit of this checkout"
        )
    return done.stdout.strip()
