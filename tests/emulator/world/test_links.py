"""Links as a matrix: rows are receivers, and whatever does not fit the network is said in one line."""

from pathlib import Path

import numpy as np
import pytest

from emulator.records.recorded_world import RecordedWorld
from emulator.scenario.scenario import Radio, Scenario
from emulator.stream import scene_message
from emulator.world.radio_inputs import LinkTable, load_links
from emulator.world.world import build_world
from vnet.errors import ScenarioError

NAMES = ["v1", "v2", "v3"]
CHAIN = [[False, False, False], [True, False, False], [False, True, False]]


def links_of(path: Path, vehicles: int = 3) -> np.ndarray | None:
    links = load_links(Radio(links=path), NAMES[:vehicles])
    assert not isinstance(links, LinkTable)
    return links


def test_without_links_there_is_no_matrix() -> None:
    assert load_links(Radio(), NAMES) is None


@pytest.mark.parametrize(
    "text",
    ["0,0,0\n1,0,0\n0,1,0\n", "1,0,0\r\n1,1,0\r\n0,1,1", "\ufeff 0 ,0,0\n\n1.0,0.0,0\n0,1e0,0\n\n"],
    ids=["plain", "the diagonal means nothing", "as spreadsheets write it"],
)
def test_a_file_is_the_matrix_it_holds(tmp_path: Path, text: str) -> None:
    path = tmp_path / "links.csv"
    path.write_text(text, encoding="utf-8")
    links = links_of(path)
    assert links is not None
    assert links.dtype == bool
    assert links.tolist() == CHAIN


def test_a_matrix_in_the_scenario_is_that_matrix() -> None:
    links = load_links(Radio.model_validate({"links": [[1, 0, 0], [1, 0, 0], [0, 1, 0]]}), NAMES)
    assert isinstance(links, np.ndarray)
    assert links.tolist() == CHAIN


def test_a_matrix_of_another_size_than_the_network_is_refused_with_the_world() -> None:
    scenario = Scenario.model_validate({"network": {"vehicles": 3}, "radio": {"links": [[0, 1], [1, 0]]}})
    with pytest.raises(ScenarioError, match=r"radio\.links is 2×2, but the network has 3 vehicles") as caught:
        build_world(scenario)
    assert "\n" not in str(caught.value)


def test_observers_are_told_no_range_where_it_means_nothing() -> None:
    for radio, range_m in (({"range_m": 500.0}, 500.0), ({"links": [[0, 1], [1, 0]]}, None)):
        scenario = Scenario.model_validate({"network": {"vehicles": 2}, "radio": radio})
        assert scene_message(RecordedWorld.of(build_world(scenario)), scenario, "")["range_m"] == range_m
