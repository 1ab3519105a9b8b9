"""docs/reference/node.md: what a vehicle program sees, from the docstrings of `vnet`."""

from __future__ import annotations

import dataclasses
import inspect
import re
import textwrap
from collections.abc import Iterator

import msgspec

import vnet
from docs.generate.markdown import docstring, sentence, table
from docs.generate.markdown import page as whole_page
from vnet.errors import PayloadTooLargeError
from vnet.node import GnssReceiver
from vnet.radio import INBOX_LIMIT, Backbone, BackboneMessage, Radio, SendResult
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.units import unit_of

INTRODUCTION = f"""
A program is one async function of one argument. It needs only `from vnet import Node`; `Fix` and `Packet` are for
annotations.

```python
from vnet import Node


async def main(node: Node) -> None:
    async for fix in node.gnss:
        await node.radio.broadcast(b"here I am")
        node.report(fix.position_m, fix.covariance_m2, heard=len(node.radio.drain()))
```

[How time passes in it](../virtual-time.md), and [what else it may do](../how-to/threads-and-libraries.md). Arrays
are numpy's, of float64. `async for` over `node.radio`, `node.gnss` and `node.backbone` waits for the next packet,
fix or message until the run ends; of each the newest {INBOX_LIMIT} unread ones are kept.
"""
PARTS = {
    "Node": vnet.Node,
    "node.radio": Radio,
    "node.gnss": GnssReceiver,
    "node.backbone": Backbone,
    "Packet": vnet.Packet,
    "BackboneMessage": BackboneMessage,
    "SendResult": SendResult,
    "Fix": vnet.Fix,
    "node.map": LaneMap,
    "node.map of a city": RoadMap,
}
HOSTS_ONLY = {"disconnect", "to_wire", "from_wire", "is_sending", "forget_results", "settle"}
"""Public, but none of a program's business."""
ERRORS = f"""
`{PayloadTooLargeError.__name__}` is in `vnet.errors`; it has `size_bytes` and `max_payload_bytes`. An error that
leaves the program, or that a task, callback or job never handles, makes the run invalid:
[checks.md](../checks.md#exceptions).
"""


def page() -> str:
    """The whole page."""
    parts = [part for title, thing in PARTS.items() for part in _part(title, thing)]
    return whole_page("What a program sees", INTRODUCTION, *parts, "## Errors", ERRORS)


def _part(title: str, thing: type) -> Iterator[str]:
    yield f"## `{title}`"
    said, _, attributes = docstring(thing).partition("\nAttributes:\n")
    if dataclasses.is_dataclass(thing) or issubclass(thing, msgspec.Struct | tuple):
        types = {name: getattr(kind, "__forward_arg__", kind) for name, kind in thing.__annotations__.items()}
        said += f" Attributes: {', '.join(_field(name, str(kind)) for name, kind in types.items())}."
    yield textwrap.fill(" ".join(said.split()), 120, break_on_hyphens=False)
    rows = [[f"`{name}`", sentence(text)] for name, text in _listed(attributes)]
    rows += [[f"`{name}`", docstring(member)] for name, member in _members(thing)]
    yield table(["attribute or method", "what"], rows)


def _field(name: str, kind: str) -> str:
    """Name of an attribute with its type and unit."""
    return f"`{name}` ({', '.join(filter(None, [_plain(kind).replace(' | ', ' or '), unit_of(name)]))})"


def _listed(attributes: str) -> list[tuple[str, str]]:
    """The `name: text` of a docstring's section; further lines of a text are indented."""
    return re.findall(r"^    (\w+): (.*(?:\n {5,}.*)*)", attributes, re.MULTILINE)


def _members(thing: type) -> Iterator[tuple[str, object]]:
    """Public methods, as they are called, and properties, in the order of the source."""
    for name, member in vars(thing).items():
        if name.startswith("_") or name in HOSTS_ONLY:
            continue
        if isinstance(member, property):
            yield name, member
        elif inspect.isfunction(member):
            parameters = list(inspect.signature(member).parameters.values())[1:]
            called = f"{name}({', '.join(_plain(parameter) for parameter in parameters)})"
            yield f"await {called}" if inspect.iscoroutinefunction(member) else called, member


def _plain(annotated: object) -> str:
    """A type, or a parameter with one, as a reader needs it."""
    return str(annotated).replace("'", "").replace("ArrayLike", "array").replace("Array", "array")
