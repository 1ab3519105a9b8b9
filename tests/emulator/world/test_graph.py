"""Components agree with scipy.sparse.csgraph, numbers included."""

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from emulator.world.neighbours import components_of_links
from vnet.types import Mask


def components(linked: Mask) -> list[int]:
    sender, receiver = np.nonzero(linked)
    return components_of_links(sender, receiver, len(linked)).tolist()


@pytest.mark.parametrize("seed", range(20))
def test_components_of_random_graphs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 60))
    linked = rng.random((count, count)) < rng.choice([0.0, 0.5, 1.0, 2.0]) / count
    assert components(linked) == connected_components(linked, directed=False)[1].tolist()


def test_no_nodes_have_no_components() -> None:
    assert components(np.zeros((0, 0), dtype=bool)) == []


def test_a_link_in_one_direction_connects() -> None:
    linked = np.zeros((4, 4), dtype=bool)
    linked[2, 0] = linked[3, 2] = True
    assert components(linked) == [0, 1, 0, 0]
