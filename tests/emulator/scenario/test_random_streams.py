"""The keyed random streams: every trace depends on their keys, so their values are pinned."""

import numpy as np
import pytest

from emulator.fault_plan import fault_stream
from emulator.scenario.random_streams import Draws, stream


def test_streams_keep_their_values() -> None:
    assert stream(7, "gnss", 3).random(2).tolist() == [0.1320400664841177, 0.7909330978096533]
    assert stream(7, "common error").random(2).tolist() == [0.954580737815342, 0.7128178038689689]
    assert fault_stream(7, 3, "select").random(2).tolist() == [0.197483794537181, 0.651097989282943]


def test_draws_of_frames_keep_their_values() -> None:
    draws = Draws(7, "loss")
    assert draws.uniform(3, 11, 2).tolist() == [0.8076039643515885, 0.4360306514597858]
    assert draws.uniform(3, 11, 2, copy=1).tolist() == [0.1219891147397213, 0.6608384290770568]
    assert Draws(7, "fault 2").words(1, 2, 2, 5).tolist() == [7680943530765392713, 8967108516191108010]
    assert Draws(2**63 - 1, "loss").uniform(0, 0, 2).tolist() == [0.3704361984961626, 0.45181856238437623]


@pytest.mark.parametrize("other", [stream(2, "gnss", 3), stream(1, "heading", 3), stream(1, "gnss", 4)])
def test_seed_name_and_item_each_make_another_stream(other: np.random.Generator) -> None:
    assert (stream(1, "gnss", 3).random(4) != other.random(4)).all()
