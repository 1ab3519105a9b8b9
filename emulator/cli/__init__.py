"""The command `vnet`, one file a group of commands; `python -m emulator` is the same command.

Exit status: 0 valid, 1 invalid, 2 wrong usage, a wrong scenario or output that cannot be written, 3 unknown, 70 a
bug of vnet's own, 130 interrupted.
"""

import sys


def main() -> None:
    """Run the command `vnet` with the arguments of this process; import only what that command needs."""
    try:
        from vnet.runtime import interrupts

        interrupts.end_at_once()
    except KeyboardInterrupt:  # of `python -m emulator`, which no console script has guarded
        sys.exit(130)
    from emulator.cli.table import find
    from vnet.runtime.environment import (
        fix_hash_seed,
        open_standard_descriptors,
        too_little_address_space,
        use_same_arithmetic,
    )

    open_standard_descriptors()
    use_same_arithmetic()
    arguments = sys.argv[1:]
    command = find(arguments)
    if command is not None and (problem := too_little_address_space(command.needed_mb)):
        sys.exit(_refuse(problem))
    if command is not None and command.runs_programs:
        fix_hash_seed("emulator")  # before any import that takes long, because it starts this process again
    from emulator.cli.application import build_app
    from emulator.cli.own_child import leave, this_process_is_a_command
    from emulator.terminal import console

    console.tolerate_failures()
    this_process_is_a_command()
    status = console.run_app(build_app([] if command is None else [command]), arguments)
    interrupts.finish(status)
    if failure := console.failure():
        status = console.say_output_failed(failure, arguments)
    leave(status)


def _refuse(problem: str) -> int:
    """Say what is wrong before anything is imported; return the exit status."""
    print(f"vnet: {problem}", file=sys.stderr)
    return 2
