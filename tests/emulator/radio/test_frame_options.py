"""Transmit power and bit rate of single frames."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import emulator
from emulator.radio.dot11p import abilities_of, airtime_ns
from emulator.scenario.radio import RATES_MBPS
from emulator.scenario.scenario import Radio as RadioSection
from tests.support.faulty_engine import PERIOD_NS, FaultyEngine, fault
from tests.support.radio import drained, engine, line
from vnet import Node
from vnet.radio import Radio, SentFrame

MS = 1_000_000
PHYSICAL: dict[str, Any] = {"path_loss": {"kind": "log_distance"}, "mac": {}, "max_peers": 1000}
KINDS: list[dict[str, Any]] = [{"to": "v1"}, {}, {"power_dbm": 19.0, "rate_mbps": 9.0}]
"""Choices of frames: to v1 alone, none, and less power at another rate."""


class Sink:
    """A transport that keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[SentFrame] = []

    def send_frame(self, frame: SentFrame) -> None:
        self.sent.append(frame)

    def busy_ratio(self, node: str) -> float | None:
        return None


def radio_of(**section: Any) -> tuple[Radio, Sink]:
    sink = Sink()
    return Radio("v01", sink, 1400, abilities_of(RadioSection.model_validate(section))), sink


def run(coroutine: Any) -> None:
    with pytest.raises(StopIteration):
        coroutine.send(None)


@pytest.mark.slow
@given(st.floats(-40, 0), st.sampled_from(RATES_MBPS), st.integers(20, 200))
def test_power_shifts_the_received_one_and_rate_the_airtime(
    gain_db: float, rate_mbps: float, distance_m: int
) -> None:
    subject = engine(line(0, distance_m), **PHYSICAL)
    subject.transmit(0, 0, [bytes(300), SentFrame("v0", bytes(300), 20 + gain_db, rate_mbps)])
    usual, chosen = drained(subject)
    assert chosen["rssi_dbm"] - usual["rssi_dbm"] == pytest.approx(gain_db, abs=0.011)
    if "gain_db" in chosen:
        assert (usual["gain_db"], usual["bitrate_mbps"]) == (0, 6)
        assert (chosen["gain_db"], chosen["bitrate_mbps"]) == (pytest.approx(gain_db, abs=1e-6), rate_mbps)
    assert chosen["left_ns"] - chosen["on_air_ns"] == airtime_ns(300, rate_mbps)
    assert usual["left_ns"] - usual["on_air_ns"] == airtime_ns(300, 6.0)


def test_a_weak_frame_is_in_range_but_fades_and_a_fast_one_needs_a_better_signal() -> None:
    subject = engine(line(0, 300), **PHYSICAL)
    choices: list[dict[str, Any]] = [{}, {"power_dbm": 5.0}, {"rate_mbps": 27.0}, {"rate_mbps": 3.0}]
    subject.transmit(0, 0, [SentFrame("v0", bytes(300), **chosen) for chosen in choices])
    outcomes = [row["outcome"] for row in drained(subject)]
    assert outcomes == ["delivered", "faded", "faded", "delivered"]


def test_a_weak_frame_keeps_the_medium_free_beyond_its_own_range() -> None:
    """v1 is 300 m away: it senses v0 at 20 dBm, and not at 0 dBm."""
    for power_dbm, together in ((20.0, False), (0.0, True)):
        subject = engine(line(0, 300), **PHYSICAL)
        subject.transmit(0, 0, [SentFrame("v0", bytes(1000), power_dbm)])
        subject.transmit(MS, 1, [bytes(100)])
        first, second = drained(subject)
        assert (second["on_air_ns"] < first["left_ns"]) is together


def test_without_choices_the_trace_is_what_it_was() -> None:
    plain, same = (engine(line(0, 100), **PHYSICAL) for _ in range(2))
    plain.transmit(0, 0, [b"a", b"b"])
    same.transmit(0, 0, [SentFrame("v0", b"a", 20.0, 6.0), SentFrame("v0", b"b")])
    plain.drain()
    same.drain()
    assert same.trace.to_table().equals(plain.trace.to_table())
    assert same.trace.sha256() == plain.trace.sha256()


def test_an_agent_that_asks_for_what_the_radio_cannot_do_gets_the_scenarios() -> None:
    subject, disc = engine(line(0, 100), **PHYSICAL), engine(line(0, 100), range_m=500.0)
    for each in (subject, disc):
        each.transmit(0, 0, [SentFrame("v0", b"a", 60.0, 7.5), SentFrame("v0", b"b", math.nan, math.nan)])
        each.drain()
        assert "gain_db" not in each.trace.to_table().column_names


def test_programs_learn_what_the_radio_can_do() -> None:
    radio, sink = radio_of(**PHYSICAL)
    assert radio.max_power_dbm == 20 and radio.rates_mbps == RATES_MBPS
    run(radio.broadcast(b"x", power_dbm=10, rate_mbps=np.float64(12)))
    run(radio.broadcast(b"y"))
    assert sink.sent == [SentFrame("v01", b"x", 10.0, 12.0), SentFrame("v01", b"y")]


@pytest.mark.parametrize(
    ("section", "choice", "line_of_error"),
    [
        (PHYSICAL, {"power_dbm": 30}, r"broadcast\(power_dbm=30\): allowed are -100 to 20 dBm; .*tx_power_dbm"),
        (PHYSICAL, {"power_dbm": math.nan}, r"power_dbm=nan\): allowed are"),
        (PHYSICAL, {"power_dbm": "much"}, r"power_dbm='much'\): allowed are"),
        (PHYSICAL, {"power_dbm": "3"}, r"power_dbm='3'\): allowed are"),
        (PHYSICAL, {"power_dbm": True}, r"power_dbm=True\): allowed are"),
        (PHYSICAL, {"power_dbm": 10**400}, r"power_dbm=1000.*\): allowed are"),
        (PHYSICAL, {"rate_mbps": "12"}, r"rate_mbps='12'\): 802.11p has"),
        (PHYSICAL, {"rate_mbps": 7}, r"broadcast\(rate_mbps=7\): 802.11p has 3, 4.5, 6, 9, 12, 18, 24, 27$"),
        ({"mac": {}}, {"power_dbm": 10}, r"only with \[radio.path_loss\] a frame has a power$"),
        ({}, {"rate_mbps": 12}, r"rate_mbps=12\): only with 802.11p"),
    ],
)
def test_what_the_radio_cannot_do_is_said_in_one_line(section: Any, choice: Any, line_of_error: str) -> None:
    radio, sink = radio_of(**section)
    with pytest.raises(ValueError, match=line_of_error) as said:
        run(radio.broadcast(b"x", **choice))
    assert "\n" not in str(said.value) and not sink.sent


async def varies(node: Node) -> None:
    """Send each frame with a power and at a rate of its own."""
    async for _ in node.gnss:
        power_dbm = float(node.rng.uniform(30, 45))
        rate_mbps = float(node.rng.choice(node.radio.rates_mbps))
        await node.radio.broadcast(bytes(300), power_dbm=power_dbm, rate_mbps=rate_mbps)


@pytest.mark.slow
@pytest.mark.parametrize("mac", [True, False], ids=["medium", "queues"])
def test_the_checks_know_of_powers_and_rates(mac: bool, tmp_path: Path) -> None:
    path_loss = {"kind": "log_distance", "tx_power_dbm": 45.0}
    radio = {"path_loss": path_loss, "max_peers": 1000, **({"mac": {}} if mac else {})}
    run, network = {"duration_s": 2.0, "settle_s": 0.0}, {"vehicles": 8, "layout": "dense"}
    scenario = {"run": run, "network": network, "radio": {**radio, "fading": {}}}
    result = emulator.simulate(scenario, program=varies, out=tmp_path / "run")
    found = {check.name: check.verdict for check in result.checks}
    for name in ("fading", "latency", "conservation", *(["medium"] if mac else [])):
        assert found[name] == "valid", (name, found)
    assert set(result.trace.column("bitrate_mbps").to_pylist()) == set(RATES_MBPS)


def test_a_replayed_frame_has_the_addressee_power_and_rate_of_the_old_one() -> None:
    """Frames are sent in turn to v1 alone, to all, and to all with less power at another rate."""
    air = FaultyEngine([fault("DataReplay", nodes={"ids": ["v0"]}, age_s=0.1)], count=3, **PHYSICAL)
    for period in range(9):
        air.send(period * PERIOD_NS, 0, SentFrame("v0", bytes([period]) * 20, **KINDS[period % 3]))
    rows = air.rows()
    replayed = [row for row in rows if row["cause"] and row["attempt"] < 2]
    assert len({row["seq"] for row in replayed}) == 8
    for row in replayed:
        assert bool(row["attempt"]) == (row["seq"] % 3 == 0)
        assert (row["gain_db"], row["bitrate_mbps"]) == ((-1, 9) if row["seq"] % 3 == 2 else (0, 6))
    assert {packet.receiver for packet in air.delivered if not packet.packet.payload[0] % 3} == {1}


def test_a_stale_frame_has_the_addressee_power_and_rate_of_the_old_one_and_its_sender_is_told() -> None:
    """Each is the frame before the last: of those sent in turn as above, whose senders await some of them."""
    air = FaultyEngine([fault("StaleMessages", nodes={"ids": ["v0"]}, age_s=0.1)], count=3, **PHYSICAL)
    for period in range(9):
        air.send(period * PERIOD_NS, 0, SentFrame("v0", bytes([period]) * 20, number=period, **KINDS[period % 3]))
    stale = [row for row in air.rows() if row["cause"] and row["attempt"] < 2]
    assert len({row["seq"] for row in stale}) == 8
    for row in stale:
        assert bool(row["attempt"]) == ((row["seq"] - 1) % 3 == 0)
        assert (row["gain_db"], row["bitrate_mbps"]) == ((-1, 9) if (row["seq"] - 1) % 3 == 2 else (0, 6))
    results = [(result.number, result.delivered, result.attempts) for result in air.engine.take_results(10**12)]
    assert results == [(0, True, 1), (3, False, 0), (6, False, 0)], "those to v1 were broadcast, all but the first"


def test_a_frame_to_nobody_leaves_no_columns_for_its_choices() -> None:
    subject = engine(line(0, 50), **PHYSICAL)
    subject.transmit(0, 0, [SentFrame("v0", b"x", 5.0, 12.0, to="v9"), b"y"])
    (row,) = drained(subject)
    assert not {"gain_db", "attempt"} & row.keys()


@pytest.mark.parametrize("to", ["v01", "\ud800", None, 2, b"v02"])
def test_what_can_be_no_other_vehicle_s_name_is_a_value_error(to: Any) -> None:
    radio, sink = radio_of(**PHYSICAL)
    with pytest.raises(ValueError, match="the name of another vehicle is expected"):
        radio.send(to, b"x").send(None)
    assert not sink.sent
