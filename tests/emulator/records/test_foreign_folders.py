"""Folders of others: pipes and devices are refused, and sizes are bounded before memory is taken."""

import os
import resource
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from emulator.checks.judge import check_run
from emulator.records import tables
from emulator.stream import messages
from tests.support.recorded import recorded
from vnet.errors import VnetError

TABLES = ("trace.parquet", "states.parquet", "metrics.parquet")
FILES = ("scenario.toml", "verdict.json", "events.jsonl", *TABLES, "world.npz")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    network, program = {"vehicles": 3}, {"entry": "agents.beacon:main"}
    scenario = {"run": {"duration_s": 1.0}, "network": network, "program": program}
    return recorded(scenario, tmp_path_factory.mktemp("foreign") / "run")


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(run, tmp_path / "run"))


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_is_no_regular_file_is_refused_in_one_line(copy: Path, name: str, kind: str) -> None:
    path = copy / name
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    with pytest.raises(VnetError, match=name) as refused:
        check_run(copy)
    assert "\n" not in str(refused.value)


def test_a_manifest_that_is_a_pipe_is_refused(copy: Path) -> None:
    (copy / "manifest.json").unlink()
    os.mkfifo(copy / "manifest.json")
    with pytest.raises(VnetError, match=r"manifest\.json"):
        check_run(copy)


@pytest.mark.parametrize(
    ("name", "column", "value", "message"),
    [
        ("trace", "sender", None, "column 'sender' has gaps"),
        ("metrics", "reporting", None, "column 'reporting' has gaps"),
        ("states", "period", 2**31 - 1, "periods 0 to 2147483647 in 30 rows"),
    ],
)
def test_a_cell_that_no_run_has_is_refused_in_one_line(
    copy: Path, name: str, column: str, value: object, message: str
) -> None:
    path = copy / f"{name}.parquet"
    kept = pq.read_table(path)
    rows = kept.to_pylist()
    rows[-1][column] = value
    pq.write_table(pa.Table.from_pylist(rows, schema=kept.schema), path)
    with pytest.raises(VnetError, match=message):
        check_run(copy)


def many_rows(path: Path, count: int) -> None:
    """Write a table of as many rows as its first one says, in a small file."""
    first = pq.read_table(path).slice(0, 1)
    columns = {
        field.name: pa.DictionaryArray.from_arrays(pa.array(np.zeros(count, np.int32)), values.dictionary)
        if pa.types.is_dictionary(field.type)
        else values.take(pa.array(np.zeros(count, np.int32)))
        for field, values in ((field, first[field.name].combine_chunks()) for field in first.schema)
    }
    pq.write_table(pa.table(columns, schema=first.schema), path, compression="zstd")


@pytest.mark.slow
def test_a_table_of_many_more_rows_than_the_verdict_speaks_of_is_refused(copy: Path) -> None:
    many_rows(copy / "trace.parquet", 2_000_000)
    before = pa.total_allocated_bytes()
    with pytest.raises(VnetError, match=r"2,000,000 rows") as refused:
        check_run(copy)
    assert "\n" not in str(refused.value)
    assert pa.total_allocated_bytes() - before < 1 << 20


@pytest.mark.parametrize("bound", ["LARGEST_RATIO", "available_bytes"])
def test_a_table_is_bounded_by_its_contents_and_by_the_memory_that_there_is(
    copy: Path, bound: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "LEAST_BOUND_BYTES", 1)
    monkeypatch.setattr(tables, bound, (lambda: 1000) if bound == "available_bytes" else 0)
    for read in (lambda: check_run(copy), lambda: list(messages(copy))):
        with pytest.raises(VnetError, match=r"rows need \d+ MB"):
            read()


def test_the_memory_that_there_is_counts_the_limit_of_the_process() -> None:
    unlimited = tables.available_bytes()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (1 << 40, limits[1]))
    try:
        assert tables.available_bytes() <= max(unlimited, 1 << 40)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
