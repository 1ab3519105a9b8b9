"""The scenario of a call from Python: its sources, its changes, and what is wrong with either in one line."""

from datetime import date
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import pytest

from emulator.scenario.loading import as_overrides, parse_values, scenario_of, wrong_value
from tests.support.paths import ROOT
from vnet.errors import OverrideError, ScenarioError


def test_a_path_a_name_data_and_a_scenario_are_sources() -> None:
    path = ROOT / "scenarios" / "twelve.toml"
    loaded = scenario_of("twelve", {"radio.loss": 0.3})
    assert loaded == scenario_of(path, {"radio.loss": 0.3}) == scenario_of(str(path), {"radio.loss": 0.3})
    assert loaded.radio.loss == 0.3
    assert scenario_of(loaded, {"run.seed": 9}).run.seed == 9
    data: dict[str, Any] = {"run": {"name": "mine"}}
    assert scenario_of(data, {"run.seed": 4, "run.duration_s": None}).run.seed == 4
    assert data == {"run": {"name": "mine"}}, "what the caller gave stays as it was"


@pytest.mark.parametrize("jitter_ms", [None, 0.0, 1.0, 1.5])
def test_what_was_given_stays_also_if_it_is_the_default_of_others(jitter_ms: float | None) -> None:
    """Zenoh programs have no jitter by default, others 1 ms."""
    radio = {} if jitter_ms is None else {"jitter_ms": jitter_ms}
    program = {"kind": "zenoh", "command": ["python", "-m", "x"]}
    given = scenario_of({"program": program, "radio": radio}, {})
    assert given.radio.jitter_ms == scenario_of(given, {"run.seed": 2}).radio.jitter_ms == (jitter_ms or 0.0)
    other = scenario_of({"radio": radio}, {})
    assert other.radio.jitter_ms == (1.0 if jitter_ms is None else jitter_ms)
    to_zenoh = {f"program.{key}": value for key, value in program.items()}
    assert scenario_of(other, to_zenoh).radio.jitter_ms == (jitter_ms or 0.0)


def test_a_resolved_scenario_may_have_another_kind_of_radio() -> None:
    """It has all keys of its own kind, which another kind does not have."""
    whole = scenario_of(
        scenario_of({"radio": {"mac": {"kind": "lte-mode4"}}}, {}).model_dump(mode="json", exclude_none=True), {}
    )
    other = scenario_of(whole, {"radio.mac.kind": "80211p"})
    assert other.radio.sidelink is None and other.radio.mac is not None


def test_values_of_all_kinds_reach_the_scenario() -> None:
    options = {"a b": [1, True, 'x"y\nz'], "none": {}, "path": Path("a/b"), "ratio": np.float32(0.5)}
    found = scenario_of({}, {"program.options": options, "network.vehicles": np.int64(7)})
    assert found.program.options == {"a b": [1, True, 'x"y\nz'], "none": {}, "path": "a/b", "ratio": 0.5}
    assert found.network.vehicles == 7


@pytest.mark.parametrize(
    ("source", "changes", "message"),
    [
        ("twelve", {"radio.los": 1}, r"radio\.los: unknown key \(did you mean loss\?\)"),
        ({}, {"radio.loss": 2}, r"^radio\.loss = 2: must be"),
        ({}, {"radio.loss": float("nan")}, r"^radio\.loss = nan: a finite number is needed"),
        (
            {},
            {"radio.loss": object()},
            r"^radio\.loss = <object .*>: a number, a boolean, a text, a list or a table",
        ),
        (
            {"run": {"seed": np.int64(4)}},
            {},
            r"^scenario: run\.seed = np\.int64\(4\): a number, a boolean, a text, a",
        ),
        (
            {"run": {"name": date(2026, 1, 1)}},
            {},
            r"run\.name = .*: dates and times are written as text, in quotes",
        ),
        ({}, {"network.vehicles=2\nrun.seed": 3}, r"network\.vehicles = '2\\nrun\.seed=3': a whole number is"),
        ({}, {"loss": 1}, r"--set loss=1: write it as section\.key=value"),
        (3, {}, r"^scenario = 3: a path, a shipped scenario's name, or a dict is needed"),
        ({"network": {"kind": "file", "path": "no.csv"}}, {}, r"network\.path = 'no\.csv': no such file"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(source: Any, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message) as raised:
        scenario_of(source, changes)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("0,0.1,0.3", [0, 0.1, 0.3]),
        ("urban,dense", ["urban", "dense"]),
        ("urban, 3", ["urban", 3]),
        ('"a,b",c', ['"a', 'b"', "c"]),
        ('"a,b","c"', ["a,b", "c"]),
        ("[1,2],[3]", [[1, 2], [3]]),
        ("true", [True]),
    ],
)
def test_values_of_a_list_are_toml_or_bare_words(text: str, values: list[Any]) -> None:
    assert parse_values("key", text) == values


def test_overrides_are_one_line_each() -> None:
    assert as_overrides({"run.name": "ü\n", "radio.loss": 1}) == ['run.name="ü\\n"', "radio.loss=1"]


def test_of_several_overrides_of_a_section_none_is_blamed_for_what_all_make() -> None:
    problem, path = "run: tape goes with order", PurePath("s.toml")
    both = ["run.order=shuffle", "run.tape=t"]
    assert str(wrong_value(path, problem, both)) == f"s.toml: {problem}"
    assert isinstance(wrong_value(path, problem, both[1:]), OverrideError)
    assert isinstance(wrong_value(path, "run.tape = 3: a path", both), OverrideError)
    of_one = wrong_value(
        path, "radio.mac: reservation_ms = 150: 100 or 200", ["radio.mac.kind=a", "radio.mac.reservation_ms=150"]
    )
    assert isinstance(of_one, OverrideError) and of_one.key == "radio.mac.reservation_ms"
    of_list = wrong_value(path, "radio.mac: bler.2 = 5: less", ["radio.mac.kind=a", "radio.mac.bler=[1, 5]"])
    assert isinstance(of_list, OverrideError) and of_list.key == "radio.mac.bler"
