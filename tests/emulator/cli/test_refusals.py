"""Whatever is wrong in a command line is said in one line, with status 2, and nothing is left behind."""

import re
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from emulator.cli import options
from emulator.terminal.console import run_app
from tests.support import maps
from tests.support.command_line import app
from tests.support.paths import ROOT
from tests.support.recorded import recorded
from vnet.transport.credentials import Credentials

pytestmark = pytest.mark.slow

FILES = {
    "good.py": "async def main(node):\n    pass\n\ndef check(run):\n    return []\n",
    "wrong_syntax.py": "async def main(node:\n",
    "lacks_module.py": "import none_such\n",
    "raises_early.py": "raise ValueError('no key')\n",
    "no_coroutine.py": "def main(node):\n    pass\n",
    "checks_here.py": "number = 5\n\nasync def waiting(run):\n    pass\n",
    "with-hyphens.py": "async def main(node):\n    pass\n",
    "src/good.py": "async def main(node):\n    pass\n",
    "two.toml": 'program = {entry = "good.py", exceptions = [{entry = "src/good.py", nodes = ["v01"]}]}\n',
    "fault.toml": '[[fault]]\nkind = "kill"\nat_s = 1.0\nduration_s = 1.0\nnodes = ["v99"]\n',
    "v01.json": Credentials("node-v01", "secret").dumps(),
    "town.geojson": maps.geojson(),
    "trips.csv": "",
    "cross.npz": "",
}
"""Files of the current folder, in which there is a finished run, too."""


def files(folder: Path) -> list[Path]:
    """Return all paths but those of an experiment, which makes its folder in `runs` first."""
    made = {"__pycache__", "experiments"}
    return sorted(path for path in folder.rglob("*") if path.name != "runs" and not made & {*path.parts})


@pytest.fixture
def typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[str], str]:
    """Return what runs a command, at a terminal without a display, and returns what it says."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    run = {"duration_s": 0.5, "settle_s": 0.1, "keep_payloads": True}
    recorded({"run": run, "network": {"vehicles": 2}, "program": {"entry": "agents.beacon:main"}}, tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(options, "_at_a_terminal", lambda: True)
    monkeypatch.setattr("emulator.cells.cells.DASK_PATIENCE_S", 0.2)
    monkeypatch.setenv("PYTHONHASHSEED", "0")  # or commands would start again
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    before = files(tmp_path)

    def said(command: str) -> str:
        status = run_app(app, shlex.split(command.removeprefix("vnet ")))
        told = capsys.readouterr()
        lines = [line for line in told.err.splitlines() if "s of emulated time" not in line]
        assert (status, told.out, len(lines), files(tmp_path)) == (2, "", 1, before), f"{command}: {told}"
        return lines[0].removeprefix("vnet: ").replace(str(tmp_path), "FOLDER").replace(str(ROOT), "ROOT")

    return said


def test_messages_are_those_that_were_read(typed: Callable[[str], str], tmp_path: Path) -> None:
    golden = (ROOT / "tests" / "golden" / "commands.txt").read_text(encoding="utf-8")
    commands = re.findall(r"^\$ ([^\n]+)\n=>", golden, re.MULTILINE)
    assert len(commands) > 80
    shown = "\n".join(f"$ {command}\n=> {typed(command)}\n" for command in commands)
    (tmp_path / "commands.txt").write_text(shown, encoding="utf-8")
    assert shown == golden, f"read {tmp_path}/commands.txt; if it is right, keep it"
