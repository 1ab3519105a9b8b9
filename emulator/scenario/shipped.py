"""The scenarios that are shipped with vnet, each found by its name: `vnet simulate twelve`."""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent.parent / "scenarios"
"""In a clone a link to its folder `scenarios/`; in an installation that folder's files."""


def shipped_names() -> list[str]:
    """Return the names of the scenarios that are shipped, sorted."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def find_scenario(name: str | Path) -> Path:
    """Return the path of a scenario, given a path or the name of one that is shipped.

    A path that exists wins over a shipped name. A name that is neither is returned as it is.
    """
    path = Path(name)
    return FOLDER / f"{name}.toml" if str(name) in shipped_names() and not _exists(path) else path


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a name too long, or with a NUL
        return True
