"""vnet: the interface between vehicle programs and the emulator. A program needs only `from vnet import Node`."""

from vnet.node import Fix, Node, Packet

__all__ = ["Fix", "Node", "Packet"]
