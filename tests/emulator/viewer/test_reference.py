"""The reference of a run that is drawn, that of the cooperative program: a filter that hears every fix."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.records.metrics import ReferenceFailedError, Setting
from emulator.report.source import Source
from emulator.viewer.scenes import DrawnReference
from tests.emulator.test_playback import watch
from vnet.node import Node
from vnet.types import Array

pytestmark = pytest.mark.slow

DECLARES = "agents.cooperative.declared"


async def say_nothing(node: Node) -> None:
    """Send and report nothing."""


def tell(folder: Path, program: str, **sections: dict[str, Any]) -> list[dict[str, Any]]:
    """The scene and the periods of a simulated run of twelve vehicles."""
    data = {
        "run": {"duration_s": 3.0},
        "network": {"vehicles": 12},
        "program": {"entry": program},
        "radio": {"range_m": 1e5},
        **sections,
    }
    return [message for stream, message in watch(data, folder).told if stream != "end"]


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    return tell(tmp_path_factory.mktemp("bound") / "run", "agents.cooperative:main")


def steps(told: list[dict[str, Any]]) -> list[float | None]:
    reference = DrawnReference(told[0])
    return [reference.step(period).get("common_error_rmse_m") for period in told[1:]]


def late(values: list[float | None]) -> float:
    return float(np.mean([value for value in values[-10:] if value is not None]))


def test_it_finds_the_common_error_as_well_as_cooperation_does(told: list[dict[str, Any]]) -> None:
    rmse = late([period["figures"]["common_error_rmse_m"] for period in told[1:]])
    assert late(steps(told)) < 1.3 * rmse
    assert late(steps(told)) < 0.3 * late([period["figures"]["fix_rmse_m"] for period in told[1:]])


def test_it_says_nothing_where_nobody_speaks_of_a_common_error(tmp_path: Path) -> None:
    told = tell(tmp_path / "run", f"{__name__}:say_nothing", run={"duration_s": 0.5})
    assert steps(told) == [None] * 5


def test_each_component_has_a_filter_of_its_own(told: list[dict[str, Any]]) -> None:
    apart = {**told[0], "component": np.array([0] * 6 + [1] * 6, dtype="<i2").tobytes()}
    together, separate = steps(told), steps([apart, *told[1:]])
    assert together != separate
    assert late(separate) < 2.0


class Reference:
    """A reference without errors."""

    NAME, TEXT, COLUMNS = "oracle", "what is known", ("fix_m",)

    def __init__(self, setting: Setting) -> None:
        self.figure: Any = 1.0

    def step(self, time_ns: int, states: Mapping[str, Array]) -> Mapping[str, Any]:
        return {"position_rmse_m": self.figure}


class Raising(Reference):
    def step(self, time_ns: int, states: Mapping[str, Array]) -> Mapping[str, Any]:
        return {"position_rmse_m": 1 / 0}


class Leaving(Reference):
    def __init__(self, setting: Setting) -> None:
        sys.exit(0)


class Wordy(Reference):
    def step(self, time_ns: int, states: Mapping[str, Array]) -> Mapping[str, Any]:
        return {"position_rmse_m": "small"}


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        (Raising, "ZeroDivisionError: division"),
        (Leaving, "SystemExit: 0"),
        (Wordy, "ValueError: could not"),
    ],
)
def test_a_reference_that_fails_is_named_and_the_run_is_drawn_and_reported(
    kind: type[Reference], says: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    declares = {"REFERENCE": [f"{__name__}:{kind.__name__}"]}
    monkeypatch.setattr("emulator.records.metrics.declared", lambda program, name: declares.get(name, []))
    messages = tell(tmp_path / "run", f"{__name__}:say_nothing", run={"duration_s": 0.5})
    with pytest.raises(ReferenceFailedError, match=rf"REFERENCE .*{kind.__name__} raises {says}"):
        DrawnReference(messages[0]).step(messages[1])
    with pytest.raises(ReferenceFailedError):
        Source(tmp_path / "run").reference_series  # noqa: B018


class WithoutFixes(Reference):
    COLUMNS = ("position_m",)


def test_a_reference_need_not_look_at_fixes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    declares = {"REFERENCE": [f"{__name__}:{WithoutFixes.__name__}"]}
    monkeypatch.setattr("emulator.records.metrics.declared", lambda program, name: declares.get(name, []))
    messages = tell(tmp_path / "run", f"{__name__}:say_nothing", run={"duration_s": 0.5})
    assert DrawnReference(messages[0]).step(messages[1]) == {"position_rmse_m": 1.0}
