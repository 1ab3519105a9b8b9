"""Maps of a report: of many roads none falls into pieces."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from emulator.report.map_figures import _distinct


@given(st.lists(st.tuples(st.floats(0, 100), st.floats(0, 100)), min_size=2, max_size=30), st.floats(0.1, 20))
def test_a_way_drawn_on_a_grid_still_leads_from_its_start_to_its_end(
    way: list[tuple[float, float]], cell_m: float
) -> None:
    points = np.array(way)
    lines = np.stack([points[:-1], points[1:]], axis=1)
    drawn = _distinct(np.concatenate([lines, lines[:, ::-1]]), cell_m)
    assert len(drawn) <= len(lines), "both directions are one"
    reached = {tuple(np.rint(points[0] / cell_m).tolist())}
    ends = {tuple(map(tuple, line)) for line in np.rint(drawn / cell_m).tolist()}
    for _ in way:
        reached |= {other for one, other in ends | {line[::-1] for line in ends} if one in reached}
    assert tuple(np.rint(points[-1] / cell_m).tolist()) in reached
