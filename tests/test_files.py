"""A file is replaced completely or not at all."""

import pytest

from aser.files import replacing


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
