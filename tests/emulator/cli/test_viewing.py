"""`vnet render` and `vnet view`, as one types them: what they make, and what they refuse."""

import shutil
import subprocess
from pathlib import Path

import pytest
from typer.testing import CliRunner

from emulator.viewer.recorder import Recorder
from emulator.viewer.sinks import Sinks, is_closed
from tests.emulator.test_playback import Watched, watch
from tests.support.command_line import app
from tests.support.forked_commands import VNET
from tests.support.paths import ROOT

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Watched:
    scenario = {
        "run": {"duration_s": 2.0, "settle_s": 0.5, "name": "watched"},
        "network": {"vehicles": 4},
        "program": {"entry": "agents.cooperative:main", "options": {"particles": 40}},
        "fault": [{"kind": "kill", "at_s": 0.5, "duration_s": 0.5, "nodes": {"count": 1}}],
    }
    watched = watch(scenario, tmp_path_factory.mktemp("cli") / "run")
    with Recorder(Sinks(save=watched.folder / "live.rrd"), "watched") as recorder:
        for stream, message in watched.told:
            recorder.take(stream, message)
    return watched


def vnet(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, list(map(str, arguments)))
    return result.exit_code, result.output


def test_a_recording_may_be_put_elsewhere(watched: Watched, tmp_path: Path) -> None:
    out = tmp_path / "mine.rrd"
    assert vnet("render", watched.folder, "--out", out) == (0, f"{out}\n")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.rrd"] and is_closed(out)


def test_what_was_there_stays_until_the_new_one_is_whole(watched: Watched, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(watched.folder, tmp_path / "run"))
    (folder / "recording.rrd").write_bytes(b"old")
    states = folder / "states.parquet"
    whole = states.read_bytes()
    states.write_bytes(whole[: len(whole) // 2] + bytes(len(whole) - len(whole) // 2 - 1000) + whole[-1000:])
    status, output = vnet("render", folder)
    assert status == 2
    assert "states.parquet" in output
    assert (folder / "recording.rrd").read_bytes() == b"old"
    assert not [path for path in folder.iterdir() if path.name.endswith(".part")]


def test_what_was_there_stays_where_the_new_one_has_no_room(watched: Watched, tmp_path: Path) -> None:
    (out := tmp_path / "mine.rrd").write_bytes(b"old")
    kib = (watched.folder / "live.rrd").stat().st_size // 1024 // 2
    words = [*VNET, "render", watched.folder, "--out", out]
    limited = ["bash", "-c", f'ulimit -f {kib}; exec "$@"', "bash", *map(str, words)]
    done = subprocess.run(limited, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2, done
    assert done.stderr.splitlines()[-1].startswith("vnet: ") and "cannot write the recording" in done.stderr
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("mine.rrd", b"old")]


def test_nothing_asks_to_render_a_run_that_was_killed(watched: Watched, tmp_path: Path) -> None:
    for name in ("scenario.toml", "events.jsonl"):
        shutil.copy(watched.folder / name, tmp_path)
    again = f"vnet run {tmp_path / 'scenario.toml'} makes the run again\n"
    for command in ("view", "render"):
        status, told = vnet(command, tmp_path)
        assert status == 2 and told.endswith(again) and told.count("\n") == 1, told
    recording = tmp_path / "recording.rrd"
    shutil.copy(watched.folder / "live.rrd", recording)
    with recording.open("r+b") as file:
        file.truncate(150)  # nothing but its name
    assert vnet("view", tmp_path)[1].endswith(again)


def test_view_says_how_to_make_a_recording_of_a_finished_run(watched: Watched, tmp_path: Path) -> None:
    for name in ("scenario.toml", "events.jsonl", "verdict.json"):
        shutil.copy(watched.folder / name, tmp_path)
    assert vnet("view", tmp_path)[1].endswith(f"make one of its files with vnet render {tmp_path}\n")
