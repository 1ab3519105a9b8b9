"""Programs that send frames to single vehicles: what they are told is the same live and simulated."""

import asyncio
import contextlib
import gc
from typing import Any

import pytest

from emulator.drivers.emulation import Emulation
from tests.support.multi_loop_driver import run_apart, run_other_ways, run_together, scenario_of
from vnet import Node

pytestmark = pytest.mark.slow

RADIO: dict[str, Any] = {
    "path_loss": {"kind": "log_distance"},
    "fading": {},
    "mac": {},
    "max_peers": 1000,
    "access_jitter_ms": 1.0,
}
SENDS = "tests.emulator.drivers.test_sending:sends"
FORGETS = "tests.emulator.drivers.test_sending:forgets"
ASKS = "tests.emulator.drivers.test_sending:asks"
GIVES_UP = "tests.emulator.drivers.test_sending:gives_up"
SAYS_GOODBYE = "tests.emulator.drivers.test_sending:says_goodbye"
ASKS_NOBODY = "tests.emulator.drivers.test_sending:asks_nobody"


async def sends(node: Node) -> None:
    """Send to the others in turn, sleep or listen in between, and tell each result when it comes."""
    others = [f"v{number:02d}" for number in range(1, 6) if f"v{number:02d}" != node.id]
    for turn in range(40):
        to = others[turn % len(others)]
        result = await node.radio.send(to, bytes(int(node.rng.integers(50, 900))))
        node.event("result", to=to, delivered=result.delivered, attempts=result.attempts)
        if node.rng.random() < 0.3:
            node.event("heard", count=len(node.radio.drain()))
        if node.rng.random() < 0.5:
            await asyncio.sleep(float(node.rng.uniform(0, 0.01)))
    async for packet in node.radio:
        node.event("received", sender=packet.sender)


async def forgets(node: Node) -> None:
    """Cancel sends early or late, and go on with others; v01 ends in the midst of one."""
    to = "v02" if node.id != "v02" else "v03"
    for turn in range(30):
        task = asyncio.create_task(node.radio.send(to, bytes(400)))
        await asyncio.sleep(float(node.rng.uniform(0, 0.006)))
        task.cancel()
        if turn == 15 and node.id == "v01":
            return
        node.event("turn", done=task.done(), waits=node.radio.is_sending)


async def gives_up(node: Node) -> None:
    """v01 gives up soon, then only sleeps; v02 ends in the midst of a send."""
    if node.id == "v01":
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(node.radio.send("v03", bytes(400)), 0.0005)
        node.event("gave up")
        await asyncio.sleep(0.1)
        node.event("slept")
    elif node.id == "v02":
        task = asyncio.create_task(node.radio.send("v03", bytes(400)))
        await asyncio.sleep(0.0005)
        task.cancel()
        return
    async for _ in node.gnss:
        pass


async def says_goodbye(node: Node) -> None:
    """Send once more when the run is over."""
    try:
        async for _ in node.radio:
            pass
    finally:
        await node.radio.send("v02" if node.id != "v02" else "v01", b"bye")


async def asks_nobody(node: Node) -> None:
    """Send to a name that no vehicle has."""
    result = await node.radio.send("v99", b"x")
    node.event("result", delivered=result.delivered, attempts=result.attempts)


async def asks(node: Node) -> None:
    """v01 sends one frame, and is still there after 0.3 s."""
    if node.id == "v01":
        await node.radio.send("v02", b"x")
        node.event("result")
        await asyncio.sleep(0.3 - node.now_ns / 1e9)
        node.event("later")


def scenario(entry: str = SENDS, faults: list[Any] | None = None, **radio: Any) -> Any:
    run = {"duration_s": 0.4, "settle_s": 0.0, "seed": 3}
    return scenario_of(faults or [], entry, 5, run=run, radio={**RADIO, **radio}, network={"layout": "dense"})


def told(emulation: Emulation) -> list[tuple[str, int, str]]:
    events = [event for event in emulation.folder.events if event.kind == "event"]
    return sorted((event.node or "", event.time_ns, str(event.details)) for event in events)


@pytest.mark.parametrize(("entry", "latency_ms"), [(SENDS, 2.0), (FORGETS, 0.05)], ids=["awaits", "forgets"])
def test_live_processes_are_told_what_their_simulation_is(entry: str, latency_ms: float) -> None:
    plan = scenario(entry, latency_ms=latency_ms, loss=0.3)
    together = run_together(plan)
    expected = told(together)
    assert len(expected) > 60
    for other in run_other_ways(plan):
        assert told(other) == expected
        assert other.engine.trace.sha256() == together.engine.trace.sha256()


@pytest.mark.parametrize("nodes_per_process", [1, 2])
def test_a_live_process_that_gives_up_a_send_goes_on(nodes_per_process: int) -> None:
    """Its result is an instant of the process all the same, for which it has to be granted."""
    plan = scenario(GIVES_UP)
    plan = plan.model_copy(update={"run": plan.run.model_copy(update={"nodes_per_process": nodes_per_process})})
    expected = told(run_together(plan))
    assert [time_ns for _, time_ns, _ in expected] == [500_000, 100_500_000]
    assert told(run_apart(plan)) == expected


def test_a_result_is_that_of_the_trace() -> None:
    emulation = run_together(scenario(loss=0.3))
    rows = [row for row in emulation.engine.trace.to_table().to_pylist() if row["attempt"]]
    results = [e for e in emulation.folder.events if e.kind == "event" and e.details["name"] == "result"]
    assert len(results) > 50
    for node in emulation.world.node_ids:
        mine = [row for row in rows if row["sender"] == node]
        for seq, event in enumerate(e for e in results if e.node == node):
            attempts = [row for row in mine if row["seq"] == seq]
            last = max(attempts, key=lambda row: row["attempt"])
            said = event.details["details"]
            assert (said["delivered"], said["attempts"]) == (last["acked"], last["attempt"])
            assert said["to"] == last["receiver"]
            known_ns = last["left_ns"] + (96_000 if last["acked"] else 85_000)
            assert event.time_ns - 2_000_000 in (known_ns, last["left_ns"] + 96_000)


def test_a_name_that_no_vehicle_has_is_not_acknowledged() -> None:
    emulation = run_together(scenario(ASKS_NOBODY))
    said = [event.details["details"] for event in emulation.folder.events if event.kind == "event"]
    assert said == [{"delivered": False, "attempts": 0}] * 5
    assert not len(emulation.engine.trace)


def test_a_send_that_outlasts_the_run_is_dropped_without_a_word(caplog: pytest.LogCaptureFixture) -> None:
    emulation = run_together(scenario(SAYS_GOODBYE))
    gc.collect()
    assert not caplog.records
    assert not [event for event in emulation.folder.events if event.kind == "unhandled"]


def test_a_result_for_a_paused_vehicle_waits_and_the_run_goes_on() -> None:
    """With one sender only: when its result comes, nobody else has anything to do."""
    fault = {"kind": "pause", "nodes": {"ids": ["v01"]}, "at_s": 0.01, "duration_s": 0.1}
    plan = scenario(ASKS, [fault], latency_ms=50.0)
    for run in (run_together, run_apart):
        emulation = run(plan)
        first, last = (event for event in emulation.folder.events if event.kind == "event")
        told = [(each.details["name"], each.time_ns) for each in (first, last)]
        assert told == [("result", 110_000_000), ("later", 300_000_000)]
