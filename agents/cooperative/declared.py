"""The declarations of the cooperative positioning programs, which the emulator imports after a run."""

from agents.cooperative.hears_all import HearsAll as REFERENCE

__all__ = ["REFERENCE"]
