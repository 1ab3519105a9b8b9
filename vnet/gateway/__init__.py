"""Zenoh programs as vehicles: their commands, the messages that cross the radio, and their frames."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import dropwhile
from pathlib import Path
from typing import Any

STARTUP = Path(__file__).with_name("startup")
"""Folder on `PYTHONPATH` by which programs in Python heed `ZENOH_CONFIG_OVERRIDE`, whatever they open, and tell of
their failure."""
FAILURE = "VNET_FAILURE"
"""Variable with the path of the file to which they write it: `error`, `status` (or empty), `place`, `details`."""
FILLED_IN = ("{id}", "{endpoint}", "{port}")
"""Words of a command that vnet fills in."""
PYTHON_FLAGS = frozenset(["-u", "-B", "-E", "-s", "-S", "-q"])
"""Options of Python's command line that change nothing on virtual time."""


def filled_in(words: Iterable[str], node: str, endpoint: str) -> list[str]:
    """Return the words of a command of the vehicle `node`, whose endpoint is PROTOCOL/HOST:PORT."""
    values = node, endpoint, endpoint.rpartition(":")[2]
    filled = list(words)
    for name, value in zip(FILLED_IN, values, strict=True):
        filled = [word.replace(name, value) for word in filled]
    return filled


def python_words(words: Sequence[str]) -> list[str]:
    """Return the words of a command of Python's from its script, -m or -c on; none if it has another option."""
    found = list(dropwhile(PYTHON_FLAGS.__contains__, words[1:]))
    is_script = found and not found[0].startswith("-")
    return found if is_script or (len(found) > 1 and found[0] in ("-m", "-c")) else []


def client_config(endpoint: str) -> dict[str, Any]:
    """Return the configuration of a session that connects to its vehicle's endpoint alone."""
    return {
        "mode": "client",
        "connect": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }


def session_variables(node: str, endpoint: str, config: Mapping[str, Any], path: Path) -> dict[str, str]:
    """Return the variables by which a program finds its endpoint; `path` is a file that has `config`.

    `ZENOH_CONFIG` is read by `Config.from_env`, and `ZENOH_CONFIG_OVERRIDE` by rmw_zenoh and, with `STARTUP` on
    `PYTHONPATH`, by `zenoh.open`.
    """
    return {
        "ZENOH_CONFIG": str(path),
        "ZENOH_CONFIG_OVERRIDE": ";".join(f"{key}={_json(value)}" for key, value in _leaves(config)),
        "VNET_ENDPOINT": endpoint,
        "VNET_NODE": node,
    }


def _json(value: object) -> str:
    """Return a value without the character that ends it."""
    return json.dumps(value).replace(";", "\\u003b")


def _leaves(table: Mapping[str, Any], path: str = "") -> list[tuple[str, Any]]:
    """Return the values of a nested table, with keys as Zenoh writes them, `connect/endpoints`."""
    leaves: list[tuple[str, Any]] = []
    for key, value in table.items():
        name = f"{path}/{key}" if path else key
        leaves += _leaves(value, name) if isinstance(value, dict) else [(name, value)]
    return leaves
