"""A file imports only from its left: the plan of the house, read from all imports."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

SRC = Path(__file__).parent.parent / "src"

# Left to right. A module imports from rows further left only, never from its own row.
ROWS = [
    {"errors", "script"},
    {
        "allocator",
        "scores",
        "files",
        "logs",
        "memory",
        "noise",
        "provenance",
        "replay.hidden",
        "trees",
        "settings.checks",
        "settings.cluster",
        "settings.keys",
        "settings.yaml_file",
    },
    {"checkpoint", "compiled", "lanes", "settings.agent"},
    {"native.library", "replay.loading", "settings.hyper", "settings.sampler"},
    {"native", "settings.config"},
    {"agents.batch", "agents.losses", "agents.networks", "agents.optim", "settings.compose"},
    {"agents.laber"},
    {"agents"},
    {"agents.dqn", "agents.sac", "replay.priorities", "replay.storage"},
    {
        "replay.bootstrap",
        "replay.cells",
        "replay.criteria",
        "replay.draws",
        "replay.facts",
        "replay.moments",
    },
    {"replay.correction", "replay.kinds"},
    {"replay.walk"},
    {"replay.counts", "replay.outcome_spread", "replay.own", "replay.unroll"},
    {"replay.sampler"},
    {"replay.buffer", "replay.outcome_model"},
    {"training.evaluation", "training.learning"},
    {"training.diagnostics"},
    {"training.loop", "training.frozen", "run_folder"},
    {"progress", "settle", "training.init_from"},
    {"build"},
    {"longer", "same", "sweep.space"},
    {"run"},
    {"reproduce", "sweep.queue", "sweep.settings", "sweep.trials"},
    {"sweep.tuned"},
    {"sweep.sensitivity", "sweep.study"},
    {"sweep.jobs"},
    {"train", "policy", "command"},
    {"sb3", "show"},
    {"api"},
    # Other libraries' users import these, and no other module does.
    {"integrations.sb3.networks", "integrations.sb3.samplers"},
    {"integrations.sb3.buffer"},
    {"integrations.sb3.unrolls"},
    {"integrations.sb3.sac"},
    {"integrations.sb3"},
]
PLACE = {module: place for place, row in enumerate(ROWS) for module in row}
# What knows the settings beside the settings themselves: what puts a run together, and all above
# it.
COMPOSING = {"training.frozen", "training.init_from", "run_folder", "settle", "build", "longer"}
COMPOSING |= {"run", "reproduce", "train", "command", "policy", "sb3", "show", "api"}
COMPOSING |= {module for module in PLACE if module.startswith("sweep.")}
COMPOSING |= {"integrations.sb3.samplers"}
OUTSIDE = {"envs", "study"}  # packages with rules of their own
HEAVY = {"torch", "gymnasium", "pandas", "matplotlib"}  # not loaded by settings
FOR_ALL = {"errors", "files", "scores", "settings.checks", "settings.keys"}  # from anywhere
FOR_ALL |= {"settings.yaml_file"}
# The rooms of the study, left to right; figures is the registry of figures.
STUDY = ["specs", "runs", "statistics", "tables", "plots", "report", "figures", "page"]
NOT_IN_STUDY = {"torch", "gymnasium"}  # but in study.tables, which may load a checkpoint
PRIVATE = {"compiled", "trees"}  # the only files that use private parts of torch
HYDRA = {"settings.compose"}


def module_name(path: Path) -> str:
    """The module without the leading `aser.`; a package goes by its own name."""
    parts = path.relative_to(SRC).with_suffix("").parts
    parts = parts[1:] if parts[0] == "aser" else parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {name: path for path in sorted(SRC.rglob("*.py")) if (name := module_name(path))}


def imported(source: str, package: str = "") -> set[str]:
    """Every dotted name that is imported; `from a import b` is a.b where that is a module."""
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
    room = name.partition(".")[0]
    refused = set() if name in HYDRA else {"hydra", "omegaconf"}
    refused |= HEAVY if room == "settings" else set()
    tables = name.startswith("study.tables")
    refused |= NOT_IN_STUDY if room == "study" and not tables else set()
    wrong = [f"{name} imports {other}" for other in others & refused]
    for target in own:
        its_room = target.partition(".")[0]
        if room == its_room == "study":
            here, there = (STUDY.index(module.split(".")[1]) for module in (name, target))
            # Drawing reads the committed tables and asks nothing that makes them.
            making = there == STUDY.index("tables") and target != "study.tables.returns"
            allowed = there <= here and not (making and name.startswith("study.plots"))
        elif room in OUTSIDE:
            allowed = its_room == room or target in FOR_ALL or tables
        elif its_room in OUTSIDE:
            allowed = name in COMPOSING
        elif its_room == "settings":
            allowed = room == "settings" or name in COMPOSING
            allowed = allowed and PLACE[target] < PLACE[name]
        else:
            allowed = PLACE.get(target, len(ROWS)) < PLACE[name] or target in ("replay", "agents")
        if room == "replay" and target in ("agents.sac", "agents.dqn") or not allowed:
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
        ("agents.sac", "from aser.replay import storage", "replay.storage"),
        ("replay.sampler", "def f():\n    from aser.agents.sac import update", "agents.sac"),
        ("replay.sampler", "from aser.agents import dqn", "agents.dqn"),
        ("agents.dqn", "from aser.agents.sac import temperature", "agents.sac"),
        ("noise", "from aser.agents import networks", "agents.networks"),
        ("training.loop", "import aser.build", "build"),
        ("training.loop", "from aser.settings.config import Config", "settings.config"),
        ("envs.maze", "from aser import noise", "noise"),
        ("study.plots.axes", "import torch.nn", "torch"),
        ("study.specs", "import torch", "torch"),
        ("settings.config", "import pandas", "pandas"),
        ("study.plots.maze", "from aser.envs import maze_states", "envs.maze_states"),
        ("study.plots.axes", "from aser.training.loop import Training", "training.loop"),
        ("study.plots.maps", "from aser.study.tables import agents", "study.tables.agents"),
        ("study.statistics.estimates", "from aser.study import figures", "study.figures"),
        ("study.figures", "from aser.study.page import content", "study.page.content"),
        ("build", "from omegaconf import OmegaConf", "omegaconf"),
        ("replay.storage", "from .sampler import Sampler", "replay.sampler"),
        ("run", "from aser.integrations import sb3", "integrations.sb3"),
    ],
)
def test_wrong_imports_are_found(name, source, wrong):
    names = imported(source, "aser." + name.rpartition(".")[0])
    own = {n.removeprefix("aser.") for n in names if n.startswith("aser.")}
    assert complaints(name, own, {n.partition(".")[0] for n in names}) == [
        f"{name} imports {wrong}"
    ]


@pytest.mark.parametrize("name", FILES)
def test_private_torch_is_in_two_files(name):
    private = re.findall(
        r"torch(?:\.\w+)*\._\w+|from torch(?:\.\w+)*\._\w+", FILES[name].read_text()
    )
    assert not private or name in PRIVATE


def test_a_wrong_setting_waits_for_no_heavy_import():
    heavy = "{'torch', 'hydra', 'gymnasium', 'pandas'}"
    code = f"import sys, train; print(sorted({heavy} & set(sys.modules)))"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"
