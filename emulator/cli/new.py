"""`vnet new`: a folder to begin with: a scenario, a program, a check and a test; or a copy of an example."""

from __future__ import annotations

import importlib.util
import keyword
import shlex
from pathlib import Path
from typing import Annotated

import typer

from emulator.cli.docs import EXAMPLES
from emulator.records.atomic import check_is_free
from emulator.terminal.console import one_line_errors
from vnet.errors import VnetError, did_you_mean, printable

_TEMPLATES = Path(__file__).parent / "templates"


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

    NAME becomes a module of Python's: letters, digits and _. With --example it is a copy of an example, which a
    page of the documentation explains.
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
        raise VnetError(f"{name}: no name for a program; letters, digits and _, and neither test_… nor …_check")
    found = importlib.util.find_spec(name)
    if found is not None and found.origin is not None:
        raise VnetError(f"{name}: Python has a module of this name ({found.origin}); choose another")
