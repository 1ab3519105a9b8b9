"""Two vehicles in SUMO's traffic, and a unit beside the road that tells them the state of the traffic lights.

The first vehicle brakes and warns, the second brakes when it hears that. Otherwise SUMO drives them.
"""

from vnet import Node

BRAKE_S, GO_S = 5.0, 9.0
"""Seconds at which the first vehicle begins to brake, and gives its speed back."""


async def main(node: Node) -> None:
    """Brake for a while, or when another warns."""
    async for fix in node.gnss:
        heard = [packet.payload.decode() for packet in node.radio.drain()]
        if node.id == "first":
            braking = BRAKE_S <= fix.time_ns / 1e9 < GO_S
            await node.radio.broadcast(b"braking" if braking else b"driving")
        else:
            braking = "braking" in heard
        if braking:
            node.drive(-3.0)  # whatever SUMO's driver would do
        else:
            node.drive(release=True)  # SUMO drives, as all others
        lights = [said for said in heard if said.startswith("light ")]
        if lights:
            node.report(light=lights[-1])


async def signal(node: Node) -> None:
    """Broadcast the state of the traffic lights."""
    async for fix in node.gnss:
        lights = fix.sensors["traffic_lights"]
        assert isinstance(lights, dict)
        await node.radio.broadcast(b"light " + lights["light"].encode())
