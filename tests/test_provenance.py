"""The provenance of a result: digest, versions and commit."""

import csv
import json
import os
import platform
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch

from aser import provenance

KEYS = ("code", "same_as")


def another_process():
    """From here on, the digest and the commit are those of a process that begins now."""
    provenance._sources.cache_clear()
    provenance._commit.cache_clear()


def digest():
    another_process()
    return provenance.code_digest()


def commit():
    another_process()
    return provenance.commit()


@pytest.fixture(autouse=True)
def fresh():
    another_process()
    yield
    another_process()


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A small package in place of aser."""
    folder = tmp_path / "src" / "small"
    for name, text in [("a.py", "x = 1\n"), ("replay/b.py", "y = 2\n"), ("study/c.py", "z = 3\n")]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    monkeypatch.setattr(provenance, "PACKAGE", folder)
    return folder


def git(folder, *words):
    name = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "init.defaultBranch=main"]
    subprocess.run(["git", "-C", str(folder), *name, *words], check=True, capture_output=True)


LANE = '''
"""A module."""
import torch
from torch import Tensor
from aser.noise import bits as numbers
from . import storage

RATE: float = 0.5  # of something


def step(x: Tensor) -> Tensor:
    """One step."""
    if x.dim() > 1:
        raise ValueError(f"{x}: too many dimensions")
    print("a step")
    return RATE * x + numbers(x)
'''


def test_the_digest_is_that_of_the_code_that_trains(package):
    before = digest()
    assert len(before) == 12 and before == digest()
    (package / "study" / "c.py").write_text("z = 4\n")
    (package / "study" / "new.py").write_text("")
    (package / "new.py").write_text('"""Nothing but words."""\n')
    (package / "notes.txt").write_text("not code")
    (package / "replay" / "b.py").rename(package / "moved.py")
    assert digest() == before
    (package / "moved.py").write_text("y = 3\n")
    assert digest() != before


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"""A module."""', ""),
        ('"""One step."""', '"""One step of\n    a lane."""'),
        ("  # of something", ""),
        ("too many dimensions", "allowed is one dimension"),
        ('print("a step")', 'print("one more step")'),
        ("x: Tensor) -> Tensor", "x)"),
        ("from aser.noise import", "from aser.training.noise import"),
        ("import torch\nfrom torch import Tensor\n", "from torch import Tensor\nimport torch\n"),
        ("return RATE * x + numbers(x)", "return (\n        RATE * x + numbers(x)\n    )"),
    ],
)
def test_words_form_and_places_are_not_in_the_digest(old, new):
    assert old in LANE and (changed := LANE.replace(old, new)) != LANE
    assert provenance.module_digest(changed) == provenance.module_digest(LANE)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("0.5", "0.25"),
        ("> 1", ">= 1"),
        ("RATE * x", "x"),
        ("ValueError", "KeyError"),
        ("bits as numbers", "uniform as numbers"),
        ("from torch import Tensor", "from numpy import Tensor"),
    ],
)
def test_a_changed_constant_or_operation_is_in_the_digest(old, new):
    assert provenance.module_digest(LANE.replace(old, new)) != provenance.module_digest(LANE)


def test_comments_in_cpp_are_not_in_the_digest(package):
    source = package / "operators.cpp"
    source.write_text("int f() { return 1; } // one\n")
    before = digest()
    source.write_text("/* gives\n one */ int f() {\n  return 1; }\n")
    assert digest() == before
    source.write_text("int f() { return 2; }")
    assert digest() != before


def test_a_process_names_the_code_that_it_has_loaded(tmp_path):
    source = provenance.PACKAGE.parent
    shutil.copytree(source, tmp_path / "src", ignore=shutil.ignore_patterns("*.egg-info"))
    git(tmp_path, "init")
    git(tmp_path, "add", "src")
    git(tmp_path, "commit", "-m", "first")
    program = """
from pathlib import Path
from aser import provenance
file = Path("src/aser/noise.py")
file.write_text(file.read_text() + "ONE = 1\\n")  # before it is loaded
import aser.build
file.write_text(file.read_text() + "TWO = 2\\n")  # and after
print(provenance.code_digest(), provenance.commit())
"""
    command = [sys.executable, "-c", program]
    process = {"cwd": tmp_path, "env": {**os.environ, "PYTHONPATH": "src"}}
    first = subprocess.run(command, capture_output=True, text=True, check=True, **process)
    code, commit_then = first.stdout.split()
    assert commit_then.endswith("+")
    noise = tmp_path / "src" / "aser" / "noise.py"
    noise.write_text(noise.read_text().replace("TWO = 2\n", ""))
    ask = [sys.executable, "-c", "from aser import provenance; print(provenance.code_digest())"]
    now = subprocess.run(ask, capture_output=True, text=True, check=True, **process)
    assert now.stdout.strip() == code != provenance.code_digest()


def test_versions_are_kept_too(monkeypatch):
    provenance.keep()
    monkeypatch.setattr(provenance, "version", lambda name: "9.9")
    assert provenance.provenance()["versions"]["torch"] != "9.9"


def test_digests_that_stand_for_the_same_code(tmp_path):
    table = tmp_path / "same_code.csv"
    assert provenance.same_code("a", table) == {"a"}
    table.write_text("code,same_as,shown_by\na,b,make same\nb,c,make same\nd,b,make same\n")
    assert provenance.same_code("a", table) == {"a", "b", "c"}
    assert provenance.same_code("d", table) == {"d", "b", "c"}  # a may have what b lacks
    assert provenance.same_code("c", table) == {"c"} and provenance.same_code("f", table) == {"f"}


def test_a_folder_called_study_above_the_package_hides_nothing(tmp_path, monkeypatch):
    for text in ("x = 1", "x = 2"):
        folder = tmp_path / text[-1] / "study" / "aser"
        folder.mkdir(parents=True)
        (folder / "a.py").write_text(text)
    digests = set()
    for name in "12":
        monkeypatch.setattr(provenance, "PACKAGE", tmp_path / name / "study" / "aser")
        digests.add(digest())
    assert len(digests) == 2


def test_the_commit_and_whether_the_files_differ_from_it(package, tmp_path):
    assert commit() is None  # not in a checkout
    git(tmp_path, "init")
    git(tmp_path, "add", "src")
    git(tmp_path, "commit", "-m", "first")
    git(tmp_path, "tag", "-a", "v1", "-m", "a release")
    head = subprocess.run(
        ["git", "-C", str(tmp_path), "rev-parse", "HEAD"], capture_output=True, text=True
    )
    assert commit() == head.stdout[:12]
    (tmp_path / "untracked.txt").write_text("a result")
    assert commit() == head.stdout[:12]
    (package / "a.py").write_text("x = 5\n")
    assert commit() == head.stdout[:12] + "+"


def test_libraries_are_no_sources_of_ones_own_wherever_they_lie(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "mine_here.py").write_text("import lib_there, broken_here.part\n")
    (tmp_path / "broken_here").mkdir()
    (tmp_path / "broken_here" / "__init__.py").write_text("assert False\n")
    library = tmp_path / "cluster" / "site-packages"
    library.mkdir(parents=True)
    (library / "lib_there.py").write_text("A = 1\n")
    monkeypatch.syspath_prepend(library)
    digest = provenance.source_digest("mine_here")
    assert digest is not None and provenance.source_digest("lib_there") is None
    (library / "lib_there.py").write_text("A = 2\n")
    assert provenance.source_digest("mine_here") == digest
    assert provenance.source_digest("broken_here.part") is None


def test_no_git_is_no_error(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert commit() is None


def test_versions_are_the_installed_ones():
    source = provenance.provenance()
    assert set(source) == {"versions", "commit", "code"}
    assert source["versions"]["python"] == platform.python_version()
    assert source["versions"]["torch"].partition("+")[0] == torch.__version__.partition("+")[0]
    assert source["versions"]["numpy"] == np.__version__
    assert json.loads(json.dumps(source)) == source


def test_the_committed_pairs_name_the_code_behind_the_committed_figures():
    results = provenance.PACKAGE.parents[1] / "results"
    with (results / "same_code.csv").open() as file:
        pairs = list(csv.DictReader(file))
    assert all(re.fullmatch("[0-9a-f]{12}", pair[key]) for pair in pairs for key in KEYS)
    with (results / "tables" / "figure_runs.csv").open() as file:
        codes = {row["code"] for row in csv.DictReader(file)}
    assert codes <= provenance.same_code(pairs[0]["code"], results / "same_code.csv")
