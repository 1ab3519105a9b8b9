"""The keyspace of Zenoh: one function for each key, so that no other file spells one.

All keys begin with `vnet/{run}`. Access rules, publishers and subscribers take their keys from here.
"""

import re

_SEGMENT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}\Z")


SEGMENTS = "names are letters, digits, '_', '.', '-', at most 64"
"""Names that `is_segment` allows, in the words of errors."""


def is_segment(name: str) -> bool:
    """Return true if the name of a run, node or host is valid in a key."""
    return _SEGMENT.match(name) is not None


def node_tx(run: str, node: str) -> str:
    """Key of messages from an agent to the emulator: hello, then yields (lockstep) or frames (real time)."""
    return f"vnet/{run}/node/{node}/tx"


def node_rx(run: str, node: str) -> str:
    """Key of messages from the emulator to an agent: welcome, then grants (lockstep) or batches (real time)."""
    return f"vnet/{run}/node/{node}/rx"


def node_report(run: str, node: str) -> str:
    """Key of copies of a node's reports for observers; they may be dropped."""
    return f"vnet/{run}/node/{node}/report"


def backbone_tx(run: str, unit: str) -> str:
    """Key of what a roadside unit sends over the backbone; its process's yields and frames refer to it."""
    return f"vnet/{run}/backbone/{unit}/tx"


def backbone_rx(run: str, unit: str) -> str:
    """Key of what a roadside unit receives over the backbone; grants and batches refer to it."""
    return f"vnet/{run}/backbone/{unit}/rx"


def node_alive(run: str, node: str) -> str:
    """Key of the liveliness token of a node's process."""
    return f"vnet/{run}/node/{node}/alive"


def host_tx(run: str, host: str) -> str:
    """Key of messages from a host to the emulator: those of its agents in bundles, and news of their processes."""
    return f"vnet/{run}/host/{host}/tx"


def host_rx(run: str, host: str) -> str:
    """Key of messages from the emulator to a host: those for its agents in bundles, and orders for processes."""
    return f"vnet/{run}/host/{host}/rx"


def host_alive(run: str, host: str) -> str:
    """Key of the liveliness token of a host."""
    return f"vnet/{run}/host/{host}/alive"


def emulator_alive(run: str) -> str:
    """Key of the emulator's liveliness token; when it disappears, an agent's orphan timeout begins."""
    return f"vnet/{run}/emulator/alive"


def observe(run: str, stream: str) -> str:
    """Key of messages from the emulator to observers."""
    return f"vnet/{run}/observe/{stream}"


def control(run: str, verb: str) -> str:
    """Key of operators' queries, which the emulator answers."""
    return f"vnet/{run}/control/{verb}"


def verb_of(key: str) -> str:
    """Return the verb of a control key."""
    return key.split("/", 3)[3]


def node_of(key: str) -> str:
    """Return the id in one of the `node/`, `backbone/` or `host/` keys above."""
    return key.split("/")[3]
