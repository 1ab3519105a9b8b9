"""Options of programs: conversion to a typed structure, and one line for everything that is not allowed."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import Meta

from agents.options import parse, refuse
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rule": "quick"}, "rule = 'quick': one of slow, fast expected"),
        ({"rule": "fats"}, "rule = 'fats': one of slow, fast expected (did you mean fast?)"),
        ({"rule": 3}, "rule = 3: one of slow, fast expected"),
        ({"count": 0}, "count = 0: a whole number from 1 to 1000 expected"),
        ({"count": 1.5}, "count = 1.5: a whole number from 1 to 1000 expected"),
        ({"count": True}, "count = True: a whole number from 1 to 1000 expected"),
        ({"share": 1.5}, "share = 1.5: a number from 0 to 1 expected"),
        ({"share": "half"}, "share = 'half': a number from 0 to 1 expected"),
        ({"share": float("nan")}, "share = nan: a number from 0 to 1 expected"),
        ({"period_s": 0}, "period_s = 0: a number above 0 expected"),
        ({"loud": 1}, "loud = 1: true or false expected"),
        ({"title": 1}, "title = 1: text expected"),
        ({"peers": "v1"}, "peers = 'v1': a list (each text) expected"),
        ({"peers": ["v1", 2]}, "peers = ['v1', 2]: a list (each text) expected"),
        ({"corner_m": [1.0]}, "corner_m = [1.0]: a list of 2 (each a number) expected"),
        ({"spans": [1]}, "spans = [1]: a table (each a list of 2 (each a number)) expected"),
        ({"spans": {"v1": [0, 1], "v2": 7}}, "spans.v2 = 7: a list of 2 (each a number) expected"),
        ({"cuont": 3}, "cuont: unknown (did you mean count?); allowed: corner_m, count, loud, peers, period_s"),
        ({"old": 3}, "old: renamed; use count"),
    ],
)
def test_what_is_not_allowed_is_refused_in_one_line(options: dict[str, object], message: str) -> None:
    with pytest.raises(ProgramError) as caught:
        parse(options, Example, {"old": "count"})
    assert str(caught.value).startswith(f"program.options.{message}")
    assert "\n" not in str(caught.value)


def test_a_long_value_is_cut() -> None:
    assert len(str(refuse("title", "x" * 10_000, "less expected"))) < 200


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=5,
)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(st.sampled_from([field.name for field in msgspec.structs.fields(Example)]), values)
def test_any_value_is_converted_or_refused_by_its_name(key: str, value: object) -> None:
    try:
        parsed = parse({key: value}, Example)
    except ProgramError as error:
        assert f"program.options.{key}" in str(error) and str(error).isprintable()
    else:
        assert parse(msgspec.to_builtins(parsed), Example) == parsed or value != value
