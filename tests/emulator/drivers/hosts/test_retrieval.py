"""Logs and files that agents leave on a host come into the run's folder, bounded, and nothing else."""

from pathlib import Path

import pytest

from emulator.drivers.hosts import retrieval
from emulator.drivers.hosts.messages import Call
from emulator.drivers.hosts.retrieval import Retrieval, hand_in
from emulator.drivers.processes import ProtocolError
from emulator.records.run_folder import RunFolder, collect
from emulator.scenario.scenario import Scenario

PROCESSES = [["v01", "v02"], ["v03"]]
ONE_MB = 1.0


@pytest.fixture
def there(tmp_path: Path) -> RunFolder:
    """A host's folder, with a log and two disks."""
    folder = RunFolder(tmp_path / "host")
    folder.logs.mkdir(parents=True)
    (folder.logs / "v01.log").write_text("a line\nanother\n")
    (folder.disks / "v02" / "deep").mkdir(parents=True)
    (folder.disks / "v02" / "deep" / "data.bin").write_bytes(bytes(range(256)) * 10)
    (folder.disks / "v02" / "empty").touch()
    (folder.disks / "v02" / "link").symlink_to("/etc/passwd")
    (folder.disks / "v03").mkdir()
    (folder.disks / "v03" / "large").write_bytes(bytes(2_000_000))
    return folder


@pytest.fixture
def here(tmp_path: Path) -> RunFolder:
    return RunFolder.create(tmp_path / "run", Scenario())


def test_logs_and_files_come_as_they_were(
    there: RunFolder, here: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrieval, "PART_BYTES", 1000)
    writer = Retrieval(here, PROCESSES, ONE_MB)
    for name, *arguments in hand_in(there.path, PROCESSES, ONE_MB):
        if name == "part":
            assert len(arguments[3]) <= 1000
            writer.take(*arguments)
        else:
            assert name == "left_out"
            writer.tell_left_out(7, *arguments)
    assert collect(here, ["v01", "v02", "v03"], ONE_MB) == {}
    assert (here.logs / "v01.log").read_text() == "a line\nanother\n"
    files = here.path / "files"
    assert (files / "v02" / "deep" / "data.bin").read_bytes() == bytes(range(256)) * 10
    assert (files / "v02" / "empty").read_bytes() == b""
    assert sorted(path.name for path in files.rglob("*") if path.is_file()) == ["data.bin", "empty"]
    told = {(event.node, event.details["count"], event.details["which"][0][:5]) for event in here.events}
    assert told == {("v02", 1, "link:"), ("v03", 1, "large")}


def test_of_a_long_log_the_end_comes(there: RunFolder, here: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retrieval, "MOST_LOG_BYTES", 8)
    items = [item for item in hand_in(there.path, PROCESSES[:1], 0.0) if item[2] == "v01"]
    assert items == [("left_out", "log", "v01", 7, []), ("part", "log", "v01", "", b"another\n")]
    Retrieval(here, PROCESSES, 0.0).tell_left_out(7, *items[0][1:])
    assert [(event.kind, event.details) for event in here.events] == [("log_left_out", {"bytes": 7})]


@pytest.mark.parametrize(
    "part",
    [
        ("part", "file", "v09", "a", b""),
        ("part", "log", "v02", "", b""),  # its process is v01
        ("part", "file", "v01", "../v03/a", b""),
        ("part", "file", "v01", "/etc/cron.d/a", b""),
        ("part", "file", "v01", "", b""),
        ("part", "file", "v01", "a\0b", b""),
        ("part", "file", "v01", "a/" * 30 + "b", b""),
        ("part", "file", "v01", "a", bytes(1_000_001)),
    ],
    ids=["another's", "no process", "up", "absolute", "none", "nul", "deep", "large"],
)
def test_what_does_not_belong_there_is_refused(part: Call, here: RunFolder) -> None:
    with pytest.raises(ProtocolError):
        Retrieval(here, PROCESSES, ONE_MB).take(*part[1:])
    assert not here.disks.exists()
