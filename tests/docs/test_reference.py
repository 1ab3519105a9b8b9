"""The reference pages are what `make docs` makes of the code as it is, and leave nothing out."""

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from docs.generate import PAGES, REFERENCE, faults, files
from docs.generate.keys import key_table
from emulator.radio.outcomes import Outcome
from emulator.radio.trace import ACKNOWLEDGED, CHOSEN, LATE, PERIOD
from emulator.records.tables import BUSY, METRICS, STATES, TABLES, TRACE, Column
from emulator.scenario.faults import KINDS
from emulator.scenario.scenario import Scenario
from emulator.scenario.sections import Section
from tests.support.recorded import recorded


@pytest.mark.slow
@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_made_from_the_code_as_it_is(name: str) -> None:
    assert (REFERENCE / name).read_text(encoding="utf-8") == PAGES[name](), "stale: make docs"


def test_there_is_no_page_that_nothing_makes() -> None:
    assert {path.name for path in REFERENCE.glob("*.md")} == set(PAGES)


@pytest.mark.slow
def test_pages_do_not_depend_on_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    wide = (REFERENCE / "commands.md").read_text(encoding="utf-8")
    for name, value in {"COLUMNS": "40", "TERMINAL_WIDTH": "40", "NO_COLOR": "1", "TERM": "dumb"}.items():
        monkeypatch.setenv(name, value)
    assert PAGES["commands.md"]() == wide


def test_every_kind_of_fault_is_there() -> None:
    page = (REFERENCE / "faults.md").read_text(encoding="utf-8")
    assert all(f"`{kind}`" in page for kind in KINDS)
    assert set(faults.NOTES) <= {kind.chapter for kind in KINDS.values()}


def test_a_key_without_a_docstring_is_refused() -> None:
    class Silent(Section):
        said: int = 1
        """Something."""
        silent_s: float = 0.0

    with pytest.raises(LookupError, match="silent_s"):
        key_table(Silent)


def test_a_column_without_a_text_is_refused() -> None:
    with pytest.raises(LookupError, match="cloud_m"):
        files.columns({**STATES.columns, "cloud_m": Column(STATES.schema.types[0], "")}, None)


@pytest.mark.slow
def test_every_file_column_and_key_of_a_run_is_there(tmp_path: Path) -> None:
    radio = {"path_loss": {"kind": "free_space"}, "mac": {}}
    scenario = Scenario.model_validate({"run": {"duration_s": 1.0}, "network": {"vehicles": 3}, "radio": radio})
    recorded(scenario, tmp_path / "run")
    left = {path.name + "/" * path.is_dir() for path in (tmp_path / "run").iterdir()}
    assert left <= {*files.FOLDER, *(table.file for table in TABLES)}
    verdict = json.loads((tmp_path / "run" / "verdict.json").read_text())
    assert verdict.keys() == files.VERDICT.keys()
    assert verdict["frames_by_outcome"].keys() == {outcome.name for outcome in Outcome} - {"pending"}
    optional = {*CHOSEN, *ACKNOWLEDGED, LATE, PERIOD}
    for table in (TRACE, STATES, BUSY, METRICS):
        own = ["neighbours"] if table is STATES else []  # what the program reports
        due = [name for name in table.columns if table is not TRACE or name not in optional]
        schema = pq.read_schema(tmp_path / "run" / table.file)
        assert schema.names == [*due, *own]
        assert [schema.field(name).type for name in due] == [table.columns[name].type for name in due]
