"""Whatever is wrong with a scenario is said in vnet's words: the key, its value and what is allowed."""

import math
import re
from collections.abc import Iterator
from typing import Any, get_args

import pytest
from pydantic import BaseModel, ValidationError

from emulator.scenario.faults import KINDS
from emulator.scenario.scenario import Scenario
from emulator.scenario.sections import first_problem

WRONG: tuple[Any, ...] = (
    *(None, True, -1, 1.5, math.inf, math.nan, 10**30, "text", "", b"bytes", [], {}, [1], [[1, 2]], ["a", 5]),
    *({"a": 1}, [{}], {"kind": 5}, {"kind": "kill"}, ["x"] * 2000, "x" * 5000, object()),
)
"""Values of which each key refuses some."""
PYDANTIC = re.compile(
    r"[Ii]nput should|[Ff]ield required|\bvalid (integer|number|string|dict|list|tuple|boolean|path)|instance of|"
    r"class '|unable to|\berror\b|string should|should have|pydantic|discriminat|\btag\b|dictionary"
)
"""Words of pydantic's."""


def keys(model: type[BaseModel], path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yield the paths of all keys of a scenario, those of sections within sections included."""
    for name, field in model.model_fields.items():
        yield (*path, name)
        for part in (field.annotation, *get_args(field.annotation)):
            if isinstance(part, type) and issubclass(part, BaseModel):
                yield from keys(part, (*path, name))


def problem(data: object) -> str:
    """Return what is said of a scenario; "" if nothing is wrong."""
    try:
        Scenario.model_validate(data)
    except ValidationError as error:
        return first_problem(error, Scenario)
    return ""


def nested(path: tuple[str, ...], value: object) -> Any:
    for key in reversed(path):
        value = {key: value}
    return value


def all_problems() -> Iterator[str]:
    for path in keys(Scenario):
        yield from (problem(nested(path, value)) for value in WRONG)
    for kind, model in KINDS.items():
        base = {"kind": kind, "at_s": 0.0, "duration_s": 1.0}
        for key in model.model_fields:
            yield from (problem({"fault": [{**base, key: value}]}) for value in WRONG)
        yield problem({"fault": [{"kind": kind}]})


def test_no_word_of_pydantic_s_is_shown() -> None:
    said = {text for text in all_problems() if text}
    assert len(said) > 500
    assert [text for text in said if PYDANTIC.search(text)] == []
    assert [text for text in said if not text.isprintable() or len(text) > 1000] == []


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({"run": {"seed": "one"}}, "run.seed = 'one': a whole number is needed"),
        ({"run": {"seed": 1.5}}, "run.seed = 1.5: a whole number is needed"),
        ({"run": {"duration_s": [1]}}, "run.duration_s = [1]: a number is needed"),
        ({"run": {"pacing": "realtme"}}, "must be 'lockstep' or 'realtime' (did you mean realtime?)"),
        ({"radio": {"loss": 2}}, "radio.loss = 2: must be less than or equal to 1"),
        ({"run": 5}, "run = 5: a table is needed"),
        ({"program": {"checks": "a"}}, "program.checks = 'a': a list is needed"),
        ({"network": {"kind": "file", "path": 5}}, "network.path = 5: a path is needed"),
        ({"fault": [{"kind": "kill"}]}, "fault.0.kill.duration_s: is missing"),
        ({"fault": 5}, "fault = 5: a list is needed"),
        ({"fault": [{"kind": "kill", "at_s": 1, "nodes": {"ids": 5}}]}, "is missing"),
    ],
)
def test_the_key_its_value_and_what_is_allowed_are_said(data: dict[str, Any], said: str) -> None:
    assert said in problem(data)
