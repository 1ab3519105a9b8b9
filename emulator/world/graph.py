"""Connected components of a graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vnet.types import Mask


def weak_components(linked: Mask) -> NDArray[np.intp]:
    """Return the component (N,) of each node of a graph (N, N), links in one direction counting too.

    Components are numbered from 0 in the order of their first nodes, as scipy.sparse.csgraph does; importing that
    takes longer than many a run.
    """
    sender, receiver = np.nonzero(linked)
    return components_of_links(sender, receiver, len(linked))


def components_of_links(sender: NDArray[np.intp], receiver: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Return the component (N,) of each of `count` nodes linked by pairs (n,), numbered as by `weak_components`.

    Each round gives the first node of a component to those that it is linked with, and follows the first nodes' own
    first nodes to the end, so that the number of rounds grows with the logarithm of the diameter.
    """
    first = np.arange(count)
    while True:
        lower = np.minimum(first[sender], first[receiver])
        joined = first.copy()
        np.minimum.at(joined, first[sender], lower)
        np.minimum.at(joined, first[receiver], lower)
        while (joined[joined] != joined).any():
            joined = joined[joined]
        if (joined == first).all():
            return np.asarray(np.unique(first, return_inverse=True)[1], dtype=np.intp)
        first = joined
