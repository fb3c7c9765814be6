"""Markdown to HTML: the pages in docs/ and the finding in the README, with links that lead on."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

from latex2mathml.converter import convert
from markdown_it import MarkdownIt
from markdown_it.token import Token
from markupsafe import Markup
from mdit_py_plugins.anchors import anchors_plugin
from mdit_py_plugins.dollarmath import dollarmath_plugin

Link = Callable[[str], str | None]  # from a target in a page to one in the site; None: no link


@dataclass(frozen=True)
class Page:
    """A page in Markdown: its title, and its body without the title."""

    title: str
    body: Markup


def page(text: str, link: Link) -> Page:
    """A page whose first line is `# Title`."""
    markdown = _reader()
    tokens = markdown.parse(text)
    title = next((t.content for t in tokens if t.type == "inline"), "")
    body = tokens[3:] if tokens and tokens[0].tag == "h1" else tokens
    _lead(body, link)
    return Page(_plain(title), _html(markdown, body))


def section(text: str, heading: str, link: Link) -> tuple[Markup, Markup]:
    """What stands below `## heading`, without it: its headline, and the rest.

    The headline is the first paragraph that begins in bold type. Each is empty where there is none.
    """
    found = re.search(
        rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", text, re.DOTALL | re.MULTILINE
    )
    if found is None:
        return Markup(""), Markup("")
    named = "\n".join(re.findall(r"(?m)^\[\w+\]: \S+$", text))  # links by a name
    markdown = _reader()
    tokens = markdown.parse(f"{found[1]}\n\n{named}\n")
    _lead(tokens, link)
    place = next(
        (
            at
            for at, (token, inner) in enumerate(pairwise(tokens))
            if token.type == "paragraph_open" and not token.level and inner.content.startswith("**")
        ),
        len(tokens),
    )
    rest = tokens[:place] + tokens[place + 3 :]
    return _html(markdown, tokens[place : place + 3]), _html(markdown, rest)


def line(text: str, link: Link) -> Markup:
    """A caption or another piece of text within a paragraph."""
    markdown = _reader()
    tokens = markdown.parseInline(text)
    _lead(tokens, link)
    return _html(markdown, tokens)


def slug(heading: str) -> str:
    """The anchor of a heading, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def _reader() -> MarkdownIt:
    markdown = MarkdownIt("commonmark", {"html": True}).enable("table")
    markdown.use(anchors_plugin, min_level=2, max_level=4, slug_func=slug)
    return markdown.use(dollarmath_plugin, allow_digits=False, renderer=_formula)


def _formula(tex: str, options: dict) -> str:
    """MathML, which browsers draw themselves."""
    return convert(tex.strip(), display="block" if options["display_mode"] else "inline")


def _html(markdown: MarkdownIt, tokens: list[Token]) -> Markup:
    """Tables may be wider than a phone, so each scrolls by itself."""
    html = markdown.renderer.render(tokens, markdown.options, {})
    html = html.replace("<table>", '<div class="scrolls"><table>')
    return Markup(html.replace("</table>", "</table></div>"))


def _lead(tokens: list[Token], link: Link) -> None:
    """Lead every link and picture to where it is in the site; a link to nothing becomes text."""
    for token in tokens:
        children = token.children or []
        dead = 0
        for child in children:
            if child.type == "link_open":
                target = link(str(child.attrGet("href")))
                if target is None:
                    child.type, child.tag, child.attrs, dead = "text", "", {}, dead + 1
                else:
                    child.attrSet("href", target)
            elif child.type == "link_close" and dead:
                child.type, child.tag, dead = "text", "", dead - 1
            elif child.type == "image":
                child.attrSet("src", link(str(child.attrGet("src"))) or "")
                child.attrSet("loading", "lazy")


def _plain(text: str) -> str:
    return re.sub(r"[`*]", "", text)
