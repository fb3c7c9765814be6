"""A yaml file is read whole: a key that is there twice is refused, not lost."""

import pytest

from aser.errors import ConfigError
from aser.settings import yaml_file


def test_what_a_file_holds(tmp_path):
    path = tmp_path / "one.yaml"
    plain = "a: {b: 1, c: [2, {b: 3}]}\nb: null\n"
    path.write_text(plain + "d: &d {e: 1}\nf: &f {<<: *d, e: 2}\ng: {<<: *f, e: 3}\n")
    wanted = {"a": {"b": 1, "c": [2, {"b": 3}]}, "b": None}
    wanted |= {"d": {"e": 1}, "f": {"e": 2}, "g": {"e": 3}}  # merged keys may stand again
    assert yaml_file.read(path) == wanted


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("a: 1\nb: 2\na: 3\n", "a is there twice in the block of line 1"),
        ("a: 1\nb:\n  c: 2\n  c: 2\n", "c is there twice in the block of line 3"),
        ("a: [1", "while parsing a flow sequence"),
    ],
)
def test_a_file_that_cannot_be_read_is_one_line(tmp_path, text, line):
    path = tmp_path / "one.yaml"
    path.write_text(text)
    for key in (None, "conf/one.yaml"):
        with pytest.raises(ConfigError) as caught:
            yaml_file.read(path, key)
        said = str(caught.value)
        assert said.startswith(f"{key or path}: cannot be read: {line}") and "\n" not in said
    with pytest.raises(ConfigError, match=r"two\.yaml: cannot be read"):
        yaml_file.read(tmp_path / "two.yaml")
