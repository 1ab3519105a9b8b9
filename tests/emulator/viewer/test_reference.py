"""The reference of a run that is drawn, that of the cooperative program: a filter that hears every fix."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.viewer.scenes import DrawnReference
from tests.emulator.test_playback import watch
from vnet.node import Node

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
