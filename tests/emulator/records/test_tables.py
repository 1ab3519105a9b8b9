"""The declaration of a table is all that vnet knows about it, beside the code that fills it."""

import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pytest

from docs.generate.files import page
from emulator.drivers import conclude
from emulator.drivers.session import Session
from emulator.export.tables import write_csv
from emulator.records.manifest import read_manifest
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.tables import FLOAT, TABLES, TEXT, TRACE, Column, Table
from emulator.scenario.scenario import Scenario
from tests.support.paths import ROOT
from vnet.errors import VnetError

TYRES = Table(
    "tyres",
    "a row for each vehicle",
    {"node": Column(TEXT, "id of the vehicle"), "wear_m": Column(FLOAT, "how much of the rubber is gone", True)},
    which=", where roads are rough",
    is_due=lambda scenario: scenario.run.name == "rough",
)


def simulated(folder: Path, wear: pa.Table, monkeypatch: pytest.MonkeyPatch) -> OpenedRun:
    gather = conclude.gather

    def gather_more(*arguments: object) -> RecordedRun:
        recorded = gather(*arguments)  # type: ignore[arg-type]
        recorded.more[TYRES] = wear  # type: ignore[index]
        return recorded

    run = {"name": "rough", "duration_s": 1.0}
    session = Session(Scenario.model_validate({"run": run, "network": {"vehicles": 2}}), folder).open()
    session.run()
    with monkeypatch.context() as patched:
        patched.setattr(conclude, "gather", gather_more)
        session.close()
    return RecordedRun.open(folder)


@pytest.mark.slow
def test_a_table_is_added_by_its_declaration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    TABLES.append(TYRES)
    try:
        wear = pa.table({"node": ["v01", "v02"], "wear_m": [0.001, None]}, TYRES.schema)
        run = simulated(tmp_path / "run", wear, monkeypatch)
        assert run.table(TYRES) == wear
        assert "tyres.parquet" in (read_manifest(tmp_path / "run") or {})
        assert "tyres.csv" in write_csv(run, tmp_path)
        text = page()
    finally:
        TABLES.remove(TYRES)
    assert "| `tyres.parquet` | [a row for each vehicle](#tyresparquet), where roads are rough |" in text
    assert "`wear_m` (`double`, m): how much of the rubber is gone" in text


@pytest.mark.slow
def test_a_gap_and_a_wrong_type_are_refused_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    TABLES.append(TYRES)
    try:
        gap = simulated(tmp_path / "gap", pa.table({"node": [None], "wear_m": [0.0]}, TYRES.schema), monkeypatch)
        whole = pa.table({"node": ["v01"], "wear_m": [1]})
        wrong = simulated(tmp_path / "wrong", whole, monkeypatch)
    finally:
        TABLES.remove(TYRES)
    with pytest.raises(VnetError, match="'node' has gaps"):
        gap.table(TYRES)
    with pytest.raises(VnetError, match="no column 'wear_m' of double"):
        wrong.table(TYRES)


def test_names_are_unique_and_every_run_has_a_trace() -> None:
    assert len({table.file for table in TABLES}) == len(TABLES)
    assert TRACE.is_due is not None and TRACE.is_due(Scenario())


@pytest.mark.slow
def test_a_table_is_made_without_pandas_and_becomes_a_data_frame_all_the_same() -> None:
    pytest.importorskip("pandas")
    lines = [
        "import sys",
        "from emulator.records.tables import TRACE",
        "table = TRACE.schema.empty_table()",
        "assert 'pandas' not in sys.modules",
        "assert list(table.to_pandas().columns) == table.column_names",
    ]
    subprocess.run([sys.executable, "-c", "\n".join(lines)], check=True, cwd=ROOT)
