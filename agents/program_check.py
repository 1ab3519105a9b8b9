"""Import programs as an agent does, before any is started.

`python -P -m agents.program_check DESCRIPTOR [--path FOLDER …] ENTRY …` looks for them in the folders too.
The reason why one cannot be loaded goes to the file descriptor; the exit status is then 2.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from vnet.errors import ProgramError
from vnet.runtime.die_with_parent import signal_at_parent_death
from vnet.runtime.programs import load_program, search_programs_in


def main(arguments: Sequence[str]) -> int:
    """Import the programs with these entries; returns the exit status."""
    descriptor, *entries = arguments
    folders = []
    while entries[0] == "--path":
        _, folder, *entries = entries
        folders.append(Path(folder))
    search_programs_in(folders)
    try:
        for entry in entries:
            load_program(entry)
    except ProgramError as error:
        os.write(int(descriptor), str(error).encode())
        return 2
    return 0


if __name__ == "__main__":
    signal_at_parent_death(signal.SIGKILL)
    os._exit(main(sys.argv[1:]))  # not to wait for threads that a program has begun
