"""docs/reference/scenario.md: every section and key of a scenario, and the options of programs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import get_args

from pydantic import BaseModel

from agents.cooperative.options import Options
from docs.generate.keys import HEADER, key_docstrings, key_rows, option_table, subsections
from docs.generate.markdown import docstring, sentence, table
from docs.generate.markdown import page as whole_page
from emulator.scenario.program import ProgramException, RoadsideUnit
from emulator.scenario.scenario import OwnSensor, Scenario

INTRODUCTION = """
A scenario is a TOML file. Every key has a default, so an empty file is a run; an unknown key is refused.
`--set SECTION.KEY=VALUE` changes one key on the command line. Each run writes all keys into its own
`scenario.toml`, with digests of its inputs and code ([`[inputs]` and `[code]`](files.md#scenariotoml)).
[scenarios/](../../scenarios/twelve.toml) has examples. A row in bold begins a section below the chapter's own;
the rows after it are its keys. `[[fault]]` has a page of its own: [faults.md](faults.md).
"""
NOT_KEYS = ("exceptions", "sensor")
"""Keys that are arrays or tables of sections."""
OPTIONS = """
Options of `agents.cooperative:main` and `agents.centralized:main`; [estimator.md](../estimator.md) explains them.
Other programs have options of their own, in `node.options`.
"""


def page() -> str:
    """The whole page: a chapter for each top section, in whose table the sections below it follow its keys."""
    parts = [part for name, kinds in subsections(Scenario).items() for part in _chapter(name, kinds[0])]
    return whole_page("The scenario file", INTRODUCTION, *parts, *_arrays(), *_options())


def _chapter(name: str, model: type[BaseModel]) -> Iterator[str]:
    yield f"## `[{name}]`"
    yield _about(model)
    yield table(HEADER, [*key_rows(model, without=NOT_KEYS), *_below(name, model)])


def _about(model: type[BaseModel]) -> str:
    return sentence(docstring(model).partition("`: ")[2])


def _below(path: str, model: type[BaseModel]) -> Iterator[list[str]]:
    """Rows of all sections below `path`: one that names the section or its kind, then its keys."""
    for name, kinds in subsections(model).items():
        below = f"{path}.{name}"
        if len(kinds) == 1:
            yield from _rows(f"[{below}]", _about(kinds[0]), kinds[0], NOT_KEYS)
            yield from _below(below, kinds[0])
        else:
            yield _title(f"[{below}]", key_docstrings(model).get(name, ""))
            for kind in kinds:
                (value,) = get_args(kind.model_fields["kind"].annotation)
                yield from _rows(f'kind = "{value}"', docstring(kind), kind, ("kind",))
    if path == "world":
        yield from _rows("[world.sensor.NAME]", _about(OwnSensor), OwnSensor, ())
    if path == "program":
        yield from _rows("[[program.exceptions]]", _about(ProgramException), ProgramException, NOT_KEYS)


def _rows(title: str, about: str, model: type[BaseModel], without: tuple[str, ...]) -> list[list[str]]:
    return [_title(title, about), *key_rows(model, without)]


def _title(title: str, about: str) -> list[str]:
    return [f"**`{title}`**", "", "", "", "", about]


def _arrays() -> Iterator[str]:
    yield "## `[[roadside]]`"
    yield _about(RoadsideUnit)
    yield table(HEADER, key_rows(RoadsideUnit))


def _options() -> Iterator[str]:
    yield "## `[program.options]` of the cooperative programs"
    yield OPTIONS
    yield option_table(Options)
