"""Tests of forwarding.py: its messages, its waits, and what becomes of warnings under faults."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import pytest

from docs.examples.cbf.forwarding import PAYLOAD_BYTES, Hazard, decode, encode, wait_s

SMALL: dict[str, Any] = {"vehicles": 80, "duration": 4, "settle": 1}
"""Dense enough that a warning finds another way around whoever fails."""


def informed(emu: Any) -> dict[int, set[str]]:
    """Return who has received each warning."""
    found: dict[int, set[str]] = defaultdict(set)
    for event in emu.events:
        if event.name == "informed":
            found[event.values["number"]].add(event.node)
    return found


async def test_a_partition_holds_warnings_back_only_while_it_lasts(vnet_emulation: Any) -> None:
    async with vnet_emulation("docs/examples/cbf/cbf.toml", **SMALL) as emu:
        await emu.run_until(1.0)
        with emu.fault("partition", groups=emu.halves()):
            await emu.run_for(0.6)
        await emu.run_for(1.4)
        reached = informed(emu)
        source_half = next(set(half) for half in emu.halves() if "v01" in half)
        assert reached[1] <= source_half
        assert len(reached[2]) >= 0.95 * 79
        emu.check("conservation", "partition_respected")


async def test_a_source_that_restarts_goes_on_with_the_next_warning(vnet_emulation: Any) -> None:
    async with vnet_emulation("docs/examples/cbf/cbf.toml", **SMALL) as emu:
        await emu.run_until(0.9)
        with emu.fault("kill", nodes=["v01"]):
            await emu.run_for(0.5)
        await emu.run_for(1.6)
        assert sorted(informed(emu)) == [0, 2]
        emu.check("own:informed_in_time", "agents_alive")


@pytest.mark.parametrize(("distance_m", "expected_s"), [(0, 0.1), (500, 0.0505), (1000, 0.001), (2000, 0.001)])
def test_the_further_the_receiver_the_shorter_it_waits(distance_m: float, expected_s: float) -> None:
    assert wait_s(distance_m, 1000.0) == pytest.approx(expected_s)


def test_a_warning_is_read_as_it_was_sent() -> None:
    payload = encode(Hazard(3, 1_000_000_000, (1.5, -2.5)))
    read = decode(payload)
    assert len(payload) == PAYLOAD_BYTES
    assert read is not None
    assert (read.number, read.since_ns, read.sender_m) == (3, 1_000_000_000, (1.5, -2.5))


@pytest.mark.parametrize("payload", [b"", b"hello", encode(Hazard(1, 2, (0.0, float("nan"))))])
def test_what_is_no_warning_is_not_read(payload: bytes) -> None:
    assert decode(payload) is None
