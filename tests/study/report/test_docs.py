"""The committed pages are what the committed tables say, and their words quote nothing else."""

import re
import shutil

import pytest

import train
from aser.errors import ConfigError
from aser.study.report import docs

ROOT = train.CONF.parent
PAGES = ("criterion.md", "field.md", "nine_mazes.md", "appendices.md")
TABLE = r"<!-- \w+: .*?<!-- end -->"


def test_every_committed_page_is_what_the_tables_say(tmp_path):
    for part in ("tables", "sensitivity"):
        shutil.copytree(ROOT / "results" / part, tmp_path / "results" / part)
    (tmp_path / "docs").mkdir()
    for name in PAGES:
        shutil.copy(ROOT / "docs" / name, tmp_path / "docs")
    docs.write_all(train.CONF, tmp_path / "results", tmp_path / "docs")
    written = ["results/claims.md", "results/tables/claims.csv", "results/tables/hyper.md"]
    for name in [*written, *(f"docs/{name}" for name in PAGES)]:
        assert (tmp_path / name).read_text() == (ROOT / name).read_text(), name


@pytest.mark.parametrize("name", PAGES)
def test_the_words_quote_only_intervals_of_the_tables(name):
    text = (ROOT / "docs" / name).read_text()
    tables = "\n".join(re.findall(TABLE, text, re.DOTALL))
    known = tables + (ROOT / "results" / "claims.md").read_text()
    words = re.sub(TABLE, "", text, flags=re.DOTALL)
    quoted = re.findall(r"-?[\d.]+ \[-?[\d.]+, -?[\d.]+\]", words)
    assert quoted or "Not run yet." in text, "the page says no number"
    for number in quoted:
        assert number in known, number


def test_tables_are_written_between_their_marks(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("Words.\n<!-- one: made -->\nold\n<!-- end -->\nkept\n")
    for _ in range(2):  # the second time nothing changes
        docs.fill(page, {"one": ["| a |", "| b |"]})
        assert page.read_text() == (
            "Words.\n<!-- one: made -->\n\n| a |\n| b |\n\n<!-- end -->\nkept\n"
        )


def test_a_page_that_lacks_a_mark_is_left_as_it_is(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(before := "<!-- one: made -->\nold\n<!-- end -->\n")
    with pytest.raises(ConfigError, match=r"page\.md: has no place <!-- two: \.\.\. -->"):
        docs.fill(page, {"one": ["new"], "two": []})
    assert page.read_text() == before
