"""Clocks that go wrong: what a program reads, how long it sleeps, and that all is right again afterwards."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.fault_plan import PlannedFault
from emulator.scenario.faults import parse_fault
from emulator.world.truth import clock_of
from tests.vnet.runtime.test_host import Over, welcome
from vnet import Node
from vnet.runtime.host import Host
from vnet.runtime.programs import Program
from vnet.runtime.virtual_time import VirtualTimeLoop
from vnet.transport import wire

S = 1_000_000_000
LAST_NS = 20 * S


def planned(kind: str, at_s: float, until_s: float, number: int = 0, **more: float) -> PlannedFault:
    data = {"kind": kind, "at_s": at_s, "duration_s": until_s - at_s, **more}
    mask = np.array([True])
    return PlannedFault(number, number, parse_fault(data), round(at_s * S), round(until_s * S), mask, None)


class Clocks:
    """Plays the emulator for one host: clocks bend as faults say, and a packet comes each second."""

    def __init__(self, faults: dict[str, Sequence[PlannedFault]], packet_every_ns: int = S) -> None:
        self.loop = VirtualTimeLoop(self._exchange)
        self.host = Host([welcome(node) for node in faults], lambda: self.loop.now_ns)
        self._faults = faults
        self._bent: set[str] = set()
        self._acted_ns = -1
        self._packet_ns = dict.fromkeys(faults, packet_every_ns)
        self._every_ns = packet_every_ns

    def _exchange(self, next_timer_ns: int | None) -> int:
        assert self.host.next_instant(next_timer_ns) is None, "windows of one instant"
        message = self.host.make_yield(b"n", 0, next_timer_ns)
        now_ns = min([next_timer_ns or LAST_NS, *(self._packet_ns[node] for node in message.waiting_radio)])
        if now_ns >= LAST_NS:
            raise Over
        changes = {t for faults in self._faults.values() for p in faults for t in (p.start_ns, p.end_ns)}
        clocks = []
        for time_ns in sorted(t for t in changes if self._acted_ns < t <= now_ns):
            for node, faults in self._faults.items():
                clock = clock_of(faults, node, 0, time_ns)
                if clock.is_wrong or node in self._bent:
                    clocks.append(clock)
                    self._bent.add(node)
        self._acted_ns = now_ns
        packets = []
        for node in self.host.nodes:
            while self._packet_ns[node] <= now_ns:
                packets.append(wire.WirePacket(node, "other", 0, self._packet_ns[node], b""))
                self._packet_ns[node] += self._every_ns
        grant = wire.decode_rx(wire.encode(wire.Grant(0, now_ns, now_ns + 1, packets, (), clocks)))
        assert isinstance(grant, wire.Grant)
        self.host.apply_clock_error(grant.clocks, self.loop)
        return self.host.open_window(grant)

    def run(self, program: Program) -> None:
        self.host.start(self.loop, dict.fromkeys(self.host.nodes, program))
        try:
            self.loop.run_forever()
        except Over:
            self.host.close(self.loop)
        finally:
            self.loop.close()


SKEW = planned("skew", 5, 10, offset_ms=-1500)
DRIFT = planned("drift", 5, 10, rate_ppm=250_000)


async def _wait_for(seconds: float) -> None:
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(asyncio.Event().wait(), seconds)


async def _wait_within(timeout: asyncio.Timeout) -> None:
    with pytest.raises(TimeoutError):
        async with timeout:
            await asyncio.Event().wait()


async def _called(by: Callable[[float, Callable[[], None]], object], when: float) -> None:
    due = asyncio.Event()
    by(when, due.set)
    await due.wait()


def _loop() -> asyncio.AbstractEventLoop:
    return asyncio.get_running_loop()


WAYS: dict[str, Callable[[float], Awaitable[None]]] = {
    "sleep": asyncio.sleep,
    "wait_for": _wait_for,
    "timeout": lambda seconds: _wait_within(asyncio.timeout(seconds)),
    "timeout_at": lambda seconds: _wait_within(asyncio.timeout_at(_loop().time() + seconds)),
    "call_later": lambda seconds: _called(_loop().call_later, seconds),
    "call_at": lambda seconds: _called(_loop().call_at, _loop().time() + seconds),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "from_s", "takes_s"),
    [*((SKEW, at_s, 2.0) for at_s in (6.0, 4.0, 9.0)), (DRIFT, 6.0, 1.6), (DRIFT, 4.0, 2.0), (DRIFT, 11.0, 2.0)],
)
def test_two_seconds_are_two_on_the_clock_by_which_they_were_set(
    fault: PlannedFault, from_s: float, takes_s: float
) -> None:
    """A skew is no change of pace, a drift is; what was set before either fires at its true time."""
    world = Clocks({"v1": [fault]})
    took_ns: dict[str, int] = {}

    async def program(node: Node) -> None:
        loop = asyncio.get_running_loop()

        def world_ns() -> int:
            return world.loop.now_ns

        await asyncio.sleep(from_s - 0.001 if from_s > 5 else from_s)
        while world_ns() < from_s * S:  # from a true instant on, whatever the clock says
            await asyncio.sleep(0.0005)
        assert loop is world.loop
        began_ns = world_ns()

        async def take(way: str) -> None:
            await WAYS[way](2.0)
            took_ns[way] = world_ns() - began_ns

        await asyncio.gather(*map(take, WAYS))

    world.run(program)
    assert took_ns == pytest.approx(dict.fromkeys(WAYS, takes_s * S), abs=2)


@pytest.mark.slow
def test_the_node_and_its_loop_show_the_same_wrong_time_and_the_right_one_again_after_it() -> None:
    clocks: list[tuple[PlannedFault, Callable[[float], float]]] = [
        (SKEW, lambda t: t - 1.5),
        (DRIFT, lambda t: t + 0.25 * (t - 5)),
    ]
    for fault, shown in clocks:
        world = Clocks({"v1": [fault]}, packet_every_ns=S // 2)
        seen: list[Any] = []

        async def program(node: Node, world: Clocks = world, seen: list[Any] = seen) -> None:
            loop = asyncio.get_running_loop()
            async for packet in node.radio:
                seen.append((world.loop.now_ns / S, node.now_ns / S, loop.time(), packet.received_ns / S))

        world.run(program)
        assert len(seen) == 39
        for true_s, *said_s in seen:
            expected = shown(true_s) if 5 <= true_s < 10 else true_s
            assert said_s == pytest.approx([expected] * 3, abs=2e-9)


@pytest.mark.slow
def test_a_packet_bears_the_time_that_the_clock_showed_when_it_came_and_not_when_it_was_read() -> None:
    """So it does not matter when a process that does not wait for it is woken: live and simulated are the same."""
    heard: dict[str, list[float]] = {}

    async def program(node: Node) -> None:
        if node.id == "v2":  # wakes the loop all the time
            async for _ in node.radio:
                pass
        await asyncio.sleep(15)
        heard[node.id] = [packet.received_ns / S for packet in node.radio.drain()]

    for others in ([], ["v2"]):
        Clocks({node: [SKEW] for node in ["v1", *others]}).run(program)
        assert heard["v1"] == [t - 1.5 if 5 <= t < 10 else t for t in range(1, 16)]


@pytest.mark.slow
def test_no_clock_shows_a_time_before_the_start_of_the_run() -> None:
    seen = []

    async def program(node: Node) -> None:
        async for packet in node.radio:
            seen.append((node.now_ns, packet.received_ns))
            node.report(x=1.0)

    Clocks({"v1": [planned("skew", 0, 10, offset_ms=-4500)]}).run(program)
    assert seen[:6] == [(0, 0)] * 4 + [(S // 2, S // 2), (3 * S // 2, 3 * S // 2)]


@pytest.mark.slow
def test_two_nodes_of_one_process_have_clocks_of_their_own() -> None:
    woken: dict[str, list[int]] = {}
    shown: dict[str, list[int]] = {}
    world = Clocks({"v1": [SKEW], "v2": [DRIFT], "v3": []})

    async def program(node: Node) -> None:
        await asyncio.sleep(6)
        for _ in range(3):
            await asyncio.create_task(asyncio.sleep(1))  # tasks of a task have its clock too
            woken.setdefault(node.id, []).append(world.loop.now_ns)
            shown.setdefault(node.id, []).append(node.now_ns)

    world.run(program)
    assert woken["v1"] == woken["v3"] == [7 * S, 8 * S, 9 * S]
    assert woken["v2"] == pytest.approx([6.8 * S, 7.6 * S, 8.4 * S], abs=3)
    assert shown["v1"] == [5.5 * S, 6.5 * S, 7.5 * S]
    assert shown["v2"] == pytest.approx([7.25 * S, 8.25 * S, 9.25 * S], abs=3)
    assert shown["v3"] == woken["v3"]


def test_a_skew_and_a_drift_together_and_apart_again() -> None:
    faults = [planned("skew", 2, 8, offset_ms=1000), planned("drift", 4, 10, number=1, rate_ppm=-500_000)]
    for time_s, offset_s, rate in ((1, 0, 0), (3, 1, 0), (6, 0, -0.5), (8, -2, -0.5), (9, -2.5, -0.5), (10, 0, 0)):
        clock = clock_of(faults, "v1", 0, time_s * S)
        assert (clock.offset_ns, clock.rate) == (round(offset_s * S), rate)
        assert clock.is_wrong == (offset_s != 0 or rate != 0)


drifts = st.lists(
    st.tuples(st.integers(0, 9), st.integers(1, 10), st.floats(-500_000, 500_000)), min_size=1, max_size=8
)


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(drifts)
def test_any_drifts_together_go_on_without_a_jump_while_they_act_and_never_stand_still(
    drawn: list[tuple[int, int, float]],
) -> None:
    faults = [planned("drift", s, s + d, n, rate_ppm=r) for n, (s, d, r) in enumerate(drawn)]
    changes = sorted({t for p in faults for t in (p.start_ns, p.end_ns)})
    ends = {p.end_ns for p in faults}
    for one_ns, next_ns in pairwise(changes):
        clock = clock_of(faults, "v1", 0, one_ns)
        again = wire.decode_rx(wire.encode(wire.Grant(0, one_ns, one_ns + 1, (), (), [clock])))
        assert isinstance(again, wire.Grant)
        assert again.clocks[0] == clock, "the wire can carry it"
        assert clock.shown_ns(next_ns) > clock.shown_ns(one_ns)
        if next_ns not in ends:
            assert abs(clock_of(faults, "v1", 0, next_ns).shown_ns(next_ns) - clock.shown_ns(next_ns)) <= 2
    assert not clock_of(faults, "v1", 0, changes[-1]).is_wrong


def test_timers_for_never_do_not_wake_anybody() -> None:
    world = Clocks({"v1": [DRIFT]})
    woken: list[float] = []

    async def program(node: Node) -> None:
        for seconds in (1e12, float("inf")):
            asyncio.get_running_loop().call_later(seconds, woken.append, seconds)
        await asyncio.sleep(1)
        woken.append(node.now_ns)

    world.run(program)
    assert woken == [S]
