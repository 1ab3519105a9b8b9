"""The backbone among roadside units: order, latency, loss, and what becomes of each message."""

import asyncio
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.drivers.backbone import BackboneNetwork
from emulator.drivers.emulation import Emulation
from emulator.scenario.scenario import Scenario
from tests.support.multi_loop_driver import run_other_ways, run_together
from vnet.errors import PayloadTooLargeError
from vnet.radio import Backbone
from vnet.transport.wire import SentMessage

NAMES = ("rsu01", "rsu02", "rsu03")
COUNTS = "tests.support.roadside_programs:counts"


def scenario(units: int = 3, **sections: Any) -> Scenario:
    program = {"exceptions": [{"nodes": list(NAMES[:units]), "entry": COUNTS}]}
    data = {
        "run": {"duration_s": 2.0, "settle_s": 0.3, **sections.pop("run", {})},
        "network": {"vehicles": 2},
        "radio": {"range_m": 1e6},
        "roadside": [{"position_m": [100.0 * n, 0.0]} for n in range(units)],
        "program": program,
    }
    return Scenario.model_validate(data | sections)


def got(emulation: Emulation) -> list[tuple[str, int, dict[str, Any]]]:
    events = [event for event in emulation.folder.events if event.kind == "event"]
    told = [(event.node or "", event.time_ns, event.details["details"]) for event in events]
    return sorted(told, key=lambda each: each[:2])


messages = st.lists(st.tuples(st.integers(0, 10**8), st.sampled_from(NAMES), st.sampled_from([None, *NAMES])))


@pytest.mark.slow
@given(messages, st.floats(0.001, 50), st.floats(0, 50), st.sampled_from([0.0, 0.5, 1.0]))
def test_messages_keep_their_order_and_none_is_early_or_forgotten(
    sent: list[tuple[int, str, str | None]], latency_ms: float, jitter_ms: float, loss: float
) -> None:
    section = {"latency_ms": latency_ms, "jitter_ms": jitter_ms, "loss": loss}
    network = BackboneNetwork(scenario(backbone=section), dict.fromkeys(NAMES, True))
    meant = 0
    for number, (time_ns, node, to) in enumerate(sorted(sent, key=lambda each: each[0])):
        network.send(time_ns, [SentMessage(node, number, to, b"%d" % number)])
        meant += 2 if to is None else to != node
    arrived = network.take(10**12)
    network.decide(10**12)
    table = network.table()
    assert table is not None and len(table) == meant
    assert table["outcome"].to_pylist().count("delivered") == len(arrived)
    assert [each.time_ns for each in arrived] == sorted(each.time_ns for each in arrived)
    for each in arrived:
        assert latency_ms * 1e6 - 1 <= each.time_ns - each.sent_ns
    for pair in {(each.sender, each.node) for each in arrived}:
        numbers = [int(each.payload) for each in arrived if (each.sender, each.node) == pair]
        assert numbers == sorted(numbers)


def test_a_message_meets_the_same_fate_whatever_others_send() -> None:
    section = {"jitter_ms": 5.0, "loss": 0.5}

    def fates(*others: str) -> list[Any]:
        network = BackboneNetwork(scenario(backbone=section), dict.fromkeys(NAMES, True))
        for time_ns in range(0, 10**9, 10**7):
            network.send(time_ns, [SentMessage(node, 0, None, b"x") for node in (*others, "rsu02")])
        network.decide(10**12)
        table = network.table()
        assert table is not None
        rows = table.to_pylist()
        return [(row["number"], row["receiver"], row["arrival_ns"]) for row in rows if row["sender"] == "rsu02"]

    alone = fates()
    assert alone == fates("rsu01", "rsu03")
    assert 60 < sum(arrival_ns is None for _, _, arrival_ns in alone) < 140


@pytest.mark.slow
def test_units_hear_the_same_together_apart_and_without_windows() -> None:
    plan = scenario(backbone={"latency_ms": 0.7, "jitter_ms": 3.0, "loss": 0.1})
    together = run_together(plan)
    assert len(got(together)) > 100
    for other in run_other_ways(plan):
        assert got(other) == got(together)
        assert other.backbone.table() == together.backbone.table()
        assert other.engine.trace.to_table() == together.engine.trace.to_table()


def test_a_unit_that_is_down_hears_nothing_and_goes_on_afterwards() -> None:
    fault = {"kind": "kill", "nodes": {"ids": ["rsu02"]}, "at_s": 0.5, "duration_s": 0.5}
    emulation = run_together(scenario(2, fault=[fault], backbone={"latency_ms": 30.0}))
    heard_ns = [details["received_ns"] for node, _, details in got(emulation) if node == "rsu02"]
    assert any(time_ns < 5e8 for time_ns in heard_ns) and any(time_ns > 1e9 for time_ns in heard_ns)
    assert not any(5e8 <= time_ns < 1e9 for time_ns in heard_ns)
    table = emulation.backbone.table()
    assert table is not None
    down = [row["arrival_ns"] for row in table.to_pylist() if row["outcome"] == "receiver_down"]
    assert down and all(5e8 <= time_ns < 1e9 for time_ns in down)


@pytest.mark.slow
@pytest.mark.parametrize("order", ["shuffle", "pct"])
def test_every_order_of_events_repeats_itself(order: str) -> None:
    runs = [run_together(scenario(run={"order": order}, backbone={"latency_ms": 7.0})) for _ in range(2)]
    assert got(runs[0]) == got(runs[1]) != []


def test_only_units_have_a_backbone() -> None:
    network = BackboneNetwork(scenario(), {})
    assert network.abilities("v01") is None
    abilities = network.abilities("rsu02")
    assert abilities is not None and tuple(abilities.peers) == ("rsu01", "rsu03")
    network.send(0, [SentMessage("v01", 0, None, b"x"), SentMessage("rsu01", 1, None, b"x" * 65_001)])
    assert network.next_ns() is None


def test_wrong_calls_are_refused() -> None:
    class Nowhere:
        def send_message(self, node: str, to: str | None, payload: bytes) -> None:
            raise AssertionError

    backbone = Backbone("rsu01", Nowhere(), ("rsu02",), 10)
    with pytest.raises(ValueError, match=r"backbone.send\('v01', …\): one of rsu02 is expected"):
        asyncio.run(backbone.send("v01", b""))
    with pytest.raises(TypeError, match=r"backbone.broadcast\('text'\): bytes are expected, not str"):
        asyncio.run(backbone.broadcast("text"))  # type: ignore[arg-type]
    with pytest.raises(PayloadTooLargeError, match=r"11 bytes exceeds backbone.max_message_bytes = 10"):
        asyncio.run(backbone.send("rsu02", bytes(11)))
