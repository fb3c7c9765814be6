"""What a result says it comes from."""

import json
import platform
import subprocess

import numpy as np
import pytest
import torch

from aser import provenance


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A small package instead of aser's own."""
    folder = tmp_path / "src" / "small"
    for name, text in [("a.py", "x = 1\n"), ("replay/b.py", "y = 2\n"), ("study/c.py", "z = 3\n")]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    monkeypatch.setattr(provenance, "PACKAGE", folder)
    return folder


def git(folder, *words):
    name = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "init.defaultBranch=main"]
    subprocess.run(["git", "-C", str(folder), *name, *words], check=True, capture_output=True)


def test_the_digest_is_that_of_the_code_that_trains(package):
    before = provenance.code_digest()
    assert len(before) == 12 and before == provenance.code_digest()
    (package / "study" / "c.py").write_text("z = 4\n")
    (package / "study" / "new.py").write_text("")
    (package / "notes.txt").write_text("not code")
    assert provenance.code_digest() == before
    seen = {before}
    (package / "replay" / "b.py").write_text("y = 3\n")
    seen.add(provenance.code_digest())
    (package / "replay" / "b.py").rename(package / "b.py")
    seen.add(provenance.code_digest())
    (package / "new.py").write_text("")
    seen.add(provenance.code_digest())
    assert len(seen) == 4


def test_a_folder_called_study_above_the_package_hides_nothing(tmp_path, monkeypatch):
    for text in ("x = 1", "x = 2"):
        folder = tmp_path / text[-1] / "study" / "aser"
        folder.mkdir(parents=True)
        (folder / "a.py").write_text(text)
    digests = set()
    for name in "12":
        monkeypatch.setattr(provenance, "PACKAGE", tmp_path / name / "study" / "aser")
        digests.add(provenance.code_digest())
    assert len(digests) == 2


def test_the_commit_and_whether_the_files_differ_from_it(package, tmp_path):
    assert provenance.commit() is None  # not in a checkout
    git(tmp_path, "init")
    git(tmp_path, "add", "src")
    git(tmp_path, "commit", "-m", "first")
    git(tmp_path, "tag", "-a", "v1", "-m", "a release")
    head = subprocess.run(["git", "-C", str(tmp_path), "rev-parse", "HEAD"], capture_output=True, text=True)
    assert provenance.commit() == head.stdout[:12]
    (tmp_path / "untracked.txt").write_text("a result")
    assert provenance.commit() == head.stdout[:12]
    (package / "a.py").write_text("x = 5\n")
    assert provenance.commit() == head.stdout[:12] + "+"


def test_no_git_is_no_error(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert provenance.commit() is None


def test_versions_are_the_installed_ones():
    said = provenance.provenance()
    assert set(said) == {"versions", "commit", "code"}
    assert said["versions"]["python"] == platform.python_version()
    assert said["versions"]["torch"].partition("+")[0] == torch.__version__.partition("+")[0]
    assert said["versions"]["numpy"] == np.__version__
    assert json.loads(json.dumps(said)) == said
