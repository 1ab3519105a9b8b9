"""An ITS station: CAMs by the rules of EN 302 637-2, DENMs while it brakes hard, and a list of those that it hears.

Messages are those of release 1, in unaligned PER. CAM: ETSI EN 302 637-2 V1.4.1. DENM: ETSI EN 302 637-3 V1.3.1.
Both take their data from TS 102 894-2 V1.3.1. The compiled modules are pycrate's (extra `its`); each of its objects
holds one value, so that a message is encoded or decoded at once.

Options: `brakes`, the vehicle that brakes, and `at_s`, when.
"""

from __future__ import annotations

import math
import re
import zlib
from dataclasses import dataclass
from typing import Any

from pycrate_asn1dir.ITS_CAM_2 import CAM_PDU_Descriptions
from pycrate_asn1dir.ITS_DENM_3 import DENM_PDU_Descriptions

from vnet import Fix, Node

VERSION, DENM, CAM = 2, 1, 2
"""Protocol version, and the numbers of the two messages, which begin each of them."""
ORIGIN_DEG = 48.7758, 9.1829
"""Latitude and longitude of the scenario's origin."""
DEGREE_M = 111_320.0
"""Length of a degree of latitude."""
START_MS = 694_310_405_000
"""The run's beginning, in milliseconds from 2004-01-01 as TimestampIts counts (with leap seconds): 2026-01-01."""
PASSENGER_CAR = 5
EMERGENCY_BRAKE = 99, 1
"""Cause and subcause of a DENM: dangerous situation, emergency electronic brake lights engaged."""
UNKNOWN_HEADING, UNKNOWN_SPEED, UNKNOWN_LATITUDE, UNKNOWN_LONGITUDE = 3601, 16383, 900_000_001, 1_800_000_001
"""The standards' values for what a station does not know."""
UNKNOWN_ALTITUDE = {"altitudeValue": 800001, "altitudeConfidence": "unavailable"}


@dataclass(frozen=True)
class Message:
    """Content of a message, as far as this example uses it. A DENM has a `cause`, and a CAM has none.

    A heading and a speed that the station does not know, and those of a DENM, are None.
    """

    station: int
    position_m: tuple[float, float]
    heading_rad: float | None = None
    speed_m_s: float | None = None
    cause: tuple[int, int] | None = None


def encode_cam(message: Message, time_ns: int) -> bytes:
    """Return a CAM with the containers that each one must have."""
    heading, speed = UNKNOWN_HEADING, UNKNOWN_SPEED
    if message.heading_rad is not None:
        heading = round(10 * (math.degrees(math.pi / 2 - message.heading_rad) % 360)) % 3600
    if message.speed_m_s is not None:
        speed = min(round(100 * message.speed_m_s), 16382)
    unavailable = {"curvatureValue": 1023, "curvatureConfidence": "unavailable"}
    high_frequency = {
        "heading": {"headingValue": heading, "headingConfidence": 127 if heading == UNKNOWN_HEADING else 10},
        "speed": {"speedValue": speed, "speedConfidence": 127 if speed == UNKNOWN_SPEED else 10},
        "driveDirection": "forward",
        "vehicleLength": {"vehicleLengthValue": 45, "vehicleLengthConfidenceIndication": "noTrailerPresent"},
        "vehicleWidth": 18,
        "longitudinalAcceleration": {
            "longitudinalAccelerationValue": 161,
            "longitudinalAccelerationConfidence": 102,
        },
        "curvature": unavailable,
        "curvatureCalculationMode": "unavailable",
        "yawRate": {"yawRateValue": 32767, "yawRateConfidence": "unavailable"},
    }
    basic = {"stationType": PASSENGER_CAR, "referencePosition": _position(message.position_m)}
    body = {
        "generationDeltaTime": _timestamp_ms(time_ns) % 65536,
        "camParameters": {
            "basicContainer": basic,
            "highFrequencyContainer": ("basicVehicleContainerHighFrequency", high_frequency),
        },
    }
    return _encoded(CAM_PDU_Descriptions.CAM, CAM, message.station, {"cam": body})


def encode_denm(message: Message, number: int, time_ns: int) -> bytes:
    """Return a DENM, the `number`-th event of its station, detected now."""
    assert message.cause is not None
    cause, subcause = message.cause
    body = {
        "management": {
            "actionID": {"originatingStationID": message.station, "sequenceNumber": number},
            "detectionTime": _timestamp_ms(time_ns),
            "referenceTime": _timestamp_ms(time_ns),
            "eventPosition": _position(message.position_m),
            "stationType": PASSENGER_CAR,
        },
        "situation": {"informationQuality": 3, "eventType": {"causeCode": cause, "subCauseCode": subcause}},
    }
    return _encoded(DENM_PDU_Descriptions.DENM, DENM, message.station, {"denm": body})


def decode(payload: bytes) -> Message | None:
    """Return a message; None for bytes that are none, which the radio may well deliver.

    None, too, for a DENM that ends an event, for a CAM of a roadside unit, and for a message without a position.
    """
    known = {CAM: CAM_PDU_Descriptions.CAM, DENM: DENM_PDU_Descriptions.DENM}
    if len(payload) < 2 or payload[0] != VERSION or payload[1] not in known:
        return None
    try:
        known[payload[1]].from_uper(payload)
        value = known[payload[1]].get_val()
    except Exception:  # pycrate has many kinds of errors for damaged bytes
        return None
    station = value["header"]["stationID"]
    if payload[1] == DENM:
        if "situation" not in value["denm"]:
            return None
        management, event = value["denm"]["management"], value["denm"]["situation"]["eventType"]
        position_m = _metres(management["eventPosition"])
        cause = event["causeCode"], event["subCauseCode"]
        return None if position_m is None else Message(station, position_m, cause=cause)
    parameters = value["cam"]["camParameters"]
    kind, high_frequency = parameters["highFrequencyContainer"]
    position_m = _metres(parameters["basicContainer"]["referencePosition"])
    if kind != "basicVehicleContainerHighFrequency" or position_m is None:
        return None
    heading, speed = high_frequency["heading"]["headingValue"], high_frequency["speed"]["speedValue"]
    heading_rad = None if heading == UNKNOWN_HEADING else math.radians(90 - heading / 10) % math.tau
    return Message(station, position_m, heading_rad, None if speed == UNKNOWN_SPEED else speed / 100)


def shown(payload: bytes) -> str:
    """Return a message in words, for `vnet trace --decode`."""
    message = decode(payload)
    if message is None:
        return "no CAM or DENM"
    speed = "speed unknown" if message.speed_m_s is None else f"{message.speed_m_s:.1f} m/s"
    kind = f"CAM, {speed}" if message.cause is None else f"DENM, cause {message.cause}"
    return f"{kind}, station {message.station} at {message.position_m[0]:.0f}, {message.position_m[1]:.0f} m"


def _encoded(description: Any, kind: int, station: int, body: dict[str, Any]) -> bytes:
    header = {"protocolVersion": VERSION, "messageID": kind, "stationID": station}
    description.set_val({"header": header} | body)
    encoded: bytes = description.to_uper()
    return encoded


def _timestamp_ms(time_ns: int) -> int:
    return START_MS + time_ns // 1_000_000


def _position(position_m: tuple[float, float]) -> dict[str, Any]:
    latitude_deg = ORIGIN_DEG[0] + position_m[1] / DEGREE_M
    longitude_deg = ORIGIN_DEG[1] + position_m[0] / (DEGREE_M * math.cos(math.radians(ORIGIN_DEG[0])))
    unavailable = {"semiMajorConfidence": 4095, "semiMinorConfidence": 4095, "semiMajorOrientation": 3601}
    latitude, longitude = round(latitude_deg * 1e7), round(longitude_deg * 1e7)
    if abs(latitude) > 900_000_000 or abs(longitude) >= 1_800_000_000:
        latitude, longitude = UNKNOWN_LATITUDE, UNKNOWN_LONGITUDE
    return {
        "latitude": latitude,
        "longitude": longitude,
        "positionConfidenceEllipse": unavailable,
        "altitude": UNKNOWN_ALTITUDE,
    }


def _metres(position: dict[str, Any]) -> tuple[float, float] | None:
    if position["latitude"] == UNKNOWN_LATITUDE or position["longitude"] == UNKNOWN_LONGITUDE:
        return None
    north_m = (position["latitude"] / 1e7 - ORIGIN_DEG[0]) * DEGREE_M
    east_m = (position["longitude"] / 1e7 - ORIGIN_DEG[1]) * DEGREE_M * math.cos(math.radians(ORIGIN_DEG[0]))
    return east_m, north_m


HEADING_RAD, POSITION_M, SPEED_M_S = math.radians(4), 4.0, 0.5
"""Changes since the last CAM that call for another."""
SHORTEST_S, LONGEST_S = 0.1, 1.0
"""Least and greatest interval between two CAMs (T_GenCamMin, T_GenCamMax)."""
IN_A_ROW = 3
"""CAMs without a change, after which the interval is the longest again (N_GenCam)."""
BRAKING_M_S2 = -6.0


@dataclass
class CamRules:
    """Generation of CAMs (clause 6.1.3): `is_due` is asked at each fix, and tells whether a CAM is sent."""

    last: Fix | None = None
    interval_s: float = LONGEST_S
    in_a_row: int = 0

    def is_due(self, fix: Fix) -> bool:
        """Tell whether to send a CAM now, and remember it."""
        if self.last is None:
            self.last = fix
            return True
        passed_s = (fix.time_ns - self.last.time_ns) / 1e9
        if passed_s < SHORTEST_S - 1e-9:
            return False
        if self._has_changed(fix):
            self.interval_s, self.in_a_row = min(passed_s, LONGEST_S), 0
        elif passed_s >= self.interval_s - 1e-9:
            self.in_a_row += 1
            if self.in_a_row >= IN_A_ROW:
                self.interval_s = LONGEST_S
        else:
            return False
        self.last = fix
        return True

    def _has_changed(self, fix: Fix) -> bool:
        assert self.last is not None
        east_m, north_m = (fix.position_m - self.last.position_m).tolist()
        return (
            abs(math.remainder(_change(fix.heading_rad, self.last.heading_rad), math.tau)) > HEADING_RAD
            or math.hypot(east_m, north_m) > POSITION_M
            or abs(_change(fix.speed_m_s, self.last.speed_m_s)) > SPEED_M_S
        )


def _change(now: float | None, before: float | None) -> float:
    """Return a change; 0 where one of the two is not known."""
    return 0.0 if now is None or before is None else now - before


def station_of(name: str) -> int:
    """Return the number of a station of this name: of `v07` 7, of others a checksum."""
    return int(name[1:]) if re.fullmatch("v[0-9]+", name) else zlib.crc32(name.encode())


async def main(node: Node) -> None:
    """Send CAMs, brake and warn if it is one's turn, and count what is heard."""
    station, rules = station_of(node.id), CamRules()
    brakes, at_s = node.options.get("brakes"), node.options.get("at_s", 2.0)
    known: set[int] = set()
    warned = sent = 0
    async for fix in node.gnss:
        for packet in node.radio.drain():
            message = decode(packet.payload)
            if message is None:
                continue
            known.add(message.station)
            if message.cause is not None and not warned:
                node.event("warned", station=message.station, cause=message.cause[0])
                warned = 1
        here = Message(station, tuple(fix.position_m.tolist()), fix.heading_rad, fix.speed_m_s)
        if rules.is_due(fix):
            await node.radio.broadcast(encode_cam(here, fix.time_ns))
            sent += 1
        if node.id == brakes and fix.time_ns >= at_s * 1e9 and (fix.speed_m_s or 0.0) > 0.5:
            node.drive(acceleration_m_s2=BRAKING_M_S2)
            warning = Message(here.station, here.position_m, cause=EMERGENCY_BRAKE)
            await node.radio.broadcast(encode_denm(warning, 1, fix.time_ns))
        node.report(fix.position_m, fix.covariance_m2, stations=len(known), warned=warned, cams=sent)
