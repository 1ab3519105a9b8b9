"""Ids of nodes for the ids in files of trips, which may hold characters that keys of messages cannot hold."""

from __future__ import annotations

import re

from vnet.transport.keys import is_segment

_UNSAFE = re.compile(r"[^A-Za-z0-9_.]|^[_.]")
"""Characters of an id that are escaped where one of them cannot be part of a key."""


def node_id(given: str) -> str:
    """Return the id of a node for an id in a file: itself if keys can hold it, else with characters escaped.

    Any character but letters, digits, `_` and `.` becomes its code in hexadecimal between hyphens, as `#` becomes
    `-23-`; so does a hyphen, so that the given id can be read from the escaped one. An `x` goes before what does
    not begin with a letter or a digit.
    """
    if is_segment(given) or not given.isprintable():
        return given
    escaped = _UNSAFE.sub(lambda found: f"-{ord(found[0]):x}-", given)
    return f"x{escaped}" if escaped.startswith("-") else escaped
