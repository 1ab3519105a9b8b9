"""The command `vnet`, one file a group of commands; `python -m emulator.cli` is the same command."""

from vnet.runtime.environment import use_one_blas_thread


def main() -> None:
    """Run the command `vnet` with the arguments of this process."""
    use_one_blas_thread()
    from emulator.cli import commands

    commands.main()
