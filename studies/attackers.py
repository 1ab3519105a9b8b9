"""Attackers among cooperating vehicles, and what they cost the others: each kind of lie on the same seeds.

The two best-connected vehicles of a network never count, whether they lie or not, so that all figures of a seed are
those of the same vehicles in the same world.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from emulator.cells.cells import Cell
from emulator.scenario.scenario import Scenario
from emulator.world.neighbours import links_within
from emulator.world.world import build_world
from studies.measure import study_cell
from studies.paper import COOPERATIVE, PAPER_RANGE_M, Labels, default_scenario
from studies.reports import (
    MISSING,
    Result,
    column,
    markdown_table,
    paired_ratio,
    select,
    shown_interval,
    unique,
    with_error,
)
from vnet.errors import counted

ATTACKER = "agents.cooperative.attacker:main"
LENGTH_S = 30.0
"""Length of a run; what attackers have done counts in its second half."""
UNCOUNTED = 2
"""Number of vehicles, the best connected, that never count: as many as lie at most."""


@dataclass(frozen=True)
class Attack:
    """An attack: the options of the program that the first `attackers` of the best-connected vehicles run."""

    lie: Mapping[str, Any] = field(default_factory=dict)
    attackers: int = 1
    defence: bool = True
    fault: Mapping[str, Any] | None = None
    """A fault of the first, in place of a lie."""


def _lie(lie: str, offset_m: float = 0.0, **more: Any) -> Attack:
    return Attack({"lie": lie} | ({"offset_m": [offset_m, 0.0]} if offset_m else {}), **more)


HONEST = "none"
ATTACKS: dict[str, Attack] = {
    HONEST: Attack(attackers=0),
    "gates": _lie("gates"),
    "gates, two": _lie("gates", attackers=2),
    "offset 0.5 m": _lie("offset", 0.5),
    "offset 50 m": _lie("offset", 50.0),
    "overconfident 50 m": _lie("overconfident", 50.0),
    "drift 10 m a minute": _lie("drift", 10.0),
    "relay 50 m": _lie("relay", 50.0),
    "sums 50 m": _lie("sums", 50.0),
    "epoch": _lie("epoch"),
    "non_finite": _lie("non_finite"),
    "absurd": _lie("absurd"),
    "random": _lie("random"),
    "receiver off by 50 m": Attack(attackers=0, fault={"kind": "gnss_jump", "offset_m": [50.0, 0.0]}),
    "offset 50 m, no defence": _lie("offset", 50.0, defence=False),
}
"""Attacks by their names in the report; all are compared with the first."""


def attack_cells(
    networks: Mapping[str, Mapping[str, Any]], seeds: Sequence[int], duration_s: float = LENGTH_S
) -> list[Cell]:
    """Return a cell for each network, attack and seed."""
    cells = []
    for network, section in networks.items():
        best = _best_connected(section)
        for name, attack in ATTACKS.items():
            for seed in seeds:
                labels: Labels = {"network": network, "attack": name, "seed": seed}
                cells.append(study_cell(labels, _scenario(section, seed, duration_s, attack, best), duration_s / 2))
    return cells


def _best_connected(section: Mapping[str, Any]) -> list[str]:
    """Return the vehicles of a network that have most others in range, the first of them first."""
    data = {"network": dict(section), "radio": {"range_m": PAPER_RANGE_M}, "program": {"entry": COOPERATIVE}}
    world = build_world(Scenario.model_validate(data))
    degree = links_within(world.at(0).position_m, PAPER_RANGE_M).out_degrees()
    return [world.node_ids[number] for number in np.argsort(-degree, kind="stable")[:UNCOUNTED]]


def _scenario(
    network: Mapping[str, Any], seed: int, duration_s: float, attack: Attack, best: Sequence[str]
) -> Scenario:
    options = {} if attack.defence else {"defence": False}
    exceptions = [
        {"nodes": [node], "entry": ATTACKER, "options": {**options, **attack.lie}}
        if number < attack.attackers
        else {"nodes": [node], "entry": COOPERATIVE, "options": options}
        for number, node in enumerate(best)
    ]
    always = {"at_s": 0.0, "duration_s": duration_s, "nodes": {"ids": [best[0]]}}
    faults = [] if attack.fault is None else [{**always, **attack.fault}]
    return default_scenario(network, seed, options, duration_s, faults, exceptions=exceptions)


HEADER = ["false", "c of the others [m]", "relative to none", "ANEES of c", "position [m]", "diverged"]


def report(results: Sequence[Result], duration_s: float) -> str:
    """Return the table of each network in Markdown."""
    parts = ["# Attackers, and what they cost the others"]
    for network in unique(results, "network"):
        rows = select(results, network=network)
        parts += [f"## {network.upper()}", markdown_table(HEADER, list(_rows(rows)))]
    seeds = counted(len(unique(results, "seed")), "seed")
    parts.append(
        f"{duration_s:g} s, counted from {duration_s / 2:g} s on; {seeds}; ± half a 95 % interval (Student's t), "
        "of ratios the standard error. Attackers are the best-connected vehicles, which lie from the beginning and "
        f"pull east; the {UNCOUNTED} best connected count in no row. Diverged: vehicles by either definition."
    )
    return "\n\n".join(parts) + "\n"


def _rows(results: Sequence[Result]) -> Iterator[list[str]]:
    honest = {row["seed"]: row["others_rmse_m"] for row in select(results, attack=HONEST)}
    for name in unique(results, "attack"):
        rows = select(results, attack=name)
        pairs = [row for row in rows if row["seed"] in honest]
        ratio = paired_ratio(column(pairs, "others_rmse_m"), [honest[row["seed"]] for row in pairs])
        yield [
            name,
            shown_interval(column(rows, "others_rmse_m")),
            with_error(*ratio, ".2f") if name != HONEST else MISSING,
            shown_interval(column(rows, "others_anees"), 2),
            shown_interval(column(rows, "others_position_rmse_m")),
            str(sum(column(rows, "others_divergent"))),
        ]
