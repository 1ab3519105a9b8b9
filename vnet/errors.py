"""The errors that vnet raises for its callers, rooted at `VnetError`, and the wording of their messages.

Each message is one line that names the subject, the value and what is allowed. Errors in vnet itself are
assertions, not members of this family.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches

LONGEST_MESSAGE = 2000
"""Characters of a message."""
LONGEST_SHOWN = 100
"""Characters of a wrong value in a message."""


class VnetError(Exception):
    """An input that vnet refuses, or an action that it cannot do, described in one line.

    A message may quote untrusted text, and is shown in terminals and logs: unprintable characters are escaped, and
    long messages are truncated.
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message, LONGEST_MESSAGE))


def printable(text: str, longest: int = LONGEST_SHOWN) -> str:
    """Return `text` in one line of at most `longest` characters, with unprintable characters escaped."""
    if not text.isprintable():
        text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text[:longest])
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def sendable(text: str) -> str:
    """Return a text as UTF-8 can have it: lone surrogates, as in names of files that are none, are escaped."""
    return text if text.isascii() else text.encode(errors="backslashreplace").decode()


def check_utf8(path: str) -> None:
    """Raise VnetError for a path with other bytes than UTF-8: the files of a run, which name paths, are UTF-8."""
    if sendable(path) != path:
        raise VnetError(f"{path}: not UTF-8, as paths must be; rename it")


def shown(value: object) -> str:
    """Return any wrong value as a message quotes it."""
    try:
        return printable(repr(value))
    except (ValueError, RecursionError):  # an integer of thousands of digits; a value nested too deeply
        return f"({type(value).__name__})"


def first_names(names: Sequence[object], most: int = 8, with_total: bool = False) -> str:
    """Return the first `most` names; an ellipsis, with the total if wanted, ends a longer list."""
    total = f" ({len(names)})" if with_total else ""
    return ", ".join(map(str, names[:most])) + (f", …{total}" if len(names) > most else "")


def did_you_mean(word: object, known: Iterable[str]) -> str:
    """Return ` (did you mean …?)` with the known word closest to a misspelt one; empty if none is close."""
    if not isinstance(word, str) or len(word) > LONGEST_SHOWN:  # the comparison takes time quadratic in its length
        return ""
    by_lower_case = {name.lower(): name for name in known}
    close = get_close_matches(word.lower(), by_lower_case, n=1, cutoff=0.7)
    return f" (did you mean {by_lower_case[close[0]]}?)" if close else ""


class ScenarioError(VnetError):
    """A scenario, an override or an input file that cannot be used. Commands end with status 2."""


class OverrideError(ScenarioError):
    """A change of a scenario that cannot be used: not its file is wrong, but what was given besides.

    `key` is the key that was changed.
    """

    def __init__(self, message: str, key: str) -> None:
        super().__init__(message)
        self.key = key


class WireError(VnetError):
    """A message on a Zenoh key that does not decode into what the key carries."""


class TransportError(VnetError):
    """A Zenoh session that could not be opened, was refused, or was lost."""


class PayloadTooLargeError(VnetError):
    """A payload larger than `radio.max_payload_bytes`, or than another `key` of the scenario."""

    def __init__(self, size_bytes: int, max_payload_bytes: int, key: str = "radio.max_payload_bytes") -> None:
        super().__init__(f"payload of {size_bytes} bytes exceeds {key} = {max_payload_bytes}")
        self.size_bytes = size_bytes
        self.max_payload_bytes = max_payload_bytes


class VirtualTimeError(VnetError):
    """An operation that a program may not use in lockstep, because it waits for the real world."""


class DeadlockError(VnetError):
    """A program whose tasks all wait for what nothing is left to bring: no timer, packet, fix, job or thread."""


class ProgramError(VnetError):
    """A vehicle program that cannot be imported, or whose entry is not a coroutine function of one node."""


def counted(number: int, noun: str, plural: str = "") -> str:
    """Return `number` with its noun: "1 frame", "2,000 frames"; `plural` is for those that take no plain "s"."""
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"
