"""vnet: what vehicle programs and the emulator agree on. A program needs only `from vnet import Node`."""

from vnet.node import Fix, Node, Packet

__all__ = ["Fix", "Node", "Packet"]
