"""HTML pages from the templates in `templates/`: self-contained, light and dark, for wide and narrow screens.

Templates escape every value. Before that `as_text` cuts it and makes it printable, as names, programs' errors and
scenarios are what others wrote.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from emulator.pages.palette import PAGE, PALETTE
from emulator.pages.text import as_text, cell
from emulator.records.disk import write_atomically
from emulator.records.verdicts import Verdict

SIGNS = {Verdict.VALID: "✓", Verdict.INVALID: "✗", Verdict.UNKNOWN: "?"}
"""Signs of the verdicts, as colour alone says nothing to some."""


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("emulator.pages"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=as_text,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.globals |= {"palette": PALETTE | PAGE, "signs": SIGNS}
    environment.filters["cut"] = as_text
    return environment


def render(template: str, **values: Any) -> str:
    """Return the page that a template makes of these values."""
    return _environment().get_template(template).render(values)


@dataclass(frozen=True)
class Table:
    """A table for the templates: its columns, which of them are numbers, and the text of each cell."""

    caption: str
    columns: list[str]
    is_numeric: list[bool]
    rows: list[list[str]]


def table(rows: Sequence[Mapping[str, Any]], caption: str = "", decimals: int | None = None) -> Table:
    """Make a table of rows of named values; columns without any value are dropped.

    With `decimals`, all fractions have so many.
    """

    def shown(value: Any) -> str:
        return cell(value) if decimals is None or not isinstance(value, float) else f"{value:,.{decimals}f}"

    names = dict.fromkeys(key for row in rows for key in row)
    columns = [name for name in names if any(row.get(name) not in (None, "") for row in rows)]
    numeric = [all(isinstance(row.get(name), (int, float, type(None))) for row in rows) for name in columns]
    return Table(caption, columns, numeric, [[shown(row.get(name)) for name in columns] for row in rows])


def put_page(path: Path, text: str) -> Path:
    """Put a page in place in one step. Raises VnetError where the disk refuses."""
    write_atomically(path, text)
    return path
