"""The outcomes of receptions: a closed set, of which each attempted reception gets exactly one.

This table is the only place that states an outcome: number and name, meaning, where it is decided, colour, sign and
condition. The trace, checks, reports, the terminal, Rerun and the reference pages read it from here.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import Self

    from emulator.scenario.scenario import Scenario


class Stage(IntEnum):
    """Place on a frame's way at which an outcome is decided, in the order in which pictures stack them."""

    RECEPTION = 1
    """At the receiver's radio."""
    CHANNEL = 2
    """Between sender and receiver, before the receiver's radio has a say."""
    SENDER = 3
    """At the sender: the frame never goes on the air."""
    ARRIVAL = 4
    """At the receiver's program, after the frame was received."""


def _always(scenario: Scenario, vehicles: int) -> bool:
    return True


def _has_grid(scenario: Scenario, vehicles: int) -> bool:
    return scenario.radio.sidelink is not None


RECEPTION, CHANNEL, SENDER, ARRIVAL = Stage


class Outcome(IntEnum):
    """The outcome of one reception. Its number is that of the trace's internal columns, its name the public one.

    `pending` is the state of a reception in flight; no finished trace contains it. Numbers count up from 0.

    `colour` is a name of `emulator.pages.palette`, and `sign` a block for terminals without colours; an outcome
    without a colour is not drawn. `meaning` completes "the outcome of a frame at a receiver if …" for the reference
    pages. `is_possible(scenario, vehicles)` says whether a run can have it, whatever faults are injected.
    """

    _value_: int
    stage: Stage | None
    colour: str
    sign: str
    meaning: str
    is_possible: Callable[[Scenario, int], bool]

    def __new__(
        cls,
        number: int,
        stage: Stage | None = None,
        colour: str = "",
        sign: str = "",
        meaning: str = "",
        is_possible: Callable[[Scenario, int], bool] = _always,
    ) -> Self:
        """Make a member that is its number, and carries its facts."""
        outcome = int.__new__(cls, number)
        outcome._value_ = number
        outcome.stage, outcome.colour, outcome.sign = stage, colour, sign
        outcome.meaning, outcome.is_possible = meaning, is_possible
        return outcome

    # fmt: off
    pending = 0, None, "", "", "it is in flight; no finished trace has it"
    delivered = 1, ARRIVAL, "green", "█", "it arrived, at `arrival_ns`; after the run's end nobody hears it"
    out_of_range = (
        2, None, "", "", "counted in `verdict.json`, and has no row, but for a frame to this vehicle alone")
    peer_cap = (
        3, CHANNEL, "orange", "░", "the receiver hears `radio.max_peers` nearer senders",
        lambda scenario, vehicles: scenario.radio.max_peers < vehicles - 1)
    lost = (
        4, RECEPTION, "red", "▒", "by `radio.loss`, or the loss of its link in `radio.links`",
        lambda scenario, vehicles: scenario.radio.loss > 0 or isinstance(scenario.radio.links, Path))
    queue_full = 5, SENDER, "blue", "▚", "the sender's queue was full"
    oversize = 6, SENDER, "ink", "▞", "longer than `radio.max_payload_bytes`"
    fault = 7, CHANNEL, "purple", "▓", "cut or lost by the fault in `cause`"
    receiver_down = 8, ARRIVAL, "grey", "▤", "it arrived at a vehicle that was down, at `arrival_ns`"
    transport = (
        9, ARRIVAL, "sky", "▥", "lost between emulator and agent; in real time only, and the run is then unknown",
        lambda scenario, vehicles: scenario.run.pacing == "realtime")
    faded = (
        10, RECEPTION, "sand", "▧", "too weak to be detected, or to be read, with nobody else on the air",
        lambda scenario, vehicles: scenario.radio.path_loss is not None)
    collided = (
        11, RECEPTION, "rust", "▨", "it would have been received had nobody else been on the air",
        lambda scenario, vehicles: scenario.radio.mac is not None)
    held_back = (
        12, SENDER, "navy", "▦", "congestion control gave a newer frame its place",
        lambda scenario, vehicles: scenario.radio.congestion is not None)
    duplicate = (
        13, RECEPTION, "yellow", "▩",
        "it was received before: its sender has missed the acknowledgement, and sent it again",
        lambda scenario, vehicles: bool(scenario.radio.mac and not scenario.radio.sidelink))
    half_duplex = (
        14, RECEPTION, "plum", "▘", "the receiver transmitted in the same slot (sidelink)", _has_grid)
    below_sensing = 15, RECEPTION, "teal", "▝", "weaker than `radio.mac.sensing_dbm` (sidelink)", _has_grid
    no_grant = (
        16, SENDER, "slate", "▖",
        "its sender may use no more of the channel, or its own frames have the slots (sidelink)", _has_grid)
    # fmt: on

    @property
    def title(self) -> str:
        """The outcome in words, for legends."""
        return self.name.replace("_", " ")


def decided_at(*stages: Stage) -> tuple[str, ...]:
    """Names of the outcomes that are decided at these stages."""
    return tuple(outcome.name for outcome in Outcome if outcome.stage in stages)


_LOST = [outcome for outcome in Outcome if outcome.colour and outcome is not Outcome.delivered]
DRAWN = (Outcome.delivered, *sorted(_LOST, key=lambda outcome: (outcome.stage or 0, outcome)))
"""Outcomes of receptions in range in the order in which they are stacked: delivered first, then by stage."""
PENDING, OUT_OF_RANGE = Outcome.pending.value, Outcome.out_of_range.value
"""The same as plain numbers, with which numpy compares ten times as fast."""
