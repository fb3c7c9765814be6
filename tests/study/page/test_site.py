"""The page of results: figures and claims are on it, links lead somewhere, nothing is loaded."""

import re
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pandas as pd
import pytest
import yaml

from aser.errors import ConfigError
from aser.study import specs
from aser.study.page import content, words

ROOT = Path(__file__).parents[3]
FIGURES = specs.names(ROOT / "conf" / "figure", specs.COMMITTED)
CLAIMS = {
    name: claim
    for part in specs.COMMITTED
    for name, claim in yaml.safe_load((ROOT / "conf/claims" / f"{part}.yaml").read_text()).items()
}
pytestmark = pytest.mark.xdist_group("page")  # one worker makes the page for all


class Reader(HTMLParser):
    """What a page links to and loads, its anchors, and its text by the id of the element."""

    def __init__(self):
        super().__init__()
        self.links, self.loaded, self.ids, self.text, self.place = [], [], set(), {}, ""

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if "id" in attributes:
            self.ids.add(attributes["id"])
        if tag in ("article", "section"):
            self.place = attributes.get("id", "")
        if "data-claim" in attributes:
            self.place = f"claim {attributes['data-claim']}"
        if tag == "a":
            self.links.append(attributes["href"])
        elif "src" in attributes or tag == "link":
            self.loaded.append(attributes.get("src") or attributes["href"])

    def handle_data(self, data):
        self.text[self.place] = self.text.get(self.place, "") + data


@cache
def read(path):
    reader = Reader()
    reader.feed(path.read_text())
    return reader


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_has_its_picture_command_caption_and_data(name, site):
    index, spec = read(site / "index.html"), specs.load(ROOT / "conf" / "figure", name)
    text = " ".join(index.text[f"figure-{name}"].split())
    assert f"make reproduce FIGURE={name} " in text and spec.title in text
    assert re.sub(r"[`*]", "", spec.caption).split(".")[0] in text
    assert f"files/conf/figure/{spec.part}/{name}.yaml.txt" in index.links
    if not (ROOT / f"results/figures/{spec.path}.png").exists():
        assert "not made yet" in text
        return
    assert f"figures/{spec.path}.png" in index.links and f"figures/{spec.path}.pdf" in index.links
    assert f"figures/{spec.path}.png" in index.loaded
    assert all(source.table in index.links for source in spec.sources)


def test_every_claim_has_all_its_rows_with_interval_and_verdict(site):
    index = read(site / "index.html")
    decided = pd.read_csv(ROOT / "results" / "tables" / "claims.csv")
    assert set(decided["claim"]) == set(CLAIMS)
    rows = content.rows(ROOT / "conf", ROOT / "results")
    assert len(rows) == len(decided)
    # A share of nothing has no estimate, and what is no number cannot be sorted.
    assert [row.estimate is None for row in rows] == decided["estimate"].isna().tolist()
    assert 'data-value="nan"' not in (site / "index.html").read_text()
    for name, claim in CLAIMS.items():
        text = " ".join(index.text[f"claim {name}"].split())
        mine = decided[decided["claim"] == name]
        assert text.count(claim["says"]) == len(mine)
        assert text.count("[") == mine["low"].notna().sum()
    one = decided[decided["claim"] == "oracle_beats_aser"].iloc[0]
    expected = f"{one.estimate:.2f} [{one.low:.2f}, {one.high:.2f}]"
    assert expected in index.text["claim oracle_beats_aser"]
    assert expected in index.text["figure-nine_mazes"]


def test_the_counts_are_the_ledgers(site):
    ledger = (ROOT / "results" / "claims.md").read_text()
    total, counts = re.search(r"Of (\d+), [^:]*: (.*?)\.", ledger).groups()
    assert f"{total} claims: {counts}" in " ".join(read(site / "index.html").text["claims"].split())


def test_the_finding_is_the_readmes(site):
    text = " ".join(read(site / "index.html").text["finding"].split())
    found = (ROOT / "README.md").read_text().split("## What we found\n")[1].split("\n## ")[0]
    bullets = re.findall(r"^- \*\*(.+?)\*\*", found, re.MULTILINE)
    assert len(bullets) >= 3
    for bullet in bullets:
        assert re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", bullet) in text
    headline = " ".join(re.search(r"^\*\*(.+?)\*\*", found, re.MULTILINE | re.DOTALL)[1].split())
    assert text.count(headline) == 1
    numbers = re.findall(r"\d\.\d\d \[[^]]*\]", " ".join(found.split()))
    for number in numbers:  # the finding is stated once
        assert text.count(number) == numbers.count(number)


def test_the_headline_stands_before_the_picture(site):
    page = (site / "index.html").read_text()
    headline = page.index('<div class="headline">')
    assert headline < page.index("an agent can learn") < page.index("<img", headline)


def test_every_link_leads_somewhere_and_nothing_comes_from_the_network(site):
    pages = sorted(site.rglob("*.html"))
    assert len(pages) == 4 + len(list((ROOT / "docs").glob("*.md")))
    for page in pages:
        reader = read(page)
        assert not [target for target in reader.loaded if re.match(r"(https?:)?//", target)]
        for target in reader.links + reader.loaded:
            path, _, anchor = unquote(target).partition("#")
            if re.match(r"https?:|data:", target):
                continue
            file = (page.parent / path).resolve() if path else page
            assert file.is_file() and file.is_relative_to(site.resolve()), f"{page.name}: {target}"
            if anchor:
                assert anchor in read(file).ids, f"{page.name}: {target}"


def test_docs_have_their_tables_and_formulas(site):
    text = (site / "docs" / "criterion.html").read_text()
    assert "<math" in text and "$$" not in text and '<div class="scrolls"><table>' in text


def test_a_site_is_replaced_and_no_other_folder(site, tmp_path):
    from aser.study.page.site import MARK, write

    other = tmp_path / "mine"
    other.mkdir()
    (other / "thesis.txt").write_text("years of work")
    with pytest.raises(ConfigError, match="is no site of make page"):
        write(ROOT, other)
    assert (other / "thesis.txt").read_text() == "years of work"
    with pytest.raises(ConfigError, match="is no site of make page"):
        write(ROOT, other / "thesis.txt")
    with pytest.raises(ConfigError, match="Not a directory; allowed: a folder to write to"):
        write(ROOT, other / "thesis.txt" / "site")
    old = tmp_path / "site"
    old.mkdir()
    (old / MARK).touch()
    (old / "old.html").touch()
    with pytest.raises(ConfigError, match=r"README\.md: is missing"):
        bare = tmp_path / "bare"
        for name in ("results/figures", "results/tables", "docs"):
            (bare / name).mkdir(parents=True)
        write(bare, old)
    assert (old / "old.html").exists()  # what was there stays after an error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bare", "mine", "site"]


def test_a_link_to_nothing_becomes_text():
    def link(target):
        return None if target == "gone.md" else f"there/{target}"

    line = words.line("see [this](gone.md) and [`that`](here.md)", link)
    assert line == 'see this and <a href="there/here.md"><code>that</code></a>'
    page = words.page("# A `title`\n\nFirst *words*.\n\n## Next part\n\n$$a^2$$\n", link)
    assert page.title == "A title" and page.body.startswith("<p>First <em>words</em>.</p>")
    assert "<h1" not in page.body and 'id="next-part"' in page.body and "<math" in page.body
    text = "# T\n\n## One\n\nsee [x]\n\n**Yes**, so.\n\n- **no**\n\n## Two\n\nno\n\n[x]: x.md\n"
    headline, rest = words.section(text, "One", link)
    assert headline.strip() == "<p><strong>Yes</strong>, so.</p>"
    assert rest.startswith('<p>see <a href="there/x.md">x</a></p>') and "Yes" not in rest
    assert "<strong>no" in rest and words.section(text, "Two", link)[0] == ""
    assert words.section(text, "Three", link) == ("", "")


def test_the_command(capsys, tmp_path):
    import page

    assert page.main(["--help"]) == 0 and "double click" in capsys.readouterr().out
    (tmp_path / "file").touch()
    assert page.main([str(tmp_path)]) == 1
    assert capsys.readouterr().err.startswith("page: ")
