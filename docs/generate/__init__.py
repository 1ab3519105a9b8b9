"""The reference pages, made from the code that they speak of: `python -m docs.generate` writes them.

Each page is a function that returns its text; nothing in it depends on the machine, the terminal or the time.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from docs.generate import checks, commands, faults, files, node, scenario

REFERENCE = Path(__file__).parents[1] / "reference"
PAGES: dict[str, Callable[[], str]] = {
    "checks.md": checks.page,
    "commands.md": commands.page,
    "faults.md": faults.page,
    "files.md": files.page,
    "node.md": node.page,
    "scenario.md": scenario.page,
}
