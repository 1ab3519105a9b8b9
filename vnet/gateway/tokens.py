"""Liveliness tokens of other vehicles, as far as their frames have been heard."""

from __future__ import annotations

from collections.abc import Iterable

TOKEN_PERIODS = 3
"""Times `liveliness_s` without word of a vehicle's tokens after which they are gone."""


class HeardTokens:
    """The tokens of each vehicle that has told them within `lifetime_ns`."""

    def __init__(self, lifetime_ns: int) -> None:
        self.lifetime_ns = lifetime_ns
        self._told: dict[str, tuple[int, tuple[str, ...]]] = {}
        """Time of the last frame, and its keys, by vehicle."""

    @property
    def keys(self) -> dict[str, None]:
        """The keys of all, in the order in which their vehicles were first heard."""
        return dict.fromkeys(key for _, keys in self._told.values() for key in keys)

    def hear(self, sender: str, keys: Iterable[str], now_ns: int) -> list[tuple[str, bool]]:
        """Take what a vehicle tells; return the keys that are gone by it (False), and those that are new (True)."""
        before = self.keys
        self._told[sender] = now_ns, tuple(keys)
        return _changes(before, self.keys)

    def expire(self, now_ns: int) -> list[tuple[str, bool]]:
        """Forget vehicles that have not been heard; return the keys that are gone by it."""
        before = self.keys
        self._told = {sender: told for sender, told in self._told.items() if now_ns - told[0] < self.lifetime_ns}
        return _changes(before, self.keys)


def _changes(before: dict[str, None], after: dict[str, None]) -> list[tuple[str, bool]]:
    gone = [(key, False) for key in before if key not in after]
    return gone + [(key, True) for key in after if key not in before]
