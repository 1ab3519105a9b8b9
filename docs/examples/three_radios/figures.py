"""Figures of runs as columns of a sweep: docs/how-to/three-radios.md."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from emulator import Result, Run

WITHIN_M = 200.0
"""Distance up to which receptions count: half a dozen seconds at the speeds of a highway."""
FROM_S = 1.0
"""Time from which frames count: C-V2X has to listen for a second before it can avoid what others have reserved."""
PLATOON = 8
"""Vehicles of the platoon, which are the first ones."""
CRUISE_M_S = 20.0
GAP_M = 20.0
"""Distance up to which a vehicle is next to another: those of the platoon are 15.5 m apart."""


def check(run: Run) -> Iterator[Result]:
    """Give the figures of the receptions within `WITHIN_M`; they are not judged."""
    figures = run.radio_figures(within_m=WITHIN_M, from_s=FROM_S)
    text = f"{figures['delivered']:,.0f} of {figures['pairs']:,.0f} receptions within {WITHIN_M:g} m"
    yield Result("near", "valid", text, figures)


def platoon(run: Run) -> Iterator[Result]:
    """Give by how much a disturbance of the speed grows from the first vehicle of a platoon to its last."""
    assert run.driven is not None
    speed = np.array(run.driven["speed_m_s"]).reshape(-1, len(run.nodes))[:, :PLATOON]
    deviation = np.linalg.norm(speed - CRUISE_M_S, axis=0)
    if not deviation[0]:
        yield Result("platoon", "not applicable", "the first vehicle has kept its speed")
        return
    amplification = float(deviation[-1] / deviation[0])
    figures = run.radio_figures(within_m=GAP_M, from_s=FROM_S)
    text = f"amplification {amplification:.3f}"
    yield Result("platoon", "valid", text, {"amplification": amplification, **figures})
