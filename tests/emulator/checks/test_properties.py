"""Properties over time: always, never, eventually, leads to, over reported values, events and truth."""

import asyncio
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pytest

from emulator.api import simulate
from emulator.checks.properties import Moment, always, eventually, leads_to, moments, never
from emulator.records.events import Event, EventKind
from emulator.records.parting import RECEPTION
from emulator.records.run import Run
from emulator.testing.harness import RunHarness
from emulator.testing.scenarios import make_scenario
from tests.support.recorded import recorded
from vnet import Node
from vnet.errors import VnetError


async def brakes(node: Node) -> None:
    """v01 brakes at 0.5 s and says so; who hears it shows a warning after 0.1 s, but v03 only after 0.4 s."""
    heard_s: float | None = None
    async for fix in node.gnss:
        now_s = fix.time_ns / 1e9
        if node.id == "v01" and now_s == 0.5:
            node.event("braked", force=0.8)
            await node.radio.broadcast(b"brake")
        if node.radio.drain() and heard_s is None:
            heard_s = now_s
        if heard_s is not None and abs(now_s - heard_s - (0.3 if node.id == "v03" else 0.0)) < 1e-6:
            node.event("warned")
        node.report(fix.position_m, warned=heard_s is not None, count=now_s)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    scenario = {
        "run": {"duration_s": 2.0, "settle_s": 0.0},
        "network": {"vehicles": 4},
        "radio": {"range_m": 1e6},
        "program": {"entry": f"{__name__}:brakes"},
    }
    return Run.open(recorded(scenario, tmp_path_factory.mktemp("run") / "run"))


BRAKES = "tests.emulator.checks.test_properties:brakes"
SHORT = {"run": {"duration_s": 1.0, "settle_s": 0.0}, "network": {"vehicles": 2}}


def braked(moment: Moment) -> bool:
    return moment.event == "braked"


@pytest.mark.slow
def test_always_and_never_ask_at_each_period_of_each_vehicle(run: Run) -> None:
    assert always(run, "counts", lambda m: m["count"] >= 0).verdict == "valid"
    assert never(run, "far", lambda m: np.abs(m["position_m"]).max() > 1e7).text == "false at 80 moments"
    failed = always(run, "early", lambda m: m["count"] < 1.0)
    assert failed.verdict == "invalid"
    assert failed.text == "is false: first of v01 at 1 s (40 of 80 in all)"
    assert failed.figures["rows"][0] == {"node": "v01", "time_s": 1.0}
    assert any("sent frame 0" in line for line in failed.figures["before"])
    assert never(run, "early", lambda m: m["count"] >= 1.0).text.startswith("is true: first of v01 at 1 s")


def test_a_predicate_that_has_nothing_to_say_is_unknown(run: Run) -> None:
    assert always(run, "nothing", lambda m: None).verdict == "unknown"
    assert always(run, "missing", lambda m: None if m["no_such"] is None else False).verdict == "unknown"


def test_what_never_happens_is_valid_in_a_run_without_any_event() -> None:
    """A live run has vnet's own events, as `joined`, and is valid; the same run simulated may have none."""
    quiet = cast(Run, SimpleNamespace(events=[], scenario=SimpleNamespace(fault=[])))
    assert never(quiet, "crash", lambda m: m.event == "crashed", at="event").verdict == "valid"
    assert always(quiet, "crash", lambda m: m.event == "crashed", at="event").verdict == "unknown"


def test_eventually_is_of_each_vehicle_and_within_a_time(run: Run) -> None:
    assert eventually(run, "late", lambda m: m["count"] >= 1.9).figures == {"slowest_s": 1.9}
    short = eventually(run, "late", lambda m: m["count"] >= 1.9, within_s=1.0)
    assert short.verdict == "invalid" and short.text.startswith("never came true within 1 s: first of v01")
    others = eventually(run, "warned", lambda m: m["warned"])
    assert others.verdict == "invalid" and others.figures["rows"] == [{"node": "v01", "time_s": 0.0}]


def test_a_vehicle_without_any_event_is_asked_as_well(run: Run) -> None:
    """v04 hears v01 as v02 does; v01, which brakes, is never warned."""

    def warned(moment: Moment) -> bool:
        return moment.event == "warned"

    failed = eventually(run, "warned", lambda m: m.event == "never", at="event")
    assert failed.verdict == "invalid" and "(4 in all)" in failed.text
    some = eventually(run, "warned", warned, at="event")
    assert some.figures["rows"] == [{"node": "v01", "time_s": 0.0}]
    others = eventually(run, "warned", warned, at="event", nodes=["v02", "v03", "v04"])
    assert others.text == "true of 3 vehicles within 0.9 s", "from their entry on"
    assert eventually(run, "one", warned, at="event", nodes=["v02"]).text.startswith("true of 1 vehicle ")
    assert eventually(run, "none", warned, at="event", nodes=["v99"]).verdict == "unknown"
    assert eventually(run, "warned", warned, 0.8, "event", ["v02", "v03"]).text.startswith(
        "never came true within 0.8 s: first of v03"
    )
    assert eventually(run, "warned", warned, nodes=["v99"]).text == "there is no vehicle v99"
    assert eventually(run, "all", lambda m: True, nodes=["v01", "v99"]).verdict == "unknown"


def test_a_run_that_is_too_short_for_a_property_leaves_it_unknown(run: Run) -> None:
    too_long = eventually(run, "late", lambda m: False, within_s=2.1)
    assert (too_long.verdict, too_long.text) == ("unknown", "no vehicle is there for 2.1 s")
    assert eventually(run, "late", lambda m: False, within_s=2.0).verdict == "invalid"
    assert eventually(run, "late", lambda m: m["count"] >= 1.0, within_s=100.0).verdict == "valid"
    causes = leads_to(run, "x", lambda m: m["count"] >= 1.8, lambda m, cause: False, 1.0)
    assert causes.text == "8 causes came less than 1 s before the end of the run"
    endless = leads_to(run, "x", lambda m: m["count"] >= 1.8, lambda m, cause: False, float("inf"))
    assert endless.text.startswith("was not followed: first of v01 at 1.8 s")


def test_what_no_property_is_is_refused(run: Run) -> None:
    with pytest.raises(VnetError, match="soon: within_s = -1: 0 or more seconds are needed"):
        eventually(run, "soon", lambda m: True, within_s=-1)
    with pytest.raises(VnetError, match="soon: within_s = nan"):
        leads_to(run, "soon", lambda m: True, lambda m, cause: True, float("nan"))
    with pytest.raises(VnetError, match="text: the predicate answered 'no': True, False or None is needed"):
        always(run, "text", lambda m: "no")  # type: ignore[arg-type, return-value]


def test_what_leads_to_what_by_events_of_other_vehicles(run: Run) -> None:
    def warned_by(node: str, within_s: float) -> str:
        result = leads_to(
            run, "warned", braked, lambda m, cause: (m.node, m.event) == (node, "warned"), within_s, at="event"
        )
        return f"{result.verdict}: {result.text}"

    assert warned_by("v02", 0.2).startswith("valid: 1 cause followed by an effect within 0.1 s")
    assert warned_by("v03", 0.5).startswith("valid")
    assert warned_by("v03", 0.2) == "invalid: was not followed within 0.2 s: first of v01 at 0.5 s, event braked"
    never_caused = leads_to(run, "x", lambda m: False, lambda m, cause: True, 1.0)
    assert never_caused.verdict == "unknown"


def test_a_cause_near_the_end_counts_only_if_its_effect_came(run: Run) -> None:
    last = leads_to(run, "x", lambda m: m["count"] >= 1.8, lambda m, cause: False, 1.0)
    assert last.verdict == "unknown", last


async def counts_the_dead(node: Node) -> None:
    """Report the number of vehicles that were heard once, and not for 0.25 s."""
    heard_s: dict[str, float] = {}
    async for fix in node.gnss:
        now_s = fix.time_ns / 1e9
        await node.radio.broadcast(node.id.encode())
        heard_s |= {packet.sender: now_s for packet in node.radio.drain()}
        node.report(fix.position_m, dead=sum(now_s - last_s > 0.25 for last_s in heard_s.values()))


def fault_scenario() -> dict[str, Any]:
    """v02 is killed from 0.5 s to 1.5 s; a loss without losses acts on all from 0.3 s to 0.4 s."""
    return {
        "run": {"duration_s": 2.0, "settle_s": 0.0},
        "network": {"vehicles": 3},
        "radio": {"range_m": 1e6},
        "fault": [
            {"kind": "kill", "at_s": 0.5, "duration_s": 1.0, "nodes": {"ids": ["v02"]}},
            {"kind": "loss", "probability": 0.0, "at_s": 0.3, "duration_s": 0.1},
        ],
    }


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return simulate(
        fault_scenario(), program=f"{__name__}:counts_the_dead", out=tmp_path_factory.mktemp("run") / "run"
    )


def kill(moment: Moment) -> bool:
    return moment.event == "fault_started" and bool(moment["kind"] == "kill")


def dead(moment: Moment, cause: Moment) -> bool:
    return bool(moment.node != cause.node and moment["dead"] >= 1)


@pytest.mark.slow
def test_a_fault_is_an_event_of_each_of_its_nodes(faulty: Run) -> None:
    of_faults = [m for m in moments(faulty, "event") if m.event in ("fault_started", "fault_ended")]
    told = [(m.time_s, m.node, m.event, m["kind"], m["fault"]) for m in of_faults]
    loss = [(0.3, "fault_started", "loss", "loss-1"), (0.4, "fault_ended", "loss", "loss-1")]
    on_v02 = [(0.5, "v02", "fault_started", "kill", "kill-0"), (1.5, "v02", "fault_ended", "kill", "kill-0")]
    assert told == [(t, node, *rest) for t, *rest in loss for node in ("v01", "v02", "v03")] + on_v02


@pytest.mark.slow
def test_a_fault_leads_to_a_reported_value(faulty: Run) -> None:
    found = leads_to(faulty, "dead", kill, dead, within_s=1.0)
    assert (found.verdict, found.figures) == ("valid", {"slowest_s": pytest.approx(0.3)})
    late = leads_to(faulty, "dead", kill, dead, within_s=0.2)
    assert late.text == "was not followed within 0.2 s: first of v02 at 0.5 s, event fault_started"
    assert leads_to(faulty, "dead", kill, dead, 1.0, at="event", effect_at="period").verdict == "valid"
    assert leads_to(faulty, "dead", kill, dead, 1.0, at="event").verdict == "invalid", "no event has that value"


@pytest.mark.slow
def test_moments_without_the_value_are_skipped_unless_they_are_asked_for(faulty: Run) -> None:
    assert always(faulty, "few", lambda m: m["dead"] <= 1).text == "true at 50 of 60 moments"
    assert never(faulty, "some", lambda m: m["dead"] > 1).verdict == "valid"
    assert always(faulty, "none", lambda m: m["dead"] == 0).verdict == "invalid"
    assert always(faulty, "reports", lambda m: m.get("dead") is not None).text == (
        "is false: first of v02 at 0.5 s (10 of 60 in all)"
    )
    assert always(faulty, "reports", lambda m: "dead" in m).verdict == "invalid"
    assert always(faulty, "typing error", lambda m: m["no_such"] <= 1).verdict == "unknown"


def test_what_is_not_a_number_is_no_value() -> None:
    moment = Moment(0, "v01", values={"fix_m": [math.nan, math.nan], "odd": [math.nan, 1.0], "none": []})
    assert [name in moment for name in ("fix_m", "odd", "none", "speed")] == [False, True, True, False]


@pytest.mark.slow
def test_a_test_promises_what_follows_a_fault_that_it_injects(tmp_path: Path) -> None:
    scenario = make_scenario(fault_scenario() | {"fault": []}, {"program": f"{__name__}:counts_the_dead"})

    async def story() -> None:
        async with RunHarness(scenario, tmp_path / "run") as emu:
            emu.leads_to(kill, dead, within_s=1.0)
            emu.always(lambda m: m["dead"] <= 1, name="few")
            await emu.run_until(0.5)
            with emu.fault("kill", nodes=["v02"]):
                await emu.run_until(1.5)
            await emu.run_until(2.0)
            emu.check("own:dead", "own:few")

    asyncio.run(story())


def test_moments_are_periods_or_events(run: Run) -> None:
    assert len(moments(run)) == 80
    events = moments(run, "event")
    assert [moment.event for moment in events if moment.node == "v01"] == ["braked"]
    assert next(m for m in events if m.event == "braked")["force"] == 0.8
    with pytest.raises(VnetError, match="at = 'second': must be 'period', 'event' or 'any'"):
        moments(run, "second")


@pytest.mark.slow
def test_the_result_is_one_of_a_check_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checks = tmp_path / "promises.py"
    checks.write_text(
        "from emulator.checks.properties import always\n\n\n"
        "def check(run):\n    yield always(run, 'small', lambda m: m['count'] < 0.5)\n"
    )
    judged = simulate(SHORT, program=BRAKES, checks=[f"{checks}:check"], out=tmp_path / "run")
    (check,) = [check for check in judged.checks if check.name == "own:small"]
    assert judged.verdict == "invalid" and check.text.startswith("is false: first of v01 at 0.5 s")


@pytest.mark.slow
def test_a_test_promises_and_the_run_is_judged_by_it(tmp_path: Path) -> None:
    scenario = make_scenario(SHORT, {"program": BRAKES})

    def counts(moment: Moment) -> bool:
        return bool(moment["count"] >= 0)

    async def story() -> None:
        async with RunHarness(scenario, tmp_path / "run") as emu:
            emu.always(counts)
            emu.never(lambda moment: moment["count"] > 0.5, name="long")
            emu.eventually(lambda moment: moment["count"] > 0.3, within_s=0.5, name="soon")
            emu.leads_to(
                braked, lambda moment, cause: moment.event == "warned", within_s=0.4, at="event", name="warns"
            )
            with pytest.raises(VnetError, match='needs a name: name="…"'):
                emu.always(lambda moment: True)
            await emu.run_until(1.0)
            emu.check("own:counts", "own:soon", "own:warns")
            with pytest.raises(AssertionError, match=r"own:long is invalid: is true: first of v01 at 0.6 s"):
                emu.check("own:long")

    asyncio.run(story())
    assert Run.open(tmp_path / "run").verdict == "invalid"


@pytest.mark.slow
def test_a_promise_with_the_name_of_a_check_is_refused(tmp_path: Path) -> None:
    scenario = make_scenario(
        {"run": {"duration_s": 1.0, "settle_s": 0.0}, "network": {"vehicles": 2}},
        {
            "program": "tests.emulator.checks.test_properties:brakes",
            "program.checks": ["tests.emulator.testing.own_checks:reads_files"],
        },
    )

    async def story() -> None:
        async with RunHarness(scenario, tmp_path / "run") as emu:
            emu.always(lambda moment: True, name="files")
            emu.always(lambda moment: False, name="other")
            await emu.run_until(0.5)
            with pytest.raises(VnetError, match="own:files: the scenario has a check of this name"):
                emu.end()
            with pytest.raises(AssertionError, match="own:other is invalid"):
                emu.check("other")

    asyncio.run(story())


@pytest.mark.slow
def test_a_promise_that_is_broken_fails_its_test_though_no_check_asks(tmp_path: Path) -> None:
    scenario = make_scenario(SHORT, {"program": BRAKES})

    async def story(folder: str, promise: Callable[[RunHarness], None]) -> None:
        async with RunHarness(scenario, tmp_path / folder) as emu:
            promise(emu)
            await emu.run_until(0.5)
            emu.check("gnss", allow_unknown=True)
            with pytest.raises(VnetError, match="own:late: the run has ended, and has been judged"):
                emu.always(lambda moment: True, name="late")

    def twice(emu: RunHarness) -> None:
        emu.always(lambda moment: False, name="same")
        with pytest.raises(VnetError, match="own:same: there is a promise of this name"):
            emu.never(lambda moment: False, name="same")

    with pytest.raises(AssertionError, match="own:same is invalid: is false: first of v01 at 0 s"):
        asyncio.run(story("broken", twice))
    asyncio.run(story("kept", lambda emu: emu.always(lambda moment: True, name="kept")))
    with pytest.raises(AssertionError, match=r"own:typo is unknown: .*: none has a value 'no_such'"):
        asyncio.run(story("typo", lambda emu: emu.always(lambda moment: moment["no_such"] >= 0, name="typo")))
    with pytest.raises(VnetError, match="own:wrong: the predicate raised ZeroDivisionError: division by zero"):
        asyncio.run(story("raises", lambda emu: emu.always(lambda moment: bool(1 / 0), name="wrong")))


def test_events_of_a_run_and_moments_of_a_property_are_named_alike() -> None:
    own = Event(5, "event", "v01", {"name": "warned", "details": {"number": 3}})
    vnets = Event(6, "crashed", "v01", {"error": "tired"})
    foreign = Event(7, "event", "v01", {"details": 3})
    found = [(each.name, each.values) for each in (own, vnets, foreign)]
    assert found == [("warned", {"number": 3}), ("crashed", {"error": "tired"}), ("", {})]
    run = cast(Run, SimpleNamespace(events=[own, vnets, foreign], scenario=SimpleNamespace(fault=[])))
    assert [(m.name, m.values) for m in moments(run, "event")] == [(e.name, e.values) for e in run.events]


# What a run does not have: events that were left out, reports between two periods, vehicles that leave.

MS = 1_000_000


def made(
    events: Sequence[Event] = (),
    rows: Mapping[str, Sequence[dict[str, Any] | None]] | None = None,
    periods: int = 10,
) -> Run:
    """Return a run of periods of 100 ms with these events, and what each vehicle has reported in each period."""
    there = [
        {"time_ns": number * 100 * MS, "node": node, "position_m": [0.0, 0.0], "values": None, **row}
        for node, its in (rows or {"v01": [{}] * periods}).items()
        for number, row in enumerate(its)
        if row is not None
    ]
    trace = pa.table({name: pa.array([], pa.string()) for name in RECEPTION})
    return cast(
        Run,
        SimpleNamespace(
            events=events,
            scenario=SimpleNamespace(fault=[]),
            states=SimpleNamespace(to_pylist=lambda: there),
            trace=trace,
            nodes=sorted({row["node"] for row in there}),
            times_s=np.arange(periods) / 10,
            period_s=0.1,
        ),
    )


def said(name: str, time_ms: int, node: str = "v01") -> Event:
    return Event(time_ms * MS, EventKind.event, node, {"name": name, "details": {}})


LEFT_OUT = Event(1000 * MS, EventKind.left_out, "v01", {"what": "event", "count": 7})


def named(name: str) -> Callable[..., bool]:
    return lambda moment, cause=None: moment.name == name


@pytest.mark.parametrize("at", ["event", "any"])
def test_events_that_were_left_out_leave_unknown_what_they_could_change(at: str) -> None:
    kept = [said("tick", 100), said("ask", 200)]
    out = made([*kept, LEFT_OUT])
    assert never(out, "disaster", named("disaster"), at=at).verdict == "unknown"
    assert never(out, "ask", named("ask"), at=at).verdict == "invalid", "whatever else there was"
    assert eventually(out, "answer", named("answer"), 0.5, at=at).verdict == "unknown"
    assert eventually(out, "answer", named("answer"), 0.1, at=at).verdict == "invalid", "before any was left out"
    assert leads_to(out, "answers", named("ask"), named("answer"), 0.5, at=at).verdict == "unknown"
    assert leads_to(out, "answers", named("tick"), named("ask"), 0.5, at=at).verdict == "unknown", "other ticks"
    soon = leads_to(out, "answers", named("tick"), named("answer"), 0.05, at=at)
    assert soon.verdict == "invalid", "the last that was kept is later"
    assert never(out, "values", lambda m: False).verdict == "valid", "of periods nothing is left out"


def test_other_vehicles_and_kinds_of_events_are_judged_as_ever() -> None:
    logs = made([said("tick", 100), Event(MS, EventKind.left_out, "v01", {"what": "log", "count": 7})])
    assert never(logs, "disaster", named("disaster"), at="event").verdict == "valid"
    two = made([said("tick", 100), LEFT_OUT], {"v01": [{}] * 10, "v02": [{}] * 10})
    failed = eventually(two, "answer", named("answer"), 0.5, at="event")
    assert failed.verdict == "invalid" and failed.figures["rows"] == [{"node": "v02", "time_s": 0.0}]


def test_what_is_reported_in_the_rest_of_its_causes_period_follows_it() -> None:
    rows = {"v01": [{"got": number == 5} for number in range(10)]}
    run = made([said("packet", 553)], rows)
    followed = leads_to(run, "got", named("packet"), lambda m, cause: m["got"], within_s=0.04)
    assert followed.verdict == "valid" and followed.figures["slowest_s"] == 0.0
    before = leads_to(made([said("packet", 600)], rows), "got", named("packet"), lambda m, cause: m["got"], 0.2)
    assert before.verdict == "invalid", "its period is over"


def test_an_event_before_its_cause_is_no_effect() -> None:
    run = made([said("answer", 520), said("ask", 553)])
    assert leads_to(run, "answers", named("ask"), named("answer"), 0.2).verdict == "invalid"


def test_causes_near_the_end_of_a_run_that_ends_within_a_period() -> None:
    end = Event(1090 * MS, EventKind.ended, None, {})
    run = made([said("ask", 1020), end])
    assert leads_to(run, "answers", named("ask"), named("answer"), 0.02, at="event").verdict == "invalid"
    assert leads_to(run, "answers", named("ask"), named("answer"), 0.02).verdict == "unknown", "nor has it periods"


def test_a_property_sees_lists_and_names_without_a_column() -> None:
    rows = [{"values": [("vec", [1.0, 2.0]), ("n63", [3.0]), ("some", [1.0] * (n % 3))]} for n in range(10)]
    run = made(rows={"v01": rows})
    assert always(run, "some", lambda m: len(m["some"]) < 3).verdict == "valid"
    assert always(run, "vec", lambda m: m["vec"] == [1.0, 2.0]).verdict == "valid"
    assert always(run, "n63", lambda m: m["n63"] == 3.0).verdict == "valid"


@pytest.mark.parametrize(
    ("ready", "verdict"),
    [
        ([False, False, None, None, False, True, False, False, False, False], "valid"),
        ([False, False, None, None, False, False, False, False, False, True], "invalid"),
        ([True, False, None, None, False, False, False, False, False, False], "invalid"),
        ([False, False, None, None, None, None, None, None, None, False], "unknown"),
    ],
    ids=["leaves early", "second stay late", "second stay never", "too short"],
)
def test_eventually_is_asked_of_each_stay_that_is_long_enough(ready: list[bool | None], verdict: str) -> None:
    run = made(rows={"v01": [None if each is None else {"ready": each} for each in ready]})
    assert eventually(run, "ready", lambda m: m["ready"], within_s=0.4).verdict == verdict
