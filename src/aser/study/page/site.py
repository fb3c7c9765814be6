"""Writes the site: one page of results, the docs beside it, and copies of all that they link to.

Everything in the folder is made from committed files, so it may be deleted at any time. It needs
no server and no network: browsers open it from the disk, where scripts may load scripts, but no
other files. So data are scripts too.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import Any

import plotly
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from aser.errors import ConfigError
from aser.study.page import content, words

MARK = "made-by-make-page"  # a file in every site, so that no other folder is ever replaced
LARGEST = 2**20  # bytes of a file that is copied only because a page links to it
PLACES = {  # folders of the repository that the site has too
    "results/figures": "figures",
    "results/tables": "tables",
}
PAGES = {  # pages of the repository that are parts of the page of results
    "results/claims.md": "index.html#claims",
    "results/figures/README.md": "index.html#figures",
}
AS_TEXT = (".md", ".yaml", ".py", ".cpp", ".cff", "")  # browsers show them where they end in .txt


def write(root: Path, out: Path) -> Path:
    """Write the site of the repository `root` into the folder `out`; returns its first page.

    A site that is there is replaced. Raises ConfigError, one line, where another folder is there or
    where a committed file is missing.
    """
    place = out.absolute()
    draft, old = (place.with_name(f".{place.name}.{os.getpid()}{end}") for end in ("", ".old"))
    try:
        empty = out.is_dir() and not any(out.iterdir())
        if out.exists() and not empty and not (out / MARK).is_file():
            said = "is no site of make page; allowed: a new folder, or such a site"
            raise ConfigError(f"{out}: {said}")
        draft.mkdir(parents=True)
    except OSError as error:
        raise ConfigError(f"{out}: {error.strerror}; allowed: a folder to write to") from None
    try:
        _Site(root, draft).build()
        if place.exists():
            place.rename(old)  # whole, so that a kill leaves no half of a site in its place
        draft.rename(place)
    except FileNotFoundError as error:
        raise ConfigError(f"{error.filename}: is missing; allowed: a whole checkout") from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
    return out / "index.html"


class _Site:
    """A site that is being written. Paths of the repository lead to places in the site."""

    def __init__(self, root: Path, out: Path):
        self.root, self.out = root, out
        docs = sorted(path.name for path in (root / "docs").glob("*.md"))
        self.prose = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", *(f"docs/{n}" for n in docs)]
        self.templates = Environment(
            loader=PackageLoader("aser.study.page"),
            autoescape=select_autoescape(),
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )

    def build(self) -> None:
        (self.out / MARK).touch()
        self._assets()
        for source, place in PLACES.items():
            shutil.copytree(self.root / source, self.out / place)
        self._prose()
        self._index()

    def link(self, source: str, at: str = ".") -> words.Link:
        """Where the links of the page `source` lead, seen from the folder `at` of the site.

        None where the site has no such thing.
        """

        def lead(target: str) -> str | None:
            path, _, anchor = target.partition("#")
            if not path or ":" in path:
                return target
            wanted = os.path.normpath(PurePosixPath(source).parent / path).replace(os.sep, "/")
            place = self._place(wanted)
            if place is None:
                return None
            place = os.path.relpath(place, at)
            return f"{place}#{anchor}" if anchor and "#" not in place else place

        return lead

    def _place(self, wanted: str) -> str | None:
        """Where a file of the repository is in the site. It is copied if it is not there yet."""
        if wanted in PAGES:
            return PAGES[wanted]
        if wanted in self.prose:
            return wanted.removesuffix(".md") + ".html"
        for folder, place in PLACES.items():
            if wanted.startswith(f"{folder}/") and (self.root / wanted).is_file():
                return place + wanted.removeprefix(folder)
        file = self.root / wanted
        if wanted.startswith("..") or not file.is_file() or file.stat().st_size > LARGEST:
            return None
        place = f"files/{wanted}" + (".txt" if file.suffix in AS_TEXT else "")
        (self.out / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, self.out / place)
        return place

    def _assets(self) -> None:
        """The scripts and the look, and plotly's own file, which its package holds."""
        folder = self.out / "assets"
        folder.mkdir()
        for file in resources.files("aser.study.page").joinpath("assets").iterdir():
            (folder / file.name).write_bytes(file.read_bytes())
        library = Path(plotly.__file__).parent / "package_data" / "plotly.min.js"
        shutil.copyfile(library, folder / "plotly.min.js")

    def _prose(self) -> None:
        """The pages in Markdown, each where it is in the repository."""
        (self.out / "docs").mkdir()
        for source in self.prose:
            folder = os.path.dirname(source) or "."
            page = words.page((self.root / source).read_text(), self.link(source, at=folder))
            base = "" if folder == "." else "../"
            self._render("document.html", source.replace(".md", ".html"), base=base, page=page)

    def _index(self) -> None:
        conf, results = self.root / "conf", self.root / "results"
        readme = (self.root / "README.md").read_text()
        rows = content.rows(conf, results)
        recorded = results / "tables" / "explorer.json"
        explorer = json.loads(recorded.read_text()) if recorded.is_file() else None
        if explorer:
            explorer["mazes"] = [content.drawn(maze) for maze in explorer["mazes"]]
        self._data("differences", content.differences(conf, results))
        self._data("explorer", explorer)
        self._data("samplers", content.samplers())
        link = self.link("README.md")
        headline, finding = words.section(readme, "What we found", link)
        self._render(
            "index.html",
            "index.html",
            base="",
            title=words.page(readme, link).title,
            headline=headline,
            finding=finding,
            rows=rows,
            counts=content.counts(rows),
            figures=content.shown(conf, results, rows),
            explorer=explorer,
            prose=self.prose,
            link=link,
            caption=lambda text: words.line(text, link),
        )

    def _data(self, name: str, value: Any) -> None:
        folder = self.out / "data"
        folder.mkdir(exist_ok=True)
        text = json.dumps(value, separators=(",", ":"), allow_nan=False)
        (folder / f"{name}.js").write_text(
            f"window.data = window.data || {{}};\ndata.{name} = {text};\n"
        )

    def _render(self, template: str, place: str, **values: Any) -> None:
        named: Mapping[str, Any] = values
        (self.out / place).write_text(self.templates.get_template(template).render(named))
