"""Messages of gateways to a run, in the place of agents, without Zenoh."""

import asyncio
import signal
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from emulator.drivers.launch import Exit
from emulator.drivers.live.gateway import Gateway
from emulator.drivers.live.gateways import Gateways
from emulator.drivers.live.supervisor import ChangeSignal
from emulator.scenario.scenario import Scenario
from tests.emulator.drivers.live.fakes import FakeLauncher, on_a_loop
from tests.support.multi_loop_driver import emulation_of
from vnet.gateway.frames import CrossingSample, CrossingTokens, Message, Reassembly
from vnet.gateway.radio_side import RadioSide
from vnet.runtime.error_text import write_report
from vnet.transport import wire
from vnet.transport.access import Access
from vnet.units import NS_PER_S

SAMPLE = CrossingSample("pose", b"here", "zenoh/bytes", False, None, "DATA", "DROP", False, None, None)
WELCOME = wire.Welcome("v01", b"1", 0, "realtime", "", {}, [], 1, 1, 1000, 1.0, 0, "")


class Rig:
    """Gateways without routers, and what they tell the run."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, vehicles: int, radio: dict[str, Any]) -> None:
        self.routers: dict[str, Gateway] = {}
        self.listened: list[str] = []
        self.noted: list[wire.Note] = []
        self.told: asyncio.Queue[tuple[str, str, Any]] = asyncio.Queue()
        monkeypatch.setattr(Gateway, "open", lambda gateway, listen: self._open_none(gateway, listen))
        scenario = Scenario.model_validate(
            {
                "run": {"pacing": "realtime"},
                "network": {"vehicles": vehicles},
                "radio": radio,
                "program": {"kind": "zenoh"},
            }
        )
        launcher: Any = FakeLauncher()
        emulation = emulation_of(scenario)
        self.emulation = emulation
        self.gateways = Gateways(emulation, launcher, False, lambda *_: None, self._tell, lambda: 0, ChangeSignal())
        self.gateways.start_agents("", Access.create("fake", []), [[node] for node in emulation.world.node_ids])

    def _open_none(self, gateway: Gateway, listen: str) -> str:
        self.routers[gateway.node_id] = gateway
        self.listened.append(listen)
        return "tcp/192.0.2.1:7000"

    def _tell(self, *item: Any) -> None:
        self.told.put_nowait(item)

    async def welcome(self, *nodes: str) -> None:
        """Have the run welcome these vehicles, once all have said hello."""
        while len(self.routers) < len(self.gateways.pids) or self.told.qsize() < len(self.routers):
            await asyncio.sleep(0)
        while not self.told.empty():
            assert isinstance(self.told.get_nowait()[2], wire.Hello)
        for node in nodes:
            self.gateways.send(node, WELCOME)

    def put(self, node: str, sample: CrossingSample, arrived_ns: int) -> None:
        """Have a program of a vehicle put a sample."""
        self.gateways.take("message", (self.routers[node], sample), arrived_ns)

    def notes(self) -> list[str]:
        """Return the lines of logs that were told with the messages since the last call."""
        notes, self.noted = self.noted, []
        return [each.text for each in notes]

    async def sent(self, count: int) -> list[tuple[list[Message | None], int]]:
        """Return the samples of the next messages with frames, and the instants of which they are."""
        found: list[tuple[list[Message | None], int]] = []
        while len(found) < count:
            what, _, item = await self.told.get()
            self.noted += item[0].traffic.notes if what == "frames" else []
            if what == "frames" and item[0].traffic.frames:
                reassembly = Reassembly()
                found.append(([reassembly.take("x", each.payload) for each in item[0].traffic.frames], item[1]))
        return found


@on_a_loop
async def test_frames_are_sent_as_of_the_instants_of_their_own_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither tokens, which are told past the radio here, nor an earlier sample of the vehicle makes one older."""
    rig = Rig(monkeypatch, 2, {"profile": "ros2", "ros2": {"graph": "always"}})
    await rig.welcome("v01")
    rig.gateways.send("v01", wire.Batch([], 0, origin_ns=0))
    assert (await rig.told.get())[0] == "frames", "it is on the air, and acknowledges"
    rig.gateways.take("token", (rig.routers["v01"], ("alive/v01", True)), 5)
    for arrived_ns in (8, 9):
        rig.put("v01", SAMPLE, arrived_ns)
    assert await rig.sent(2) == [([SAMPLE], 8), ([SAMPLE], 9)]
    await rig.gateways.close()


@on_a_loop
async def test_an_endpoint_is_there_again_at_its_port_and_at_all_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, 1, {})
    await rig.welcome("v01")
    await asyncio.to_thread(rig.gateways.detach("v01"), 1.0)
    rig.gateways.start_agents("", Access.create("fake", []), [["v01"]])
    while len(rig.listened) < 2:
        await asyncio.sleep(0)
    (vehicle,) = rig.gateways._vehicles.values()
    await rig.gateways._open_again(vehicle)
    assert rig.listened == ["tcp/127.0.0.1:0", "tcp/127.0.0.1:7000", "tcp/127.0.0.1:7000"]
    await rig.gateways.close()


@pytest.mark.parametrize("end", ["finished", "failed", "routers"])
def test_many_tokens_within_a_moment_are_two_messages(monkeypatch: pytest.MonkeyPatch, end: str) -> None:
    """Also if their program, or the router, ends within it."""
    monkeypatch.setattr("emulator.drivers.live.gateways.TOKENS_S", 0.0)

    async def test() -> None:
        rig = Rig(monkeypatch, 1, {})
        monkeypatch.setattr(Gateway, "_is_alive", lambda gateway, key: True)
        await rig.welcome("v01")
        rig.gateways.send("v01", wire.Batch([], 0, origin_ns=0))
        assert (await rig.told.get())[0] == "frames", "it is on the air, and acknowledges"
        router: Any = rig.routers["v01"]
        router._session = SimpleNamespace(close=lambda: None)
        (vehicle,) = rig.gateways._vehicles.values()
        vehicle.is_ready, vehicle.commands = True, {"v01": "talk"}
        for key in "abc":
            rig.gateways.take("token", (router, (key, True)), 5)
        assert await rig.sent(1) == [([CrossingTokens(("a",))], 5)]
        if end == "routers":
            vehicle.commands = {}
            rig.gateways.restart_endpoints(60.0)
        else:
            assert rig.gateways.takes_end("v01", Exit(int(end == "failed"), ""))
        assert [told for told, _ in await rig.sent(1)] == [[CrossingTokens(("a", "b", "c"))]]
        for _ in range(10):
            await asyncio.sleep(0)
        while not rig.told.empty():
            what, _, item = rig.told.get_nowait()
            assert what != "frames" or not item[0].traffic.frames
        await rig.gateways.close()

    asyncio.run(test())


@on_a_loop
async def test_what_programs_put_before_the_start_goes_out_in_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that puts more before its turn sends both, in their order, and the latest sample of each key alone."""
    monkeypatch.setattr("emulator.drivers.live.gateways.TURNS_S", 1e6)
    rig = Rig(monkeypatch, 3, {})
    await rig.welcome("v01", "v02", "v03")
    lane, newer = replace(SAMPLE, key="lane"), replace(SAMPLE, payload=b"there")
    for node in ("v01", "v02", "v03"):
        rig.put(node, SAMPLE, 1)
        rig.put(node, lane, 2)
        rig.gateways.send(node, wire.Batch([], 0, origin_ns=0))
    ((first, _),) = await rig.sent(1)
    assert first == [SAMPLE, lane], "v01 has the first turn"
    rig.put("v02", newer, 7)
    assert await rig.sent(1) == [([lane, newer], 7)]
    assert rig.notes() == ["1 sample of before the start not sent: later ones of their keys are"]
    assert rig.told.empty(), "the turn of v03 is far away"
    await rig.gateways.close()


@on_a_loop
async def test_a_vehicle_that_ends_before_its_turn_sends_what_it_has_put(monkeypatch: pytest.MonkeyPatch) -> None:
    """Or it is counted, if a fault has ended the vehicle: no sample is lost without a word."""
    monkeypatch.setattr("emulator.drivers.live.gateways.TURNS_S", 1e6)
    rig = Rig(monkeypatch, 3, {})
    await rig.welcome("v01", "v02", "v03")
    for node in ("v02", "v03"):
        rig.put(node, SAMPLE, 1)
    for node in ("v02", "v03", "v01"):
        rig.gateways.send(node, wire.Batch([], 0, origin_ns=0))
    assert (await rig.told.get())[1] == "v01", "its turn is at once, and it is the last to begin"
    rig.gateways.detach("v02")
    assert [samples for samples, _ in await rig.sent(1)] == [[SAMPLE]]
    rig.emulation.up["v03"] = False
    rig.gateways.kill("v03")
    _, node, (frames, _) = await rig.told.get()
    assert (node, list(frames.traffic.frames)) == ("v03", [])
    assert [each.text for each in frames.traffic.notes] == ["1 frame not sent: the vehicle has ended"]
    await rig.gateways.close()


@on_a_loop
async def test_a_command_that_fails_between_batch_0_and_the_start_has_crashed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig(monkeypatch, 1, {})
    await rig.welcome("v01")
    vehicle = rig.gateways._vehicles["v01"]
    vehicle.commands["v01"] = "python drive.py"
    write_report(str(rig.gateways._failure_path(vehicle, "v01")), KeyError("calibration"), None, "drive.py:9")
    rig.gateways.send("v01", wire.Batch([], 0, origin_ns=0))
    assert rig.gateways.takes_end("v01", Exit(1, "")) and not vehicle.on_air
    what, node, item = await rig.told.get()
    assert (what, node) == ("frames", "v01")
    (ending,) = item[0].traffic.endings
    assert (ending.kind, ending.error, ending.place) == ("crashed", "KeyError: 'calibration'", "drive.py:9")
    await rig.gateways.close()


@on_a_loop
async def test_tokens_are_not_forgotten_by_a_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames that tell of them are held back meanwhile."""
    rig, now_ns = Rig(monkeypatch, 2, {}), [0]
    told: list[bool] = []
    monkeypatch.setattr(rig.gateways, "_now_ns", lambda: now_ns[0])
    await rig.welcome("v01")
    gateway, vehicle = rig.routers["v01"], rig.gateways._vehicles["v01"]
    monkeypatch.setattr(gateway, "_show_token", lambda key, is_there: told.append(is_there))
    RadioSide.hear_tokens(gateway, "v02", CrossingTokens(("alive/v02",)), 0)
    for number, seconds in (signal.SIGSTOP, 10), (signal.SIGCONT, 12):
        rig.gateways.signal("v01", number)
        now_ns[0] = seconds * NS_PER_S
        rig.gateways._renew_tokens(vehicle)
    assert told == [True]
    now_ns[0] = 16 * NS_PER_S
    rig.gateways._renew_tokens(vehicle)
    assert told == [True, False]
    await rig.gateways.close()


@on_a_loop
async def test_a_number_that_a_fault_has_changed_hides_no_later_word_of_tokens(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig, told = Rig(monkeypatch, 2, {}), list[tuple[str, bool]]()
    await rig.welcome("v01")
    gateway = rig.routers["v01"]
    monkeypatch.setattr(gateway, "_show_token", lambda key, is_there: told.append((key, is_there)))
    for time_s, number, keys in ((0, 2**40, ("a",)), (0.1, 5, ("b",)), (1.0, 6, ("c",))):
        RadioSide.hear_tokens(gateway, "v02", CrossingTokens(keys), round(time_s * NS_PER_S), number)
    assert told == [("a", True), ("a", False), ("c", True)]
    await rig.gateways.close()


@on_a_loop
async def test_routers_are_there_again_once_all_restarts_that_overlap_are_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A vehicle whose program is just starting keeps its router: who connects for the first time does not wait."""
    rig, sleeps = Rig(monkeypatch, 2, {}), list[asyncio.Future[None]]()
    opened, closed, now_s = list[str](), list[str](), [0.0]
    await rig.welcome("v01", "v02")
    rig.gateways._vehicles["v01"].is_ready = True

    async def close(gateway: Gateway) -> None:
        closed.append(gateway.node_id)

    def sleep(seconds: float) -> asyncio.Future[None]:
        sleeps.append(asyncio.get_running_loop().create_future())
        return sleeps[-1]

    with monkeypatch.context() as patched:
        patched.setattr(Gateway, "close", close)
        patched.setattr(Gateway, "open", lambda gateway, listen: opened.append(gateway.node_id))
        patched.setattr("emulator.drivers.live.gateways.asyncio.sleep", sleep)
        patched.setattr(rig.gateways, "_loop", SimpleNamespace(time=lambda: now_s[0]))
        tasks = [asyncio.ensure_future(rig.gateways._restart_endpoints(down_s)) for down_s in (1000.0, 10.0)]
        while len(sleeps) < 2:
            await asyncio.wait(tasks, timeout=0)
        now_s[0] = 10.0
        sleeps[1].set_result(None)
        while len(sleeps) < 3:
            await asyncio.wait(tasks, timeout=0)
        assert opened == [] and closed == ["v01", "v01"]
        now_s[0] = 1000.0
        for each in (sleeps[0], sleeps[2]):
            each.set_result(None)
        await asyncio.gather(*tasks)
        assert opened == ["v01"]
    await rig.gateways.close()
