"""Texts as pages and tables show them; what others wrote is cut, and made printable."""

from __future__ import annotations

from typing import Any

from markupsafe import Markup

LONGEST_TEXT = 20_000
"""Characters of a text that a page shows at most."""


def as_text(value: object, longest: int = LONGEST_TEXT) -> str:
    """Return a value as text: cut to `longest` characters, unprintable ones as escapes; nothing for None.

    Markup that a template has made is returned as it is. Anything else is still to be escaped.
    """
    if isinstance(value, Markup):
        return value
    text = "" if value is None else str(value)
    if len(text) > longest:
        text = f"{text[: longest - 1]}…"
    return text if text.isprintable() else "".join(map(_printable, text))


def _printable(character: str) -> str:
    return character if character.isprintable() or character in "\n\t" else repr(character)[1:-1]


def cell(value: Any) -> str:
    """Return a value as a table shows it: six digits of a fraction, nothing for None."""
    if isinstance(value, float):
        return f"{value:.6g}"
    return as_text(value)
