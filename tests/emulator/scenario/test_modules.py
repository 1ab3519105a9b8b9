"""Programs and checks are found beside the scenario first, then in the current folder, as modules or as files."""

import json
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest
from typer.testing import CliRunner

from emulator.records.recorded_run import RecordedRun
from emulator.records.run_folder import RunFolder
from emulator.scenario.loading import load_scenario
from emulator.scenario.scenario import Scenario
from emulator.testing.scenarios import make_scenario
from tests.support.command_line import app
from vnet.errors import ProgramError
from vnet.runtime.programs import load_program, search_programs_in

SAY = """
async def main(node):
    async for fix in node.gnss:
        await node.radio.broadcast({!r})
        node.report(size=node.options.get("size", 0))

async def other(node):
    async for fix in node.gnss:
        await node.radio.broadcast(b"o")
"""
SHORT = '[run]\nname = "own"\nduration_s = 0.5\nsettle_s = 0.0\n[network]\nvehicles = 2\n[radio]\nrange_m = 1e5\n'


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The current folder, with `scenarios/own.toml` in it; what is imported from there is forgotten."""
    (tmp_path / "scenarios").mkdir()
    (tmp_path / "scenarios" / "own.toml").write_text(SHORT)
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    yield tmp_path
    sys.path[:] = before
    for name in [name for name in sys.modules if name.startswith(("pp_", "pp "))]:
        del sys.modules[name]


def program(path: Path, payload: bytes) -> None:
    """Write a program whose frames are `payload`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(SAY.format(payload))


def load(*overrides: str) -> Scenario:
    return load_scenario(Path("scenarios/own.toml"), overrides)


def simulate(*arguments: object) -> tuple[int, str]:
    """Run `vnet simulate`; returns status and output."""
    words = ["simulate", *map(str, arguments), "--quiet", "--no-report"]
    done = CliRunner(env={"PYTHONHASHSEED": "0"}).invoke(app, words)
    return done.exit_code, done.output


def sizes(folder: str) -> set[int]:
    return set(RecordedRun.open(Path(folder)).trace["size_bytes"].to_pylist())


@pytest.mark.slow
def test_the_scenarios_own_folder_comes_before_the_current_one(here: Path) -> None:
    program(here / "pp_hello.py", b"here")
    program(here / "scenarios" / "pp_hello.py", b"beside")
    assert load('program.entry="pp_hello:main"').program.folders == (here / "scenarios", here)
    assert simulate("scenarios/own.toml", "--program", "pp_hello:main", "--out", "first")[0] == 0
    assert sizes("first") == {len(b"beside")}


@pytest.mark.parametrize("folder", [".", "scenarios"])
@pytest.mark.parametrize("entry", ["pp_one:main", "pp_package.deep:main", "pp_one.py", "pp_one.py:main"])
def test_a_program_is_found_in_either_folder(here: Path, folder: str, entry: str) -> None:
    program(here / folder / "pp_one.py", b"1")
    program(here / folder / "pp_package" / "deep.py", b"1")
    loaded = load(f'program.entry="{entry}"').program
    assert loaded.folders == ((here / folder).resolve(),)
    assert loaded.entry == ("pp_package.deep:main" if "deep" in entry else "pp_one:main")


def test_vnets_own_programs_and_what_is_installed_need_no_folder(here: Path) -> None:
    (here / "agents").mkdir()
    program(here / "agents" / "beacon.py", b"not this one")
    assert load().program.folders == ()
    assert load('program.entry="json:dumps"').program.folders == ()


@pytest.mark.slow
def test_a_file_of_the_command_line_is_one_of_the_current_folder(here: Path) -> None:
    program(here / "pp_hello.py", b"here")
    program(here / "scenarios" / "pp_hello.py", b"beside")
    assert simulate("scenarios/own.toml", "--program", "pp_hello.py", "--out", "first")[0] == 0
    assert sizes("first") == {len(b"here")}


@pytest.mark.slow
def test_a_file_may_name_its_function_and_lie_anywhere(here: Path) -> None:
    program(here / "deep" / "er: 2" / "pp_far.py", b"far")
    assert simulate("scenarios/own.toml", "--program", "deep/er: 2/pp_far.py:other", "--out", "first")[0] == 0
    assert sizes("first") == {1}


@pytest.mark.slow
def test_the_stored_command_works_from_any_folder(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program(here / "scenarios" / "pp_hello.py", b"here")
    simulate("scenarios/own.toml", "--program", "pp_hello.py", "--out", "my first")
    stored = json.loads((here / "my first" / "verdict.json").read_text())
    (here / "elsewhere").mkdir()
    monkeypatch.chdir(here / "elsewhere")
    del sys.modules["pp_hello"]
    vnet, verb, *words = shlex.split(stored["reproduce"])
    assert (vnet, verb) == ("vnet", "simulate")
    assert simulate(*words, "--out", "again") == (0, "verdict: valid  again\n")
    assert RecordedRun.open(Path("again")).record.trace_sha256 == stored["trace_sha256"]
    moved = (here / "my first").rename(here / "moved")
    assert (
        RecordedRun.open(Path("../moved")).record.reproduce
        == f"vnet simulate {here}/elsewhere/../moved/scenario.toml"
    )
    assert RecordedRun.open(moved).record.reproduce == f"vnet simulate {moved}/scenario.toml"


def test_the_digest_of_a_program_is_that_of_its_folder(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program(here / "scenarios" / "pp_hello.py", b"beside")
    scenario = load('program.entry="pp_hello:main"')
    monkeypatch.chdir("/")
    before = RunFolder.create(here / "one", scenario).code["program"]
    program(here / "scenarios" / "pp_hello.py", b"changed")
    assert RunFolder.create(here / "two", scenario).code["program"] != before


def test_a_test_finds_programs_beside_its_scenario(here: Path) -> None:
    program(here / "scenarios" / "pp_hello.py", b"beside")
    for entry in ("pp_hello:main", "pp_hello.py"):
        made = make_scenario("scenarios/own.toml", {"program": entry}).program
        assert (made.entry, made.folders) == ("pp_hello:main", (here / "scenarios",))


def test_exceptions_and_checks_are_found_likewise(here: Path) -> None:
    program(here / "pp_liar.py", b"lie")
    (here / "scenarios" / "pp_checks.py").write_text("def check(run):\n    return []\n")
    exceptions = 'program.exceptions=[{entry="pp_liar.py", nodes=["v01"]}]'
    loaded = load(exceptions, 'program.checks=["pp_checks.py"]').program
    assert loaded.of("v01").entry == "pp_liar:main"
    assert loaded.checks == ("pp_checks:check",)
    assert loaded.folders == (here, here / "scenarios")


def test_given_folders_come_first_and_are_relative_to_the_scenario(here: Path) -> None:
    program(here / "pp_hello.py", b"here")
    program(here / "src" / "pp_hello.py", b"src")
    loaded = load('program.entry="pp_hello:main"', 'program.folders=["../src"]').program
    assert loaded.folders == (here / "src", here)


@pytest.mark.slow
def test_an_option_is_short_for_a_key_of_the_scenario(here: Path) -> None:
    program(here / "pp_hello.py", b"x")
    arguments = ["scenarios/own.toml", "--program", "pp_hello.py", "--out", "one"]
    assert simulate(*arguments, "--option", "size=7", "--option", "word=far away")[0] == 0
    run = RecordedRun.open(Path("one"))
    assert run.scenario.program.options == {"size": 7, "word": "far away"}
    assert (run.value("size") == 7).all()


def test_folders_are_searched_last_and_those_of_another_run_no_more(here: Path) -> None:
    search_programs_in([])  # those of earlier tests no more
    installed = sys.path[:-1]
    search_programs_in([here / "a", here / "b"])
    assert sys.path == [*installed, str(here / "a"), str(here / "b"), str(Path.cwd())]
    search_programs_in([here / "b"])
    assert sys.path == [*installed, str(here / "b"), str(Path.cwd())]
    search_programs_in([])
    assert sys.path == [*installed, str(Path.cwd())]


def test_agents_of_a_live_run_are_told_the_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from emulator.drivers.launch import Launcher
    from vnet.transport.access import Access

    started: list[Any] = []
    launcher = Launcher(tmp_path, [tmp_path / "a b", tmp_path])
    monkeypatch.setattr(launcher, "start", lambda *arguments: started.append(arguments))
    launcher.start_agents("tcp/127.0.0.1:1", Access.create("run", [["v01"]]), [["v01"]])
    (arguments,) = [words for _, words, *_ in started]
    assert arguments[-4:] == ["--path", str(tmp_path / "a b"), "--path", str(tmp_path)]


@pytest.mark.slow
def test_a_file_name_may_have_blanks(here: Path) -> None:
    program(here / "pp my prog.py", b"blank")
    status, said = simulate("scenarios/own.toml", "--program", "pp my prog.py", "--out", "run")
    assert status == 0, said
    again = load_scenario(here / "run" / "scenario.toml")
    assert again.program.entry == "pp my prog:main"
    assert RecordedRun.open(here / "run").scenario.program.entry == again.program.entry
    status, said = simulate("run/scenario.toml", "--out", "again")
    assert status == 0, said
    digests = [json.loads((here / each / "verdict.json").read_text())["trace_sha256"] for each in ("run", "again")]
    assert digests[0] == digests[1]


def test_programs_that_were_not_there_before_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder on the path that is made later, an archive that is written again, a relative entry."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path / "later"), str(tmp_path / "z.zip"), "relative"])
    text = "async def main(node): pass"

    def write(folder: str) -> None:
        Path(folder).mkdir(exist_ok=True)
        Path(folder, f"found_{folder}_9.py").write_text(text)

    def pack(*names: str) -> None:
        with ZipFile("z.zip", "w") as archive:
            for name in names:
                archive.writestr(f"{name}.py", text)

    pack("found_first_9")
    Path("relative").mkdir()
    with pytest.raises(ProgramError):
        load_program("found_nothing_9:main")
    write("later")
    write("relative")
    pack("found_first_9", "found_second_9")
    search_programs_in([])
    for name in ("found_later_9", "found_second_9", "found_relative_9"):
        load_program(f"{name}:main")
        monkeypatch.delitem(sys.modules, name)
