"""vnet: the interface between vehicle programs and the emulator. A program needs only `from vnet import Node`.

These names are imported at their first use: whatever must come before numpy, which they need, can come after vnet.
Nothing else is imported here: Ctrl-C ends a command without a traceback only once this package is there.
"""

TYPE_CHECKING = False  # typing's takes milliseconds
if TYPE_CHECKING:
    from typing import Any

    from vnet.node import Fix, Node
    from vnet.radio import Packet

__all__ = ["Fix", "Node", "Packet"]


def __getattr__(name: str) -> "Any":
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module("vnet.radio" if name == "Packet" else "vnet.node"), name)
