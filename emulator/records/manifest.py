"""The manifest of a run's folder: SHA-256 of each file that was written until the verdict, by its path.

Reports, recordings and access files may be made, or left out, afterwards, and are not in it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

from pydantic import ValidationError

from emulator.records.run_folder import (
    EVENTS_FILE,
    FILES,
    MANIFEST_FILE,
    PROGRAMS_LOG,
    SCENARIO_FILE,
    VERDICT_FILE,
    WORLD_FILE,
    RunFolder,
)
from emulator.records.tables import TABLES
from emulator.records.tape import TAPE_FILE
from emulator.scenario.sections import validated
from vnet.bounded import open_regular, read_regular
from vnet.errors import VnetError, printable

LARGEST_BYTES = 1 << 26
UNLISTED = ("logs/checks.txt", "logs/checks.log", "logs/programs.log")
"""Output of own checks, which judge a folder again, and logs of checks and programs of earlier vnets."""


def _evidence() -> list[str]:
    """Return the files by which a run is judged; those that are there stand in the manifest."""
    tables = [table.file for table in TABLES]
    return [SCENARIO_FILE, *tables, WORLD_FILE, TAPE_FILE, EVENTS_FILE, VERDICT_FILE]


def write_manifest(folder: RunFolder) -> None:
    """Write the digests of the files as they are now. Raises VnetError where the disk refuses."""
    digests = {name: sha256_of(folder.path / name) for name in _names(folder.path)}
    folder.put_json(MANIFEST_FILE, digests)


def read_manifest(folder: Path) -> dict[str, str] | None:
    """Return the digests by path, or None if there is no manifest. Raises VnetError for anything else."""
    path = folder / MANIFEST_FILE
    try:
        return validated(dict[str, str], json.loads(read_regular(path, LARGEST_BYTES)), strict=True)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise VnetError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (ValidationError, ValueError, RecursionError):
        raise VnetError(f"{path}: not a table of digests by file") from None


def differing_files(folder: Path, digests: dict[str, str]) -> dict[str, str]:
    """Return the files that are not those of the manifest, each with what is wrong with it."""
    found = {}
    added = (name for name in _names(folder) if name not in UNLISTED)
    for name in sorted({*digests, *added}):
        if name not in digests:
            found[name] = "is not in the manifest"
        elif Path(name).is_absolute() or ".." in Path(name).parts:
            found[name] = "is no file of the folder"
        else:
            try:
                if sha256_of(folder / name) != digests[name]:
                    found[name] = "has other contents"
            except VnetError as error:
                found[name] = str(error).rpartition(": ")[2]
    return {printable(name): what for name, what in found.items()}


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file. Raises VnetError if it cannot be read."""
    try:
        with open_regular(path) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise VnetError(f"{path}: cannot be read: {error.strerror or error}") from None
    except ValueError as error:
        raise VnetError(f"{path}: {error}") from None


def _names(folder: Path) -> Iterator[str]:
    """Yield the files of a folder that is complete, as the manifest names them."""
    yield from (name for name in _evidence() if (folder / name).is_file())
    for below in (folder / "logs", folder / FILES):
        for path in sorted(below.rglob("*")):
            if path.is_file() and not path.is_symlink() and path != folder / "logs" / PROGRAMS_LOG:
                yield path.relative_to(folder).as_posix()
