"""Charts and maps of what programs report, from a run's folder."""

import pytest

from emulator.drivers.conclude import conclude
from emulator.drivers.emulation import Emulation
from emulator.drivers.simulate import simulate
from emulator.records.run_folder import RunFolder
from emulator.report.drawing import draw_charts
from emulator.report.map_figures import map_charts
from emulator.report.program_figures import program_charts
from emulator.report.source import Source
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world
from vnet import Node


async def talkative(node: Node) -> None:
    """Report a value of each kind, some of them only now and then."""
    number = int(node.id.removeprefix("v"))
    async for fix in node.gnss:
        await node.radio.broadcast(b"here")
        seconds = fix.time_ns / 1e9
        figures = {"load_percent": 10.0 * number, "debt": -seconds, "same": 1}
        if number > 1:
            figures["late"] = seconds
        node.report(**figures, warned=seconds > 0.5, state="busy" if seconds > 0.5 else "idle")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Source:
    """A run of one second."""
    folder = tmp_path_factory.mktemp("run") / "run"
    scenario = Scenario.model_validate(
        {
            "run": {"duration_s": 1.0, "settle_s": 0.1},
            "network": {"vehicles": 4, "layout": "dense"},
            "program": {"entry": f"{__name__}:talkative"},
        }
    )
    emulation = Emulation(scenario, build_world(scenario), RunFolder.create(folder, scenario))
    conclude(emulation, simulate(emulation)[0], "simulate")
    return Source(folder)


def test_each_value_has_a_chart(source: Source) -> None:
    charts, missing = draw_charts(program_charts(source))
    found = {chart.title: chart for chart in charts}
    assert missing == {}
    assert set(found) == {"load", "debt", "same", "late", "warned", "state"}
    assert "load (%)" in found["load"].svg and "5 to 95 %" in found["load"].caption
    assert "warned (%)" in found["warned"].svg and "say true" in found["warned"].caption
    assert "busy" in found["state"].svg and "idle" in found["state"].svg
    assert "v02" in found["late"].svg, "v01 never reports it"


def test_vehicles_are_coloured_by_values_that_differ(source: Source) -> None:
    charts, _ = draw_charts(map_charts(source))
    found = {chart.title: chart for chart in charts}
    assert set(found) == {"Map", "Map: load"}, "all others end with one value for all vehicles"
    assert "v04" in found["Map"].svg and "links that delivered frames" in found["Map"].caption
    assert "10 – 16" in found["Map: load"].svg and "34 – 40" in found["Map: load"].svg


def test_shares_of_texts_are_those_of_the_vehicles_that_report(source: Source) -> None:
    shares, texts = source.text_shares("state")
    assert texts == ["idle", "busy"]
    assert shares.tolist() == [[1.0, 0.0]] * 6 + [[0.0, 1.0]] * 4
