"""A run's folder is made once, for one run, and says in one line why it cannot be."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.records.events import KINDS, Event, EventKind
from emulator.records.recorded_run import RecordedRun
from emulator.records.run_folder import RunFolder
from emulator.scenario.loading import load_scenario
from emulator.scenario.scenario import Scenario
from vnet.errors import VnetError


def test_a_name_that_another_run_has_just_taken_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "run-1").symlink_to("gone")  # looks free, and cannot be made
    assert [RunFolder.create(None, Scenario()).path.name for _ in range(2)] == ["run-1-2", "run-1-3"]


def test_a_link_to_a_place_that_is_gone_is_no_place_for_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").symlink_to("gone")
    with pytest.raises(VnetError, match="cannot write: File exists"):
        RunFolder.create(None, Scenario())


def test_a_place_that_the_system_refuses_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(VnetError, match="cannot write: File name too long"):
        RunFolder.create(tmp_path / ("a" * 300), Scenario())
    with pytest.raises(VnetError, match=r"\\udce9: not UTF-8"):
        RunFolder.create(tmp_path / "b\udce9", Scenario())
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


def test_each_run_gets_a_folder_of_its_own_and_latest_is_the_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    scenario = Scenario.model_validate({"run": {"name": "night", "seed": 7}})
    first = RunFolder.create(None, scenario)
    first.event(1, EventKind.started)
    before = {path: path.read_bytes() for path in first.path.rglob("*") if path.is_file()}
    second, third = RunFolder.create(None, scenario), RunFolder.create(None, scenario)
    assert [folder.path.name for folder in (first, second, third)] == ["night-7", "night-7-2", "night-7-3"]
    assert {path: path.read_bytes() for path in first.path.rglob("*") if path.is_file()} == before
    assert (tmp_path / "runs" / "latest").readlink() == Path("night-7-3"), "relative, so that runs can be moved"
    assert not list((tmp_path / "runs").glob(".latest*"))


def test_a_folder_holds_its_scenario_from_the_start(tmp_path: Path) -> None:
    scenario = Scenario.model_validate({"run": {"seed": 11}, "radio": {"loss": 0.25}})
    folder = RunFolder.create(tmp_path / "deep" / "run", scenario)
    assert load_scenario(folder.path / "scenario.toml") == scenario
    assert RecordedRun.open(folder.path).events == []
    assert folder.logs.is_dir()


def test_out_may_be_new_or_empty_and_is_latest_in_runs_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "empty").mkdir(parents=True)
    assert RunFolder.create(tmp_path / "runs" / "empty", Scenario()).path == tmp_path / "runs" / "empty"
    assert RunFolder.create(tmp_path / "elsewhere" / "new", Scenario()).path.exists()
    assert (tmp_path / "runs" / "latest").readlink() == Path("empty")
    assert not (tmp_path / "elsewhere" / "latest").exists()


def test_a_folder_of_the_name_latest_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("latest", "other"):
        RunFolder.create(Path("runs") / name, Scenario())
    assert sorted(path.name for path in Path("runs").iterdir()) == ["latest", "other"]
    assert not Path("runs/latest").is_symlink()


@pytest.mark.parametrize("what", ["a file", "a folder with a file", "a folder with a hidden file", "a run"])
def test_out_that_holds_something_is_refused_and_left_alone(tmp_path: Path, what: str) -> None:
    path = tmp_path / "out"
    if what == "a run":
        RunFolder.create(path, Scenario())
    elif what == "a file":
        path.write_text("mine")
    else:
        path.mkdir()
        (path / (".hidden" if "hidden" in what else "notes.txt")).write_text("mine")
    before = {each: each.read_bytes() for each in [path, *path.rglob("*")] if each.is_file()}
    with pytest.raises(VnetError, match="exists and is not an empty folder") as refused:
        RunFolder.create(path, Scenario())
    assert "\n" not in str(refused.value)
    assert {each: each.read_bytes() for each in [path, *path.rglob("*")] if each.is_file()} == before


def test_a_place_below_a_file_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(VnetError, match="cannot write: Not a directory") as refused:
        RunFolder.create(tmp_path / "file" / "run", Scenario())
    assert "\n" not in str(refused.value)


def test_a_folder_that_goes_away_during_the_run_is_one_line(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run", Scenario())
    folder.path.rename(tmp_path / "elsewhere")
    folder.event(1, EventKind.died, "v01")  # is written at the end, if it can be
    writers: list[Callable[[], object]] = [lambda: folder.put_json("verdict.json", {})]
    for write in writers:
        with pytest.raises(VnetError, match="cannot write") as refused:
            write()
        assert "\n" not in str(refused.value)


json_values = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
event_list = st.lists(
    st.tuples(
        st.integers(0, 2**62),
        st.sampled_from(["died", "crashed", "late_deliveries"]),
        st.none() | st.text(min_size=1, max_size=5),
        st.dictionaries(
            st.sampled_from(["error", "how", "count"]), json_values | st.lists(json_values, max_size=3)
        ),
    ),
    min_size=1,
    max_size=4,
)


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(event_list, st.data())
def test_events_up_to_the_cut_survive_a_cut_anywhere(
    tmp_path_factory: pytest.TempPathFactory, events: list[tuple[Any, ...]], data: st.DataObject
) -> None:
    folder = RunFolder.create(tmp_path_factory.mktemp("events") / "run", Scenario())
    for time_ns, kind, node, details in events:
        folder.event(time_ns, KINDS[kind], node, **details)
    assert RecordedRun.open(folder.path).events == folder.events == [Event(*event) for event in events]
    path = folder.path / "events.jsonl"
    whole = path.read_bytes()
    cut = data.draw(st.integers(0, len(whole)))
    path.write_bytes(whole[:cut])
    complete = whole[: cut + 1].count(b"\n")  # a line that only lacks its end can be read
    assert RecordedRun.open(folder.path).events == folder.events[:complete]


def test_events_of_no_run_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(VnetError, match="not a run's folder") as refused:
        _ = RecordedRun.open(tmp_path).events
    assert "\n" not in str(refused.value)
