"""CPM and VAM of ETSI's release 2, and the BSM of SAE J2735, by schemas of ASN.1: docs/how-to/standard-messages.md.

asn1tools (extra `its`) compiles the schemas and encodes in unaligned PER. `its2.asn` has what the examples send of
CPM and VAM; ETSI's own modules may stand in its place. The schema of J2735 is SAE's: bring your copy.
"""

from __future__ import annotations

import math
import re
import zlib
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import asn1tools

from vnet.errors import VnetError, printable

PROFILE = Path(__file__).with_name("its2.asn")
ORIGIN_DEG = 48.7758, 9.1829
"""Latitude and longitude of the scenario's origin."""
DEGREE_M = 111_320.0
"""Length of a degree of latitude."""
START_MS = 694_310_405_000
"""The run's beginning, in milliseconds from 2004-01-01 as TimestampIts counts (with leap seconds): 2026-01-01."""
CPM_HEADER, VAM_HEADER = {"protocolVersion": 2, "messageId": 14}, {"protocolVersion": 3, "messageId": 16}
VEHICLE_CONTAINER, OBJECT_CONTAINER = 1, 5
"""Numbers of a CPM's containers."""
MOST_OBJECTS = 255
"""Most objects of a CPM."""
CYCLIST = 2
"""Station type of a VAM."""
BSM = 20
"""`messageId` of a BSM in a `MessageFrame`."""
NOT_KNOWN = 127
"""Confidence of speeds and angles: unavailable."""
UNKNOWN_HEADING, UNKNOWN_SPEED = 3601, 16383
UNKNOWN_BSM_HEADING, UNKNOWN_BSM_SPEED, UNKNOWN_SECOND = 28800, 8191, 65535
UNKNOWN_LATITUDE, UNKNOWN_LONGITUDE = 900_000_001, 1_800_000_001
"""The standards' values for what a station does not know."""
Xy = tuple[float, float]


@cache
def schema(path: str | Path = PROFILE, *needed: str) -> Any:
    """Return the compiled types of a file of ASN.1, or of all `*.asn` in a folder.

    Raises VnetError in one line, also if one of the types `needed` is not there.
    """
    path = Path(str(path))
    files = sorted(path.rglob("*.asn")) if path.is_dir() else [path]
    if not files or not all(file.is_file() for file in files):
        raise VnetError(f"program.options.asn1 = '{path}': a file of ASN.1, or a folder with *.asn, is needed")
    try:
        types = asn1tools.compile_files([str(file) for file in files], "uper", encoding="latin-1")
    except (asn1tools.ParseError, asn1tools.CompileError) as error:
        raise VnetError(f"program.options.asn1 = '{path}': {str(error).splitlines()[0]}") from None
    if missing := [name for name in needed if name not in types.types]:
        raise VnetError(f"program.options.asn1 = '{path}': has no type {', '.join(missing)}")
    return types


@dataclass(frozen=True)
class Seen:
    """A road user at `position_m` with `velocity_m_s`, east and north, `age_s` before the message's time."""

    position_m: Xy
    velocity_m_s: Xy
    age_s: float = 0.0


@dataclass(frozen=True)
class Message:
    """Content of a message, as far as the examples use it: its sender and, in a CPM, what that sees of others.

    A heading and a speed that it does not tell are None.
    """

    station: int
    time_ns: int
    position_m: Xy
    heading_rad: float | None = None
    speed_m_s: float | None = None
    objects: tuple[Seen, ...] = ()


def station_of(name: str) -> int:
    """Return the number of a station of this name: of `v07` 7, of others a checksum."""
    return int(name[1:]) if re.fullmatch("v[0-9]+", name) else zlib.crc32(name.encode())


def encode_cpm(message: Message, types: Any) -> bytes:
    """Return a CPM with the containers of a vehicle and of objects, in m east and north of the vehicle.

    Objects that a CPM cannot say are left out: further than 1.3 km, faster than 163 m/s, older than 2 s, or more
    than 255.
    """
    sayable = [seen for seen in message.objects if _is_sayable(message, seen)][:MOST_OBJECTS]
    objects = [_object(number, message, seen) for number, seen in enumerate(sayable)]
    vehicle = {"orientationAngle": {"value": _to_north(message.heading_rad), "confidence": NOT_KNOWN}}
    perceived = {"numberOfPerceivedObjects": len(objects), "perceivedObjects": objects}
    containers = {
        VEHICLE_CONTAINER: types.encode("OriginatingVehicleContainer", vehicle),
        OBJECT_CONTAINER: types.encode("PerceivedObjectContainer", perceived),
    }
    ellipse = {"semiMajorConfidence": 4095, "semiMinorConfidence": 4095, "semiMajorOrientation": 3601}
    management = {
        "referenceTime": START_MS + message.time_ns // 1_000_000,
        "referencePosition": _place(message.position_m) | {"positionConfidenceEllipse": ellipse},
    }
    wrapped = [{"containerId": key, "containerData": data} for key, data in containers.items()]
    payload = {"managementContainer": management, "cpmContainers": wrapped}
    value = {"header": CPM_HEADER | {"stationId": message.station}, "payload": payload}
    return bytes(types.encode("CollectivePerceptionMessage", value))


def _is_sayable(message: Message, seen: Seen) -> bool:
    """Return whether an object is within the ranges of its fields, which asn1tools does not check."""
    offsets_m = [there_m - here_m for there_m, here_m in zip(seen.position_m, message.position_m, strict=True)]
    is_near = all(-1310.715 < offset_m < 1310.705 for offset_m in offsets_m)  # false for NaN, too
    return is_near and all(abs(each) <= 163.81 for each in seen.velocity_m_s) and -2.047 <= seen.age_s <= 2.047


def _object(number: int, message: Message, seen: Seen) -> dict[str, Any]:
    coordinates = {
        f"{axis}Coordinate": {"value": round(100 * (there_m - here_m)), "confidence": 4096}
        for axis, there_m, here_m in zip("xy", seen.position_m, message.position_m, strict=True)
    }
    velocity = {
        f"{axis}Velocity": {"value": round(100 * speed_m_s), "confidence": NOT_KNOWN}
        for axis, speed_m_s in zip("xy", seen.velocity_m_s, strict=True)
    }
    return {
        "objectId": number,
        "measurementDeltaTime": round(-1000 * seen.age_s),
        "position": coordinates,
        "velocity": ("cartesianVelocity", velocity),
    }


@lru_cache(maxsize=1024)  # in a simulation all receivers decode the same bytes
def decode_cpm(payload: bytes, types: Any) -> Message | None:
    """Return a CPM; None for bytes that are none, which the radio may well deliver, and for one without a position.

    Objects whose place or velocity along the axes is not told, or is out of range, are left out.
    """
    if payload[:2] != bytes(CPM_HEADER.values()):
        return None
    try:
        value = types.decode("CollectivePerceptionMessage", payload)
        of = {each["containerId"]: each["containerData"] for each in value["payload"]["cpmContainers"]}
        heading, found = UNKNOWN_HEADING, []
        if VEHICLE_CONTAINER in of:
            vehicle = types.decode("OriginatingVehicleContainer", of[VEHICLE_CONTAINER])
            heading = vehicle["orientationAngle"]["value"]
        if OBJECT_CONTAINER in of:
            found = types.decode("PerceivedObjectContainer", of[OBJECT_CONTAINER])["perceivedObjects"]
        management = value["payload"]["managementContainer"]
        position_m = _metres(management["referencePosition"])
    except Exception:  # asn1tools has many kinds of errors for damaged bytes
        return None
    time_ns = (management["referenceTime"] - START_MS) * 1_000_000
    objects = tuple(_seen(each, position_m) for each in found if _is_told(each))
    return Message(value["header"]["stationId"], time_ns, position_m, _from_north(heading), objects=objects)


def _is_told(found: dict[str, Any]) -> bool:
    """Return whether an object's place and velocity along the axes are known and in range."""
    kind, velocity = found.get("velocity", ("", {}))
    return (
        kind == "cartesianVelocity"
        and all(-131072 < found["position"][f"{axis}Coordinate"]["value"] < 131071 for axis in "xy")
        and all(-16383 < velocity[f"{axis}Velocity"]["value"] < 16382 for axis in "xy")
    )


def _seen(found: dict[str, Any], origin_m: Xy) -> Seen:
    x_m, y_m = (found["position"][f"{axis}Coordinate"]["value"] / 100 for axis in "xy")
    _, velocity = found["velocity"]
    x_m_s, y_m_s = (velocity[f"{axis}Velocity"]["value"] / 100 for axis in "xy")
    return Seen((origin_m[0] + x_m, origin_m[1] + y_m), (x_m_s, y_m_s), found["measurementDeltaTime"] / -1000)


def encode_vam(message: Message, types: Any) -> bytes:
    """Return a VAM of a cyclist with the containers that each one must have."""
    speed = UNKNOWN_SPEED
    if message.speed_m_s is not None:
        speed = min(round(100 * abs(message.speed_m_s)), 16382)
    ellipse = {"semiMajorAxisLength": 4095, "semiMinorAxisLength": 4095, "semiMajorAxisOrientation": 3601}
    basic = {
        "stationType": CYCLIST,
        "referencePosition": _place(message.position_m) | {"positionConfidenceEllipse": ellipse},
    }
    moves = {
        "heading": {"value": _to_north(message.heading_rad), "confidence": NOT_KNOWN},
        "speed": {"speedValue": speed, "speedConfidence": NOT_KNOWN},
        "longitudinalAcceleration": {
            "longitudinalAccelerationValue": 161,
            "longitudinalAccelerationConfidence": 102,
        },
    }
    body = {
        "generationDeltaTime": (START_MS + message.time_ns // 1_000_000) % 65536,
        "vamParameters": {"basicContainer": basic, "vruHighFrequencyContainer": moves},
    }
    return bytes(types.encode("VAM", {"header": VAM_HEADER | {"stationId": message.station}, "vam": body}))


def decode_vam(payload: bytes, types: Any, now_ns: int) -> Message | None:
    """Return a VAM of the last minute, or of 5 s to come by a slow clock; None for bytes that are none.

    None, too, for a VAM without a position.
    """
    if payload[:2] != bytes(VAM_HEADER.values()):
        return None
    try:
        value = types.decode("VAM", payload)
        parameters = value["vam"]["vamParameters"]
        position_m = _metres(parameters["basicContainer"]["referencePosition"])
    except Exception:
        return None
    now_ms = START_MS + now_ns // 1_000_000
    age_ms = (now_ms - value["vam"]["generationDeltaTime"] + 5000) % 65536 - 5000
    moves = parameters["vruHighFrequencyContainer"]
    speed = moves["speed"]["speedValue"]
    return Message(
        station=value["header"]["stationId"],
        time_ns=(now_ms - age_ms - START_MS) * 1_000_000,
        position_m=position_m,
        heading_rad=_from_north(moves["heading"]["value"]),
        speed_m_s=None if speed == UNKNOWN_SPEED else speed / 100,
    )


def encode_bsm(message: Message, count: int, types: Any) -> bytes:
    """Return a `MessageFrame` with a BSM, the `count`-th of its station, whose core data say what is not known.

    Raises VnetError in one line for `types` that have other fields.
    """
    place, heading, speed = _place(message.position_m), UNKNOWN_BSM_HEADING, UNKNOWN_BSM_SPEED
    if message.heading_rad is not None:
        heading = round(math.degrees(math.pi / 2 - message.heading_rad) % 360 / 0.0125) % 28800
    if message.speed_m_s is not None:
        speed = min(round(abs(message.speed_m_s) / 0.02), 8190)
    core = {
        "msgCnt": count % 128,
        "id": (message.station % 2**32).to_bytes(4, "big"),
        "secMark": message.time_ns // 1_000_000 % 60_000,
        "lat": place["latitude"],
        "long": place["longitude"],
        "elev": -4096,
        "accuracy": {"semiMajor": 255, "semiMinor": 255, "orientation": 65535},
        "transmission": "unavailable",
        "speed": speed,
        "heading": heading,
        "angle": 127,
        "accelSet": {"long": 2001, "lat": 2001, "vert": -127, "yaw": 0},
        "brakes": {
            "wheelBrakes": (b"\x80", 5),
            **dict.fromkeys(("traction", "abs", "scs", "brakeBoost", "auxBrakes"), "unavailable"),
        },
        "size": {"width": 180, "length": 450},
    }
    try:
        value = types.encode("BasicSafetyMessage", {"coreData": core})
        return bytes(types.encode("MessageFrame", {"messageId": BSM, "value": value}))
    except asn1tools.EncodeError as error:
        raise VnetError(f"program.options.asn1: not the BSM of J2735: {printable(str(error), 80)}") from None


def decode_bsm(payload: bytes, types: Any) -> Message | None:
    """Return a BSM, its time within a minute; None for bytes that are none and a BSM without position or time."""
    try:
        frame = types.decode("MessageFrame", payload)
        if frame["messageId"] != BSM:
            return None
        core = types.decode("BasicSafetyMessage", frame["value"])["coreData"]
        position_m = _metres({"latitude": core["lat"], "longitude": core["long"]})
    except Exception:
        return None
    if core["secMark"] == UNKNOWN_SECOND:
        return None
    heading, speed = core["heading"], core["speed"]
    return Message(
        station=int.from_bytes(core["id"], "big"),
        time_ns=core["secMark"] * 1_000_000,
        position_m=position_m,
        heading_rad=None if heading == UNKNOWN_BSM_HEADING else math.radians(90 - heading * 0.0125) % math.tau,
        speed_m_s=None if speed == UNKNOWN_BSM_SPEED else speed * 0.02,
    )


def _to_north(heading_rad: float | None) -> int:
    """Return a heading from east as ETSI's tenths of a degree from north, clockwise."""
    if heading_rad is None:
        return UNKNOWN_HEADING
    return round(10 * (math.degrees(math.pi / 2 - heading_rad) % 360)) % 3600


def _from_north(angle: int) -> float | None:
    return None if angle == UNKNOWN_HEADING else math.radians(90 - angle / 10) % math.tau


def _place(position_m: Xy) -> dict[str, Any]:
    latitude_deg = ORIGIN_DEG[0] + position_m[1] / DEGREE_M
    longitude_deg = ORIGIN_DEG[1] + position_m[0] / (DEGREE_M * math.cos(math.radians(ORIGIN_DEG[0])))
    altitude = {"altitudeValue": 800001, "altitudeConfidence": "unavailable"}
    latitude, longitude = round(latitude_deg * 1e7), round(longitude_deg * 1e7)
    if abs(latitude) > 900_000_000 or abs(longitude) >= 1_800_000_000:  # which asn1tools does not check
        latitude, longitude = UNKNOWN_LATITUDE, UNKNOWN_LONGITUDE
    return {"latitude": latitude, "longitude": longitude, "altitude": altitude}


def _metres(place: dict[str, Any]) -> Xy:
    """Return a position in m east and north of the origin. Raises ValueError for one that is not known."""
    if place["latitude"] == UNKNOWN_LATITUDE or place["longitude"] == UNKNOWN_LONGITUDE:
        raise ValueError("without a position")
    north_m = (place["latitude"] / 1e7 - ORIGIN_DEG[0]) * DEGREE_M
    east_m = (place["longitude"] / 1e7 - ORIGIN_DEG[1]) * DEGREE_M * math.cos(math.radians(ORIGIN_DEG[0]))
    return east_m, north_m
