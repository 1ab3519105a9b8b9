"""`vnet docs`: the pages of the documentation, which come with the package."""

from __future__ import annotations

import pydoc
import sys
from pathlib import Path
from typing import Annotated

import typer

from emulator.terminal.console import one_line_errors
from vnet.errors import VnetError, did_you_mean, printable

FOLDER = Path(__file__).parents[1] / "docs.d"
"""The pages and their examples: in a clone a link to its `docs`, in a wheel a copy."""
EXAMPLES = FOLDER / "examples"


def docs(
    page: Annotated[
        str | None, typer.Argument(metavar="PAGE", help="A page to read: orders, how-to/debugging, or debugging.")
    ] = None,
    path: Annotated[bool, typer.Option("--path", help="Print where it is, or where all pages are.")] = False,
) -> None:
    """List the pages of the documentation, or print one."""
    with one_line_errors():
        if page is not None:
            found = find_page(page)
            _show(found.read_text("utf-8").rstrip("\n")) if not path else print(found)
        elif path:
            print(FOLDER.resolve())
        else:
            pages = list_pages()
            width = max(map(len, pages))
            print("\n".join(f"{name:{width}}  {_title(file)}" for name, file in pages.items()))


def list_pages() -> dict[str, Path]:
    """Return the pages by name, those of the first level first."""
    files = sorted(FOLDER.glob("**/*.md"), key=lambda file: (len(file.parts), file))
    return {file.relative_to(FOLDER).with_suffix("").as_posix(): file.resolve() for file in files}


def find_page(name: str) -> Path:
    """Return the page of a name, or of the last part of one. Raises VnetError if there is none."""
    pages = list_pages()
    wanted = name.removeprefix("docs/").removesuffix(".md")
    found = [file for known, file in pages.items() if wanted in (known, known.rpartition("/")[2])]
    if not found:
        raise VnetError(f"{printable(name)}: no page{did_you_mean(wanted, pages)}; vnet docs lists all")
    return found[0]


def _title(file: Path) -> str:
    with file.open(encoding="utf-8") as page:
        return next((line.removeprefix("# ").rstrip() for line in page if line.startswith("# ")), "")


def _show(text: str) -> None:
    if sys.stdout.isatty():
        pydoc.pager(text)
    else:
        print(text)
