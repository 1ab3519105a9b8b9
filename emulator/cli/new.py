"""`vnet docs` and `vnet new`: the pages that come with the package, and a folder to begin with, or an example's."""

from __future__ import annotations

import importlib.util
import keyword
import pydoc
import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from emulator.records.disk import check_is_free
from emulator.terminal.console import one_line_errors
from vnet.errors import VnetError, did_you_mean, printable

FOLDER = Path(__file__).parents[1] / "docs.d"
"""The pages and their examples: in a clone a link to its `docs`, in a wheel a copy."""
EXAMPLES = FOLDER / "examples"
_TEMPLATES = Path(__file__).parent / "templates"


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
            if not Path("docs/examples").exists():
                print('for commands that name files of docs/: ln -s "$(vnet docs --path)" docs', file=sys.stderr)


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


def new(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME", help="The new folder, and the program in it; left out, that of the example."
        ),
    ] = None,
    example: Annotated[
        str | None, typer.Option(metavar="EXAMPLE", help="Copy this example of the documentation instead.")
    ] = None,
) -> None:
    """Write a folder to begin with: a scenario, its program, a check of what it promises, and a test.

    NAME becomes a module of Python's: letters of ASCII, digits and _. With --example it is a copy of an example,
    which a page of the documentation explains.
    """
    with one_line_errors():
        if name is None and example is None:
            raise VnetError(f"name the new folder, or an example with --example: {', '.join(examples())}")
        folder = Path(name or example or "")
        if example is not None:
            source = _example(example)
        check_is_free(folder)
        if example is not None:
            copy_example(source, folder)
        else:
            _check_name(folder.name)
            write_project(folder)
        print(f"{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")
        scenario, *_ = sorted(folder.glob("*.toml"))
        print(f"next: cd {shlex.quote(str(folder))} && vnet simulate {scenario.name}")


def examples() -> list[str]:
    """Return the names of the examples with a scenario."""
    return sorted({path.parent.name for path in EXAMPLES.glob("*/*.toml")})


def _example(name: str) -> Path:
    if name not in (known := examples()):
        meant = did_you_mean(name, known)
        raise VnetError(f"--example {printable(name)}: no example{meant}; there are {', '.join(known)}")
    return EXAMPLES / name


def copy_example(source: Path, folder: Path) -> None:
    """Copy the files of an example, which is a package of the documentation, into a folder of its own.

    Raises:
        VnetError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path in source.iterdir():
            if path.is_file() and path.name != "__init__.py":
                text = path.read_text("utf-8")
                for place in (f"docs.examples.{source.name}.", f"docs/examples/{source.name}/"):
                    text = text.replace(place, "")
                (folder / path.name).write_text(text, "utf-8")
    except OSError as error:
        raise VnetError(f"{folder}: cannot be written: {error.strerror}") from error


def write_project(folder: Path) -> None:
    """Write the files of a new project into a folder, and make the folder if it is not there.

    Args:
        folder: its last part is the name of the program.

    Raises:
        VnetError: the folder cannot be written.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # other commands do not wait for it

    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), undefined=StrictUndefined, keep_trailing_newline=True, autoescape=False
    )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for template in environment.list_templates():
            path = folder / template.removesuffix(".j2").replace("NAME", folder.name)
            path.write_text(environment.get_template(template).render(name=folder.name), encoding="utf-8")
    except OSError as error:
        raise VnetError(f"{folder}: cannot be written: {error.strerror}") from error


def _check_name(name: str) -> None:
    """The program is a module: its name must be one, and hide no other."""
    reserved = keyword.iskeyword(name) or name.startswith("test_") or name.endswith("_check")
    if reserved or not (name.isidentifier() and name.isascii()):
        raise VnetError(
            f"{name}: no name for a program; ASCII letters, digits and _, no keyword of Python, test_… or …_check"
        )
    found = importlib.util.find_spec(name)
    if found is not None and found.origin is not None:
        raise VnetError(f"{name}: Python has a module of this name ({found.origin}); choose another")
