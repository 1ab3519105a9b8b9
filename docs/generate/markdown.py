"""Pieces of Markdown: pages, tables, and what a docstring says."""

from __future__ import annotations

import ast
import functools
import inspect
import re
import textwrap
from collections.abc import Iterable, Sequence

NOTICE = "<!-- Generated from the code by `make docs`; edits here are overwritten. -->"


def page(title: str, *parts: str) -> str:
    """A whole page from its parts, which are paragraphs, headings and tables."""
    text = "\n\n".join([NOTICE, f"# {title}", *(part.strip("\n") for part in parts if part)]) + "\n"
    return re.sub(r"^(##+ .*)\n\n", r"\1\n", text, flags=re.MULTILINE)


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; columns in which nothing stands are left out. Without rows it is nothing."""
    rows = [[cell(entry) for entry in row] for row in rows]
    if not rows:
        return ""
    kept = [column for column in range(len(header)) if any(row[column] for row in rows)]
    lines = [[header[column] for column in kept], ["---"] * len(kept)]
    lines += [[row[column] for column in kept] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def cell(text: str) -> str:
    """Text in one line, as a table's cell needs it."""
    return " ".join(text.split()).replace("|", "\\|")


def sentence(text: str) -> str:
    """`text` with a capital letter at its start."""
    return text[:1].upper() + text[1:]


def docstring(thing: object) -> str:
    """Return the docstring of `thing` itself. Raises LookupError if there is none."""
    text = inspect.cleandoc(getattr(thing, "__doc__", None) or "")
    if not text:
        raise LookupError(f"{thing!r} has no docstring")
    return text


@functools.cache  # most classes derive from others, whose files are parsed for each of them otherwise
def attribute_docstrings(of: type) -> dict[str, str]:
    """The docstrings below the attributes of a class, by name, as Python itself does not keep them."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(of))).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for statement, following in zip(body.body, body.body[1:], strict=False):
        match statement, following:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                found[name] = inspect.cleandoc(text)
    return found
