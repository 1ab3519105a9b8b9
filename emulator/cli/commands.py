"""The whole command line of `vnet`, with every command imported: for the documentation, and for tests."""

from __future__ import annotations

from emulator.cli.application import build_app

app = build_app()
