"""The digest of a program changes with each of its own modules, and with nothing else; changes are told."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from emulator.cells.worker import modules_of
from emulator.records.code_digest import changed_code, digests_of, entries_of, program_digest, vnet_digest
from emulator.records.recorded_run import RecordedRun
from emulator.scenario.scenario import Scenario
from tests.support.command_line import app

MAIN = """
import json, numpy
from .near import NAME
from cd_tools.deep import thing
DECLARES = "cd_declared"

async def main(node):
    import cd_lazy
    async for fix in node.gnss:
        await node.radio.broadcast(NAME)
"""
FILES = {
    "cd_program/__init__.py": "",
    "cd_program/app.py": MAIN,
    "cd_program/near.py": "NAME = b'here'\n",
    "cd_program/unused.py": "",
    "cd_tools/deep/__init__.py": "from . import thing\n",
    "cd_tools/deep/thing.py": "import cd_broken\n",
    "cd_lazy.py": "",
    "cd_broken.py": "def (:\n",
    "cd_declared.py": "CHECKS: list[str] = ['cd_check:a']\nFIGURES = 'cd_figures:F'\nTEXT = 'cd_elsewhere:a'\n",
    "cd_check.py": "",
    "cd_figures.py": "",
    "scripts/cd_talker.py": "import cd_beside, cd_lazy\n",
    "scripts/cd_beside.py": "",
    "others/cd_talker.py": "import cd_beside\n",
    "others/cd_beside.py": "",
    "cd_package/__init__.py": "",
    "cd_package/__main__.py": "",
    "cd_elsewhere.py": "",
}
OWN = {"cd_program/__init__.py", "cd_program/app.py", "cd_program/near.py", "cd_lazy.py", "cd_broken.py"}
OWN |= {"cd_declared.py", "cd_check.py", "cd_figures.py"}
SCRIPTS = {
    "scripts/cd_talker.py",
    "scripts/cd_beside.py",
    "cd_lazy.py",
    "others/cd_talker.py",
    "others/cd_beside.py",
}
ENTRY = "cd_program.app:main"


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A program of several modules in the current folder."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("cd_")]:
        del sys.modules[name]


@pytest.mark.parametrize("name", FILES)
def test_each_module_of_a_program_counts_and_no_other(name: str, program: Path) -> None:
    before = program_digest([ENTRY])
    assert before is not None and before == program_digest([ENTRY])
    (program / name).write_text(FILES[name] + "# changed\n")
    belongs = name in OWN or name.startswith("cd_tools")
    assert (program_digest([ENTRY]) != before) is belongs
    assert not any(module.startswith("cd_") for module in sys.modules), "nothing is imported"


@pytest.mark.parametrize(
    ("commands", "own"),
    [
        ([["python", "-u", "scripts/cd_talker.py"], ["others/cd_talker.py"], ["./car", "-m", "fast"]], SCRIPTS),
        ([["python", "-m", "cd_lazy", "{id}"], ["python", "cd_{id}.py"]], {"cd_lazy.py"}),
        ([["python3", "-m", "cd_package"]], {"cd_package/__init__.py", "cd_package/__main__.py"}),
    ],
)
def test_sources_of_zenoh_programs_count(commands: list[list[str]], own: set[str], program: Path) -> None:
    settings = {"run": {"pacing": "realtime"}, "program": {"kind": "zenoh", "command": commands}}
    scenario = Scenario.model_validate(settings)
    for name, text in FILES.items():
        before = program_digest(modules_of(scenario))
        (program / name).write_text(text + "# changed\n")
        assert before is not None and (program_digest(modules_of(scenario)) != before) is (name in own), name


def test_a_namespace_package_within_a_package_counts(program: Path) -> None:
    inner = program / "cd_program" / "plain" / "leaf.py"
    inner.parent.mkdir()
    inner.write_text("LEAF = 1\n")
    (program / "cd_program" / "near.py").write_text("from cd_program.plain.leaf import LEAF\n")
    before = program_digest([ENTRY])
    assert before is not None
    inner.write_text("LEAF = 2\n")
    assert program_digest([ENTRY]) != before


def test_what_is_installed_in_another_environment_does_not_count(
    program: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = program / "lib" / "site-packages"
    other.mkdir(parents=True)
    (other / "cd_installed.py").write_text("")
    monkeypatch.syspath_prepend(other)
    (program / "cd_program" / "near.py").write_text("import cd_installed\n")
    before = program_digest([ENTRY])
    (other / "cd_installed.py").write_text("changed = True\n")
    assert before is not None and program_digest([ENTRY]) == before


def test_a_program_that_cannot_be_found_has_no_digest(program: Path) -> None:
    (program / "cd_program" / "app.py").unlink()
    assert program_digest([ENTRY]) is None
    assert program_digest(["nowhere:main"]) is None
    assert digests_of((ENTRY,)) == {"entries": ENTRY, "vnet": vnet_digest()}


def test_exceptions_belong_to_the_program(program: Path) -> None:
    exceptions = [{"entry": "cd_lazy:main", "nodes": ["v01"]}]
    scenario = Scenario.model_validate({"program": {"entry": "agents.beacon:main", "exceptions": exceptions}})
    assert entries_of(scenario) == ("agents.beacon:main", "cd_lazy:main")
    assert program_digest(entries_of(scenario)) != program_digest(["agents.beacon:main"])


def test_what_changed_is_named_if_the_programs_are_the_same() -> None:
    now = {"entries": "a:main", "program": "1", "vnet": "2"}
    assert changed_code({}, now) == changed_code(now, now) == ""
    assert changed_code({**now, "entries": "b:main", "program": "3"}, now) == ""
    assert changed_code({**now, "program": "3"}, now) == "the program a:main changed since this run was recorded"
    both = changed_code({"entries": "a:main", "program": "3", "vnet": "4"}, now)
    assert both == "the program a:main and vnet changed since this run was recorded"


def simulate(scenario: Path, out: Path, *options: str) -> Any:
    arguments = ["simulate", str(scenario), "--out", str(out), "--no-report", "--quiet", *options]
    done = CliRunner(env={"PYTHONHASHSEED": "0"}).invoke(app, arguments)
    assert (out / "verdict.json").exists(), done.output
    return done


@pytest.mark.slow
def test_a_changed_program_is_told_in_one_line_and_recorded_and_the_run_goes_on(
    program: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (program / "cd_single.py").write_text(
        MAIN.split("\n\n")[1].replace("NAME", "b'one'").replace("import cd_lazy", "")
    )
    monkeypatch.syspath_prepend(str(program))
    (program / "s.toml").write_text(
        '[run]\nduration_s = 1.0\nsettle_s = 0.0\n[network]\nvehicles = 2\n[program]\nentry = "cd_single:main"\n'
    )
    first = simulate(program / "s.toml", program / "first")
    again = simulate(program / "first" / "scenario.toml", program / "again")
    assert first.stderr == again.stderr == ""
    with (program / "cd_single.py").open("a") as source:
        source.write("# repaired\n")
    told = simulate(program / "first" / "scenario.toml", program / "told")
    assert told.stderr.startswith("vnet: note: ") and told.stderr.count("\n") == 1
    assert "the program cd_single:main changed since this run was recorded" in told.stderr
    runs = [RecordedRun.open(program / name) for name in ("first", "again", "told")]
    assert [[e.details["what"] for e in run.event("code_changed")] != [] for run in runs] == [False, False, True]
    assert len({run.record.trace_sha256 for run in runs}) == 1, "the hash of the trace does not depend on it"
    spoken = simulate(program / "first" / "scenario.toml", program / "json", "--log-format", "json")
    notes = [json.loads(line) for line in spoken.stderr.splitlines()]
    assert [note["message"] for note in notes if note["kind"] == "note"] == [told.stderr[12:-1]]
    other = simulate(program / "first" / "scenario.toml", program / "other", "--program", "agents.beacon:main")
    assert "changed" not in other.stderr


def test_a_source_that_nests_too_deeply_has_a_digest_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "deep.py").write_text("x = " + "-" * 100_000 + "1\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert digests_of(("deep:main",))["program"]


def test_a_folder_with_the_name_of_a_program_does_not_hide_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `platoon/platoon.toml` with `platoon.py` beside it, run from above: the import finds the module, too."""
    folder = tmp_path / "cd_same"
    folder.mkdir()
    (folder / "cd_same.py").write_text(MAIN)
    digest = program_digest(("cd_same:main",), (folder,))
    monkeypatch.syspath_prepend(str(tmp_path))
    assert program_digest(("cd_same:main",), (folder,)) == digest is not None
