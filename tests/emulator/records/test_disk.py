"""Files and folders appear whole or not at all."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from emulator.records.disk import atomically, write_atomically
from vnet.errors import VnetError


def test_a_file_is_replaced_in_one_step(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_atomically(path, "first")
    with atomically(path) as part:
        part.write_text("second")
        assert path.read_text() == "first", "until the block is over"
        assert part.parent == path.parent, "a move within one file system"
    assert path.read_text() == "second"
    write_atomically(path, b"\xff")
    assert path.read_bytes() == b"\xff"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failure_leaves_what_was_there_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_atomically(path, "first")
    with pytest.raises(KeyboardInterrupt), atomically(path) as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_appears_whole(tmp_path: Path) -> None:
    path = tmp_path / "csv"
    with pytest.raises(ZeroDivisionError), atomically(path) as part:
        part.mkdir()
        (part / "a.csv").write_text("half")
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())
    with atomically(path) as part:
        part.mkdir()
        (part / "a.csv").write_text("x")
    assert [each.name for each in path.iterdir()] == ["a.csv"]
    assert [each.name for each in tmp_path.iterdir()] == ["csv"]


def test_a_disk_that_refuses_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(VnetError, match=r"^\S*gone/a: cannot write: No such file or directory$"):
        write_atomically(tmp_path / "gone" / "a", "x")
    (tmp_path / "file").write_text("")
    with pytest.raises(VnetError, match=r"^\S*file/a: cannot write: Not a directory$"):
        write_atomically(tmp_path / "file" / "a", "x")


def test_text_that_cannot_be_encoded_is_written_all_the_same(tmp_path: Path) -> None:
    write_atomically(tmp_path / "a", "\udc80é")
    assert (tmp_path / "a").read_text(encoding="utf-8") == "?é"


def test_a_colon_in_a_relative_path_is_no_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read and write the file: pyarrow takes `a:b` for a scheme and a path."""
    monkeypatch.chdir(tmp_path)
    folder = Path("a:b")
    folder.mkdir()
    table = pa.table({"x": [1, 2]})
    with atomically(folder / "t.parquet") as part:
        pq.write_table(table, part)
    assert pq.read_table((folder / "t.parquet").absolute()) == table
