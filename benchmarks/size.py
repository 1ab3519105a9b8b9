"""The size of vnet, in lines and files that git knows. `python -m benchmarks size` prints it."""

import subprocess
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCE = ("vnet", "agents", "emulator", "studies")
TO_CHANGE_A_RUN = (
    "vnet",
    "agents",
    "emulator/fault_plan.py",
    *(f"emulator/{name}" for name in ("scenario", "world", "radio", "records", "checks", "drivers")),
)
"""The packages that somebody must know who changes how a run runs."""
SMALL = 60
"""Lines below which a file needs a reason."""


def size(root: Path = ROOT) -> dict[str, int]:
    """Return lines and files of a work tree by what they are; templates of pages are not counted as source."""

    def files(*folders: str, ending: str = ".py") -> list[Path]:
        command = ["git", "ls-files", "-z", "-co", "--exclude-standard", "--", *folders]
        listed = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout.split("\0")
        paths = sorted({root / name for name in listed if name.endswith(ending)})
        return [path for path in paths if path.exists()]

    source = files(*SOURCE)
    return {
        "source, lines": _lines(source),
        "to know for changing a run, lines": _lines(files(*TO_CHANGE_A_RUN)),
        "source, files": len(source),
        f"files under {SMALL} lines": _count(source, lambda lines: 1 < lines < SMALL),
        "tests, lines": _lines(files("tests")),
        "pages, lines": _lines(files("README.md", "CONTRIBUTING.md", "docs", ending=".md")),
    }


def _lines(paths: list[Path]) -> int:
    return sum(len(path.read_text().splitlines()) for path in paths)


def _count(paths: list[Path], of: Callable[[int], bool]) -> int:
    return sum(of(len(path.read_text().splitlines())) for path in paths)


def table(root: Path = ROOT) -> str:
    """Return the sizes as a table in Markdown."""
    rows = [f"| {what} | {number:,} |" for what, number in size(root).items()]
    return "\n".join(["| | now |", "|---|---|", *rows])
