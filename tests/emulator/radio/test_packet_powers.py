"""Powers of received packets, for programs and in the trace."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.radio import drained, engine, line
from vnet.radio import SentFrame
from vnet.transport import wire

MS = 1_000_000
NOISE_DBM = -97.0
LOG_DISTANCE: dict[str, Any] = {"kind": "log_distance"}


@pytest.mark.slow
@given(st.floats(1, 400), st.floats(0, 33))
def test_a_frame_that_is_alone_has_the_power_of_its_path_loss(distance_m: float, tx_power_dbm: float) -> None:
    subject = engine(line(0, distance_m), path_loss={**LOG_DISTANCE, "tx_power_dbm": tx_power_dbm}, mac={})
    subject.transmit(0, 0, [bytes(300)])
    rssi_dbm = tx_power_dbm - 47.86 - 20 * math.log10(distance_m)
    for each in subject.advance(10 * MS):
        assert each.packet.rssi_dbm == pytest.approx(rssi_dbm, abs=0.00501)
        assert each.packet.snr_db == pytest.approx(rssi_dbm - NOISE_DBM, abs=0.00501)


@pytest.mark.parametrize("radio", [{"range_m": 500.0}, {"range_m": 500.0, "mac": {}}], ids=["disc", "medium"])
def test_without_a_path_loss_there_is_no_power(radio: dict[str, Any]) -> None:
    subject = engine(line(0, 100), **radio)
    subject.transmit(0, 0, [bytes(300)])
    (delivery,) = subject.advance(10 * MS)
    assert delivery.packet.rssi_dbm is None and delivery.packet.snr_db is None
    assert not {"rssi_dbm", "snr_db"} & set(subject.trace.to_table().column_names)


def test_interference_counts_by_the_time_that_it_lasts() -> None:
    """v2 is hidden from v0, and is on air during the last of 51 symbols of v0's frame."""
    subject = engine(line(0, 50, 900), path_loss={**LOG_DISTANCE, "exponent": 2.5, "floor_dbm": -130.0}, mac={})
    subject.transmit(0, 0, [bytes(300)])
    (lone,) = subject.advance(10 * MS)
    subject.transmit(10 * MS, 0, [bytes(300)])
    subject.transmit(10 * MS + 300_000, 2, [bytes(300)])
    rows = [row for row in drained(subject) if row["receiver"] == "v1"]
    _, first, second = sorted(rows, key=lambda row: row["sent_ns"])
    left_ns, other_ns = first["left_ns"], second["on_air_ns"]
    share = (left_ns - other_ns) / (left_ns - first["on_air_ns"] - 40_000)
    assert 0.1 < share < 0.9
    assert first["rssi_dbm"] == lone.packet.rssi_dbm, "interference is no power of the frame's own"
    interference_mw = 10 ** (second["rssi_dbm"] / 10) * share
    expected_db = first["rssi_dbm"] - 10 * math.log10(10 ** (NOISE_DBM / 10) + interference_mw)
    assert first["snr_db"] == pytest.approx(expected_db, abs=0.02)
    assert first["snr_db"] < lone.packet.snr_db


@pytest.mark.parametrize("late_ns", [0, 100_000])
@given(st.floats(-60, 30))
def test_a_vehicle_that_transmits_receives_nothing_however_weakly(late_ns: int, dbm: float) -> None:
    subject = engine(line(0, 1), path_loss=LOG_DISTANCE, mac={}, access_jitter_ms=0.0)
    subject.transmit(0, 0, [SentFrame("v0", bytes(300), dbm)])
    subject.transmit(late_ns, 1, [bytes(300)])
    subject.advance(10 * MS)
    first, second = sorted(subject.trace.to_table().to_pylist(), key=lambda row: row["sender"])
    together = first["on_air_ns"] < second["left_ns"] and second["on_air_ns"] < first["left_ns"]
    assert not together or "delivered" not in {first["outcome"], second["outcome"]}


def test_fading_is_in_the_power_and_the_trace_has_what_the_packet_says() -> None:
    subject = engine(line(0, 60, 120, 180), path_loss=LOG_DISTANCE, fading={})
    for number in range(40):
        subject.transmit(number * 10 * MS, 0, [b"hello"])
    packets = {(each.packet.sent_ns, each.receiver): each.packet for each in subject.advance(1000 * MS)}
    rows = subject.trace.to_table().to_pylist()
    for row in rows:
        if row["outcome"] == "delivered":
            packet = packets[row["sent_ns"], int(row["receiver"][1])]
            assert (packet.rssi_dbm, packet.snr_db) == (row["rssi_dbm"], row["snr_db"])
    nearest = [row["rssi_dbm"] for row in rows if row["receiver"] == "v1"]
    assert np.ptp(nearest) > 3, "drawn for each frame"
    assert {row["outcome"] for row in rows} == {"delivered", "faded"}
    faded = [row["rssi_dbm"] for row in rows if row["outcome"] == "faded"]
    assert max(faded) < max(nearest)


def test_a_frame_that_never_was_on_air_has_no_power_in_the_trace() -> None:
    subject = engine(line(0, 60), path_loss=LOG_DISTANCE, mac={}, queue_frames=1)
    subject.transmit(0, 0, [bytes(100)] * 3)
    rows = drained(subject)
    assert [row["rssi_dbm"] is None for row in rows] == [row["outcome"] == "queue_full" for row in rows]
    assert any(row["outcome"] == "queue_full" for row in rows)


def test_powers_travel_to_a_live_program_as_they_are() -> None:
    subject = engine(line(0, 60), path_loss=LOG_DISTANCE)
    subject.transmit(0, 0, [b"hello"])
    (delivery,) = subject.advance(10 * MS)
    sent = wire.Grant(0, 0, 1, packets=[wire.WirePacket.of("v1", delivery.packet)])
    received = wire.decode_rx(wire.encode(sent))
    assert isinstance(received, wire.Grant)
    assert received.packets[0].packet() == delivery.packet
