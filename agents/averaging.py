"""The averaging program: mean consensus of fixed inputs, one a vehicle, without a filter.

One round and one broadcast a period, so that the consensus is measured alone. A round takes the newest frame of
each peer since the last round: with a latency below a period and no loss, round t is step t of the linear
iteration.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from agents import options as parsing
from agents.cooperative.cmm.consensus import AveragingConsensus, AveragingRule, Consensus, RatioConsensus, Share
from agents.cooperative.frame import short_name
from vnet import Node, Packet
from vnet.types import Array
from vnet.units import NS_PER_S

DECLARES = "agents.cooperative.declared"


class AveragingFrame(msgspec.Struct, array_like=True):
    """One broadcast: a `Share` with its sets as sorted lists of short names."""

    epoch: int
    running_sum: tuple[float, float, float]
    out_neighbours: list[str]
    heard: list[str]


Seconds = Annotated[float, Meta(ge=-1e9, le=1e9)]


class Options(msgspec.Struct, frozen=True, kw_only=True):
    """Options of the averaging program."""

    rule: Literal["ratio", AveragingRule] = "ratio"
    """Rule of the consensus."""
    silent: dict[str, tuple[Seconds, Seconds]] = {}
    """Absences by node id: [from_s, to_s) of the run."""

    @classmethod
    def parse(cls, options: Mapping[str, Any]) -> Options:
        """Convert the options of a scenario. Raises ProgramError with the key, the value and what is allowed."""
        parsed = parsing.parse(options, cls)
        for node, (from_s, to_s) in parsed.silent.items():
            if from_s > to_s:
                raise parsing.refuse(f"silent.{node}", [from_s, to_s], "[from_s, to_s] expected, the earlier first")
        return parsed

    def is_silent(self, node: str, time_ns: int) -> bool:
        """Tell whether `node` is away at `time_ns`."""
        if node not in self.silent:
            return False
        from_s, to_s = self.silent[node]
        return from_s <= time_ns / NS_PER_S < to_s


class Averager:
    """The consensus of one vehicle with the fixed input `value` (2,), without any radio of its own.

    rejected: number of frames that could not be decoded.
    """

    def __init__(self, node_id: str, rule: str, value: Array) -> None:
        self.value = value
        name = short_name(node_id)
        self.consensus: Consensus = RatioConsensus(name) if rule == "ratio" else AveragingConsensus(name, rule)
        self.rejected = 0
        self._newest_ns: dict[str, int] = {}

    def round(self, packets: Iterable[Packet]) -> bytes:
        """Do one round with the newest frame of each peer; returns the frame to broadcast."""
        shares: dict[str, Share] = {}
        for packet in packets:
            sender = short_name(packet.sender)
            if packet.sent_ns <= self._newest_ns.get(sender, -1):
                continue
            try:
                shares[sender] = decode(packet.payload)
            except ValueError:
                self.rejected += 1
            else:
                self._newest_ns[sender] = packet.sent_ns
        return encode(self.consensus.round(self.value, shares))


def encode(share: Share) -> bytes:
    """Encode a share as the bytes of a frame."""
    frame = AveragingFrame(share.epoch, share.running_sum, sorted(share.out_neighbours), sorted(share.heard))
    return msgspec.msgpack.encode(frame)


def decode(payload: bytes) -> Share:
    """Decode the share in a frame. Raises ValueError for other bytes, and for numbers that are not finite."""
    frame = msgspec.msgpack.decode(payload, type=AveragingFrame)  # its errors are ValueErrors
    if not all(map(math.isfinite, frame.running_sum)) or frame.epoch < 0:
        raise ValueError("numbers out of bounds")
    return Share(frame.epoch, frame.running_sum, frozenset(frame.out_neighbours), frozenset(frame.heard))


async def main(node: Node) -> None:
    """Average until the run ends; a vehicle that has been `silent` starts again with the same input."""
    options = Options.parse(node.options)
    value = node.rng.standard_normal(2)
    averager = Averager(node.id, options.rule, value)
    async for fix in node.gnss:
        packets = node.radio.drain()
        if options.is_silent(node.id, fix.time_ns):
            averager = Averager(node.id, options.rule, value)
            continue
        payload = averager.round(packets)
        await node.radio.broadcast(payload)
        _report(node, averager, len(payload))


def _report(node: Node, averager: Averager, size: int) -> None:
    """Report the input as the `common_error_m` of the metrics, so that they compare the mean with its mean."""
    values: dict[str, Any] = {"common_error_m": averager.value, "bytes": size, "rejected": averager.rejected}
    mean_m = averager.consensus.mean_m
    if mean_m is not None:
        values["mean_m"] = mean_m
    node.report(**values)
