"""Recording of what programs report: curves, maps, texts, and views for nothing else."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.emulator.test_playback import watch
from tests.emulator.viewer.test_recorder import views, write
from tests.support.recordings import Entity, read_back
from vnet import Node

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("strict")]


async def program(node: Node) -> None:
    """Report the vehicle's number, sometimes more; positions are the raw fixes."""
    number = int(node.id.removeprefix("v"))
    async for fix in node.gnss:
        await node.radio.broadcast(b"here")
        values: dict[str, Any] = {"delay_ms": 10.0 * number, "state": "late" if fix.time_ns >= 5e8 else "early"}
        if fix.time_ns >= 3e8:
            values["warned"] = number > 2
        node.report(fix.position_m, fix.covariance_m2, **values)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of a run of one second."""
    folder = tmp_path_factory.mktemp("run")
    run, network = {"duration_s": 1.0, "settle_s": 0.1}, {"vehicles": 4, "layout": "dense"}
    scenario = {"run": run, "network": network, "program": {"entry": f"{__name__}:program"}}
    write(watch(scenario, folder / "run").told, folder / "recording.rrd", "v02")
    return folder / "recording.rrd"


@pytest.fixture(scope="module")
def entities(path: Path) -> dict[str, Entity]:
    """Entities of the recording."""
    return read_back(path)


def test_a_value_is_a_curve_of_mean_band_and_vehicle(entities: dict[str, Entity]) -> None:
    delay = entities["/program/curve/delay_ms"]
    numbers = list(delay.at["Scalars:scalars"].values())
    assert len(numbers) == 10
    high, low = np.percentile([10, 20, 30, 40], [95, 5])
    assert np.allclose(numbers, [high, low, 25.0, 20.0])
    assert next(iter(entities["/program/curve/warned"].at["Scalars:scalars"])) == pytest.approx(0.3)


def test_a_text_is_a_state_of_the_vehicle(entities: dict[str, Entity]) -> None:
    assert entities["/program/texts/state"].at["StateChange:state"] == {0.0: ["early"], 0.5: ["late"]}


def test_no_view_is_laid_out_for_what_the_program_does_not_do(path: Path) -> None:
    names, origins = views(path)
    assert "Program" in names
    assert {"program/curve/delay_ms", "program/curve/warned", "program/texts", "map", "radio/frames"} <= set(
        origins
    )
    estimates = {
        "common", "position", "peers/weight", "figures/common-error", "figures/position", "figures/consensus",
    }  # fmt: skip
    assert not estimates & set(origins)
    assert not {"vehicle/position", "vehicle/common", "vehicle/errors", "radio/busy"} & set(origins)
