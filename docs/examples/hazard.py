"""Hazard warnings that are forwarded from vehicle to vehicle, with msgpack payloads.

The vehicle `source` (in `[program.options]`; by default v1, v01, v001, …) warns of a hazard at its position.
Whoever is warned for the first time forwards it once, with one hop more: so it reaches vehicles far beyond the
range of the source.
Each vehicle reports whether it is warned, over how many hops, and after how many milliseconds:

    vnet simulate scenarios/beacon.toml --program docs.examples.hazard:main --set radio.range_m=1500
"""

from __future__ import annotations

import re
from typing import Any

import msgpack

from vnet import Node

MOST_HOPS = 10
"""A warning that has been forwarded so often goes no further."""
FIRST = re.compile("v0*1")
"""Id of the source where no option says it: the first vehicle of a generated network of any size."""


def read_warning(payload: bytes) -> dict[str, Any] | None:
    """A payload as a warning; None for anything else that the radio may bring."""
    try:
        message = msgpack.unpackb(payload)
    except ValueError:
        return None
    types = {"kind": str, "event": str, "position_m": list, "since_ns": int, "hops": int}
    if not isinstance(message, dict) or message.keys() != types.keys() or message["kind"] != "hazard":
        return None
    return message if all(type(message[name]) is kind for name, kind in types.items()) else None


async def main(node: Node) -> None:
    """Warn, or forward each warning once; report at each fix what is known."""
    source = node.options.get("source")
    is_source = node.id == source if source else FIRST.fullmatch(node.id) is not None
    known: dict[str, dict[str, Any]] = {}
    delay_ms: dict[str, float] = {}
    malformed = 0
    async for fix in node.gnss:
        if is_source and not known:
            position_m = fix.position_m.tolist()
            event = {"event": f"{node.id}/1", "position_m": position_m, "since_ns": node.now_ns, "hops": 0}
            known[f"{node.id}/1"] = {"kind": "hazard", **event}
            await node.radio.broadcast(msgpack.packb(known[f"{node.id}/1"]))
        for packet in node.radio.drain():
            warning = read_warning(packet.payload)
            if warning is None:
                malformed += 1
            elif warning["event"] not in known:
                warning["hops"] += 1
                known[warning["event"]] = warning
                delay_ms[warning["event"]] = (packet.received_ns - warning["since_ns"]) / 1e6
                if warning["hops"] < MOST_HOPS:
                    await node.radio.broadcast(msgpack.packb(warning))
        figures: dict[str, float] = {"warned": bool(known), "malformed": malformed}
        if known:
            figures["hops"] = max(warning["hops"] for warning in known.values())
        if delay_ms:
            figures["delay_ms"] = max(delay_ms.values())
        node.report(fix.position_m, fix.covariance_m2, **figures)
