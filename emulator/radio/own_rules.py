"""Rules of the user's own: faults whose effect a function decides, frame by frame.

A rule is a function of a frame and of a state of its own. On links (`kind = "custom"`) it is called once for each
frame that has a receiver in range on its links, and says what becomes of it at each receiver. At senders
(`kind = "custom_sender"`) it is called once for each frame that a program sends, and says what is sent in its
place. Frames are given in the order in which they are sent, live and simulated alike.

A rule that raises, answers nonsense or does not answer is told once, and then lets everything pass.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emulator.fault_plan import PlannedFault
from emulator.radio.frames import (
    NO_CAUSE,
    Answered,
    Copied,
    Frame,
    Receptions,
    Transmission,
    flips_between,
    random_flips,
)
from emulator.radio.outcomes import PENDING
from emulator.radio.propagation import DIGITS
from emulator.radio.topology import TopologySnapshot
from emulator.scenario import own_functions
from emulator.scenario.faults import OwnRule
from emulator.scenario.own_functions import NonsenseError, load_function
from emulator.scenario.program import Program
from emulator.scenario.random_streams import Draws, frame_stream
from vnet.errors import shown
from vnet.runtime.programs import search_programs_in
from vnet.types import Array, Mask
from vnet.units import NS_PER_S

LONGEST_DELAY_S = 60.0
MOST_COPIES = 20
MOST_FLIPS = 65_000
MOST_FRAMES = 200
"""Frames that a sender may send in place of one."""
__all__ = ["Answer", "OwnRules", "RadioFrame", "RuleFailure", "RuledLinks"]
T = TypeVar("T")
Rule = Callable[["RadioFrame", dict[str, Any]], Any]


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


@dataclass(frozen=True)
class RadioFrame:
    """A frame as a rule sees it. Arrays are read-only; those over receivers have one entry for each of `receivers`.

    The receivers are those in range on the fault's links, by their numbers. `sequence` counts the sender's frames,
    and `copy` is 0 but for frames that a fault sends besides them. `time_ns` is when it was sent, in emulated time,
    and positions and distances are those of that time.
    """

    sender: str
    sequence: int
    copy: int
    time_ns: int
    payload: bytes
    receivers: tuple[str, ...]
    distance_m: Array
    """Distance of each receiver from the sender (n,)."""
    position_m: Array
    """Position of each receiver (n, 2)."""
    sender_position_m: Array
    """Position of the sender (2,)."""
    power_dbm: float | None
    """Transmit power, antenna gains included; None without `[radio.path_loss]`."""
    rate_mbps: float
    """Bit rate in Mbit/s."""
    options: Mapping[str, Any]
    """The fault's `options`."""
    _position_of: Callable[[str], Array]
    _stream: tuple[int, str, int, int, int]

    @property
    def time_s(self) -> float:
        """Time at which it was sent, in emulated seconds."""
        return self.time_ns / NS_PER_S

    @cached_property
    def rng(self) -> np.random.Generator:
        """Random generator of this frame under this fault: nothing else draws from it, or changes it."""
        return frame_stream(*self._stream)

    def where(self, vehicle: str) -> Array:
        """Return the position (2,) of any vehicle, NaN if it is not in the network. Raises KeyError."""
        return self._position_of(vehicle)


@dataclass(frozen=True)
class RuleFailure:
    """The failure of a rule: fault's label, rule, when and on whose frame, what is wrong, and the traceback."""

    fault: str
    rule: str
    time_ns: int
    sender: str
    error: str
    where: str = ""


class OwnRules:
    """The rules of one run, their states, and which of them have failed.

    `on_failure` is told of each that does. `tx_power_dbm` are the powers (N,) of frames whose program has chosen
    none; None without a path loss.
    """

    def __init__(self, seed: int, node_ids: Sequence[str]) -> None:
        self.tx_power_dbm: Sequence[float] | None = None
        self._seed = seed
        self._node_ids = tuple(node_ids)
        self._number = {node: number for number, node in enumerate(node_ids)}
        self._functions: dict[str, Rule] = {}
        self._states: dict[int, dict[str, Any]] = {}
        self._options: dict[int, Mapping[str, Any]] = {}
        self._failed: set[int] = set()
        self.on_failure: Callable[[RuleFailure], None] = lambda failure: None

    def load(self, faults: Sequence[object], program: Program) -> None:
        """Import the rules of these faults. Raises ScenarioError."""
        self._functions |= load_rules(faults, program)

    def ask_link(self, planned: PlannedFault, frame: Frame, columns: NDArray[np.intp]) -> Answered | None:
        """Return what becomes of a frame at these columns (n,) of its topology; None if nothing does."""
        if planned.number in self._failed:
            return None
        seen = self._seen(planned, frame, columns)
        return self._ask(planned, seen, lambda answer: answered_by_link(answer, seen.receivers, frame.size_bytes))

    def ask_sender(self, planned: PlannedFault, frame: Frame, max_bytes: int) -> list[bytes]:
        """Return the payloads that are sent in place of a frame; none if the rule drops it."""
        if planned.number in self._failed:
            return [frame.payload]
        columns = np.flatnonzero(frame.topology.admitted[frame.sender])
        seen = self._seen(planned, frame, columns)
        answer = self._ask(planned, seen, lambda answer: answered_by_sender(answer, max_bytes))
        return [frame.payload] if answer is None else answer

    def _ask(self, planned: PlannedFault, seen: RadioFrame, understood: Callable[[Any], T]) -> T | None:
        fault = planned.fault
        assert isinstance(fault, OwnRule)
        state = self._states.setdefault(planned.number, {})
        try:
            answer = own_functions.call_bounded(self._functions[fault.rule], seen, state)
            return None if answer is None else understood(answer)
        except (Exception, SystemExit, own_functions.NoAnswerError) as error:
            self._failed.add(planned.number)
            said, where = own_functions.told(error, __file__)
            self.on_failure(RuleFailure(planned.label, fault.rule, seen.time_ns, seen.sender, said, where))
            return None

    def _seen(self, planned: PlannedFault, frame: Frame, columns: NDArray[np.intp]) -> RadioFrame:
        topology, number = frame.topology, planned.number
        fault = planned.fault
        assert isinstance(fault, OwnRule)
        if number not in self._options:
            self._options[number] = MappingProxyType(deepcopy(fault.options))
        receivers = columns if topology.receiver is None else topology.receiver[frame.sender, columns]
        largest_dbm = self.largest_dbm(frame.sender)
        return RadioFrame(
            sender=self._node_ids[frame.sender],
            sequence=frame.seq,
            copy=frame.copy,
            time_ns=frame.sent_ns,
            payload=frame.payload,
            receivers=tuple(self._node_ids[node] for node in receivers.tolist()),
            distance_m=_fixed(topology.distance_m[frame.sender, columns]),
            position_m=_fixed(topology.position_m[receivers]),
            sender_position_m=_fixed(topology.position_m[frame.sender]),
            power_dbm=None if largest_dbm is None else round(largest_dbm + frame.gain_db, DIGITS),
            rate_mbps=frame.bitrate_mbps,
            options=self._options[number],
            _position_of=lambda vehicle: self._where(topology, vehicle),
            _stream=(self._seed, f"fault {planned.draws_of} rule", frame.sender, frame.seq, frame.draw),
        )

    def largest_dbm(self, node: int) -> float | None:
        """Return the power of frames of a node that has chosen none; None without a path loss."""
        return None if self.tx_power_dbm is None else self.tx_power_dbm[node]

    def _where(self, topology: TopologySnapshot, vehicle: str) -> Array:
        if vehicle not in self._number:
            raise KeyError(f"no vehicle {shown(vehicle)}")
        return _fixed(topology.position_m[self._number[vehicle]])


@dataclass
class RuledLinks:
    """A rule that acts on links, and its stream of draws for altered bytes."""

    planned: PlannedFault
    draws: Draws
    rules: OwnRules

    def lost(self, sent: Transmission) -> Mask:
        """Return the columns (M,) at which the rule drops a frame; what else it answers is kept for `change`."""
        topology, sender, links = sent.frame.topology, sent.frame.sender, self.planned.links
        assert links is not None
        drop = np.zeros(topology.in_range.shape[1], dtype=bool)
        near = topology.in_range[sender] & topology.admitted[sender] & links[sender][topology.receivers(sender)]
        columns = np.flatnonzero(near)
        if sent.sender_outcome or not len(columns):
            return drop
        answered = self.rules.ask_link(self.planned, sent.frame, columns)
        if answered is not None:
            drop[columns] = answered.drop
            sent.answers[self.planned.number] = columns, answered
        return drop

    def change(self, sent: Transmission, index: int, receptions: Receptions) -> None:
        """Delay, alter and duplicate the pending receptions of transmission number `index` as the rule says."""
        if self.planned.number not in sent.answers:
            return
        columns, answered = sent.answers[self.planned.number]
        pending = receptions.outcome[index, columns] == PENDING
        self._delay(answered.delay_ns, columns[pending], pending, index, receptions)
        self._alter(answered, sent.frame, index, columns, pending, receptions)
        copied = np.where(pending, answered.copies, 0)
        for number in range(int(copied.max())):
            mask = np.zeros(receptions.outcome.shape[1], dtype=bool)
            mask[columns] = copied > number
            later_ns = (number + 1) * answered.copy_delay_ns
            receptions.copies.append(Copied(index, mask, later_ns, self.planned.number))

    def _delay(
        self,
        delay_ns: NDArray[np.int64],
        columns: NDArray[np.intp],
        pending: Mask,
        index: int,
        receptions: Receptions,
    ) -> None:
        later = delay_ns[pending]
        receptions.arrival_ns[index, columns] += later
        self._name(receptions, index, columns[later > 0])

    def _alter(
        self,
        answered: Answered,
        frame: Frame,
        index: int,
        columns: NDArray[np.intp],
        pending: Mask,
        receptions: Receptions,
    ) -> None:
        """Alter the bytes that the rule says; the number of the receiver keys which ones it leaves to chance."""
        chance = None
        for n in np.flatnonzero(pending).tolist():
            flips = list(flips_between(frame.payload, answered.payload[n])) if n in answered.payload else []
            if answered.corrupt[n] and frame.payload:
                if chance is None:
                    count = len(frame.topology.position_m)
                    chance = self.draws.uniform(frame.sender, frame.seq, count, frame.draw)
                    chance = chance[frame.topology.receivers(frame.sender)]
                flips += random_flips(chance[columns[n]], len(frame.payload), int(answered.corrupt[n]))
            if flips:
                receptions.flips.setdefault((index, int(columns[n])), []).extend(flips)
                self._name(receptions, index, columns[n : n + 1])

    def _name(self, receptions: Receptions, index: int, columns: NDArray[np.intp]) -> None:
        """Let receptions that name no fault yet name this one."""
        unnamed = columns[receptions.cause[index, columns] == NO_CAUSE]
        receptions.cause[index, unnamed] = self.planned.number


def load_rules(faults: Sequence[object], program: Program) -> dict[str, Rule]:
    """Import the rules of faults, by entry; they are looked for in the program's folders, too.

    Raises ScenarioError for one that cannot be imported.
    """
    entries = dict.fromkeys(fault.rule for fault in faults if isinstance(fault, OwnRule))
    if entries:
        search_programs_in(program.folders)
    usage = "of a frame and a state: def {}(frame, state)"
    return {entry: load_function("fault.rule", entry, program, usage) for entry in entries}


def _fixed(values: Array) -> Array:
    """Return a copy that cannot be changed."""
    copied = np.array(values, dtype=float)
    copied.setflags(write=False)
    return copied
