"""Modules that these tests import once: pytester forgets what a session imported, and numpy cannot come twice."""

from importlib import import_module

for _name in ("agents.beacon", "agents.cooperative", "emulator.testing.harness", "emulator.testing.strategies"):
    import_module(_name)
