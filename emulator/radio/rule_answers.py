"""Answers of rules of the user's own, and what is no answer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emulator.radio.frames import Answered
from emulator.scenario.own_functions import NonsenseError
from vnet.errors import shown
from vnet.types import Mask
from vnet.units import NS_PER_S

LONGEST_DELAY_S = 60.0
MOST_COPIES = 20
MOST_FLIPS = 65_000
MOST_FRAMES = 200
"""Frames that a sender may send in place of one."""


class Answer(NamedTuple):
    """The answer of a rule on links. Each value is one for all receivers, or one for each (n,)."""

    drop: ArrayLike = False
    """True: the frame is lost, outcome `fault`."""
    delay_s: ArrayLike = 0.0
    """Extra latency in seconds, 0 to 60."""
    corrupt: ArrayLike = 0
    """Number of bytes that arrive altered, chosen by chance, 0 to 65000; all bytes of a shorter frame."""
    payload: Mapping[str, bytes] = {}
    """Bytes that arrive instead, by the receiver's id; as many as were sent."""
    copies: ArrayLike = 0
    """Number of further arrivals, 0 to 20."""
    copy_delay_s: float = 0.01
    """Time from one of these arrivals to the next in seconds, more than 0 and up to 60."""


def answered_by_link(answer: Any, receivers: Sequence[str], size_bytes: int) -> Answered:
    """Return the answer of a rule on links to a frame of `size_bytes`. Raises NonsenseError."""
    if not isinstance(answer, Answer):
        raise NonsenseError(f"{shown(answer)}: Answer(…) is needed, or None to let the frame pass")
    count = len(receivers)
    delay_s = _numbers("delay_s", answer.delay_s, count, LONGEST_DELAY_S, float)
    return Answered(
        drop=_array("drop", answer.drop, count, np.bool_, "True or False"),
        delay_ns=np.round(delay_s * NS_PER_S).astype(np.int64),
        corrupt=_numbers("corrupt", answer.corrupt, count, MOST_FLIPS, int).astype(np.int64),
        payload=_payloads(answer.payload, receivers, size_bytes),
        copies=_numbers("copies", answer.copies, count, MOST_COPIES, int).astype(np.int64),
        copy_delay_ns=_copy_delay_ns(answer.copy_delay_s),
    )


def answered_by_sender(answer: Any, max_bytes: int) -> list[bytes]:
    """Return the payloads that a rule at a sender answers; none if it drops the frame. Raises NonsenseError."""
    if not isinstance(answer, (list, tuple)):
        raise NonsenseError(f"{shown(answer)}: a list of payloads is needed, or None to change nothing")
    if len(answer) > MOST_FRAMES:
        raise NonsenseError(f"{len(answer)} payloads: {MOST_FRAMES} at most")
    for payload in answer:
        if not isinstance(payload, bytes):
            raise NonsenseError(f"the payload {shown(payload)}: bytes are needed")
        if len(payload) > max_bytes:
            raise NonsenseError(f"a payload of {len(payload)} bytes: radio.max_payload_bytes = {max_bytes}")
    return list(answer)


def _array(name: str, given: Any, count: int, kind: type[np.generic], needed: str) -> NDArray[Any]:
    """Return values (n,) of one kind."""
    try:
        values = np.asarray(given)
    except ValueError:
        raise NonsenseError(f"{name} = {shown(given)}: {needed} is needed, or {count} of them") from None
    if not np.issubdtype(values.dtype, kind):
        raise NonsenseError(f"{name} = {shown(given)}: {needed} is needed, or {count} of them")
    if values.shape not in ((), (count,)):
        raise NonsenseError(f"{name} of shape {values.shape}: one value is needed, or {count}, one a receiver")
    return np.broadcast_to(values, (count,))


def _numbers(name: str, given: Any, count: int, most: float, kind: type[int | float]) -> NDArray[Any]:
    """Return numbers (n,) from 0 to `most`."""
    whole = kind is int
    needed = f"{'a whole number' if whole else 'a number'} from 0 to {most:g}"
    values = _array(name, given, count, np.integer if whole else np.number, needed)
    wrong = values[~((values >= 0) & (values <= most))] if values.dtype.kind in "iuf" else values
    if len(wrong):
        raise NonsenseError(f"{name} = {wrong[0]}: {needed} is needed")
    return values


def _payloads(given: Any, receivers: Sequence[str], size_bytes: int) -> dict[int, bytes]:
    if not isinstance(given, Mapping):
        raise NonsenseError(f"payload = {shown(given)}: a dict is needed, from a receiver's id to bytes")
    index = {node: number for number, node in enumerate(receivers)}
    for node, payload in given.items():
        if node not in index:
            raise NonsenseError(f"payload[{shown(node)}]: is none of the frame's receivers")
        if not isinstance(payload, bytes) or len(payload) != size_bytes:
            raise NonsenseError(f"payload[{shown(node)}] = {shown(payload)}: {size_bytes} bytes are needed")
    return {index[node]: payload for node, payload in given.items()}


def _copy_delay_ns(given: Any) -> int:
    is_number = isinstance(given, (int, float, np.integer, np.floating)) and not isinstance(given, bool)
    if not is_number or not math.isfinite(given) or not 0 < given <= LONGEST_DELAY_S:
        raise NonsenseError(
            f"copy_delay_s = {shown(given)}: a number over 0 and up to {LONGEST_DELAY_S:g} is needed"
        )
    return max(1, round(float(given) * NS_PER_S))
