"""docs/reference/scenario.md: every section and key of a scenario, and the options of programs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import get_args

from pydantic import BaseModel

from agents.cooperative.options import Options
from docs.generate.keys import key_docstrings, key_table, option_table, subsections
from docs.generate.markdown import docstring, sentence
from docs.generate.markdown import page as whole_page
from emulator.scenario.program import ProgramException, RoadsideUnit
from emulator.scenario.scenario import Scenario
from emulator.scenario.world import OwnSensor

INTRODUCTION = """
A scenario is a TOML file. Every key has a default, so that an empty file is a run; a key that does not exist is
refused. `--set SECTION.KEY=VALUE` changes one key at the command line, and each run writes all of them, defaults
included, into its own `scenario.toml`, with [`[inputs]` and `[code]`](files.md#scenariotoml) besides: digests of
the files that it read and of its code, so that a change is noticed. [scenarios/](../../scenarios/twelve.toml) has
examples.
"""
OPTIONS = """
What `agents.cooperative:main` and `agents.centralized:main` take; [estimator.md](../estimator.md) explains what
they do. Other programs have options of their own, in `node.options`.
"""


def page() -> str:
    """The whole page."""
    return whole_page("The scenario file", INTRODUCTION, *_sections("", Scenario), *_options())


def _sections(path: str, model: type[BaseModel]) -> Iterator[str]:
    """The section at `path` and all below it."""
    if path:
        yield from _section(f"[{path}]", model, without=("exceptions", "sensor"))
    for name, kinds in subsections(model).items():
        below = f"{path}.{name}" if path else name
        if len(kinds) == 1:
            yield from _sections(below, kinds[0])
        else:
            yield from _choice(below, key_docstrings(model).get(name, ""), kinds)
    if path == "world":
        yield from _section("[world.sensor.NAME]", OwnSensor)
    if path == "program":
        yield from _section("[[program.exceptions]]", ProgramException)
    if not path:
        yield from _section("[[roadside]]", RoadsideUnit)
        yield "## `[[fault]]`"
        yield "What breaks, where, from when and for how long: [faults.md](faults.md)."


def _section(heading: str, model: type[BaseModel], without: tuple[str, ...] = ()) -> Iterator[str]:
    yield f"## `{heading}`"
    yield sentence(docstring(model).partition("`: ")[2])
    yield key_table(model, without)


def _choice(path: str, said: str, kinds: list[type[BaseModel]]) -> Iterator[str]:
    """A section that is of one of several kinds."""
    yield f"## `[{path}]`"
    yield said
    for kind in kinds:
        (name,) = get_args(kind.model_fields["kind"].annotation)
        yield f'### `kind = "{name}"`'
        yield docstring(kind)
        yield key_table(kind, without=("kind",))


def _options() -> Iterator[str]:
    yield "## `[program.options]` of the cooperative programs"
    yield OPTIONS
    yield option_table(Options)
