"""The console scripts `vnet` and `vnet-agent`: they start vnet's packages, or name what is found in place of one.

They stand outside these packages, because a user's own `emulator.py` on PYTHONPATH hides the package of this name.
"""

import sys
from importlib import import_module


def emulator() -> None:
    """Run the command `vnet`."""
    _start("emulator.cli")


def agent() -> None:
    """Run the command `vnet-agent`."""
    _start("agents.cli")


def _start(module: str) -> None:
    """Run the `main` of a module, Ctrl-C ending the process without a traceback from here on."""
    try:
        from vnet.runtime import interrupts

        interrupts.end_at_once()
    except KeyboardInterrupt:
        sys.exit(130)
    try:
        main = import_module(module).main
    except ModuleNotFoundError:
        from vnet.runtime.own_packages import foreign_on_path

        if not (foreign := foreign_on_path(module.partition(".")[0])):
            raise
        print(f"vnet: {foreign}", file=sys.stderr)
        sys.exit(2)
    main()
