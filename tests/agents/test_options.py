"""Options of programs: conversion to a typed structure, and one line for everything that is not allowed."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta

from agents import averaging
from agents.cooperative.attacker import Attack
from agents.cooperative.options import Options
from agents.options import parse, refuse
from tests.support.paths import ROOT
from vnet.errors import ProgramError


class Example(msgspec.Struct, frozen=True, kw_only=True):
    """One option of each kind."""

    rule: Literal["slow", "fast"] = "slow"
    count: Annotated[int, Meta(ge=1, le=1000)] = 3
    share: Annotated[float, Meta(ge=0, le=1)] = 0.5
    period_s: Annotated[float, Meta(gt=0)] = 0.1
    loud: bool = False
    title: str = ""
    peers: list[str] = []
    corner_m: tuple[float, float] = (0.0, 0.0)
    spans: dict[str, tuple[float, float]] = {}


def test_options_that_are_not_set_have_their_defaults() -> None:
    assert parse({}, Example) == Example()
    parsed = parse({"count": 5, "share": 1, "corner_m": [1, 2], "spans": {"v1": [0, 2.5]}}, Example)
    assert parsed == Example(count=5, share=1.0, corner_m=(1.0, 2.0), spans={"v1": (0.0, 2.5)})


PROGRAMS: dict[str, Callable[[dict[str, Any]], object]] = {
    "example": lambda options: parse(options, Example, {"old": "count"}),
    "cooperative": Options.parse,
    "attacker": Attack.split,
    "averaging": averaging.Options.parse,
}


def refusal_of(program: str, options: str) -> str:
    with pytest.raises(ProgramError) as caught:
        PROGRAMS[program](tomllib.loads(options))
    assert "\n" not in str(caught.value)
    return str(caught.value).removeprefix("program.options.")


def test_what_is_not_allowed_is_refused_in_one_line(tmp_path: Path) -> None:
    golden = (ROOT / "tests" / "golden" / "options.txt").read_text(encoding="utf-8")
    given = re.findall(r"^(\w+): (.+)\n=>", golden, re.MULTILINE)
    shown = "\n".join(f"{program}: {options}\n=> {refusal_of(program, options)}\n" for program, options in given)
    (tmp_path / "options.txt").write_text(shown, encoding="utf-8")
    assert len(given) > 40 and shown == golden, f"read {tmp_path}/options.txt; if it is right, keep it"


def test_a_long_value_is_cut() -> None:
    assert len(str(refuse("title", "x" * 10_000, "less expected"))) < 200


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=5,
)


@pytest.mark.slow
@given(st.sampled_from([field.name for field in msgspec.structs.fields(Example)]), values)
def test_any_value_is_converted_or_refused_by_its_name(key: str, value: object) -> None:
    try:
        parsed = parse({key: value}, Example)
    except ProgramError as error:
        assert f"program.options.{key}" in str(error) and str(error).isprintable()
    else:
        assert parse(msgspec.to_builtins(parsed), Example) == parsed or value != value
