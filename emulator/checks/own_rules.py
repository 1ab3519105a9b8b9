"""The check of rules of the user's own: each answered every frame that it was asked about."""

from __future__ import annotations

from typing import Any

from emulator.records.events import Event, EventKind
from emulator.records.recorded_run import RecordedRun
from emulator.records.verdicts import Finding, NotExercised, result
from emulator.scenario.faults import OwnRule
from vnet.counted import counted
from vnet.units import NS_PER_S


def check_own_rules(recorded: RecordedRun) -> Finding:
    """Check that no rule of the user's own raised, answered nonsense, or did not answer at all."""
    name = "own_rules"
    rules = [fault for fault in recorded.scenario.fault if isinstance(fault, OwnRule)]
    failed = recorded.event(EventKind.rule_failed)
    sensors = recorded.scenario.world.sensor
    if not rules and not sensors and not failed:
        return NotExercised(name, "no rule and no sensor of your own")
    answered = [f"{counted(len(rules), 'rule')} of your own answered every frame"] if rules else []
    answered += [f"{counted(len(sensors), 'sensor')} of your own answered every period"] if sensors else []
    text = " and ".join(answered)
    broken_text = "; ".join(map(_told, failed))
    return result(name, len(failed), text, broken_text, list(map(_row, failed)), failed=len(failed))


def _told(event: Event) -> str:
    said = event.details
    when = f"at {event.time_ns / NS_PER_S:.3f} s"
    if (sender := said.get("sender")) is not None:
        when += f", on a frame of {sender}"
    return f"{said.get('fault')} ({said.get('rule')}) {said.get('error')}, {when}"


def _row(event: Event) -> dict[str, Any]:
    return {"time_ns": event.time_ns, **event.details}
