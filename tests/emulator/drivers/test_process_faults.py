"""Faults of processes: what a vehicle's program meets, simulated and with a loop for each process alike."""

import asyncio
import gc
import random
from collections import Counter
from collections.abc import AsyncIterator, Callable
from typing import Any, cast

import pytest

from emulator.drivers.emulation import Emulation
from emulator.scenario.faults import KINDS, parse_fault
from emulator.scenario.scenario import Scenario
from tests.emulator.checks.test_faults import NEEDED
from tests.support.multi_loop_driver import emulation_of, fault, run_apart, run_forked, run_together, scenario_of
from vnet import Node
from vnet.radio import SentFrame
from vnet.reports import Report
from vnet.transport import wire

pytestmark = pytest.mark.slow

HERE = "tests.emulator.drivers.test_process_faults"
ORDERED = "tests.support.fault_programs:minds_the_order"
PERIOD_NS = 200_000_000
IDS = ["v01", "v02", "v03", "v04"]
Entry = tuple[int, int, str]
Run = Callable[[Scenario], Emulation]
diary: dict[str, list[Entry]] = {}
"""Record of the programs below, by node: when by the loop's clock, in which incarnation, and what."""


def note(node: Node, what: str) -> None:
    now_ns = round(asyncio.get_running_loop().time() * 1e9)
    diary.setdefault(node.id, []).append((now_ns, node.incarnation, what))


async def lives(node: Node) -> None:
    """Says something at each fix, and notes how it begins and ends."""
    note(node, f"begins {node.rng.random():.6f}")
    try:
        async for fix in node.gnss:
            note(node, f"fix {fix.time_ns}")
            await node.radio.broadcast(bytes([node.incarnation]))
            node.report(fix.position_m, incarnation=node.incarnation)
    finally:
        note(node, "ends")
        await node.radio.broadcast(b"last words")
        node.report(incarnation=-1)


async def waits_at_its_end(node: Node) -> None:
    """Waits in its `finally` block for longer than it is down, and writes down that it does."""
    try:
        await asyncio.Event().wait()
    finally:
        with (node.folder / f"log{node.incarnation}").open("w") as file:
            file.write("begins to end, ")
            try:
                for _ in range(40):
                    await asyncio.sleep(0.1)
                    note(node, "goes on")
            finally:
                file.write("ends")


async def abandons_generators(node: Node) -> None:
    """Leaves generators to the collector of garbage, whose end is an event, and keeps much else."""

    async def numbers() -> AsyncIterator[int]:
        try:
            yield 1
        finally:
            node.event("ends")

    kept: list[object] = []
    while True:
        await asyncio.sleep(0.07)
        generator: list[object] = [numbers()]
        await anext(cast(AsyncIterator[int], generator[0]))
        generator.append(generator)
        kept += [[] for _ in range(100)]


async def writes_when_it_ends(node: Node) -> None:
    """Has nothing more to do after a time of its own, but for a timer at the end; writes and says when it ends."""
    asyncio.get_running_loop().call_at(3.0, note, node, "is past the end")
    try:
        await asyncio.sleep(0.1 * int(node.id[1:]))
        await asyncio.Event().wait()
    finally:
        (node.folder / f"ended{node.incarnation}").write_text(str(node.now_ns / 1e9))
        node.event("ends")


async def tells_its_end(node: Node) -> None:
    """Waits for nothing, and says how it ends."""
    try:
        await asyncio.Event().wait()
    finally:
        node.event("ends")


async def clings_to_life(node: Node) -> None:
    """Ends only when nobody can hear it any more: catches what is to end it, and goes on."""
    while True:
        try:
            await asyncio.sleep(0.05)
        except asyncio.CancelledError:
            note(node, "not yet")
        await node.radio.broadcast(bytes([node.incarnation]))
        node.report(incarnation=node.incarnation)


async def cannot_be_cancelled(node: Node) -> None:
    """One vehicle waits again and again for something that was cancelled: a loop that has to run this hangs."""
    if node.id != "v02":
        await lives(node)
    never = asyncio.get_running_loop().create_future()
    await node.radio.broadcast(b"x")
    while True:
        try:
            await never
        except asyncio.CancelledError:
            note(node, "cancelled")


async def ends_early(node: Node) -> None:
    """The first vehicle's program returns, and the last one's crashes."""
    note(node, "begins")
    async for fix in node.gnss:
        await node.radio.broadcast(b"x")
        if fix.time_ns >= 2 * PERIOD_NS and node.id == "v01":
            return
        if fix.time_ns >= 2 * PERIOD_NS and node.id == "v04":
            raise RuntimeError("the battery is flat")


async def wakes_up(node: Node) -> None:
    """Each task notes what wakes it: packets, fixes, timers with and without a task."""

    async def hear() -> None:
        async for packet in node.radio:
            note(node, f"packet {packet.sender} {packet.received_ns}")

    async def locate() -> None:
        async for fix in node.gnss:
            note(node, f"fix {fix.time_ns}")
            await node.radio.broadcast(b"x")

    async def tick(name: str) -> None:
        while True:
            await asyncio.sleep(0.3)
            note(node, name)

    def strike() -> None:
        note(node, "strike")
        asyncio.get_running_loop().call_later(0.25, strike)

    asyncio.get_running_loop().call_later(0.25, strike)
    await asyncio.gather(tick("first"), tick("second"), locate(), hear())


def both(faults: list[dict[str, Any]], program: str, **sections: Any) -> tuple[Emulation, dict[str, list[Entry]]]:
    """Run simulated and apart, and see that both are the same; returns the simulation and what was noted in it."""
    scenario = scenario_of(faults, program if ":" in program else f"{HERE}:{program}", **sections)
    gc.collect()  # programs of earlier runs that were killed: their `finally` blocks run when they are cleared away
    diary.clear()
    together = run_together(scenario)
    noted = {node: list(entries) for node, entries in diary.items()}
    apart = run_apart(scenario)
    assert fingerprint(together) == fingerprint(apart)
    return together, noted


def fingerprint(emulation: Emulation) -> tuple[str, str, list[Any]]:
    events = [(e.time_ns, e.kind, e.node, e.details) for e in emulation.folder.events if e.kind != "started"]
    shown = [(t, k, n, {key: v for key, v in d.items() if key != "where"}) for t, k, n, d in events]
    return emulation.engine.trace.sha256(), emulation.metrics.sha256(), shown


def rows(emulation: Emulation) -> list[dict[str, Any]]:
    return emulation.engine.trace.to_table().to_pylist()


def sent_by(emulation: Emulation, node: str) -> list[int]:
    return sorted({row["sent_ns"] for row in rows(emulation) if row["sender"] == node})


def reports(emulation: Emulation, node: str) -> list[tuple[int, float]]:
    """(time of the period, reported incarnation) of a node, where it reported."""
    states = emulation.metrics.states_table().to_pylist()
    rows = [row for row in states if row["node"] == node and row["incarnation"] is not None]
    return [(row["time_ns"], row["incarnation"]) for row in rows]


def test_who_is_killed_is_silent_deaf_and_comes_back_as_another() -> None:
    emulation, noted = both([fault("kill", 1.1, 0.6, "v02")], "lives", radio={"loss": 0.0})
    assert sent_by(emulation, "v02") == [t for t in range(0, 15 * PERIOD_NS, PERIOD_NS) if not 1.1e9 <= t < 1.7e9]
    deaf = [row for row in rows(emulation) if row["outcome"] == "receiver_down"]
    assert {row["receiver"] for row in deaf} == {"v02"}
    assert all(1_100_000_000 <= row["arrival_ns"] < 1_700_000_000 for row in deaf)
    killed = [t for t, incarnation, what in noted["v02"] if what == "ends" and incarnation == 0]
    assert all(t >= 3e9 for t in killed), "it is gone at once, and discarded after the run"
    assert not any(row["size_bytes"] == len(b"last words") for row in rows(emulation))
    begun = {incarnation: (t, what) for t, incarnation, what in noted["v02"] if what.startswith("begins")}
    assert [begun[0][0], begun[1][0]] == [0, 1_700_000_000]
    assert begun[0][1] != begun[1][1], "another random stream"
    assert [int(w.split()[1]) for _, i, w in noted["v02"] if i == 1 and w.startswith("fix")][:2] == [
        1_800_000_000,
        2_000_000_000,
    ], "fixes only from then on"
    told = reports(emulation, "v02")
    assert [t for t, _ in told if 1_100_000_000 <= t < 1_800_000_000] == []
    assert {incarnation for t, incarnation in told if t > 1_700_000_000} == {1.0}
    assert {incarnation for t, incarnation in told if t < 1_100_000_000} == {0.0}
    events = [(e.time_ns, e.kind, e.node) for e in emulation.folder.events if e.kind in ("restarted", "died")]
    assert events == [(1_700_000_000, "restarted", "v02")]


def test_who_is_restarted_runs_its_finally_blocks_and_nobody_hears_them() -> None:
    emulation, noted = both([fault("restart", 1.1, 0.6, "v02")], "lives", radio={"loss": 0.0})
    ends = [(t, incarnation) for t, incarnation, what in noted["v02"] if what == "ends"]
    assert ends[0][1] == 0
    assert ends[0][0] >= 1_100_000_000
    assert not any(row["size_bytes"] == len(b"last words") for row in rows(emulation))
    assert all(incarnation >= 0 for _, incarnation in reports(emulation, "v02"))
    assert sent_by(emulation, "v02") == [t for t in range(0, 15 * PERIOD_NS, PERIOD_NS) if not 1.1e9 <= t < 1.7e9]


@pytest.mark.parametrize("run", [run_together, run_apart, run_forked])
def test_who_is_restarted_waits_for_nothing_more_and_keeps_what_it_has_written(run: Run) -> None:
    diary.clear()
    emulation = run(scenario_of([fault("restart", 1.1, 0.6, "v02")], f"{HERE}:waits_at_its_end"))
    assert diary == {}, "no time passes in processes that end"
    written = {file.name: file.read_text() for file in emulation.folder.disks.glob("v02/log*")}
    assert written == dict.fromkeys(["log0", "log1"], "begins to end, ends")


@pytest.mark.parametrize("order", ["fifo", "shuffle"])
def test_a_program_that_is_restarted_before_it_has_begun_is_in_no_deadlock(order: str) -> None:
    emulation, _ = both([fault("restart", 0.0, 0.5, "v02")], "lives", run={"order": order})
    assert [event.node for event in emulation.folder.events if event.kind == "exception"] == []


@pytest.mark.parametrize("run", [run_together, run_forked])
def test_nothing_is_collected_any_more_once_the_run_is_over(run: Run) -> None:
    scenario = scenario_of([], f"{HERE}:abandons_generators", run={"settle_s": 0.0})
    generators = Counter(event.time_ns for event in run(scenario).folder.events if event.kind == "event")
    assert generators.keys() == {1_000_000_000, 2_000_000_000}


@pytest.mark.parametrize("run", [run_together, run_apart, run_forked])
def test_a_process_ends_at_the_instant_that_ends_it_whenever_it_last_had_anything_to_do(run: Run) -> None:
    diary.clear()
    emulation = run(scenario_of([fault("restart", 1.1, 0.6, "v02")], f"{HERE}:writes_when_it_ends"))
    assert diary == {}, "what is due at the end is not done"
    files = {node: sorted(emulation.folder.disks.glob(f"{node}/*")) for node in IDS}
    written = {node: [float(file.read_text()) for file in some] for node, some in files.items()}
    assert written == {"v01": [3.0], "v02": [1.1, 3.0], "v03": [3.0], "v04": [3.0]}
    told = [(event.time_ns, event.node) for event in emulation.folder.events if event.kind == "event"]
    assert told == [(3_000_000_000, node) for node in IDS]


@pytest.mark.parametrize("run", [run_together, run_apart, run_forked])
def test_whoever_waits_for_nothing_ends_by_the_clock_that_it_has_by_then(run: Run) -> None:
    faults = [fault("skew", 1.5, 0.5, "v02", offset_ms=500), fault("skew", 2.4, 9, "v03", offset_ms=500)]
    scenario = scenario_of(faults, f"{HERE}:writes_when_it_ends", run={"settle_s": 0.0})
    written = {file.parent.name: float(file.read_text()) for file in run(scenario).folder.disks.glob("*/ended0")}
    assert written == {"v01": 3.0, "v02": 3.0, "v03": 3.5, "v04": 3.0}


@pytest.mark.parametrize("run", [run_together, run_apart, run_forked])
def test_whoever_is_paused_as_the_run_ends_ends_as_the_others_do(run: Run) -> None:
    faults = [fault("pause", 0.15, 9, "v02"), fault("pause", 2.9, 9, "v03")]
    scenario = scenario_of(faults, f"{HERE}:writes_when_it_ends", run={"settle_s": 0.0})
    assert [event.node for event in run(scenario).folder.events if event.kind == "event"] == IDS


@pytest.mark.parametrize("run", [run_together, run_apart, run_forked])
@pytest.mark.parametrize("kind", ["kill", "restart"])
def test_a_fault_after_which_nobody_has_anything_to_do_acts_all_the_same(run: Run, kind: str) -> None:
    scenario = scenario_of([fault(kind, 2.5, 9, "v01")], f"{HERE}:tells_its_end", run={"settle_s": 0.0})
    assert [event.node for event in run(scenario).folder.events if event.kind == "event"] == ["v02", "v03", "v04"]


@pytest.mark.parametrize("kind", ["kill", "restart"])
def test_at_an_instant_the_fault_comes_first(kind: str) -> None:
    """A fix of the very instant is neither heard by who is killed then nor missed by who comes back."""
    emulation, _ = both([fault(kind, 1.0, 0.6, "v02")], "lives", radio={"loss": 0.0})
    assert sent_by(emulation, "v02") == [t for t in range(0, 15 * PERIOD_NS, PERIOD_NS) if not 1.0e9 <= t < 1.6e9]


@pytest.mark.parametrize(
    ("kind", "nodes"),
    [("kill", IDS), ("restart", IDS), ("pause", IDS), ("kill", ["v02"]), ("restart", ["v01", "v03", "v04"])],
)
def test_a_fault_at_time_0_ends_at_its_instant_even_if_it_takes_all(kind: str, nodes: list[str]) -> None:
    emulation, noted = both([fault(kind, 0.0, 0.5, *nodes)], "lives")
    for node in IDS:
        begins = [t for t, _, what in noted[node] if what.startswith("begins")]
        assert begins == [500_000_000 if node in nodes else 0]
    assert all(emulation.up.values())


@pytest.mark.parametrize("kind", ["kill", "restart", "pause"])
def test_all_at_once_in_the_middle_come_back(kind: str) -> None:
    emulation, _ = both([fault(kind, 1.1, 0.6)], "lives")
    times = {row["sent_ns"] for row in rows(emulation)}
    assert not any(1_100_000_000 <= t < 1_700_000_000 for t in times)
    assert max(times) == 2_800_000_000
    assert all(emulation.up.values())
    assert emulation.faults.active(2_500_000_000) == []


def test_at_the_resume_come_packets_then_fixes_then_timers_each_in_order() -> None:
    _, noted = both([fault("pause", 0.5, 0.8, "v02")], "wakes_up", radio={"loss": 0.0, "access_jitter_ms": 0})
    before = [entry for entry in noted["v02"] if entry[0] < 500_000_000]
    assert not [entry for entry in noted["v02"] if 500_000_000 <= entry[0] < 1_300_000_000]
    woken = [what for t, _, what in noted["v02"] if t == 1_300_000_000]
    kinds = [what.split()[0] for what in woken]
    assert kinds == ["packet"] * 12 + ["fix"] * 4 + ["strike", "first", "second"]
    packets = [int(what.split()[2]) for what in woken[:12]]
    assert packets == sorted(packets)
    assert woken[12:16] == [f"fix {t}" for t in range(600_000_000, 1_300_000_000, PERIOD_NS)]
    later = [(t, what) for t, _, what in noted["v02"] if t > 1_300_000_000 and what in ("first", "strike")]
    assert later[:2] == [(1_550_000_000, "strike"), (1_600_000_000, "first")], "then each sleeps its time again"
    assert before[-1][2].startswith("packet")


def test_others_do_not_notice_but_for_the_silence() -> None:
    """In nothing that does not come from or go to the paused vehicle is there a difference."""

    def others(faults: list[dict[str, Any]]) -> list[Any]:
        emulation, _ = both(faults, "lives")
        return [row for row in rows(emulation) if "v02" not in (row["sender"], row["receiver"])]

    assert others([fault("pause", 0.5, 0.8, "v02")]) == others([]) == others([fault("kill", 0.5, 0.8, "v02")])


@pytest.mark.parametrize(
    ("faults", "silent"),
    [
        ([("kill", 0.7, 0.8), ("pause", 1.0, 1.0)], [(0.7, 2.0)]),
        ([("pause", 0.7, 0.8), ("kill", 1.0, 1.0)], [(0.7, 2.0)]),
        ([("pause", 0.7, 1.3), ("kill", 1.0, 0.2)], [(0.7, 2.0)]),
        ([("kill", 0.7, 1.3), ("pause", 1.0, 0.2)], [(0.7, 2.0)]),
        ([("kill", 0.7, 0.8), ("restart", 1.1, 0.9)], [(0.7, 2.0)]),
        ([("kill", 0.7, 0.4), ("kill", 1.1, 0.4)], [(0.7, 1.5)]),
        ([("kill", 0.7, 0.2), ("restart", 1.3, 0.2), ("kill", 1.9, 0.2)], [(0.7, 0.9), (1.3, 1.5), (1.9, 2.1)]),
        ([("pause", 0.7, 0.6), ("kill", 1.3, 0.4)], [(0.7, 1.7)]),
    ],
)
def test_overlapping_faults_of_one_vehicle_end_when_the_last_does(
    faults: list[tuple[str, float, float]], silent: list[tuple[float, float]]
) -> None:
    emulation, _ = both([fault(kind, at_s, d, "v02") for kind, at_s, d in faults], "lives")
    due = range(0, 15 * PERIOD_NS, PERIOD_NS)
    spoke = set(sent_by(emulation, "v02"))
    for start_s, end_s in silent:
        assert not any(start_s * 1e9 <= t < end_s * 1e9 for t in spoke), (start_s, end_s)
    quiet = [t for t in due if any(start_s * 1e9 <= t < end_s * 1e9 for start_s, end_s in silent)]
    assert [t for t in due if t not in spoke] == quiet
    downs = 3 if len(faults) == 3 else 1
    assert emulation.incarnation["v02"] == downs


@pytest.mark.parametrize("program", ["clings_to_life", "tests.support.fault_programs:does_not_give_up"])
@pytest.mark.parametrize("kind", ["kill", "restart"])
def test_a_program_that_goes_on_after_its_end_is_not_heard(kind: str, program: str) -> None:
    emulation, _ = both([fault(kind, 1.02, 0.5, "v02"), fault(kind, 2.02, 0.3, "v02")], program)
    for start_ns, end_ns in ((1_020_000_000, 1_520_000_000), (2_020_000_000, 2_320_000_000)):
        assert not any(start_ns <= t < end_ns for t in sent_by(emulation, "v02"))
    assert emulation.incarnation["v02"] == 2
    if program == "clings_to_life":
        assert reports(emulation, "v02")[-1][1] == 2.0
        assert len(sent_by(emulation, "v02")) < 55, "one of it speaks, not three"


def test_a_killed_program_is_not_even_cancelled() -> None:
    _, noted = both([fault("kill", 1.0, 0.5, "v02", "v03")], "clings_to_life")
    assert not any(what == "not yet" and t < 2_900_000_000 for t, _, what in noted.get("v02", []))


def test_a_program_that_waits_for_what_was_cancelled_does_not_hang_the_run_when_killed() -> None:
    """It stays killed to the end, at which whoever lives is cancelled."""
    faults = [fault("kill", 1.0, 100.0, "v02")]
    scenario = scenario_of(faults, f"{HERE}:cannot_be_cancelled", run={"settle_s": 0.0})
    emulation = run_together(scenario)
    assert sent_by(emulation, "v02") == [0]
    assert sent_by(emulation, "v01")[-1] == 2_800_000_000


@pytest.mark.parametrize("together", [1, 2, 4])
@pytest.mark.parametrize("kind", ["kill", "restart"])
def test_what_has_finished_or_crashed_is_not_started_anew_whoever_shares_its_process(
    kind: str, together: int
) -> None:
    """v01 is the lead of its process and has finished; v04 crashed, and is not the lead of its own."""
    emulation, noted = both([fault(kind, 1.0, 0.5)], "ends_early", run={"nodes_per_process": together})
    begun = {node: [incarnation for _, incarnation, what in noted[node] if what == "begins"] for node in IDS}
    assert begun == {"v01": [0], "v02": [0, 1], "v03": [0, 1], "v04": [0]}
    restarted = [event.node for event in emulation.folder.events if event.kind == "restarted"]
    assert restarted == ["v02", "v03"]
    assert [emulation.up[node] for node in IDS] == [False, True, True, False]


def test_reports_of_who_was_killed_at_that_instant_are_discarded_with_its_frames() -> None:
    emulation = emulation_of(scenario_of([fault("kill", 1.0, 1.0, "v02")], ORDERED))
    emulation.act(1_000_000_000)
    late = Report(999_999_999, "v02", (0.0, 0.0), None, {})
    emulation.take(1_000_000_000, [wire.Traffic([SentFrame("v02", b"x")], [late])])
    emulation.finish(3_000_000_000)
    assert len(emulation.engine.trace) == 0
    assert all(row["estimate_m"] is None for row in emulation.metrics.states_table().to_pylist())


def drawn(seed: int, kinds: list[str], together: int) -> list[dict[str, Any]]:
    """A schedule of faults drawn at random, many of them at the same instants."""
    rng = random.Random(seed)
    groups = [IDS[start : start + together] for start in range(0, 4, together)]
    faults = []
    for _ in range(rng.randint(2, 6)):
        kind = rng.choice(kinds)
        chosen = [node for group in rng.sample(groups, rng.randint(1, len(groups))) for node in group]
        more = dict(NEEDED.get(kind, {}))
        if kind == "skew":
            more["offset_ms"] = rng.choice([-1000, -130, 50, 500])
        if kind == "drift":
            more["rate_ppm"] = rng.choice([-500_000, 500_000, 1000, 333_333])
        who = chosen if "nodes" in type(parse_fault(fault(kind, 0, 1, **more))).model_fields else []
        at_s = rng.choice([0, 0.2, 0.4, 1, rng.uniform(0, 2.4)])
        faults.append(fault(kind, round(at_s, 3), rng.choice([0.2, 0.4, 1, 1.7]), *who, **more))
    return faults


@pytest.mark.parametrize(("seed", "together"), [(0, 1), (1, 2), (2, 2), (3, 1)])
def test_any_schedule_replays_whether_programs_share_a_loop_or_not(seed: int, together: int) -> None:
    kinds = [kind for kind in KINDS if not kind.endswith("r_restart")]
    if seed % 2:
        kinds = ["kill", "restart", "pause", "skew", "drift"]
    emulation, _ = both(drawn(seed, kinds, together), ORDERED, run={"nodes_per_process": together, "seed": seed})
    assert fingerprint(run_forked(emulation.scenario)) == fingerprint(emulation), "simulated in processes as well"
    assert all(emulation.up.values()), "at the end all is healed"
    assert not any(e.kind in ("died", "crashed", "spun") for e in emulation.folder.events)
    started = [e.details["fault"] for e in emulation.folder.events if e.kind == "fault_started"]
    ended = [e.details["fault"] for e in emulation.folder.events if e.kind == "fault_ended"]
    assert sorted(started) == sorted(ended)


def test_timers_of_one_instant_fire_in_the_order_in_which_they_were_set_however_many_share_the_loop() -> None:
    both([], ORDERED)
