"""The node on whose behalf code runs: it travels with asyncio's contexts into tasks, callbacks and jobs."""

from __future__ import annotations

import contextvars

from vnet.node import Node

current_node: contextvars.ContextVar[Node | None] = contextvars.ContextVar("vnet_node", default=None)
"""A node, in one of its incarnations; None outside programs."""
