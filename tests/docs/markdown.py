"""The Markdown of the documentation: its pages, their fenced blocks, links and headings."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

from markdown_it import MarkdownIt
from markdown_it.token import Token

from tests.support.paths import ROOT

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
_parser = MarkdownIt("commonmark").enable("table")


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, the further words after it, what it holds, and where it stands."""

    language: str
    name: str
    text: str
    place: str


def blocks(text: str, page: str) -> list[Block]:
    """All fenced blocks of a page, in order."""
    found = []
    for token in _parser.parse(text):
        if token.type == "fence":
            assert token.map is not None
            language, _, name = token.info.strip().partition(" ")
            found.append(Block(language, name, token.content, f"{page}:{token.map[0] + 1}"))
    return found


def links(text: str) -> Iterator[str]:
    """The targets of all links and pictures of a page."""
    for token in _inline(text):
        target = token.attrGet("href") or token.attrGet("src")
        if token.type in ("link_open", "image") and target:
            yield str(target)


@cache
def anchors(text: str) -> set[str]:
    """The names that GitHub gives the headings of a page."""
    tokens = _parser.parse(text)
    headings = [after.content for token, after in pairwise(tokens) if token.type == "heading_open"]
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower() for heading in headings)
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in plain}


def _inline(text: str) -> Iterator[Token]:
    for token in _parser.parse(text):
        yield from token.children or ()
