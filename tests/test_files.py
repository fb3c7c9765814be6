"""A file is replaced completely or not at all."""

import subprocess
import sys
from pathlib import Path

import pytest

from aser.files import HOST, is_draft, replacing


def test_the_new_file_takes_the_place_of_the_old_one(tmp_path):
    path = tmp_path / "new" / "table.csv"
    for text in ("one", "two"):
        with replacing(path) as draft:
            draft.write_text(text)
            assert draft.parent == path.parent and draft != path
        assert path.read_text() == text
    assert [file.name for file in path.parent.iterdir()] == ["table.csv"]


def test_a_failure_leaves_the_old_file_and_no_draft(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), replacing(path) as draft:
        draft.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_what_a_killed_process_left_is_removed_by_the_next_write(tmp_path):
    path = tmp_path / "checkpoint.pt"
    code = (
        "import sys, time; from pathlib import Path; from aser.files import replacing\n"
        "with replacing(Path(sys.argv[1])) as draft:\n"
        "    draft.write_text('half'); print(draft, flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", code, str(path)]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    left = Path(writer.stdout.readline().strip())
    assert left.read_text() == "half" and is_draft(left) and not is_draft(path)
    with replacing(path) as draft:  # the other one lives, so its draft stays
        draft.write_text("one")
    assert left.exists()
    writer.kill()
    writer.communicate()
    others = {
        f".checkpoint.pt.elsewhere-{writer.pid}": "of another host, where it may live",
        f".summary.json.{HOST}-{writer.pid}": "of another file",
        ".checkpoint.pt.notes": "no draft",
    }
    for name, text in others.items():
        (tmp_path / name).write_text(text)
    with replacing(path) as draft:
        draft.write_text("two")
    assert path.read_text() == "two" and not left.exists()
    assert {file.name for file in tmp_path.iterdir()} == {"checkpoint.pt", *others}


@pytest.mark.parametrize("name", ["table.csv", ".lock", ".gitignore", ".a.b.c", ".x-1", ".a.h-x"])
def test_other_files_are_no_drafts(name):
    assert not is_draft(Path(name))
