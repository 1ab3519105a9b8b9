"""The channel busy ratio that programs read."""

import asyncio
from typing import Any

import pytest

from emulator.drivers.emulation import Emulation
from emulator.radio.medium import SLICE_NS, WINDOW_NS
from tests.support.multi_loop_driver import run_other_ways, run_together, scenario_of
from vnet import Node

pytestmark = pytest.mark.slow

MS = 1_000_000
RADIO: dict[str, Any] = {
    "path_loss": {"kind": "log_distance", "tx_power_dbm": 40.0},
    "mac": {},
    "bitrate_mbps": 3.0,
    "max_peers": 1000,
}
MEASURES = "tests.emulator.drivers.test_busy_feed:measures"
SLEEPS = "tests.emulator.drivers.test_busy_feed:sleeps"


async def measures(node: Node) -> None:
    """Fill the medium at an uneven pace, and report the busy ratio at uneven times, without looking for packets."""
    while True:
        node.event("read", busy=-1.0 if node.radio.busy_ratio is None else node.radio.busy_ratio)
        await node.radio.broadcast(bytes(int(node.rng.integers(100, 1400))))
        await asyncio.sleep(float(node.rng.uniform(0.001, 0.03)))


async def sleeps(node: Node) -> None:
    """Wake often without a word, and read the busy ratio at some of these quiet instants."""
    if node.id == "v01":
        await measures(node)
    while True:
        for _ in range(int(node.rng.integers(1, 9))):
            await asyncio.sleep(0.0037)
        before = node.radio.busy_ratio
        await asyncio.sleep(0.0041)
        if before != node.radio.busy_ratio:
            node.event("read", busy=node.radio.busy_ratio or 0.0)


def scenario(entry: str = MEASURES, **radio: Any) -> Any:
    run = {"duration_s": 0.7, "settle_s": 0.0, "seed": 3}
    return scenario_of([], entry, 5, run=run, radio={**RADIO, **radio}, network={"layout": "dense"})


def readings(emulation: Emulation) -> list[tuple[str, int, float]]:
    told = [event for event in emulation.folder.events if event.kind == "event"]
    return sorted((event.node or "", event.time_ns, event.details["details"]["busy"]) for event in told)


def on_air_by_the_trace(emulation: Emulation) -> list[tuple[int, int]]:
    """Times in ns in which anybody was on air, in their order and apart from each other: all hear each other."""
    rows = emulation.engine.trace.to_table().select(["on_air_ns", "left_ns"]).to_pylist()
    apart: list[tuple[int, int]] = []
    for begin_ns, end_ns in sorted(
        {(row["on_air_ns"], row["left_ns"]) for row in rows if row["on_air_ns"] is not None}
    ):
        if apart and begin_ns <= apart[-1][1]:
            apart[-1] = (apart[-1][0], max(end_ns, apart[-1][1]))
        else:
            apart.append((begin_ns, end_ns))
    return apart


def busy(on_air: list[tuple[int, int]], begin_ns: int, end_ns: int) -> float:
    """Return the share of a time that these times take."""
    taken_ns = sum(max(0, min(end, end_ns) - max(begin, begin_ns)) for begin, end in on_air)
    return taken_ns / (end_ns - begin_ns)


@pytest.mark.parametrize("latency_ms", [0.3, 2.0, 35.0])
def test_the_ratio_is_that_of_100_ms_one_lookahead_ago(latency_ms: float) -> None:
    emulation = run_together(scenario(latency_ms=latency_ms))
    read = readings(emulation)
    on_air = on_air_by_the_trace(emulation)
    assert len(read) > 25
    for _, time_ns, ratio in read:
        end_ns = max(0, (time_ns - round(latency_ms * MS)) // SLICE_NS * SLICE_NS)
        begin_ns = end_ns - WINDOW_NS
        assert ratio == pytest.approx(busy(on_air, begin_ns, end_ns), abs=1e-6), time_ns
    assert max(ratio for _, _, ratio in read) > 0.5


@pytest.mark.parametrize(
    ("entry", "latency_ms"), [(MEASURES, 0.3), (SLEEPS, 35.0)], ids=["busy programs", "quiet instants"]
)
def test_live_processes_read_what_their_simulation_does(entry: str, latency_ms: float) -> None:
    plan = scenario(entry, latency_ms=latency_ms)
    expected = readings(run_together(plan))
    assert len(expected) > 20
    assert all(readings(other) == expected for other in run_other_ways(plan))


def test_without_a_medium_there_is_nothing_to_measure() -> None:
    emulation = run_together(scenario(mac=None))
    assert {ratio for _, _, ratio in readings(emulation)} == {-1.0}
