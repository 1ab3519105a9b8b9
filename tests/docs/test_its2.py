"""The examples of release 2 and of J2735: messages against a second codec, what vehicles see, and a cyclist."""

import importlib.util
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pycrate_asn1dir.ITS_CAM_2 import CAM_PDU_Descriptions
from pycrate_asn1dir.ITS_DENM_3 import DENM_PDU_Descriptions

import emulator
from docs.examples.its import station
from docs.examples.its2.perception import NOWHERE_M, PLACES, fused, seen_of
from docs.examples.its2.sight import sensor
from docs.examples.its2.standard_messages import (
    PROFILE,
    Message,
    Seen,
    decode_bsm,
    decode_cpm,
    decode_vam,
    encode_bsm,
    encode_cpm,
    encode_vam,
    schema,
)
from docs.examples.its2.vulnerable import is_due
from emulator import SensedTruth
from tests.support.paths import ROOT
from vnet import Fix
from vnet.errors import VnetError

pytestmark = pytest.mark.slow

ETSI, J2735 = (os.environ.get(name) for name in ("VNET_ETSI_ASN1", "VNET_J2735_ASN1"))
"""Folder of ETSI's modules of CPM, VAM and CDD, and file or folder of SAE's: no package carries them."""
NO_J2735 = pytest.mark.skipif(J2735 is None, reason="VNET_J2735_ASN1 names no ASN.1 of SAE J2735")
EXAMPLE = ROOT / "docs" / "examples" / "its2"
STAND_IN = Path(__file__).with_name("frame.asn")
"""A schema in which a BSM has the names and ranges that the example uses. It is no schema of SAE's."""
LENGTH_M = st.floats(-1000, 1000)
SPEED_M_S = st.floats(-60, 60)
MESSAGES = st.builds(
    Message,
    station=st.integers(0, 2**32 - 1),
    time_ns=st.integers(0, 10**5).map(lambda ms: ms * 1_000_000),
    position_m=st.tuples(LENGTH_M, LENGTH_M),
    heading_rad=st.none() | st.floats(0, 6.28),
    speed_m_s=st.none() | st.floats(0, 60),
    objects=st.lists(
        st.builds(
            Seen,
            position_m=st.tuples(st.floats(-300, 300), st.floats(-300, 300)),
            velocity_m_s=st.tuples(SPEED_M_S, SPEED_M_S),
            age_s=st.integers(0, 2000).map(lambda ms: ms / 1000),
        ),
        max_size=20,
    ).map(tuple),
)


def compiled(file: Path, folder: Path) -> ModuleType:
    """Return a schema as pycrate compiles it: a codec that shares no code with asn1tools."""
    target = folder / f"{file.stem}_by_pycrate.py"
    command = Path(sys.executable).with_name("pycrate_asn1compile.py")
    words = [sys.executable, str(command), "-i", str(file), "-o", str(target.with_suffix(""))]
    subprocess.run(words, check=True, capture_output=True, timeout=100)  # it keeps what it has compiled
    spec = importlib.util.spec_from_file_location(target.stem, target)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def second(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The examples' schema by pycrate."""
    return compiled(PROFILE, tmp_path_factory.mktemp("pycrate")).Its2Profile


def assert_close(one: Message, other: Message | None) -> None:
    """Expect a message to have come through, to the resolution of the standards."""
    assert other is not None
    assert (one.station, len(one.objects)) == (other.station, len(other.objects))
    np.testing.assert_allclose(one.position_m, other.position_m, atol=0.02)
    assert (one.heading_rad is None) == (other.heading_rad is None)
    if one.heading_rad is not None and other.heading_rad is not None:
        assert abs(np.angle(np.exp(1j * (one.heading_rad - other.heading_rad)))) < 0.002
    for sent, read in zip(one.objects, other.objects, strict=True):
        np.testing.assert_allclose(sent.position_m, read.position_m, atol=0.03)
        np.testing.assert_allclose(sent.velocity_m_s, read.velocity_m_s, atol=0.006)
        assert sent.age_s == pytest.approx(read.age_s, abs=1e-9)


@given(MESSAGES)
def test_a_cpm_is_read_by_a_second_codec_and_written_with_the_same_bytes(second: Any, message: Message) -> None:
    payload = encode_cpm(message, schema())
    codec = second.CollectivePerceptionMessage
    codec.from_uper(payload)
    value = codec.get_val()
    assert value["header"] == {"protocolVersion": 2, "messageId": 14, "stationId": message.station}
    codec.set_val(value)
    assert codec.to_uper() == payload
    decoded = decode_cpm(payload, schema())
    assert_close(message, decoded)
    assert decoded is not None and decoded.time_ns == message.time_ns


@given(MESSAGES)
def test_a_vam_is_read_by_a_second_codec_and_written_with_the_same_bytes(second: Any, message: Message) -> None:
    payload = encode_vam(message, schema())
    second.VAM.from_uper(payload)
    value = second.VAM.get_val()
    moves = value["vam"]["vamParameters"]["vruHighFrequencyContainer"]
    assert moves["speed"]["speedValue"] == (16383 if message.speed_m_s is None else round(100 * message.speed_m_s))
    assert (moves["heading"]["value"] == 3601) == (message.heading_rad is None)
    second.VAM.set_val(value)
    assert second.VAM.to_uper() == payload
    decoded = decode_vam(payload, schema(), message.time_ns + 60_000_000_000)
    assert decoded is not None and decoded.time_ns == message.time_ns
    assert_close(Message(message.station, 0, message.position_m, message.heading_rad), decoded)
    assert decoded.speed_m_s == pytest.approx(message.speed_m_s, abs=0.006)


@pytest.mark.skipif(ETSI is None, reason="VNET_ETSI_ASN1 names no folder with ETSI's ASN.1 of CPM, VAM and CDD")
@given(MESSAGES)
def test_the_examples_schema_has_the_bytes_of_etsi_s_own(message: Message) -> None:
    assert ETSI is not None
    full = schema(ETSI)
    assert encode_cpm(message, full) == (cpm := encode_cpm(message, schema()))
    assert encode_vam(message, full) == (vam := encode_vam(message, schema()))
    assert decode_cpm(cpm, full) == decode_cpm(cpm, schema())
    assert decode_vam(vam, full, message.time_ns) == decode_vam(vam, schema(), message.time_ns)


@pytest.mark.parametrize("path", [STAND_IN, pytest.param(J2735, marks=NO_J2735)])
@given(MESSAGES)
def test_a_bsm_comes_through(path: Any, message: Message) -> None:
    types = schema(path)
    payload = encode_bsm(message, 130, types)
    bsm = types.decode("BasicSafetyMessage", types.decode("MessageFrame", payload)["value"])
    assert bsm["coreData"]["msgCnt"] == 2
    decoded = decode_bsm(payload, types)
    assert_close(Message(message.station, 0, message.position_m, message.heading_rad), decoded)
    assert decoded is not None and decoded.time_ns == message.time_ns % 60_000_000_000
    assert decoded.speed_m_s == pytest.approx(message.speed_m_s, abs=0.011)


def test_another_schema_than_that_of_a_bsm_is_told_in_one_line(tmp_path: Path) -> None:
    other = tmp_path / "other.asn"
    other.write_text(STAND_IN.read_text().replace("long ", "lon "))
    with pytest.raises(VnetError, match=r"^program\.options\.asn1: .*$"):
        encode_bsm(Message(2**40, 0, (0.0, 0.0), 0.0, -3.0), 0, schema(other))
    with pytest.raises(VnetError, match="5"):
        schema(5)


def test_a_bsm_is_read_by_a_second_codec_and_written_with_the_same_bytes(tmp_path: Path) -> None:
    frame = compiled(STAND_IN, tmp_path).StandIn.MessageFrame
    payload = encode_bsm(Message(7, 1_234_000_000, (12.3, -45.6), 1.0, 13.9), 5, schema(STAND_IN))
    frame.from_uper(payload)
    name, value = frame.get_val()["value"]
    assert (name, value["coreData"]["speed"], value["coreData"]["msgCnt"]) == ("BasicSafetyMessage", 695, 5)
    frame.set_val(frame.get_val())
    assert frame.to_uper() == payload


def test_what_a_cpm_cannot_say_is_left_out() -> None:
    near, farthest = Seen((10.0, 0.0), (1.0, 0.0)), Seen((1310.70, -1310.71), (1.0, 0.0))
    unsayable = (
        Seen((2000.0, 0.0), (0, 0)),
        Seen((0, -1311.0), (0, 0)),
        Seen((1310.71, 0), (0, 0)),
        Seen((0, 0), (-170.0, 0)),
        Seen((0, 0), (0, 0), 2.1),
    )
    message = Message(1, 0, (0.0, 0.0), objects=(*unsayable, near, farthest))
    decoded = decode_cpm(encode_cpm(message, schema()), schema())
    assert decoded is not None and len(decoded.objects) == 2
    for seen, told in zip(decoded.objects, (near, farthest), strict=True):
        np.testing.assert_allclose(seen.position_m, told.position_m, atol=0.03)


@pytest.mark.parametrize("missing", range(2))
def test_a_cpm_of_a_roadside_unit_or_of_one_who_sees_nothing_is_read(missing: int) -> None:
    message = Message(1, 0, (0.0, 0.0), 1.0, objects=(Seen((10.0, 0.0), (1.0, 0.0)),))
    value = schema().decode("CollectivePerceptionMessage", encode_cpm(message, schema()))
    del value["payload"]["cpmContainers"][missing]
    decoded = decode_cpm(schema().encode("CollectivePerceptionMessage", value), schema())
    assert decoded is not None
    assert ((decoded.heading_rad is None), len(decoded.objects)) == [(True, 1), (False, 0)][missing]


NOWHERE = {"latitude": 900_000_001, "longitude": 1_800_000_001}
"""A position of which the sender knows nothing."""


def test_a_message_without_a_position_is_none() -> None:
    """That of others; a BSM without a time is none, either."""
    at, types, cam, denm = (0.0, 0.0), schema(), CAM_PDU_Descriptions.CAM, DENM_PDU_Descriptions.DENM
    cam.from_uper(station.encode_cam(station.Message(1, at), 0))
    value = cam.get_val()
    value["cam"]["camParameters"]["basicContainer"]["referencePosition"].update(NOWHERE)
    cam.set_val(value)
    assert station.decode(cam.to_uper()) is None
    denm.from_uper(station.encode_denm(station.Message(1, at, cause=station.EMERGENCY_BRAKE), 1, 0))
    value = denm.get_val()
    value["denm"]["management"]["eventPosition"].update(NOWHERE)
    denm.set_val(value)
    assert station.decode(denm.to_uper()) is None
    value = types.decode("VAM", encode_vam(Message(1, 0, at), types))
    value["vam"]["vamParameters"]["basicContainer"]["referencePosition"].update(NOWHERE)
    assert decode_vam(types.encode("VAM", value), types, 0) is None
    value = types.decode("CollectivePerceptionMessage", encode_cpm(Message(1, 0, at), types))
    value["payload"]["managementContainer"]["referencePosition"].update(NOWHERE)
    assert decode_cpm(types.encode("CollectivePerceptionMessage", value), types) is None
    far = (500_000.0, 5_400_000.0)  # beyond the pole
    assert station.decode(station.encode_cam(station.Message(1, far), 0)) is None
    assert decode_vam(encode_vam(Message(1, 0, far), types), types, 0) is None
    assert decode_cpm(encode_cpm(Message(1, 0, far), types), types) is None
    types = schema(STAND_IN)
    assert decode_bsm(encode_bsm(Message(1, 0, far), 0, types), types) is None
    frame = types.decode("MessageFrame", encode_bsm(Message(1, 0, at), 0, types))
    for unknown in ({"lat": 900_000_001}, {"long": 1_800_000_001}, {"secMark": 65535}):
        value = types.decode("BasicSafetyMessage", frame["value"])
        value["coreData"].update(unknown)
        bsm = frame | {"value": types.encode("BasicSafetyMessage", value)}
        assert decode_bsm(types.encode("MessageFrame", bsm), types) is None


@pytest.mark.parametrize(
    ("part", "wrong"),
    [
        ("position", {"xCoordinate": {"value": 131071, "confidence": 4096}}),
        ("position", {"yCoordinate": {"value": -131072, "confidence": 4096}}),
        *(("velocity", {"xVelocity": {"value": value, "confidence": 127}}) for value in (-16383, 16382, 16383)),
    ],
)
def test_an_object_whose_place_or_velocity_is_not_told_is_left_out(part: str, wrong: dict[str, Any]) -> None:
    types, seen = schema(), Seen((10.0, 0.0), (1.0, 0.0))
    value = types.decode(
        "CollectivePerceptionMessage", encode_cpm(Message(1, 0, (0.0, 0.0), objects=(seen,)), types)
    )
    container = value["payload"]["cpmContainers"][1]
    perceived = types.decode("PerceivedObjectContainer", container["containerData"])
    told = perceived["perceivedObjects"][0][part]
    (told[1] if part == "velocity" else told).update(wrong)
    container["containerData"] = types.encode("PerceivedObjectContainer", perceived)
    decoded = decode_cpm(types.encode("CollectivePerceptionMessage", value), types)
    assert decoded is not None and decoded.objects == ()


def test_no_cam_tells_a_heading_that_its_station_does_not_know(tmp_path: Path) -> None:
    its = ROOT / "docs" / "examples" / "its" / "its.toml"
    emulator.simulate(its, duration_s=0.3, set={"world.gnss.heading": False}, out=tmp_path / "run")
    payloads = pq.read_table(tmp_path / "run" / "payloads.parquet")["payload"].to_pylist()
    messages = [station.decode(payload) for payload in payloads]
    assert messages and all(message is not None and message.heading_rad is None for message in messages)
    known, unknown = (Fix(0, np.zeros(2), np.eye(2), heading_rad, 0.0) for heading_rad in (2.0, None))
    for last, now in ((known, unknown), (unknown, known)):
        assert not station.CamRules(last, in_a_row=1).is_due(replace(now, time_ns=200_000_000))
        assert not is_due(replace(now, time_ns=200_000_000), last)


def test_a_vam_of_a_clock_that_is_ahead_has_its_time() -> None:
    message = Message(1, 10_000_000_000, (0.0, 0.0))
    decoded = decode_vam(encode_vam(message, schema()), schema(), message.time_ns - 10_000_000)
    assert decoded is not None and decoded.time_ns == message.time_ns


def test_a_message_with_a_flipped_bit_or_cut_short_is_a_message_or_none() -> None:
    message = Message(7, 10**9, (10.0, -20.0), objects=(Seen((50.0, 60.0), (3.0, -4.0)),))
    sent = station.Message(message.station, message.position_m, cause=station.EMERGENCY_BRAKE)
    encoded = [
        encode_cpm(message, schema()),
        encode_vam(message, schema()),
        station.encode_cam(sent, message.time_ns),
        station.encode_denm(sent, 1, message.time_ns),
    ]
    for payload in encoded:
        number, bits = int.from_bytes(payload, "big"), 8 * len(payload)
        flipped = [(number ^ 1 << bit).to_bytes(len(payload), "big") for bit in range(bits)]
        for read in (*flipped, *(payload[:length] for length in range(len(payload)))):
            for decoded in (decode_cpm(read, schema()), decode_vam(read, schema(), 0)):
                assert decoded is None or isinstance(decoded, Message)
            assert isinstance(station.decode(read), station.Message | None)


@given(st.lists(st.tuples(st.integers(2, 100), st.booleans()), min_size=1, max_size=5))
def test_while_there_are_fixes_cams_are_at_most_a_second_apart(gaps: list[tuple[int, bool]]) -> None:
    """Each gap of so many periods without a fix, after which it may have moved, is followed by 3 s of fixes."""
    rules, period, east_m, sent = station.CamRules(), 0, 0.0, 0
    for gap, has_moved in [(1, False), *gaps]:
        period, east_m = period + gap, east_m + 100.0 * has_moved
        first = period
        for period in range(first, first + 30):
            if rules.is_due(Fix(period * 100_000_000, np.array([east_m, 0.0]), np.eye(2), 0.0, 0.0)):
                sent = period
            assert period - max(sent, first) < 10 or sent == period


def test_a_vehicle_and_a_building_hide_what_is_behind() -> None:
    place_m = np.array([[-40.0, 0.0], [-10.0, 0.0], [30.0, 0.0], [0.0, -40.0], [0.0, 5.0]])
    truth = SensedTruth(
        time_ns=0,
        node_ids=("a", "b", "c", "d", "e"),
        position_m=place_m,
        heading_rad=np.zeros(5),
        speed_m_s=np.full(5, 14.0),
        options={"range_m": 80.0, "misses": 0.0, "sigma": 0.0},
        rng=np.random.default_rng(1),
    )
    readings = {name: np.reshape(numbers, (-1, 4)) for name, numbers in sensor(truth, {}).items()}
    places_m = {
        name: sorted(map(tuple, (rows[:, :2] + place_m["abcde".index(name)]).tolist()))
        for name, rows in readings.items()
    }
    assert places_m["a"] == [(-10.0, 0.0), (0.0, 5.0)]  # b hides c, and a building d
    assert (0.0, -40.0) in places_m["e"] and (30.0, 0.0) in places_m["e"]
    assert readings["a"][:, 2:].tolist() == [[14.0, 0.0]] * 2


def test_what_several_tell_of_one_vehicle_is_one_place() -> None:
    seen = [Seen((50.0, 0.0), (10.0, 0.0))]
    told = Message(2, 0, (-30.0, 0.0), objects=(Seen((49.0, 0.5), (10.0, 0.0)), Seen((0.5, 0.0), (0.0, 0.0))))
    old = Message(3, -400_000_000, (200.0, 0.0))
    places = fused(100_000_000, (0.0, 0.0), seen, [(told, (10.0, 0.0)), (old, (0.0, 0.0))])
    assert places == [(50.0, 0.0), (-29.0, 0.0), (200.0, 0.0)]  # the third object is the vehicle itself
    assert fused(200_000_000, (0.0, 0.0), (), [(old, (0.0, 0.0))]) == []


def test_the_share_that_is_seen_and_ghosts_are_those_of_the_truth() -> None:
    position_m = np.array([[0.0, 0.0], [20.0, 0.0], [0.0, 50.0], [500.0, 0.0]])
    knows = [[(20.0, 1.0), (0.0, 60.0)], [(0.0, 0.0), (0.0, 50.0)], [], []]
    row = np.full((4, 2 * PLACES), NOWHERE_M)
    for number, places in enumerate(knows):
        row[number, : 2 * len(places)] = np.ravel(places)
    assert list(seen_of(position_m, row)) == pytest.approx([(1 / 2 + 1 + 0) / 3, 1 / 3])


def test_a_crossing_is_seen_better_together(tmp_path: Path) -> None:
    shares = []
    for number, changes in enumerate(({"program.options.shares": False}, {})):
        run = emulator.simulate(
            EXAMPLE / "perception.toml", duration_s=2.0, set=changes, out=tmp_path / str(number)
        )
        shares.append(float(run.metrics["seen_share"].to_numpy()[10:].mean()))
        assert run.verdict == ("unknown" if number == 0 else "valid")
    assert shares[0] < 0.5 and shares[1] > 0.95


@pytest.mark.parametrize("listens", [True, False])
def test_a_car_that_heeds_vams_does_not_run_into_a_cyclist(listens: bool, tmp_path: Path) -> None:
    scenario = {
        "run": {"duration_s": 20.0, "settle_s": 0.0},
        "network": {
            "kind": "driven",
            "vehicles": 2,
            "driven": {"start_m": [200.0, 50.0], "speed_mps": [5.0, 14.0]},
        },
        "radio": {"range_m": 300.0, "loss": 0.3},
        "program": {
            "entry": "docs.examples.its2.vulnerable:main",
            "options": {"cyclist": "v01", "listens": listens},
        },
    }
    run = emulator.simulate(scenario, out=tmp_path / "run")
    assert any(event.kind == "collision" for event in run.events) is not listens
