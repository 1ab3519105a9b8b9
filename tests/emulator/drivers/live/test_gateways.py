"""Messages of gateways to a run, in the place of agents, without Zenoh."""

import asyncio
from typing import Any

import pytest

from emulator.drivers.live.gateway import Gateway
from emulator.drivers.live.gateways import Gateways
from emulator.drivers.live.supervisor import ChangeSignal
from emulator.scenario.scenario import Scenario
from tests.emulator.drivers.live.fakes import FakeLauncher, on_a_loop
from tests.support.multi_loop_driver import emulation_of
from vnet.gateway.frames import CrossingSample
from vnet.transport import wire
from vnet.transport.access import Access

SAMPLE = CrossingSample("pose", b"here", "zenoh/bytes", False, None, "DATA", "DROP", False, None, None)
WELCOME = wire.Welcome("v01", b"1", 0, "realtime", "", {}, [], 1, 1, 1000, 1.0, 0, "")


@on_a_loop
async def test_frames_are_sent_as_of_the_instants_of_their_own_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither tokens, which are told past the radio here, nor an earlier sample of the vehicle makes one older."""
    routers: dict[str, Gateway] = {}
    told: asyncio.Queue[tuple[str, str, Any]] = asyncio.Queue()

    def open_none(gateway: Gateway, listen: str) -> str:
        routers[gateway.node] = gateway
        return listen

    def tell(*item: Any) -> None:
        told.put_nowait(item)

    monkeypatch.setattr(Gateway, "open", open_none)
    scenario = Scenario.model_validate(
        {
            "run": {"pacing": "realtime"},
            "network": {"vehicles": 2},
            "radio": {"profile": "ros2", "ros2": {"graph": "always"}},
            "program": {"kind": "zenoh"},
        }
    )
    launcher: Any = FakeLauncher()
    gateways = Gateways(emulation_of(scenario), launcher, False, lambda *_: None, tell, lambda: 0, ChangeSignal())
    gateways.start_agents("", Access.create("fake", []), [["v01"], ["v02"]])
    for _ in range(2):
        assert isinstance((await told.get())[2], wire.Hello)
    gateways.send("v01", WELCOME)
    gateways.send("v01", wire.Batch([], 0, origin_ns=0))
    assert (await told.get())[0] == "frames", "it is on the air, and acknowledges"
    router = routers["v01"]
    gateways.take("token", (router, ("alive/v01", True)), 5)
    for arrived_ns in (8, 9):
        gateways.take("message", (router, SAMPLE), arrived_ns)
    sent = [(await told.get())[2] for _ in range(2)]
    assert [(len(frames.traffic.frames), arrived_ns) for frames, arrived_ns in sent] == [(1, 8), (1, 9)]
    await gateways.close()
