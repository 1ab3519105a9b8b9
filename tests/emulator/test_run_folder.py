"""A run's folder is made once, for one run, and says in one line why it cannot be."""

from pathlib import Path

import pytest

from emulator.observe.run_folder import RunFolder
from vnet.errors import VnetError
from vnet.scenario import Scenario


def test_a_name_that_another_run_has_just_taken_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "run-1").symlink_to("gone")  # looks free, and cannot be made
    assert [RunFolder.create(None, Scenario()).path.name for _ in range(2)] == ["run-1-2", "run-1-3"]


def test_a_place_that_the_system_refuses_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(VnetError, match="cannot write: File name too long"):
        RunFolder.create(tmp_path / ("a" * 300), Scenario())
    (tmp_path / "runs").touch()
    with pytest.raises(VnetError, match="cannot write"):
        RunFolder.create(None, Scenario())


def test_a_table_that_fails_half_way_leaves_what_was_there(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run", Scenario())
    folder.put_json("verdict.json", {"verdict": "valid"})

    def fail(path: Path) -> None:
        path.write_text("{")
        raise OSError(28, "No space left on device")

    with pytest.raises(VnetError, match="No space left on device"):
        folder.put("verdict.json", fail)
    assert '"valid"' in (folder.path / "verdict.json").read_text()
