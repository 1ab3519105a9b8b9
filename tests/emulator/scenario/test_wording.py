"""Whatever is wrong with a scenario is said in vnet's words: the key, its value and what is allowed."""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel, ValidationError

from emulator.scenario.faults import KINDS
from emulator.scenario.loading import load_scenario
from emulator.scenario.scenario import Scenario
from emulator.scenario.sections import first_problem
from tests.support.paths import ROOT
from vnet.errors import ScenarioError

pytestmark = pytest.mark.slow

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


def said_of(text: str, folder: Path) -> str:
    """Return what is wrong with a scenario of this text."""
    path = folder / "s.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    said = str(caught.value).removeprefix(f"{path}: ").replace(str(folder), "FOLDER")
    assert said != str(caught.value) and "\n" not in said
    return said


def test_messages_are_those_that_were_read(tmp_path: Path) -> None:
    """Each names the key, its value, and what is allowed."""
    golden = (ROOT / "tests" / "golden" / "messages.txt").read_text(encoding="utf-8")
    texts = re.findall(r"(.+?)\n=> [^\n]+\n\n?", golden, re.DOTALL)
    assert len(texts) > 100
    shown = "\n".join(f"{text}\n=> {said_of(text, tmp_path)}\n" for text in texts)
    (tmp_path / "messages.txt").write_text(shown, encoding="utf-8")
    assert shown == golden, f"read {tmp_path}/messages.txt; if it is right, keep it"
