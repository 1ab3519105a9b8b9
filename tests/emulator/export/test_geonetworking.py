"""Headers of GeoNetworking: what is read of messages, what headers say, and what Wireshark makes of them."""

import io
import math
import shutil
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pycrate_asn1dir.ITS_CAM_2 import CAM_PDU_Descriptions
from typer.testing import CliRunner

import emulator
from docs.examples.its.station import EMERGENCY_BRAKE, ORIGIN_DEG, Message, decode, encode_cam, encode_denm
from emulator.cli.export import export
from emulator.export.pcapng import Router, Station, station_of, write_pcapng
from emulator.records.recorded_run import OpenedRun, RecordedRun
from tests.support.cli import command_app
from tests.support.paths import ROOT
from vnet.errors import VnetError

EXAMPLE = ROOT / "docs" / "examples" / "its"
places = st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))


@pytest.mark.slow
@given(
    places,
    st.none() | st.floats(0, 2 * math.pi),
    st.none() | st.floats(0, 160),
    st.integers(0, 2**32 - 1),
    st.integers(0, 10**14),
)
def test_place_speed_and_heading_of_a_cam_are_read_from_its_bits(
    position_m: tuple[float, float], heading_rad: float | None, speed_m_s: float | None, station: int, time_ns: int
) -> None:
    message = encode_cam(Message(station, position_m, heading_rad, speed_m_s), time_ns)
    again = decode(message)
    read = station_of(message)
    assert again is not None and read is not None
    assert read.latitude == pytest.approx(1e7 * (ORIGIN_DEG[0] + position_m[1] / 111_320), abs=1)
    assert again.speed_m_s == pytest.approx(speed_m_s, abs=0.006)
    assert read.speed / 100 == (again.speed_m_s or 0.0)
    assert (again.heading_rad is None) == (heading_rad is None)
    to_north_deg = 0.0 if heading_rad is None else (90 - math.degrees(heading_rad)) % 360
    assert abs(math.remainder(read.heading / 10 - to_north_deg, 360)) < 0.06
    assert again.station == station
    assert again.position_m == pytest.approx(position_m, abs=0.02)


@pytest.mark.slow
@given(places, st.integers(0, 2**32 - 1), st.integers(0, 65535), st.integers(0, 10**14))
def test_the_place_of_a_denm_is_read_from_its_bits(
    position_m: tuple[float, float], station: int, number: int, time_ns: int
) -> None:
    message = encode_denm(Message(station, position_m, cause=EMERGENCY_BRAKE), number, time_ns)
    read, again = station_of(message), decode(message)
    assert read is not None and again is not None
    assert read.latitude == pytest.approx(1e7 * (ORIGIN_DEG[0] + position_m[1] / 111_320), abs=1)
    assert (again.station, again.cause) == (station, EMERGENCY_BRAKE)


@pytest.mark.slow
@given(st.sampled_from([b"", b"\2\1", b"\2\2", b"\1\2"]), st.binary(max_size=80) | st.just(b"\xff" * 40))
def test_no_bytes_are_too_strange(begin: bytes, rest: bytes) -> None:
    read = station_of(begin + rest)
    assert (Router().packet(0, 0, 0, begin + rest) is None) == (read is None)


def test_headers_are_as_the_standard_has_them() -> None:
    router = Router()
    cam = encode_cam(Message(7, (0.0, 0.0), math.pi / 2, 20.0), 0)
    packet = router.packet(2, 5, 1_500_000_000, cam)
    assert packet is not None
    basic, common, source = packet[:4], packet[4:12], packet[12:36]
    assert basic == bytes([0x11, 0, 1 << 2 | 1, 1])
    assert struct.unpack(">BBBBHBB", common) == (0x20, 0x50, 2, 0x80, 4 + len(cam), 1, 0)
    assert source[:8] == bytes.fromhex("1400020000000003")
    place = struct.unpack(">IiiHH", source[8:])
    assert place == (1500, round(1e7 * ORIGIN_DEG[0]), round(1e7 * ORIGIN_DEG[1]), 0x8000 | 2000, 0)
    assert packet[36:] == bytes(4) + struct.pack(">HH", 2001, 0) + cam
    denm = encode_denm(Message(7, (0.0, 100.0), cause=EMERGENCY_BRAKE), 1, 0)
    packet = router.packet(2, 6, 0, denm)
    assert packet is not None
    assert (packet[5], packet[12:16]) == (0x40, struct.pack(">HH", 6, 0))
    assert packet[24:40][4:] == source[12:]  # where its last CAM has said that it is
    latitude, _, radius_m = struct.unpack(">iiH", packet[40:50])
    assert (latitude, radius_m) == (round(1e7 * (ORIGIN_DEG[0] + 100 / 111_320)), 1000)
    assert packet[56:] == struct.pack(">HH", 2002, 0) + denm
    assert station_of(b"\x02\x03" + bytes(60)) is None
    assert Station(1, 2) == Station(1, 2, 0, 0)


@pytest.mark.slow
def test_a_place_that_is_not_available_is_the_last_one_and_said_to_be_inaccurate() -> None:
    """As of a station whose receiver has an outage; the header has no value for it."""
    known, router = encode_cam(Message(7, (0.0, 0.0), 0.0, 20.0), 0), Router()
    cam = CAM_PDU_Descriptions.CAM
    cam.from_uper(known)
    value = cam.get_val()
    place = value["cam"]["camParameters"]["basicContainer"]["referencePosition"]
    place |= {"latitude": 900_000_001, "longitude": 1_800_000_001}
    cam.set_val(value)
    places = []
    for message in (nowhere := cam.to_uper(), known, nowhere):
        packet = router.packet(2, 5, 0, message)
        assert packet is not None
        places.append((*struct.unpack(">ii", packet[24:32]), packet[32] >> 7))
    origin = [round(1e7 * each) for each in ORIGIN_DEG]
    assert places == [(0, 0, 0), (*origin, 1), (*origin, 0)]


@pytest.mark.slow
@given(st.integers(0, 255), st.booleans())
def test_a_cam_has_the_headers_of_its_station_type_also_with_the_least_that_it_may_say(
    kind: int, is_vehicle: bool
) -> None:
    cam = CAM_PDU_Descriptions.CAM
    cam.from_uper(encode_cam(Message(7, (0.0, 0.0), 0.0, 20.0), 0))
    value = cam.get_val()
    value["cam"]["camParameters"]["basicContainer"]["stationType"] = kind
    if not is_vehicle:
        value["cam"]["camParameters"]["highFrequencyContainer"] = ("rsuContainerHighFrequency", {})
    cam.set_val(value)
    message = cam.to_uper()
    assert len(message) == (41 if is_vehicle else 26)
    packet = Router().packet(0, 0, 0, message)
    assert packet is not None and packet.endswith(message)
    assert packet[12] == (kind if kind < 32 else 0) << 2
    assert packet[7] == (0 if kind == 15 else 0x80), "a roadside unit is not mobile"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OpenedRun]:
    """A run of the example in which a vehicle warns."""
    folder = tmp_path_factory.mktemp("its") / "run"
    options: dict[str, Any] = {"program.options.at_s": 0.5}
    emulator.simulate(EXAMPLE / "its.toml", duration_s=1.0, set=options, out=folder)
    yield RecordedRun.open(folder)


@pytest.mark.slow
def test_wireshark_dissects_both_messages(recorded: OpenedRun, tmp_path: Path) -> None:
    if (tshark := shutil.which("tshark")) is None:
        pytest.skip("tshark is not installed: apt-get install tshark")
    path = tmp_path / "its.pcapng"
    with path.open("wb") as file:
        count = write_pcapng(recorded, file, as_its=True)
    fields = ["btpb.dstport", "its.messageID", "its.stationID", "geonw.src_pos.speed", "_ws.malformed"]
    command = [tshark, "-r", str(path), "-T", "fields", *(word for field in fields for word in ("-e", field))]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rows = [line.split("\t") for line in out.splitlines()]
    assert len(rows) == count
    assert {(row[0], row[1]) for row in rows} == {("2001", "2"), ("2002", "1")}
    assert {row[2] for row in rows} == {str(number) for number in range(1, 11)}
    assert {row[4] for row in rows} == {""}


@pytest.mark.slow
def test_what_cannot_be_written_is_one_line(recorded: OpenedRun, tmp_path: Path) -> None:
    with pytest.raises(VnetError, match="--payloads its: the run has kept no payloads; run it with --set"):
        emulator.simulate("beacon", duration_s=0.5, out=tmp_path / "beacon")
        write_pcapng(RecordedRun.open(tmp_path / "beacon"), io.BytesIO(), as_its=True)
    done = CliRunner().invoke(command_app(export), [str(tmp_path / "beacon"), "--payloads", "its"])
    assert "--payloads its: of pcapng, and not of csv" in done.stderr
