"""Logs and events of programs have time, node and level, are the same in both drivers, and are bounded."""

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from emulator.drivers.conclude import conclude
from emulator.drivers.emulation import MOST_NOTES, Emulation
from emulator.records.disk import NodeLogs, cut_log
from emulator.records.recorded_run import RecordedRun
from emulator.records.tables import STATES
from emulator.report.source import Source
from emulator.report.write import report_page
from emulator.scenario.scenario import Scenario
from tests.support.multi_loop_driver import run_apart, run_forked, run_together, scenario_of
from vnet.node import Node
from vnet.reports import RESERVED_NAMES

logger = logging.getLogger("my.program")


async def talks(node: Node) -> None:
    async for fix in node.gnss:
        await node.radio.broadcast(b"x")
        if fix.time_ns == 400_000_000:
            node.log("half way", level="warning")
            node.event("turned", left=True, by=np.float64(0.5), where="here", odd=float("nan"))
            logger.error("no way, %s", node.id)
            logger.debug("below the level of the logger")
            await asyncio.gather(in_a_task())


async def in_a_task() -> None:
    await asyncio.sleep(0.1)
    logger.warning("in a task")


async def floods(node: Node) -> None:
    for number in range(MOST_NOTES + 7):
        node.log(f"line {number}")
    await asyncio.sleep(9)


def log_of(emulation: Emulation) -> str:
    return (emulation.folder.logs / "v01.log").read_text()


def told(emulation: Emulation) -> list[tuple[Any, ...]]:
    noted = [event for event in emulation.folder.events if event.kind in ("log", "event")]
    return [(event.time_ns, event.kind, event.node, event.details) for event in noted]


@pytest.mark.slow
@pytest.mark.parametrize("nodes_per_process", [1, 2])
def test_logs_and_events_are_the_same_live_and_simulated(nodes_per_process: int) -> None:
    scenario = scenario_of([], f"{__name__}:talks", vehicles=2, run={"nodes_per_process": nodes_per_process})
    together, apart = run_together(scenario), run_apart(scenario)
    assert told(together) == told(apart) == told(run_forked(scenario))
    assert [each for each in told(together) if each[2] == "v01"] == [
        (400_000_000, "log", "v01", {"level": "warning", "text": "half way"}),
        (
            400_000_000,
            "event",
            "v01",
            {"name": "turned", "details": {"left": True, "by": 0.5, "where": "here", "odd": "nan"}},
        ),
        (400_000_000, "log", "v01", {"level": "error", "text": "my.program: no way, v01"}),
        (500_000_000, "log", "v01", {"level": "warning", "text": "my.program: in a task"}),
    ]
    lines = (together.folder.logs / "v01.log").read_text().splitlines()
    assert lines == [
        "0.400000 v01 warning: half way",
        "0.400000 v01 info: event turned left=True, by=0.5, where=here, odd=nan",
        "0.400000 v01 error: my.program: no way, v01",
        "0.500000 v01 warning: my.program: in a task",
    ]
    conclude(together, 1.0, "simulate")
    assert RecordedRun.open(together.folder.path).event("event")[0].details["name"] == "turned"
    page = report_page(Source(together.folder.path))
    assert '<section id="log">' in page
    assert "turned: left True, by 0.5, where here, odd nan" in page
    assert ">half way<" in page


async def breaks_lines(node: Node) -> None:
    node.log("one\ntwo")
    node.event("said", text="one\ntwo")


async def logs_in_jobs(node: Node) -> None:
    loop, pool = asyncio.get_running_loop(), ThreadPoolExecutor(1)
    for executor, text in ((None, "default"), (pool, "own")):
        await loop.run_in_executor(executor, logging.warning, text)
    pool.shutdown()


@pytest.mark.slow
@pytest.mark.parametrize("run", [run_together, run_apart, run_forked])
def test_what_a_job_of_an_executor_logs_is_its_vehicles(run: Callable[[Scenario], Emulation]) -> None:
    emulation = run(scenario_of([], f"{__name__}:logs_in_jobs", vehicles=2))
    said = [(event.node, event.details["text"]) for event in emulation.folder.events if event.kind == "log"]
    assert sorted(said) == [(node, f"root: {pool}") for node in ("v01", "v02") for pool in ("default", "own")]


async def says_goodbye(node: Node) -> None:
    try:
        await asyncio.sleep(100)
    finally:
        node.event("bye")
        node.log("bye")


@pytest.mark.slow
@pytest.mark.parametrize("run", [run_together, run_apart, run_forked])
def test_what_a_restart_ends_is_not_heard_any_more(run: Callable[[Scenario], Emulation]) -> None:
    fault = {"kind": "restart", "at_s": 0.5, "duration_s": 0.2, "nodes": ["v02"]}
    emulation = run(scenario_of([fault], f"{__name__}:says_goodbye", vehicles=2))
    said = [event.time_ns for event in emulation.folder.events if event.kind in ("event", "log")]
    assert not [time_ns for time_ns in said if time_ns < 1_000_000_000]


def test_lines_that_are_broken_keep_their_beginning_apart() -> None:
    emulation = run_together(scenario_of([], f"{__name__}:breaks_lines", vehicles=2))
    lines = (emulation.folder.logs / "v01.log").read_text().splitlines()
    assert lines[:3] == ["0.000000 v01 info: one", "    two", "0.000000 v01 info: event said text=one\\ntwo"]


@pytest.mark.slow
def test_a_flood_is_cut_and_counted() -> None:
    emulation = run_together(scenario_of([], f"{__name__}:floods", vehicles=2))
    conclude(emulation, 1.0, "simulate")
    assert len(told(emulation)) == 2 * MOST_NOTES
    left_out = [(e.node, e.details) for e in emulation.folder.events if e.kind == "left_out"]
    assert left_out == [("v01", {"what": "log", "count": 7}), ("v02", {"what": "log", "count": 7})]


def test_a_log_that_is_full_says_so_once(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("emulator.records.disk.LARGEST_LOG_BYTES", 20)
    logs = NodeLogs(tmp_path)
    for number in range(5):
        logs.write("v01", f"line {number:03}")
    assert (tmp_path / "v01.log").read_text() == (
        "line 000\nline 001\n(the log is full: further lines are left out after 20 bytes)\n"
    )


def test_a_log_of_a_process_is_cut_while_it_has_it_open(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("emulator.records.disk.LARGEST_LOG_BYTES", 20)
    path, words = tmp_path / "v01.log", "(the log is full: further lines are left out after 20 bytes)\n"
    with path.open("a", buffering=1) as log:
        log.write("line 000\nline 001\n")
        cut_log(path)
        assert path.read_text() == "line 000\nline 001\n"
        for _ in range(2):
            log.write("line 002\nline 003\n")
            cut_log(path)
            assert path.read_text() == f"line 000\nline 001\nli\n{words}"
    cut_log(tmp_path / "none.log")


class Transport:
    """One that forgets all that it is given."""

    def now_ns(self, node: str) -> int:
        return 0

    def send_frame(self, node: str, payload: bytes, options: object) -> None: ...

    def send_report(self, report: object) -> None: ...

    def send_note(self, *note: object) -> None: ...


@pytest.fixture
def node() -> Node:
    return Node("v01", Transport(), lane_map=None, seed=1, options={}, period_ns=1, max_payload=1)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "name", ["", "x/y", "a b <c>", ".x", "node", "time_ns", "position_m", "values", "x.\udce9", "x.\x1b"]
)
def test_a_figure_that_would_vanish_is_refused(node: Node, name: str) -> None:
    with pytest.raises(ValueError, match=r"^report\(.*: (this name is taken by vnet|not a name of a value)"):
        node.report(**{name: 1.0})


def test_names_of_columns_and_names_with_a_dot_are_taken(node: Node) -> None:
    names: dict[str, Any] = {"delay_ms": 1.0, "weight.flow.0/x": 0.5, "mean_m": [1.0, 2.0], "f\u00fc\u00df": True}
    node.report(**names)


def test_vnets_own_columns_are_those_that_no_value_can_have() -> None:
    assert frozenset(STATES.columns) - {"estimate_m", "covariance_m2", "common_error_m"} == RESERVED_NAMES


def test_numbers_and_texts_by_one_name_are_refused(node: Node) -> None:
    node.report(delay_ms=4, state="idle")
    node.report(delay_ms=True, state="busy")
    expected = r"^report\(delay_ms='text'\): a text, but v01 has reported a number by this name; use two names$"
    with pytest.raises(ValueError, match=expected):
        node.report(delay_ms="text")
    with pytest.raises(
        ValueError, match=r"^report\(state=1.0\): a number, but v01 has reported a text by this name"
    ):
        node.report(state=1)


def test_wrong_levels_and_details_are_refused(node: Node) -> None:
    with pytest.raises(
        ValueError, match=r"^log\(level='loud'\): allowed are debug, info, warning, error, critical$"
    ):
        node.log("x", level="loud")
    with pytest.raises(ValueError, match=r"^event\(''\): a name is expected"):
        node.event("")
    with pytest.raises(ValueError, match=r"^event\('fault_started'\): a name is expected, other"):
        node.event("fault_started")  # for properties it would be a fault
    with pytest.raises(ValueError, match=r"^event\(y=\[1\]\): a number, a boolean or a text is expected$"):
        node.event("x", y=[1])  # type: ignore[arg-type]


async def says_what_utf_8_does_not_have(node: Node) -> None:
    node.log("\udcff")
    node.event("\udcff", **{"\udcff": "\udcff"})
    node.report(note="\udcff")
    task = asyncio.create_task(fails("\udcff"))
    await asyncio.wait([task])
    await fails("\udcff")


async def fails(text: str) -> None:
    raise ValueError(text)


@pytest.mark.slow
@pytest.mark.parametrize("run", [run_together, run_forked])
def test_lone_surrogates_are_escaped(run: Callable[[Scenario], Emulation]) -> None:
    """Names of files that are no UTF-8 have them; a program that tells of such a file goes on."""
    emulation = run(scenario_of([], f"{__name__}:says_what_utf_8_does_not_have", vehicles=1))
    told = [event.details for event in emulation.folder.events if event.node == "v01"]
    texts = [str(value) for details in told for value in (*details, *details.values())]
    assert sum("\\udcff" in text for text in texts) >= 6
    assert "\udcff" not in "".join(texts) + log_of(emulation)
