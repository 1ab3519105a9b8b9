"""Lookahead of a scenario: how far no process can hear of what another one does."""

from __future__ import annotations

from emulator.scenario.roadside import Backbone
from emulator.scenario.scenario import Radio, Scenario
from vnet.units import NS_PER_MS

MIN_LATENCY_NS = 1_000
"""Least latency of a reception: time passes in every exchange between nodes."""


def least_latency_ns(radio: Radio) -> int:
    """Return the shortest time from the end of a frame to its arrival: faults and jitter only add to it."""
    return max(int(radio.latency_ms * NS_PER_MS), MIN_LATENCY_NS)


def lookahead_ns(scenario: Scenario) -> int:
    """Return the shortest time from sending to arrival: of frames, and of messages among roadside units."""
    radio_ns = least_latency_ns(scenario.radio)
    if len(scenario.roadside) < 2:
        return radio_ns
    backbone = scenario.backbone or Backbone()
    return min(radio_ns, max(int(backbone.latency_ms * NS_PER_MS), MIN_LATENCY_NS))
