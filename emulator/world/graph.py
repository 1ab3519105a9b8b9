"""Connected components of a dense graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vnet.types import Mask


def weak_components(linked: Mask) -> NDArray[np.intp]:
    """Return the component (N,) of each node of a graph (N, N), links in one direction counting too.

    Components are numbered from 0 in the order of their first nodes, as scipy.sparse.csgraph does; importing that
    takes longer than many a run.
    """
    joined = linked | linked.T
    label = np.full(len(joined), -1, dtype=np.intp)
    number = 0
    for start in range(len(joined)):
        if label[start] >= 0:
            continue
        label[start] = number
        frontier = np.array([start])
        while len(frontier):
            frontier = np.flatnonzero(joined[frontier].any(axis=0) & (label < 0))
            label[frontier] = number
        number += 1
    return label
