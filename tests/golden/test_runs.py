"""The golden table: shipped scenarios and the examples of the documentation come to what they came to before."""

import re
import sys
from pathlib import Path

import pytest

from tests.docs.markdown import PAGES
from tests.golden.runs import TABLE, dump, load, machine
from tests.support.paths import ROOT

MADE_WITH, ROWS = load()
CASES = [
    pytest.param(name, way, id=f"{name}-{way}", marks=() if row.quick and way == row.ways[0] else pytest.mark.slow)
    for name, row in ROWS.items()
    for way in row.ways
]
EXEMPT = {
    "docs/examples/sumo_loop/street.toml": "needs libsumo",
    "docs/how-to/ros2.md:chatter.toml": "its programs live in real time: system/test_ros2.py",
}
"""Scenarios without a row, and why."""


@pytest.mark.slow
@pytest.mark.parametrize(("name", "way"), CASES)
def test_a_run_comes_to_what_the_table_says(name: str, way: str, tmp_path: Path) -> None:
    row = ROWS[name]
    found = row.run(way, tmp_path)
    expected = dict(row.results)
    if way == "real time" and found["verdict"] == "unknown":
        expected["verdict"] = "unknown"  # the machine may be too slow for it
    if machine() != MADE_WITH:
        expected |= {key: found[key] for key in row.numpy}
    if sys.version_info[:2] != (3, 11) and "tape" in expected:
        expected["tape"] = found["tape"]  # how many steps asyncio takes depends on its version
    assert found == expected


def test_every_scenario_that_is_shipped_or_documented_has_a_row() -> None:
    rows = [(row.page, row.command.split()[0]) for row in ROWS.values()]
    files = [*ROOT.glob("scenarios/*.toml"), *ROOT.glob("docs/examples/**/*.toml")]
    missing = {str(file.relative_to(ROOT)) for file in files} - {scenario for _, scenario in rows}
    written = {
        (str(page.relative_to(ROOT)), name)
        for page in PAGES
        for name in re.findall(r"^```toml\n# (\S+\.toml)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert missing | {":".join(each) for each in written - set(rows)} == EXEMPT.keys()


def test_the_table_is_as_it_is_written() -> None:
    assert TABLE.read_text(encoding="utf-8") == dump(MADE_WITH, ROWS)
