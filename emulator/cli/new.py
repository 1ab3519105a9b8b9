"""`vnet new`: a folder with a scenario, a program, a check and a test to begin with."""

from __future__ import annotations

import importlib.util
import keyword
import shlex
from pathlib import Path
from typing import Annotated

import typer

from emulator.terminal.console import one_line_errors
from vnet.errors import VnetError

_TEMPLATES = Path(__file__).parent / "templates"


def new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The new folder, and the program in it.")],
) -> None:
    """Write a folder to begin with: a scenario, its program, a check of what it promises, and a test.

    NAME becomes a module of Python's: letters, digits and _.
    """
    with one_line_errors():
        folder = Path(name)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise VnetError(f"{folder}: exists and is not an empty folder")
        _check_name(folder.name)
        write_project(folder)
        print(f"{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")
        print(f"next: cd {shlex.quote(str(folder))} && vnet simulate {folder.name}.toml")


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
