"""Vehicles that send a BSM of SAE J2735 with each fix, and count whom they hear: docs/how-to/standard-messages.md.

    vnet simulate scenarios/beacon.toml --program docs/examples/its2/safety.py --option asn1=J2735.asn

Options: `asn1`, the file or folder of your copy of SAE's schema.
"""

from __future__ import annotations

from docs.examples.its2.standard_messages import Message, decode_bsm, encode_bsm, schema, station_of
from vnet import Node
from vnet.errors import VnetError


async def main(node: Node) -> None:
    """Send ten BSMs a second, and report the number of others."""
    if "asn1" not in node.options:
        raise VnetError("program.options.asn1: the file or folder of your copy of J2735's ASN.1 is needed")
    types, station = schema(node.options["asn1"], "BasicSafetyMessage", "MessageFrame"), station_of(node.id)
    others: set[int] = set()
    count = 0
    async for fix in node.gnss:
        for packet in node.radio.drain():
            if (heard := decode_bsm(packet.payload, types)) is not None:
                others.add(heard.station)
        here_m = float(fix.position_m[0]), float(fix.position_m[1])
        told = Message(station, fix.time_ns, here_m, fix.heading_rad, fix.speed_m_s)
        await node.radio.broadcast(encode_bsm(told, count, types))
        count += 1
        node.report(fix.position_m, fix.covariance_m2, others=len(others))
