"""Disks of vehicles survive kills, are the same in both drivers, and are collected with care."""

import asyncio
import fcntl
import gc
import logging
import os
import sqlite3
import weakref
from contextlib import closing
from pathlib import Path

import pytest

from emulator.drivers.conclude import conclude
from emulator.drivers.emulation import Emulation
from emulator.records.run_folder import DEEPEST, MOST_FILES, RunFolder, collect
from tests.support.multi_loop_driver import run_apart, run_forked, run_together, scenario_of
from vnet.node import Node
from vnet.runtime.host import Disks

FAULTS = [
    {"kind": "kill", "at_s": 0.5, "duration_s": 0.6, "nodes": ["v01"]},
    {"kind": "restart", "at_s": 1.0, "duration_s": 0.4, "nodes": ["v02"]},
]


async def keeps_a_diary(node: Node) -> None:
    diary = node.folder / "diary.txt"
    before = diary.read_text() if diary.exists() else ""
    diary.write_text(f"{before}{node.incarnation}\n")
    async for fix in node.gnss:
        await node.radio.broadcast(diary.read_bytes())
        node.report(fix.position_m, fix.covariance_m2, entries=len(diary.read_text().split()))


def files_of(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


def concluded(emulation: Emulation) -> tuple[str, str]:
    _, verdict = conclude(emulation, 1.0, "simulate")
    return verdict["trace_sha256"], verdict["metrics_sha256"]


@pytest.mark.slow
@pytest.mark.parametrize("nodes_per_process", [1, 2])
def test_what_was_written_is_there_after_a_fault_and_in_the_run_at_its_end(nodes_per_process: int) -> None:
    faults, run = FAULTS if nodes_per_process == 1 else [], {"nodes_per_process": nodes_per_process}
    scenario = scenario_of(faults, f"{__name__}:keeps_a_diary", vehicles=3, run=run)
    together, apart, again = run_together(scenario), run_apart(scenario), run_forked(scenario)
    assert concluded(together) == concluded(apart) == concluded(again)
    first = "0\n1\n" if nodes_per_process == 1 else "0\n"
    expected = {"v01/diary.txt": first, "v02/diary.txt": first, "v03/diary.txt": "0\n"}
    for emulation in (together, apart, again):
        assert files_of(emulation.folder.path / "files") == expected
        assert not emulation.folder.disks.exists()


async def holds_its_disk(node: Node) -> None:
    """Hold a lock and an open transaction, count in a `finally` block, and write without flushing."""
    lock, unflushed = (node.folder / "lock").open("w"), (node.folder / f"{node.incarnation}.txt").open("w")
    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    database, counted = sqlite3.connect(node.folder / "rows.db", timeout=0), 0
    database.text_factory = bytes
    database.execute("create table if not exists rows(n int)")
    database.commit()
    of_nothing = [weakref.proxy(Path("gone").joinpath)]  # whoever asks what it is has an error
    try:
        async for fix in node.gnss:
            counted += 1
            unflushed.write("lost\n")
            database.execute("insert into rows values(1)")
            await asyncio.sleep(0.05)
            if counted % 3:
                database.commit()
            node.report(fix.position_m, fix.covariance_m2, entries=counted, odd=len(of_nothing))
    finally:
        (node.folder / "counted.txt").write_text(f"{node.incarnation} {counted}")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
@pytest.mark.parametrize("kind", ["kill", "restart"])
def test_what_was_ended_holds_nothing_and_writes_no_more(kind: str) -> None:
    ended = FAULTS[0] | {"kind": kind}
    emulation = run_together(scenario_of([ended], f"{__name__}:holds_its_disk", vehicles=1))
    concluded(emulation)
    gc.collect()  # while nobody minds files that were not closed
    assert not [event for event in emulation.folder.events if event.kind == "crashed"]
    disk = emulation.folder.path / "files" / "v01"
    assert (disk / "0.txt").read_text() == ""
    incarnation, counted = map(int, (disk / "counted.txt").read_text().split())
    with closing(sqlite3.connect(disk / "rows.db")) as database:
        ((rows,),) = database.execute("select count(*) from rows")
    assert incarnation == 1 and rows >= counted - 2, "what either has committed is there"


async def logs_to_its_disk(node: Node) -> None:
    logging.basicConfig(filename=node.folder / f"{node.id}.log", level=logging.INFO)
    async for fix in node.gnss:
        logging.info("incarnation %d", node.incarnation)
        node.report(fix.position_m, fix.covariance_m2)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["kill", "restart"])
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_program_that_was_ended_configures_logging_anew(kind: str) -> None:
    """The handler of the incarnation before would write to nowhere."""
    root = logging.getLogger()
    before, root.handlers = root.handlers, []
    try:
        ended = FAULTS[0] | {"kind": kind}
        emulation = run_together(scenario_of([ended], f"{__name__}:logs_to_its_disk", vehicles=1))
        concluded(emulation)
    finally:
        root.handlers = before
        root.setLevel(logging.WARNING)
    assert "incarnation 1" in (emulation.folder.path / "files" / "v01" / "v01.log").read_text()


class Collected:
    """Writes a file when it is discarded; a cycle keeps it until then."""

    def __init__(self, path: Path) -> None:
        self.me, self.path = self, path

    def __del__(self) -> None:
        self.path.write_text("collected")


async def leaves_garbage(node: Node) -> None:
    Collected(node.folder / "late.txt")
    if node.id == "v01":
        await asyncio.sleep(99)


@pytest.mark.slow
def test_what_those_have_left_who_were_not_killed_still_acts() -> None:
    killed = [{"kind": "kill", "at_s": 0.5, "duration_s": 99.0, "nodes": {"ids": ["v01"]}}]
    emulation = run_together(scenario_of(killed, f"{__name__}:leaves_garbage", vehicles=2))
    assert (emulation.folder.disks / "v02" / "late.txt").read_text() == "collected"
    concluded(emulation)


async def keeps_nothing(node: Node) -> None:
    async for fix in node.gnss:
        node.report(fix.position_m, fix.covariance_m2)


@pytest.mark.slow
def test_who_asks_for_no_disk_has_none() -> None:
    emulation = run_together(scenario_of([], f"{__name__}:keeps_nothing", vehicles=2))
    assert not emulation.folder.disks.exists()
    concluded(emulation)
    assert not (emulation.folder.path / "files").exists()


async def fills_its_disk(node: Node) -> None:
    (node.folder / "big").write_bytes(bytes(3000))
    (node.folder / "small").write_text("kept")


@pytest.mark.slow
def test_what_is_too_much_is_told_in_an_event() -> None:
    emulation = run_together(scenario_of([], f"{__name__}:fills_its_disk", vehicles=2, run={"files_max_mb": 0.002}))
    concluded(emulation)
    assert files_of(emulation.folder.path / "files") == {"v01/small": "kept", "v02/small": "kept"}
    told = [(event.node, event.details) for event in emulation.folder.events if event.kind == "files_left_out"]
    details = {"count": 1, "which": ["big: 3,000 bytes, and there is room for 2,000"]}
    assert told == [("v01", details), ("v02", details)]


def test_nothing_but_regular_files_below_the_disk_is_collected(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    secret = tmp_path / "secret"
    secret.write_text("secret")
    disk = Disks(folder.disks).of("v01")
    (disk / "a").mkdir()
    (disk / "a" / "kept").write_text("kept")
    (disk / "b.link").symlink_to(secret)
    (disk / "c.up").symlink_to(tmp_path)
    os.mkfifo(disk / "d.pipe")
    (disk / "e\udcff\n").write_text("an odd name")
    with (disk / "f.huge").open("wb") as file:
        file.truncate(1 << 40)
    (disk / "a" / "back").symlink_to("..")
    left_out = collect(folder, ["v01", "v02"], 1.0)
    assert files_of(tmp_path / "run" / "files") == {"v01/a/kept": "kept", "v01/e\udcff\n": "an odd name"}
    assert left_out.keys() == {"v01"}
    assert left_out["v01"].count == 5
    assert left_out["v01"].which == ["b.link: a link", "c.up: a link", "d.pipe: no regular file"]
    assert secret.read_text() == "secret"
    assert not folder.disks.exists()


def test_a_disk_that_is_a_link_is_not_followed(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").write_text("not the vehicle's")
    folder.disks.mkdir(parents=True)
    (folder.disks / "v01").symlink_to(tmp_path / "other")
    collect(folder, ["v01"], 1.0)
    assert not (tmp_path / "run" / "files").exists()
    assert (tmp_path / "other" / "file").exists()


@pytest.mark.slow
def test_many_files_and_deep_folders_are_bounded(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    disk = Disks(folder.disks).of("v01")
    for number in range(MOST_FILES + 2):
        (disk / f"{number:05}").touch()
    deep = disk.joinpath(*["x"] * (DEEPEST + 3))
    deep.mkdir(parents=True)
    (deep / "file").touch()
    left_out = collect(folder, ["v01"], 1.0)["v01"]
    assert left_out.count == 3
    assert left_out.which[0] == f"{MOST_FILES:05}: more than {MOST_FILES} files"
    assert left_out.which[2] == f"{'x/' * DEEPEST}x: more than {DEEPEST} folders deep"
    assert len(files_of(tmp_path / "run" / "files")) == MOST_FILES


def test_without_a_place_a_disk_is_temporary() -> None:
    disks = Disks()
    folder = disks.of("v01")
    assert folder.is_dir() and disks.of("v01") == folder != disks.of("v02")
