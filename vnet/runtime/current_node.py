"""The node on whose behalf code runs: it travels with asyncio's contexts into tasks, callbacks and jobs.

A program may run code in a context of its own, which does not have the variable. So a loop in virtual time knows
by itself to which node the callback belongs that runs.
"""

from __future__ import annotations

import asyncio
import contextvars
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vnet.node import Node

current_node: contextvars.ContextVar[Node | None] = contextvars.ContextVar("vnet_node", default=None)
"""A node, in one of its incarnations; None outside programs."""
NOBODY = contextvars.Context()
"""Context of callbacks that vnet itself sets while programs run."""
NOBODY.run(current_node.set, None)


def present_node() -> Node | None:
    """Return the node on whose behalf the present code runs, whatever its context."""
    node: Node | None = getattr(asyncio._get_running_loop(), "running_node", None)
    return current_node.get() if node is None else node
