"""The whole command line of `vnet`, with every command imported."""

from emulator.cli.application import build_app

app = build_app()
