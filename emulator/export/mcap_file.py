"""Export of a run as MCAP with JSON messages, for Foxglove and Rerun.

Topics, each with its JSON schema: `/tf` the true pose of each vehicle (foxglove.FrameTransforms, which viewers show
with names), `/vehicles/fix` and `/vehicles/estimate` (foxglove.PosesInFrame), `/states` the truth, fixes and
reports of a period, `/metrics` its figures, `/frames` each frame with its receivers by outcome, `/events`. Messages
of ROS 2 that were sent by radio are there as they are, in CDR, if their payloads were kept. Times are nanoseconds
from the start of the run. The scenario is an attachment.
"""

from __future__ import annotations

import heapq
import json
import math
from base64 import b64encode
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
import pyarrow as pa

from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.run_folder import SCENARIO_FILE
from emulator.records.tables import PAYLOADS
from vnet.errors import VnetError
from vnet.extras import is_installed, require
from vnet.gateway.frames import CrossingSample, Reassembly
from vnet.gateway.ros2 import TopicKey, parse_topic
from vnet.units import NS_PER_S

Channel = str | tuple[str, TopicKey]
"""A topic of vnet's, or a vehicle and what it has published in ROS 2."""
Message = tuple[int, Channel, dict[str, Any] | bytes]
"""Time in ns, channel and content."""

NUMBER: dict[str, Any] = {"type": "number"}
TEXT: dict[str, Any] = {"type": "string"}
INTEGER: dict[str, Any] = {"type": "integer"}


def _object(**properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_TIME = _object(sec=INTEGER, nsec=INTEGER)
_VECTOR = _object(x=NUMBER, y=NUMBER, z=NUMBER)
_QUATERNION = _object(x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER)
_POSES = _object(timestamp=_TIME, frame_id=TEXT, poses=_list(_object(position=_VECTOR, orientation=_QUATERNION)))
_TRANSFORM = _object(
    timestamp=_TIME, parent_frame_id=TEXT, child_frame_id=TEXT, translation=_VECTOR, rotation=_QUATERNION
)
_STATE = _object(
    node=TEXT,
    position_m=_list(NUMBER),
    heading_rad=NUMBER,
    fix_m=_list(NUMBER),
    estimate_m=_list(NUMBER),
    covariance_m2=_list(NUMBER),
    values={"type": "object"},
)
_FRAME = _object(
    sender=TEXT,
    seq=INTEGER,
    copy=INTEGER,
    size_bytes=INTEGER,
    payload_digest=TEXT,
    payload={"type": "string", "contentEncoding": "base64"},
    cause=TEXT,
    outcomes={"type": "object", "additionalProperties": _list(TEXT)},
    altered=_list(TEXT),
)
SCHEMAS: dict[str, tuple[str, dict[str, Any]]] = {
    "/tf": ("foxglove.FrameTransforms", _object(transforms=_list(_TRANSFORM))),
    "/vehicles/fix": ("foxglove.PosesInFrame", _POSES),
    "/vehicles/estimate": ("foxglove.PosesInFrame", _POSES),
    "/states": ("vnet.States", _object(period=INTEGER, common_error_m=_list(NUMBER), vehicles=_list(_STATE))),
    "/metrics": ("vnet.PeriodFigures", {"type": "object"}),
    "/frames": ("vnet.Frame", _FRAME),
    "/events": ("vnet.Event", _object(kind=TEXT, node=TEXT, details={"type": "object"})),
}
"""Name and content of each topic's schema."""
_STATE_COLUMNS = ("position_m", "heading_rad", "fix_m")
"""Columns of `states.parquet` in `/states`, beside those that programs report."""


def write_mcap(
    recorded: OpenedRun,
    file: BinaryIO,
    definitions: Path | None = None,
    tell: Callable[[str], object] = lambda text: None,
) -> int:
    """Write a run; return the number of messages. Raise VnetError if the package mcap is missing.

    `definitions` is a folder with PACKAGE/msg/TYPE.msg of types of ROS 2 that rosbags has not. `tell` is told of
    each type without a definition.
    """
    require("MCAP", "mcap")
    from mcap.writer import Writer

    stores = _typestores(definitions)
    writer = Writer(file)
    writer.start(profile="", library="vnet")
    channels: dict[Channel, int] = {}
    for topic, (name, schema) in SCHEMAS.items():
        described = json.dumps({"title": name, **schema}).encode()
        schema_id = writer.register_schema(name, "jsonschema", described)
        channels[topic] = writer.register_channel(topic, "json", schema_id)
    count = 0
    for time_ns, channel, message in heapq.merge(*_streams(recorded), key=lambda one: one[0]):
        if isinstance(channel, tuple) and channel not in channels:
            vehicle, sent = channel
            text = _definition(stores, sent.type, sent.type_hash)
            if text is None:
                tell(f"{sent.type} of {vehicle}{sent.topic} has no definition with its hash, and so no schema")
            schema_id = 0 if text is None else writer.register_schema(sent.type, "ros2msg", text)
            told = {"node": vehicle, "type": sent.type, "type_hash": sent.type_hash}
            channels[channel] = writer.register_channel(f"/{vehicle}{sent.topic}", "cdr", schema_id, told)
        data = message if isinstance(message, bytes) else json.dumps(message, allow_nan=False).encode()
        writer.add_message(channels[channel], log_time=time_ns, publish_time=time_ns, data=data, sequence=count)
        count += 1
    scenario = recorded.scenario_text.encode()
    writer.add_attachment(
        create_time=0, log_time=0, name=SCENARIO_FILE, media_type="application/toml", data=scenario
    )
    writer.finish()  # type: ignore[no-untyped-call]
    return count


def _streams(recorded: OpenedRun) -> list[Iterator[Message]]:
    """Return the streams of messages, each in the order of time."""
    return [_periods(recorded), _metrics(recorded), _frames(recorded), _events(recorded), _ros2(recorded)]


def _ros2(recorded: RecordedRun) -> Iterator[Message]:
    """Yield the messages that programs of ROS 2 have published by radio, if the run has kept its payloads."""
    table = recorded.table(PAYLOADS)
    if table is None or recorded.scenario.radio.profile != "ros2":
        return
    reassembly = Reassembly()
    for row in table.sort_by([(name, "ascending") for name in ("time_ns", "sender", "seq")]).to_pylist():
        try:
            message = reassembly.take(row["sender"], row["payload"])
        except (msgspec.MsgspecError, LookupError):  # of a program that has the radio's bytes in hand
            continue
        if isinstance(message, CrossingSample) and not message.is_delete:
            topic = parse_topic(message.key)
            if topic is not None and topic.key == message.key:
                yield row["time_ns"], (row["sender"], topic), message.payload


def _typestores(definitions: Path | None) -> list[Any]:
    """Return the types of a folder, and those of Humble and of each later ROS 2 of rosbags, with the folder's.

    Without rosbags there are none.
    """
    if not is_installed("rosbags"):
        if definitions is not None:
            require("definitions of ROS 2", "rosbags")
        return []
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

    later = list(Stores)[list(Stores).index(Stores.ROS2_HUMBLE) :]
    stores = [get_typestore(each) for each in (Stores.EMPTY, *later)]
    files = [] if definitions is None else sorted(definitions.glob("**/msg/*.msg"))
    if definitions is not None and not files:
        raise VnetError(f"{definitions}: has no PACKAGE/msg/TYPE.msg")
    for path in files:
        name = f"{path.absolute().parts[-3]}/msg/{path.stem}"
        try:
            types = get_types_from_msg(path.read_text(), name)
            for store in stores:
                store.register({name: each for name, each in types.items() if name not in store.fielddefs})
        except (OSError, UnicodeDecodeError, TypesysError) as error:
            raise VnetError(f"{path}: is no definition of {name}: {' '.join(str(error).split())}") from None
    return stores


def _definition(stores: Sequence[Any], ros_type: str, type_hash: str) -> bytes | None:
    """Return the definition of a type, with those it uses; None unless there is one with this hash.

    Of a type without a hash, as Humble sends them, it is the first: of a folder, or the oldest.
    """
    for store in (each for each in stores if ros_type in each.fielddefs):
        try:
            if not type_hash.startswith("RIHS01_") or store.hash_rihs01(ros_type) == type_hash:
                return bytes(store.generate_msgdef(ros_type, ros_version=2)[0].encode())
        except KeyError:  # of a type that it uses, and that is not there
            continue
    return None


def _periods(recorded: RecordedRun) -> Iterator[Message]:
    count, values = len(recorded.node_ids), recorded.value_names
    names = [*_STATE_COLUMNS, *(name for name in recorded.reported_names if name not in values)]
    for start in range(0, len(recorded.states), max(count, 1)):
        rows = recorded.states.slice(start, count).to_pylist()
        time_ns = rows[0]["time_ns"]
        yield time_ns, "/tf", {"transforms": [_transform(row) for row in rows if _is_point(row["position_m"])]}
        for topic, name in (("/vehicles/fix", "fix_m"), ("/vehicles/estimate", "estimate_m")):
            poses = [_pose(row[name]) for row in rows if _is_point(row[name])]
            yield time_ns, topic, {"timestamp": _stamp(time_ns), "frame_id": "map", "poses": poses}
        yield (
            time_ns,
            "/states",
            {
                "period": rows[0]["period"],
                "common_error_m": _finite(rows[0]["common_error_m"]),
                "vehicles": [_state(row, names, values) for row in rows if _is_point(row["position_m"])],
            },
        )


def _state(row: dict[str, Any], names: Sequence[str], own: Sequence[str]) -> dict[str, Any]:
    """Return the state of a vehicle: `names` are columns, `own` those of values by names of the program's own.

    Columns that have no numbers are left out, as a fix in an outage.
    """
    columns = {name: row[name] for name in names if row[name] is not None and np.isfinite(row[name]).all()}
    values = {name: _finite(value) for name, value in row["values"] or ()}
    values |= {name: _finite(row[name]) for name in own if row[name] is not None}
    return {
        "node": row["node"],
        **columns,
        "values": values,
    }


def _is_point(point: list[float] | None) -> bool:
    return point is not None and all(map(math.isfinite, point))


def _finite(value: Any) -> Any:
    """Return a number, or a list of numbers, with null for NaN and infinity, which JSON lacks."""
    if isinstance(value, list):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _stamp(time_ns: int) -> dict[str, int]:
    sec, nsec = divmod(time_ns, NS_PER_S)
    return {"sec": sec, "nsec": nsec}


def _vector(point: list[float]) -> dict[str, float]:
    return {"x": point[0], "y": point[1], "z": 0.0}


def _pose(point: list[float]) -> dict[str, Any]:
    return {"position": _vector(point), "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


def _transform(row: dict[str, Any]) -> dict[str, Any]:
    heading_rad = row["heading_rad"] if math.isfinite(row["heading_rad"]) else 0.0
    half = heading_rad / 2
    return {
        "timestamp": _stamp(row["time_ns"]),
        "parent_frame_id": "map",
        "child_frame_id": row["node"],
        "translation": _vector(row["position_m"]),
        "rotation": {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)},
    }


def _metrics(recorded: RecordedRun) -> Iterator[Message]:
    for row in recorded.metrics.to_pylist():
        yield row["time_ns"], "/metrics", {name: _finite(value) for name, value in row.items()}


def _events(recorded: RecordedRun) -> Iterator[Message]:
    for event in sorted(recorded.events, key=lambda event: event.time_ns):
        yield event.time_ns, "/events", {"kind": event.kind, "node": event.node or "", "details": event.details}


def _frames(recorded: OpenedRun) -> Iterator[Message]:
    order = np.lexsort((recorded.receiver, recorded.emission, recorded.sent_ns))
    edges = np.flatnonzero(np.diff(recorded.emission[order])) + 1
    outcomes = recorded.trace["outcome"].cast(pa.string()).to_pylist()
    causes = recorded.trace["cause"].cast(pa.string()).to_pylist()
    sizes, altered = recorded.column("size_bytes"), recorded.caused_by("corrupt", "custom")
    for rows in np.split(order, edges) if len(order) else ():
        by_outcome: dict[str, list[str]] = {}
        for row in rows.tolist():
            by_outcome.setdefault(outcomes[row], []).append(recorded.node_ids[int(recorded.receiver[row])])
        first = int(rows[np.argmin(altered[rows])])  # which shows what was sent, if any does
        others = rows[recorded.digest[rows] != recorded.digest[first]].tolist()
        sender, seq = recorded.node_ids[int(recorded.sender[first])], int(recorded.seq[first])
        kept = recorded.payloads
        payload = None if kept is None else kept.of(sender, seq, recorded.digest[rows].tolist())
        yield (
            int(recorded.sent_ns[first]),
            "/frames",
            {
                "sender": sender,
                "seq": seq,
                "copy": int(recorded.copy[first]),
                "size_bytes": int(sizes[first]),
                "payload_digest": f"{int(recorded.digest[first]):016x}",
                **({} if payload is None else {"payload": b64encode(payload).decode()}),
                "cause": causes[first],
                "outcomes": by_outcome,
                "altered": [recorded.node_ids[int(recorded.receiver[row])] for row in others],
            },
        )
