"""The command `vnet`, one file a group of commands; `python -m emulator.cli` is the same command."""


def main() -> None:
    """Run the command `vnet` with the arguments of this process."""
    from emulator.cli import commands

    commands.main()
