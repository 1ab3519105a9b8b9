"""The drivers of both pacings, against processes that only answer."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest
from msgspec.structs import replace

from emulator.drivers.lockstep import Lockstep, run_in_lockstep
from emulator.drivers.processes import Stalled
from emulator.drivers.realtime import RealTime, run_in_real_time
from emulator.records.events import Event
from tests.emulator.drivers.live.fakes import IDS, Stage, hello, in_virtual_time
from tests.support.multi_loop_driver import fault
from vnet.radio import SentFrame
from vnet.transport import wire
from vnet.transport.wire import MessageRef, Sent, SentMessage

MS = 1_000_000
RUN = {"duration_s": 0.6, "settle_s": 0.1, "stall_timeout_s": 1.0, "join_timeout_s": 1.0}
Answer = Callable[[str, Any], wire.AgentMessage | None]


class Play:
    """A pacing on a stage. What processes say to a message, by `answer`, comes as from Zenoh's threads."""

    def __init__(self, pacing: str, answer: Answer, **stage: Any) -> None:
        stage["run"] = {**RUN, **stage.get("run", {})}
        self.stage = Stage(pacing=pacing, **stage)
        self.stage.join(begin=False)
        self.live, self.emulation = self.stage.live, self.stage.emulation
        groups = self.stage.members.processes()
        kind = Lockstep if pacing == "lockstep" else RealTime
        self.pacing = kind(self.emulation, groups)
        self.live.begin(groups, lambda: max(self.pacing.now_ns, 0))
        self.answer = answer
        self.stage.attachment.on_send = self.respond

    async def run(self) -> None:
        if isinstance(self.pacing, Lockstep):
            await run_in_lockstep(self.pacing, self.live)
        else:
            await run_in_real_time(self.pacing, self.live)

    async def finish(self, deadline_s: float) -> None:
        assert isinstance(self.pacing, RealTime)
        await self.live.finish_real_time(self.pacing, deadline_s)

    def respond(self, node: str, message: wire.EmulatorMessage) -> None:
        said = self.answer(node, message)
        if said is not None:
            self.hear("message", node, wire.encode(said))

    def hear(self, what: str, name: str, payload: bytes) -> None:
        self.live.hear(what, name, payload)

    async def stalls(self) -> list[Event]:
        """The events of a run that ends because processes have stalled."""
        with pytest.raises(Stalled):
            await self.run()
        return [event for event in self.stage.emulation.folder.events if event.kind == "stalled"]

    def hear_last_words(self, node: str, **traffic: Any) -> None:
        seq = sum(1 for each, _ in self.sent(wire.Batch) if each == node)
        last = wire.Frames(b"1", seq, seq, [], wire.Traffic(**traffic), final=True)
        self.hear("message", node, wire.encode(last))

    def sent(self, kind: type) -> list[tuple[str, Any]]:
        return [(node, message) for node, message in self.stage.attachment.sent if isinstance(message, kind)]


def yields(node: str, message: Any, nonce: bytes = b"1") -> wire.AgentMessage | None:
    """A process in lockstep with a timer every 100 ms."""
    if isinstance(message, wire.StackRequest):
        return wire.StackDump(nonce, f"{node} is here")
    if not isinstance(message, wire.Grant):
        return None
    frames = [SentFrame(node, b"x")] if node == "v01" else []
    steps = [wire.Step(message.time_ns, wire.Traffic(frames))]
    return wire.Yield(nonce, message.seq, message.time_ns + 100 * MS, (), (), steps, 1)


@in_virtual_time
async def test_lockstep_runs_to_the_end_grant_by_grant() -> None:
    play = Play("lockstep", yields)
    await play.run()
    grants = play.sent(wire.Grant)
    assert [node for node, _ in grants] == IDS * 6
    assert [grant.time_ns for node, grant in grants if node == "v02"] == [n * 100 * MS for n in range(6)]
    assert len(play.stage.emulation.metrics.rows) == 3
    assert len(play.stage.emulation.engine.trace) == 6 * 3
    assert play.pacing.now_ns == 500 * MS


@in_virtual_time
async def test_in_lockstep_a_death_is_told_at_the_barrier_that_the_process_does_not_answer() -> None:
    def answer(node: str, message: Any) -> wire.AgentMessage | None:
        if node == "v02" and isinstance(message, wire.Grant) and message.time_ns == 200 * MS:
            play.stage.launcher.dies(play.stage.supervisor, "v02")
            return None
        return yields(node, message)

    play = Play("lockstep", answer)
    await play.run()
    (died,) = [event for event in play.stage.emulation.folder.events if event.kind == "died"]
    assert (died.node, died.time_ns, died.details["how"]) == ("v02", 200 * MS, "SIGSEGV")
    assert [node for node, _ in play.sent(wire.Grant)].count("v01") == 6


@in_virtual_time
async def test_in_lockstep_a_yield_after_the_death_of_its_process_is_refused() -> None:
    def answer(node: str, message: Any) -> wire.AgentMessage | None:
        if node == "v02" and isinstance(message, wire.Grant) and message.time_ns == 200 * MS:
            play.stage.launcher.dies(play.stage.supervisor, "v02")
        return yields(node, message)

    play = Play("lockstep", answer)
    await play.run()
    assert play.stage.events("died", "refused", "stalled") == [("refused", "v02"), ("died", "v02")]
    assert [node for node, _ in play.sent(wire.Grant)].count("v04") == 6


@in_virtual_time
async def test_in_lockstep_a_killed_process_is_awaited_before_time_goes_on() -> None:
    returning: list[str] = []

    def answer(node: str, message: Any) -> wire.AgentMessage | None:
        return yields(node, message, b"2" if node == "v02" and returning else b"1")

    play = Play("lockstep", answer, faults=[fault("kill", 0.15, 0.2, "v02")])
    start = play.stage.launcher.start_agents

    def start_and_join(*arguments: Any, **more: Any) -> None:
        start(*arguments, **more)
        returning.append("v02")
        play.stage.members.hello("v02", hello("v02", nonce=b"2"))

    play.stage.launcher.start_agents = start_and_join  # type: ignore[method-assign]
    await play.run()
    times = [(grant.seq, grant.time_ns // MS) for node, grant in play.sent(wire.Grant) if node == "v02"]
    assert times == [(0, 0), (1, 100), (0, 350), (1, 450), (2, 550)]
    assert play.stage.launcher.done == [("kill", "v02"), ("start", "v02")]


@in_virtual_time
async def test_in_lockstep_a_process_that_does_not_come_back_ends_the_run() -> None:
    play = Play("lockstep", yields, faults=[fault("restart", 0.15, 0.2, "v02")])
    (stalled,) = await play.stalls()
    assert (stalled.node, stalled.details["error"]) == ("v02", "has not come back within 1 s")
    assert play.sent(wire.End) == [("v02", wire.End(None, "restarted by a fault", time_ns=150_000_000))]


@in_virtual_time
async def test_in_lockstep_a_process_that_does_not_yield_ends_the_run_with_its_stack() -> None:
    def answer(node: str, message: Any) -> wire.AgentMessage | None:
        stuck = isinstance(message, wire.Grant) and message.time_ns == 200 * MS
        return None if stuck and node in ("v02", "v03") else yields(node, message)

    play = Play("lockstep", answer)
    where = [(event.node, event.details["where"]) for event in await play.stalls()]
    assert where == [("v02", "v02 is here"), ("v03", "v03 is here")]
    assert play.stage.launcher.done == [("stack", "v02"), ("stack", "v03")]


@in_virtual_time
async def test_in_lockstep_a_refused_yield_is_told_with_its_reason() -> None:
    def answer(node: str, message: Any) -> wire.AgentMessage | None:
        said = yields(node, message)
        if isinstance(said, wire.Yield) and message.time_ns == 200 * MS and node == "v02":
            return replace(said, seq=said.seq + 7)
        return said

    play = Play("lockstep", answer)
    (stalled,) = await play.stalls()
    (refused,) = [event for event in play.stage.emulation.folder.events if event.kind == "refused"]
    assert stalled.node == refused.node == "v02"
    assert stalled.details["refused"] == refused.details["reason"]


@in_virtual_time
async def test_in_lockstep_a_process_whose_instants_go_on_has_not_stalled() -> None:
    asked: list[int] = []
    owed: list[wire.Yield] = []

    def answer(node: str, message: Any) -> wire.AgentMessage | None:
        if isinstance(message, wire.Grant) and message.time_ns == 200 * MS and node == "v02":
            owed.append(yields(node, message))  # type: ignore[arg-type]
            return None
        if isinstance(message, wire.StackRequest):
            asked.append(len(asked))
            if len(asked) == 3:
                play.hear("message", node, wire.encode(owed[0]))
            return wire.StackDump(b"1", "busy", 200 * MS + len(asked))
        return yields(node, message)

    play = Play("lockstep", answer)
    await play.run()
    assert len(asked) == 3, "asked each time that nothing has come for run.stall_timeout_s"
    assert play.stage.events("stalled") == []
    assert play.pacing.now_ns == 500 * MS


@in_virtual_time
async def test_in_lockstep_a_process_that_stays_at_its_instant_has_stalled() -> None:
    asked: list[str] = []

    def answer(node: str, message: Any) -> wire.AgentMessage | None:
        if isinstance(message, wire.StackRequest):
            asked.append(node)
            return wire.StackDump(b"1", "stuck", 201 * MS)
        stuck = isinstance(message, wire.Grant) and message.time_ns == 200 * MS and node == "v02"
        return None if stuck else yields(node, message)

    play = Play("lockstep", answer)
    assert [event.node for event in await play.stalls()] == ["v02"]
    assert asked == ["v02", "v02"], "once more, as it had come from 200 ms to 201 ms"


@in_virtual_time
async def test_in_lockstep_only_those_have_stalled_whose_yields_their_host_does_not_keep() -> None:
    kept: dict[str, bytes] = {}

    def answer(node: str, message: Any) -> wire.AgentMessage | None:
        if isinstance(message, wire.Grant) and message.time_ns == 200 * MS and node in ("v02", "v03"):
            kept[node] = wire.encode(yields(node, message))  # type: ignore[arg-type]
            return None
        if isinstance(message, wire.StackRequest):
            if node == "v03":
                play.hear("message", node, kept[node])
            return wire.StackDump(b"1", "here", 200 * MS)
        return yields(node, message)

    play = Play("lockstep", answer)
    assert [event.node for event in await play.stalls()] == ["v02"]


@in_virtual_time
async def test_a_run_that_is_interrupted_in_a_restart_of_the_emulator_can_tell_its_end() -> None:
    play = Play("lockstep", yields, faults=[fault("emulator_restart", 0.2, 0.1, down_s=60.0)])
    running = asyncio.ensure_future(play.run())
    asyncio.get_running_loop().call_later(30.0, running.cancel)
    await asyncio.wait([running])
    assert running.cancelled() and play.stage.attachment.done == ["close", "open"]
    assert play.stage.events("emulator_restarted") == [("emulator_restarted", None)], "the silence was planned"


@in_virtual_time
async def test_a_restart_of_the_emulator_is_announced_and_ends_when_all_have_answered() -> None:
    asked: list[str] = []

    def answer(node: str, message: Any) -> wire.AgentMessage | None:
        if isinstance(message, wire.StackRequest):
            asked.append(node)
            if asked.count(node) == 1 and node == "v03":
                return None  # not connected yet
        return yields(node, message)

    play = Play("lockstep", answer, faults=[fault("emulator_restart", 0.2, 0.1, down_s=0.01)])
    await play.run()
    assert [node for node, _ in play.sent(wire.Await)] == IDS
    assert play.stage.attachment.done == ["close", "open"]
    assert asked.count("v03") == 2
    assert play.stage.events("emulator_restarted") == [("emulator_restarted", None)]
    assert not play.stage.supervisor.reconnecting


@in_virtual_time
async def test_a_message_of_the_other_pacing_is_refused() -> None:
    play = Play("lockstep", yields)
    play.hear("message", "v01", wire.encode(wire.Frames(b"1", 0, 0, [], wire.Traffic())))
    await play.run()
    assert play.stage.events("refused") == [("refused", "v01")]


UNITS: dict[str, Any] = {
    "network": {"vehicles": 2},
    "roadside": [{"id": node, "position_m": [0.0, 0.0]} for node in ("v03", "v04")],
}


def outcomes(play: Play) -> list[tuple[int, str, str]]:
    play.stage.emulation.backbone.decide(10**12)
    table = play.stage.emulation.backbone.table()
    assert table is not None
    return [(row["sent_ns"], row["sender"], row["outcome"]) for row in table.to_pylist()]


@pytest.mark.parametrize("first", ["message", "yield"])
@in_virtual_time
async def test_a_yield_waits_for_the_messages_of_the_backbone_to_which_it_refers(first: str) -> None:
    def answer(node: str, message: Any) -> wire.AgentMessage | None:
        if node != "v03" or not isinstance(message, wire.Grant):
            return yields(node, message)
        sent = SentMessage("v03", message.seq, None, b"x")
        step = wire.Step(message.time_ns, wire.Traffic(messages=[sent]))
        whole = wire.Yield(b"1", message.seq, message.time_ns + 100 * MS, (), (), [step], 1)
        said, contents = wire.split_yield(whole)
        puts: list[tuple[str, str, bytes]]
        puts = [("message", "v03", wire.encode(said))]
        puts += [("backbone", unit, wire.encode(each)) for unit, each in contents]
        for put in reversed(puts) if first == "message" else puts:
            play.hear(*put)
        return None

    play = Play("lockstep", answer, **UNITS)
    await play.run()
    assert outcomes(play) == [(time_ns, "v03", "delivered") for time_ns in range(0, 600 * MS, 100 * MS)]
    assert play.stage.events("stalled", "refused") == []


@pytest.mark.parametrize(
    ("unit", "nonce", "refused"),
    [
        ("v04", b"1", "the process of v03 speaks for v04"),
        ("v03", b"2", "a message without the nonce"),
        ("", b"", ""),
    ],
)
@in_virtual_time
async def test_a_message_of_the_backbone_that_never_comes_is_named(unit: str, nonce: bytes, refused: str) -> None:
    """It was lost, or it came on the key of another unit, or from another process."""

    def answer(node: str, message: Any) -> wire.AgentMessage | None:
        if node != "v03" or not isinstance(message, wire.Grant):
            return yields(node, message)
        if unit:
            play.hear("backbone", unit, wire.encode(Sent(nonce, 7, None, b"x")))
        if unit == "v04":
            other = wire.Step(message.time_ns, wire.Traffic(messages=[MessageRef(unit, 7)]))
            play.hear("message", "v03", wire.encode(wire.Yield(b"1", message.seq, None, (), (), [other], 1)))
        step = wire.Step(message.time_ns, wire.Traffic(messages=[MessageRef("v03", 7)]))
        return wire.Yield(b"1", message.seq, None, (), (), [step], 1)

    play = Play("lockstep", answer, **UNITS)
    (stalled,) = await play.stalls()
    expected = "yield 0 without 1 message of v03 on the backbone, to which it refers, within 1 s"
    assert stalled.node == "v03" and stalled.details["error"].startswith(expected)
    reasons = [e.details["reason"] for e in play.stage.emulation.folder.events if e.kind == "refused"]
    assert [reason.startswith(refused) for reason in reasons] == [True] * bool(refused)


# Real time, on a clock that only the test moves.


def frames(node: str, message: Any) -> wire.AgentMessage | None:
    """A process in real time that acknowledges every batch, and sends a final message when it is told to end."""
    if isinstance(message, wire.Batch):
        sent = [SentFrame(node, b"x")] if message.fixes else []
        return wire.Frames(b"1", message.seq, message.seq + 1, [], wire.Traffic(sent))
    return None


@in_virtual_time
async def test_real_time_sends_what_is_due_to_its_end() -> None:
    play = Play("realtime", frames)
    await play.run()
    batches = play.sent(wire.Batch)
    for node in IDS:
        seqs = [batch.seq for each, batch in batches if each == node]
        assert seqs == list(range(len(seqs)))
        fixes = [fix.time_ns for each, batch in batches if each == node for fix in batch.fixes]
        assert fixes == [0, 200 * MS, 400 * MS]
    assert play.pacing.now_ns >= play.stage.emulation.duration_ns
    assert play.stage.events("died", "stalled", "refused") == []


@pytest.mark.parametrize(("said", "gaps"), [(2, 0), (1, 1), (None, 0)])
@in_virtual_time
async def test_in_real_time_the_answer_to_a_restart_tells_what_that_has_lost(said: int | None, gaps: int) -> None:
    """Two messages of v03 have not come when one does, long after the restart."""

    def answer(node: str, message: Any) -> wire.AgentMessage | None:
        if isinstance(message, wire.StackRequest):
            return wire.StackDump(b"1", "", seq=said if node == "v03" else 0)
        if node != "v03":
            return None
        is_late = isinstance(message, wire.Batch) and [fix.time_ns for fix in message.fixes] == [1000 * MS]
        return wire.Frames(b"1", 2, 1, [], wire.Traffic()) if is_late else None

    run = {"duration_s": 1.2, "settle_s": 0.1}
    play = Play("realtime", answer, run=run, faults=[fault("emulator_restart", 0.1, 0.1, down_s=0.01)])
    await play.run()
    assert play.stage.events("emulator_restarted", "refused") == [("emulator_restarted", None)]
    assert isinstance(play.pacing, RealTime) and play.pacing.gaps == gaps


@in_virtual_time
async def test_in_real_time_a_death_is_told_at_once_and_nobody_waits_for_last_words_of_the_dead() -> None:
    def answer(node: str, message: Any) -> wire.AgentMessage | None:
        if node == "v02" and isinstance(message, wire.Batch) and message.seq == 1:
            play.stage.launcher.dies(play.stage.supervisor, "v02")
        return frames(node, message)

    play = Play("realtime", answer)
    await play.run()
    assert play.stage.events("died") == [("died", "v02")]
    assert not play.stage.emulation.up["v02"]
    for node in ("v01", "v03", "v04"):
        play.hear_last_words(node)
    before_ns = play.pacing.now_ns
    await play.finish(3600.0)
    assert play.pacing.now_ns == before_ns


@in_virtual_time
async def test_in_real_time_a_process_that_says_no_last_words_is_waited_for_until_the_deadline() -> None:
    play = Play("realtime", frames)
    await play.run()
    before_ns = play.pacing.now_ns
    await play.finish((before_ns + wire.HEAD_START_NS) / 1e9 + 1.0)
    assert play.pacing.now_ns - before_ns == 1000 * MS


@in_virtual_time
async def test_in_real_time_processes_that_end_when_they_are_told_to_have_not_died() -> None:
    play = Play("realtime", frames)
    await play.run()
    supervisor, loop = play.stage.supervisor, asyncio.get_running_loop()
    supervisor.all_told_to_end()
    for node in IDS[:2]:
        play.hear_last_words(node)
        play.stage.launcher.ends_as_told(supervisor, node)
    play.stage.launcher.ends_as_told(supervisor, "v03")  # without a last message
    loop.call_later(2.0, play.hear_last_words, "v04")
    before_ns = play.pacing.now_ns
    await play.finish((before_ns + wire.HEAD_START_NS) / 1e9 + 5.0)
    assert play.stage.events("died") == []
    assert play.pacing.now_ns - before_ns == 2000 * MS, "it waits for v04, and for nobody else"


@in_virtual_time
async def test_in_real_time_a_message_of_the_backbone_comes_after_its_frames_or_is_a_gap() -> None:
    def answer(node: str, message: Any) -> wire.AgentMessage | None:
        said = frames(node, message)
        if node != "v03" or not isinstance(said, wire.Frames):
            return said
        refs = [MessageRef("v03", said.seq), MessageRef("v03", 1000)] if said.seq < 2 else []
        play.hear("message", "v03", wire.encode(replace(said, traffic=wire.Traffic(messages=refs))))
        if said.seq < 2:
            play.hear("backbone", "v03", wire.encode(Sent(b"1", said.seq, "v04", b"x")))
        return None

    play = Play("realtime", answer, **UNITS)
    await play.run()
    await play.finish(0.0)
    assert [outcome for _, _, outcome in outcomes(play)] == ["delivered"] * 2
    (gap,) = [event for event in play.stage.emulation.folder.events if event.kind == "transport_gap"]
    assert gap.details["count"] == 1


@pytest.mark.parametrize("ended", [False, True])
@in_virtual_time
async def test_in_real_time_a_message_of_the_backbone_may_come_after_the_last_frames(ended: bool) -> None:
    """If it was sent when the run was over, nobody misses it."""
    play = Play("realtime", frames, **UNITS)
    if ended:
        await play.run()
    for node in IDS:
        play.hear_last_words(node, messages=[MessageRef(node, 0)] if node == "v03" else [])
    if not ended:
        content = wire.encode(Sent(b"1", 0, None, b"x"))
        asyncio.get_running_loop().call_later(0.1, play.hear, "backbone", "v03", content)
    await play.finish(3600.0)
    assert play.stage.events("transport_gap", "refused") == []
