"""The keyspace: one function a key, so that no other file spells one.

Everything lives under `vnet/{run}`. Rules, publishers and subscribers all take their keys from here.
"""

import re

_SEGMENT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}\Z")


def is_segment(name: str) -> bool:
    """Whether a run's name or a node's id may stand in a key: letters, digits, `_ . -`, at most 64."""
    return _SEGMENT.match(name) is not None


def node_tx(run: str, node: str) -> str:
    """From an agent to the emulator: hello, then yields (lockstep) or frames (real time)."""
    return f"vnet/{run}/node/{node}/tx"


def node_rx(run: str, node: str) -> str:
    """From the emulator to an agent: welcome, then grants (lockstep) or batches (real time)."""
    return f"vnet/{run}/node/{node}/rx"


def node_report(run: str, node: str) -> str:
    """A copy of a node's reports for those who watch; it may be dropped."""
    return f"vnet/{run}/node/{node}/report"


def node_alive(run: str, node: str) -> str:
    """The liveliness token of a node's process."""
    return f"vnet/{run}/node/{node}/alive"


def emulator_alive(run: str) -> str:
    """The liveliness token of the emulator: an agent that sees it go starts its orphan clock."""
    return f"vnet/{run}/emulator/alive"


def observe(run: str, stream: str) -> str:
    """From the emulator to recorders and users' tools."""
    return f"vnet/{run}/observe/{stream}"


def control(run: str, verb: str) -> str:
    """Queries of operators, answered by the emulator."""
    return f"vnet/{run}/control/{verb}"


def verb_of(key: str) -> str:
    """The verb of a control key."""
    return key.split("/", 3)[3]


def node_of(key: str) -> str:
    """The node id in one of the `node/` keys above."""
    return key.split("/")[3]
