"""The outcomes of receptions: a closed set, of which each attempted reception gets exactly one.

This table is the only place that states an outcome: number and name, meaning, where it is decided, colour, sign and
condition. The trace, checks, reports, the terminal, Rerun and the reference pages read it from here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
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


@dataclass(frozen=True, kw_only=True)
class Facts:
    """All that vnet states about an outcome.

    `meaning` completes "the outcome of a frame at a receiver if …" for the reference pages. `colour` is a name of
    `emulator.pages.palette`, and `sign` a block for terminals without colours; an outcome without a colour is not
    drawn. `is_possible(scenario, vehicles)` says whether a run can have it, whatever faults are injected.
    """

    meaning: str
    stage: Stage | None = None
    colour: str = ""
    sign: str = ""
    is_possible: Callable[[Scenario, int], bool] = _always


IN_FLIGHT = Facts(meaning="it is in flight; no finished trace has it")


class Outcome(IntEnum):
    """The outcome of one reception. Its number is that of the trace's internal columns, its name the public one.

    `pending` is the state of a reception in flight; no finished trace contains it. Numbers count up from 0.
    """

    _value_: int
    facts: Facts

    def __new__(cls, number: int, facts: Facts = IN_FLIGHT) -> Self:
        """Make a member that is its number, and carries its facts."""
        outcome = int.__new__(cls, number)
        outcome._value_ = number
        outcome.facts = facts
        return outcome

    pending = 0
    delivered = (
        1,
        Facts(meaning="it arrived, at `arrival_ns`", stage=Stage.ARRIVAL, colour="green", sign="█"),
    )
    out_of_range = (
        2,
        Facts(meaning="counted in `verdict.json`, and has no row, but for a frame to this vehicle alone"),
    )
    peer_cap = (
        3,
        Facts(
            meaning="the receiver hears `radio.max_peers` nearer senders",
            stage=Stage.CHANNEL,
            colour="orange",
            sign="░",
            is_possible=lambda scenario, vehicles: scenario.radio.max_peers < vehicles - 1,
        ),
    )
    lost = (
        4,
        Facts(
            meaning="by `radio.loss`, or the loss of its link in `radio.links`",
            stage=Stage.RECEPTION,
            colour="red",
            sign="▒",
            is_possible=lambda scenario, vehicles: (
                scenario.radio.loss > 0 or isinstance(scenario.radio.links, Path)
            ),
        ),
    )
    queue_full = (
        5,
        Facts(meaning="the sender's queue was full", stage=Stage.SENDER, colour="blue", sign="▚"),
    )
    oversize = (
        6,
        Facts(meaning="longer than `radio.max_payload_bytes`", stage=Stage.SENDER, colour="ink", sign="▞"),
    )
    fault = (
        7,
        Facts(meaning="cut or lost by the fault in `cause`", stage=Stage.CHANNEL, colour="purple", sign="▓"),
    )
    receiver_down = (
        8,
        Facts(
            meaning="it arrived at a vehicle that was down, at `arrival_ns`",
            stage=Stage.ARRIVAL,
            colour="grey",
            sign="▤",
        ),
    )
    transport = (
        9,
        Facts(
            meaning="lost between emulator and agent; in real time only, and the run is then unknown",
            stage=Stage.ARRIVAL,
            colour="sky",
            sign="▥",
            is_possible=lambda scenario, vehicles: scenario.run.pacing == "realtime",
        ),
    )
    faded = (
        10,
        Facts(
            meaning="too weak to be detected, or to be read, with nobody else on the air",
            stage=Stage.RECEPTION,
            colour="sand",
            sign="▧",
            is_possible=lambda scenario, vehicles: scenario.radio.path_loss is not None,
        ),
    )
    collided = (
        11,
        Facts(
            meaning="it would have been received had nobody else been on the air",
            stage=Stage.RECEPTION,
            colour="rust",
            sign="▨",
            is_possible=lambda scenario, vehicles: scenario.radio.mac is not None,
        ),
    )
    held_back = (
        12,
        Facts(
            meaning="congestion control gave a newer frame its place",
            stage=Stage.SENDER,
            colour="navy",
            sign="▦",
            is_possible=lambda scenario, vehicles: scenario.radio.congestion is not None,
        ),
    )
    duplicate = (
        13,
        Facts(
            meaning="it was received before: its sender has missed the acknowledgement, and sent it again",
            stage=Stage.RECEPTION,
            colour="yellow",
            sign="▩",
            is_possible=lambda scenario, vehicles: bool(scenario.radio.mac and not scenario.radio.sidelink),
        ),
    )
    half_duplex = (
        14,
        Facts(
            meaning="the receiver transmitted in the same slot (sidelink)",
            stage=Stage.RECEPTION,
            colour="plum",
            sign="▘",
            is_possible=_has_grid,
        ),
    )
    below_sensing = (
        15,
        Facts(
            meaning="weaker than `radio.mac.sensing_dbm` (sidelink)",
            stage=Stage.RECEPTION,
            colour="teal",
            sign="▝",
            is_possible=_has_grid,
        ),
    )
    no_grant = (
        16,
        Facts(
            meaning="its sender may use no more of the channel, or its own frames have the slots (sidelink)",
            stage=Stage.SENDER,
            colour="slate",
            sign="▖",
            is_possible=_has_grid,
        ),
    )

    @property
    def title(self) -> str:
        """The outcome in words, for legends."""
        return self.name.replace("_", " ")


def decided_at(*stages: Stage) -> tuple[str, ...]:
    """Names of the outcomes that are decided at these stages."""
    return tuple(outcome.name for outcome in Outcome if outcome.facts.stage in stages)


_LOST = [outcome for outcome in Outcome if outcome.facts.colour and outcome is not Outcome.delivered]
DRAWN = (Outcome.delivered, *sorted(_LOST, key=lambda outcome: (outcome.facts.stage or 0, outcome)))
"""Outcomes of receptions in range in the order in which they are stacked: delivered first, then by stage."""
PENDING, OUT_OF_RANGE = Outcome.pending.value, Outcome.out_of_range.value
"""The same as plain numbers, with which numpy compares ten times as fast."""
