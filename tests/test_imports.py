"""A file imports only from its left: the plan of the house, read from the imports (lazy ones too)."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

SRC = Path(__file__).parent.parent / "src"

# Left to right. A module imports from rows further left only, never from its own row.
ROWS = [
    {"errors"},
    {"allocator", "checks", "batch", "lanes", "noise", "optim", "provenance"},
    {"agent_config", "hyper", "native"},
    {"networks", "sampler_config"},
    {"config", "dqn", "sac", "replay.priorities", "replay.storage"},
    {"replay.bootstrap", "replay.criteria"},
    {"replay.sampler"},
    {"replay.buffer"},
    {"checkpoint", "diagnostics", "evaluation", "learning"},
    {"training", "pretraining", "run_folder"},
    {"build"},
    {"run", "sweep.space"},
    {"sweep.queue", "sweep.trials"},
    {"sweep.tuned", "sweep.worker"},
    {"train"},
]
PLACE = {module: place for place, row in enumerate(ROWS) for module in row}
SETTINGS = {"agent_config", "hyper", "sampler_config", "config"}
# What knows the settings, and the packages apart.
COMPOSING = {"run_folder", "build", "run", "sweep.trials", "sweep.tuned", "sweep.space", "train"}
OUTSIDE = {"envs", "study"}  # packages with rules of their own
STUDY_MAY_PROBE = re.compile(
    r"study\.probes(_\w+)?"
)  # the modules of the study that may load a checkpoint
NOT_IN_STUDY = {"torch", "gymnasium"}


def module_name(path: Path) -> str:
    """The module without the leading `aser.`; a package goes by its own name."""
    parts = path.relative_to(SRC).with_suffix("").parts
    parts = parts[1:] if parts[0] == "aser" else parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {name: path for path in sorted(SRC.rglob("*.py")) if (name := module_name(path))}


def imported(source: str, package: str = "") -> set[str]:
    """Every dotted name that is imported anywhere; `from a import b` is a.b where that is a module."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                up = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*up, base]).rstrip(".")
            names = {f"{base}.{alias.name}" for alias in node.names}
            modules = {name for name in names if name.removeprefix("aser.") in FILES}
            found |= modules if modules == names else modules | {base}
    return found


def imports_of(name: str) -> tuple[set[str], set[str]]:
    """The project's own modules that a module imports, and the other top-level packages."""
    path = FILES[name]
    package = ".".join(path.relative_to(SRC).parent.parts)
    names = imported(path.read_text(), package)
    own = {n.removeprefix("aser.") for n in names if n.startswith("aser.")} | (names & {"train"})
    return own, {n.partition(".")[0] for n in names} - {"aser"}


def complaints(name: str, own: set[str], others: set[str]) -> list[str]:
    """What is wrong with a module's imports."""
    package = name.partition(".")[0]
    wrong = [
        f"{name} imports {other}" for other in others & {"hydra", "omegaconf"} if name != "train"
    ]
    if package == "study" and not STUDY_MAY_PROBE.fullmatch(name):
        wrong += [f"{name} imports {other}" for other in others & NOT_IN_STUDY]
    for target in own:
        its_package = target.partition(".")[0]
        if package in OUTSIDE:
            probing = bool(STUDY_MAY_PROBE.fullmatch(name))
            allowed = its_package == package or target in ("errors", "checks") or probing
        elif its_package in OUTSIDE:
            allowed = name in COMPOSING
        elif target in SETTINGS:
            allowed = name in SETTINGS | COMPOSING and PLACE[target] < PLACE[name]
        else:
            allowed = PLACE.get(target, len(ROWS)) < PLACE[name] or target == "replay"
        if {package, its_package} in ({"sac", "replay"}, {"dqn", "replay"}) or not allowed:
            wrong.append(f"{name} imports {target}")
    return wrong


@pytest.mark.parametrize("name", FILES)
def test_a_file_imports_only_from_its_left(name):
    known = name in PLACE or name.partition(".")[0] in OUTSIDE or FILES[name].name == "__init__.py"
    assert known, f"give {name} a place in ROWS"
    own, others = imports_of(name)
    if name in PLACE or name.partition(".")[0] in OUTSIDE:
        assert complaints(name, own, others) == []
    else:
        assert own == set(), "a package's __init__ stays empty of the rest"


@pytest.mark.parametrize(
    ("name", "source", "wrong"),
    [
        ("sac", "from aser.replay import storage", "replay.storage"),
        ("replay.sampler", "def f():\n    from aser.sac import update", "sac"),
        ("replay.sampler", "from aser import dqn", "dqn"),
        ("dqn", "from aser.sac import temperature", "sac"),
        ("noise", "from aser import networks", "networks"),
        ("training", "import aser.build", "build"),
        ("training", "from aser.config import Config", "config"),
        ("envs.maze", "from aser import noise", "noise"),
        ("study.plots", "import torch.nn", "torch"),
        ("study.probing", "import torch", "torch"),
        ("study.maze_maps", "from aser.envs import maze_states", "envs.maze_states"),
        ("study.plots", "from aser.training import Training", "training"),
        ("build", "from omegaconf import OmegaConf", "omegaconf"),
        ("replay.storage", "from .sampler import Sampler", "replay.sampler"),
    ],
)
def test_wrong_imports_are_found(name, source, wrong):
    names = imported(source, "aser." + name.rpartition(".")[0])
    own = {n.removeprefix("aser.") for n in names if n.startswith("aser.")}
    assert complaints(name, own, {n.partition(".")[0] for n in names}) == [
        f"{name} imports {wrong}"
    ]


def test_a_wrong_setting_waits_for_no_heavy_import():
    code = "import sys, train; print(sorted({'torch', 'hydra', 'gymnasium', 'pandas'} & set(sys.modules)))"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"
