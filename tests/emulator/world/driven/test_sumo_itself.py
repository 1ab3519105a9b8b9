"""SUMO itself, stepped with the run, where the extra `sumo` is installed: on the documentation's example."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import emulator
from emulator.records.recorded_run import RecordedRun
from emulator.scenario.loading import load_scenario
from emulator.world.driven.sumo import SumoWorld
from emulator.world.world import build_world
from tests.support.paths import ROOT
from vnet import Node
from vnet.errors import VnetError
from vnet.types import Array

EXAMPLE = ROOT / "docs" / "examples" / "sumo_loop"
HAS_LIBSUMO = importlib.util.find_spec("libsumo") is not None
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not HAS_LIBSUMO, reason="libsumo is not installed (extra sumo)")]
NOISELESS = {"world.ranging.sigma_m": 0.0, "world.ranging.rate_sigma_mps": 0.0, "world.gnss.speed_sigma_mps": 0.0}


def simulated(out: Path, program: Any = None, **changes: Any) -> emulator.Run:
    changes = NOISELESS | {name.replace("__", "."): value for name, value in changes.items()}
    return emulator.simulate(EXAMPLE / "street.toml", program=program, set=changes, duration_s=25.0, out=out)


def column(run: emulator.Run, name: str) -> dict[str, Array]:
    assert run.driven is not None
    nodes = list(dict.fromkeys(run.driven["node"].to_pylist()))  # without units beside the road
    return dict(zip(nodes, np.array(run.driven[name]).reshape(-1, len(nodes)).T, strict=True))


def test_vehicles_do_what_programs_say_and_the_others_react(tmp_path: Path) -> None:
    """The first stops: the second, which SUMO drives, stops behind it and another, and all go on again."""
    gaps: list[tuple[float, float | None]] = []

    async def main(node: Node) -> None:
        async for fix in node.gnss:
            time_s = fix.time_ns / 1e9
            await node.radio.broadcast(b"here")
            if node.id == "second":
                gaps.append((time_s, fix.gap_m))
            elif 6.0 <= time_s < 16.0:
                node.drive(-4.0)
            else:
                node.drive(release=True)

    run = simulated(tmp_path / "run", main)
    speed, along_m, told = (column(run, name) for name in ("speed_m_s", "along_m", "command_m_s2"))
    assert_allclose(np.diff(speed["first"][60:80]), -0.4, atol=1e-9)
    assert speed["first"][120:160].max() == 0.0 and speed["first"][-1] > 5.0
    assert speed["second"][150:160].max() < 1.0, "it comes to a stop"
    assert np.isnan(told["second"]).all()
    assert run.driving["collisions"] == 0
    standing_m = [gap for time_s, gap in gaps if 14.0 <= time_s < 16.0 and gap is not None]
    assert 2.0 < min(standing_m) < 4.0, "behind the one ahead, whoever that is"
    assert along_m["first"][-1] > 120.0
    position_m = RecordedRun.open(tmp_path / "run").vectors("position_m")[:, 0]
    assert_allclose(position_m[0], [5.1 - 2.5, 195.2], atol=0.2)


def test_a_run_is_the_same_again_and_has_its_lights(tmp_path: Path) -> None:
    """In new processes of SUMO; the traffic lights have the phases of the network."""
    first, again = (simulated(tmp_path / name) for name in ("run", "again"))
    assert first.trace.equals(again.trace)
    assert_array_equal(column(first, "speed_m_s")["first"], column(again, "speed_m_s")["first"])
    other = simulated(tmp_path / "other", network__seed=2)
    assert (column(first, "speed_m_s")["first"] != column(other, "speed_m_s")["first"]).any()
    world = build_world(load_scenario(EXAMPLE / "street.toml"))
    assert isinstance(world, SumoWorld)
    for _ in range(110):
        world.advance()
    lights = [world.traffic_lights(period)["light"] for period in range(0, 111, 10)]
    assert lights == ["rGG"] * 8 + ["ryy"] * 2 + ["Grr"] * 2
    assert world.versions["sumo"].startswith("SUMO ")
    assert len(world.lane_map.point_m) > 4, "[map] reads the same network"


def test_who_does_not_look_ahead_collides_and_lanes_are_changed_when_asked_for(tmp_path: Path) -> None:
    async def main(node: Node) -> None:
        async for fix in node.gnss:
            await node.radio.broadcast(b"here")
            node.drive(0.5 if node.id == "second" else -1.0, lane=int(fix.time_ns == 2_000_000_000))

    run = simulated(tmp_path / "run", main)
    collisions = [(event.node, event.details["with"]) for event in run.events if event.kind == "collision"]
    assert ("second", "human-23-1") in collisions
    assert len(collisions) == len(set(collisions)), "each pair once"
    left_m = RecordedRun.open(tmp_path / "run").vectors("position_m")[:, 0, 1]
    assert left_m[0] == pytest.approx(195.2, abs=0.1) and np.nanmax(left_m) == pytest.approx(198.4, abs=0.1)


def test_an_error_of_sumo_is_one_line(tmp_path: Path) -> None:
    for name in ("street.sumocfg", "street.net.xml"):
        (tmp_path / name).write_text((EXAMPLE / name).read_text())
    (tmp_path / "street.rou.xml").write_text("<routes><vehicle id='a' depart='0' route='none'/></routes>")
    with pytest.raises(VnetError, match=r"street\.sumocfg: SUMO: The route 'none'") as caught:
        simulated(tmp_path / "run", network__path=str(tmp_path / "street.sumocfg"))
    assert "\n" not in str(caught.value)
