"""The command `vnet`, one file a group of commands; `python -m emulator` is the same command.

Exit status: 0 valid, 1 invalid, 2 wrong usage or a wrong scenario, 3 unknown, 130 interrupted.
"""

import sys

from vnet.runtime.environment import fix_hash_seed, use_one_blas_thread


def main() -> None:
    """Run the command `vnet` with the arguments of this process; import only what that command needs."""
    from emulator.cli.table import find

    use_one_blas_thread()
    command = find(sys.argv[1:])
    if command is not None and command.runs_programs:
        fix_hash_seed("emulator.cli")  # before any import that takes long, because it starts this process again
    from emulator.cli.application import build_app
    from emulator.terminal.console import run_app, tolerate_any_sign

    tolerate_any_sign()
    sys.exit(run_app(build_app([] if command is None else [command]), sys.argv[1:]))
