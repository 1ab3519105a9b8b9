"""The example programs of the documentation do what they say."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from docs.examples.hazard import read_warning
from emulator.drivers.simulate import simulate
from tests.support.recorded import prepared
from vnet.reports import Report

WARNING = {"kind": "hazard", "event": "v01/1", "position_m": [1.0, 2.0], "since_ns": 0, "hops": 0}


def last_reports(
    folder: Path,
    links: list[list[int]],
    faults: Sequence[dict[str, Any]] = (),
    duration_s: float = 2.0,
    **options: str,
) -> dict[str, Report]:
    """The last report of each vehicle of a network with these links, of which none loses a frame."""
    scenario = {
        "run": {"duration_s": duration_s, "settle_s": 0.5},
        "network": {"vehicles": len(links)},
        "radio": {"loss": 0.0, "links": links},
        "program": {"entry": "docs.examples.hazard:main", "options": options},
        "fault": faults,
    }
    emulation = prepared(scenario, folder)
    found: dict[str, Report] = {}
    emulation.watch(lambda view: found.update({report.node: report for report in view.reports}))
    simulate(emulation)
    return found


@pytest.mark.slow
def test_a_warning_is_forwarded_to_vehicles_out_of_range(tmp_path: Path) -> None:
    line = [[int(abs(a - b) == 1) for b in range(5)] for a in range(5)]
    reports = last_reports(tmp_path / "run", line, source="v02")
    nodes = sorted(reports)
    assert [reports[node].values["hops"] for node in nodes] == [1, 0, 1, 2, 3]
    assert all(report.values["warned"] == 1 and report.values["malformed"] == 0 for report in reports.values())


@pytest.mark.slow
def test_a_vehicle_without_links_is_not_warned(tmp_path: Path) -> None:
    reports = last_reports(tmp_path / "run", [[0, 1, 0], [1, 0, 0], [0, 0, 0]], source="v02")
    assert [reports[node].values["warned"] for node in sorted(reports)] == [1, 1, 0]


@pytest.mark.slow
def test_the_first_of_a_hundred_vehicles_warns_by_default(tmp_path: Path) -> None:
    links = [[int(abs(a - b) == 1) for b in range(100)] for a in range(100)]
    reports = last_reports(tmp_path / "run", links, duration_s=0.6)
    assert [node for node in sorted(reports) if reports[node].values.get("hops") == 0] == ["v001"]


@pytest.mark.slow
def test_a_corrupted_warning_is_counted_and_dropped(tmp_path: Path) -> None:
    corrupt = {"kind": "corrupt", "at_s": 0.0, "duration_s": 1.0, "probability": 1.0, "flips": 1000}
    reports = last_reports(tmp_path / "run", [[0, 1], [1, 0]], [corrupt], source="v02")
    assert [reports[node].values["malformed"] for node in sorted(reports)] == [1, 0]


@pytest.mark.parametrize(
    "altered",
    [{"kind": "other"}, {"hops": True}, {"hops": "1"}, {"position_m": None}, {"more": 1}, {"event": b"x"}],
)
def test_what_only_looks_like_a_warning_is_none(altered: dict[str, Any]) -> None:
    assert read_warning(msgpack.packb(WARNING)) == WARNING
    assert read_warning(msgpack.packb({**WARNING, **altered})) is None


@pytest.mark.slow
@given(st.binary(max_size=40))
def test_no_payload_does_harm(payload: bytes) -> None:
    assert read_warning(payload) is None
