"""Texts of others reach a terminal as text: no escape sequence of theirs is sent, and no markup is obeyed."""

import io
import json
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from rich.panel import Panel
from rich.table import Table
from rich.text import Text
from typer.testing import CliRunner

from emulator.cli.commands import app
from emulator.scenario.scenario import Scenario
from emulator.terminal.safe_console import SafeConsole
from tests.support.recorded import recorded

HOSTILE = "\x1b]0;owned\x07\x1b[2J\x9b31m\x00[/red] :smile:"


def printed(renderable: object) -> str:
    file = io.StringIO()
    console = SafeConsole(file)
    console.print(renderable)
    return file.getvalue()


def is_plain(text: str) -> bool:
    return all(character.isprintable() or character in "\n\t" for character in text)


def test_control_characters_are_shown_in_whatever_holds_them() -> None:
    table = Table("head")
    table.add_row(Text(HOSTILE))
    table.add_row(HOSTILE)
    for each in (HOSTILE, Text(HOSTILE), table, Panel(HOSTILE, title=Text(HOSTILE))):
        text = printed(each)
        assert is_plain(text), repr(text)
        assert "x1b]0;owned" in text
    assert "[/red] :smile:" in printed(HOSTILE)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scenario = Scenario.model_validate(
        {"run": {"duration_s": 1.0}, "network": {"vehicles": 3}, "program": {"entry": "agents.beacon:main"}}
    )
    return recorded(scenario, tmp_path_factory.mktemp("safe") / "run")


def of_events(folder: Path) -> None:
    event = {
        "time_ns": 1,
        "kind": "crashed",
        "node": "v01",
        "error": HOSTILE,
        "where": HOSTILE,
        "log_tail": HOSTILE,
    }
    with (folder / "events.jsonl").open("a") as file:
        file.write(json.dumps(event) + "\n")


def of_verdict(folder: Path) -> None:
    path = folder / "verdict.json"
    data = json.loads(path.read_text())
    data["checks"].append(
        {"name": f"own:{HOSTILE}", "verdict": "invalid", "text": HOSTILE, "figures": {"rows": [{HOSTILE: HOSTILE}]}}
    )
    data["not_exercised"].append({"name": f"own:{HOSTILE}", "reason": HOSTILE})
    data["reproduce"] = f"vnet {HOSTILE}"
    path.write_text(json.dumps(data))


def of_manifest(folder: Path) -> None:
    (folder / "manifest.json").write_text(json.dumps({HOSTILE: HOSTILE}))


def of_states(folder: Path) -> None:
    path = folder / "states.parquet"
    states = pq.read_table(path)
    pq.write_table(states.append_column(f"a.{HOSTILE}", states["heading_rad"]), path)


@pytest.mark.parametrize("edit", [of_events, of_verdict, of_manifest, of_states])
@pytest.mark.parametrize("command", ["check", "report", "compare", "radio", "trace", "play"])
def test_no_command_sends_what_a_folder_holds(run: Path, tmp_path: Path, edit: object, command: str) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    edit(copy)  # type: ignore[operator]
    arguments = [command, str(copy), *([str(run)] if command == "compare" else [])]
    if command == "play":
        arguments = ["diff", str(copy), str(run)]
    done = CliRunner(env={"PYTHONHASHSEED": "0"}).invoke(app, arguments)
    assert done.exit_code in (0, 1, 2), done.output
    assert is_plain(done.output), repr(done.output)
