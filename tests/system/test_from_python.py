"""`emulator.run` and `emulator.simulate` with real processes, in an event loop and in a notebook's kernel."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Any

import pytest

import emulator
from agents import beacon
from tests.support.paths import ROOT

pytestmark = pytest.mark.slow

SMALL: dict[str, Any] = {"run": {"name": "small", "duration_s": 0.5}, "network": {"vehicles": 3}}
CELLS = (
    f"import os; os.chdir({{folder!r}}); import sys; sys.path.insert(0, {str(ROOT)!r})",
    "import emulator",
    f"scenario = {SMALL!r}",
    "run = emulator.simulate(scenario, out='imported'); print(run.verdict, run.trace.num_rows)",
    "async def main(node):\n    async for fix in node.gnss:\n        await node.radio.broadcast(b'hello')\n",
    "own = emulator.simulate(scenario, program=main, out='own'); own",
    "print([left.reason[:13] for left in own.not_applicable if left.name == 'replay'])",
)


def test_run_has_a_process_for_each_vehicle_inside_a_running_event_loop(tmp_path: Path) -> None:
    async def main() -> emulator.Run:
        return emulator.run(SMALL, program=beacon.main, out=tmp_path / "live")

    live = asyncio.run(main())
    assert live.verdict == "valid"
    assert {path.name for path in (live.folder / "logs").iterdir()} >= {"v01.log", "v02.log", "v03.log"}
    assert live.trace.equals(emulator.simulate(SMALL, program=beacon.main, out=tmp_path / "simulated").trace)


def test_a_notebook_runs_programs_and_shows_the_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a kernel of its own: its loop runs while cells do, and its hash seed is drawn."""
    import nbclient  # slow to import, and but one worker of pytest needs it
    import nbformat

    monkeypatch.delenv("PYTHONHASHSEED", raising=False)
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    cells = [nbformat.v4.new_code_cell(text.format(folder=str(tmp_path))) for text in CELLS[:1]]
    cells += [nbformat.v4.new_code_cell(text) for text in CELLS[1:]]
    notebook = nbformat.v4.new_notebook(cells=cells)
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    printed = [output.get("text", "") for cell in notebook.cells for output in cell.outputs]
    assert "valid 30\n" in printed
    assert "['not warranted']\n" in printed
    (shown,) = [output for cell in notebook.cells for output in cell.outputs if "data" in output]
    assert shown["data"]["text/html"].startswith('<iframe title="vnet report" sandbox="allow-scripts"')
