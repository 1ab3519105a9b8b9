"""The errors a caller of vnet can meet, rooted at `VnetError`.

Each message is one line that names the thing, the value and what is allowed. Mistakes of vnet's own are
assertions, not members of this family.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches

LONGEST_MESSAGE = 2000
"""Characters of a whole message."""
LONGEST_SHOWN = 100
"""Characters of a wrong value in a message."""


class VnetError(Exception):
    """Anything that vnet refuses or cannot do, said in one line.

    A message may quote what others wrote, and it ends in terminals and logs: what is not printable is escaped, and
    what is too long is cut.
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message, LONGEST_MESSAGE))


def printable(text: str, longest: int = LONGEST_SHOWN) -> str:
    """`text` in one line of at most `longest` characters, with escapes for what is not printable."""
    if not text.isprintable():
        text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text[:longest])
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def shown(value: object) -> str:
    """A wrong value as a message quotes it, whatever it is."""
    try:
        return printable(repr(value))
    except (ValueError, RecursionError):  # an integer of thousands of digits; a value nested too deeply
        return f"({type(value).__name__})"


def first_names(names: Sequence[object], most: int = 8, with_total: bool = False) -> str:
    """Return the first `most` names, with commas; an ellipsis, with the total if wanted, ends a longer list."""
    total = f" ({len(names)})" if with_total else ""
    return ", ".join(map(str, names[:most])) + (f", …{total}" if len(names) > most else "")


def did_you_mean(word: object, known: Iterable[str]) -> str:
    """What a misspelt word may have been meant to be, as ` (did you mean …?)`; empty if it is like none."""
    if not isinstance(word, str) or len(word) > LONGEST_SHOWN:  # comparing takes time in the square of its length
        return ""
    by_small_letters = {name.lower(): name for name in known}
    close = get_close_matches(word.lower(), by_small_letters, n=1, cutoff=0.7)
    return f" (did you mean {by_small_letters[close[0]]}?)" if close else ""


class ScenarioError(VnetError):
    """A scenario, an override or an input file that cannot be used. Commands end with status 2."""


class WireError(VnetError):
    """A message on a Zenoh key that does not decode into what the key carries."""


class TransportError(VnetError):
    """A Zenoh session that could not be opened, was refused, or was lost."""


class PayloadTooLargeError(VnetError):
    """A broadcast above the radio's limit."""

    def __init__(self, size_bytes: int, max_payload_bytes: int) -> None:
        super().__init__(f"payload of {size_bytes} bytes exceeds radio.max_payload_bytes = {max_payload_bytes}")
        self.size_bytes = size_bytes
        self.max_payload_bytes = max_payload_bytes


class VirtualTimeError(VnetError):
    """Something that a program may not do in lockstep, because it would wait on the real world."""


class ProgramError(VnetError):
    """A vehicle program that cannot be imported or has the wrong shape."""
