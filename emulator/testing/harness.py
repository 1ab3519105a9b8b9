"""A run in the hands of a test: it goes on when the test says so, breaks when the test says so, and is judged.

Emulated time passes only in `run_until` and `run_for`. Everything that the test does to the run is written into the
run's scenario, so that `vnet simulate FOLDER/scenario.toml` gives the same trace.
"""

from __future__ import annotations

import asyncio
import math
import shlex
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa

from emulator.cells.worker import rule_entry
from emulator.checks.judge import CheckResult, Judgement, Verdict
from emulator.checks.own import PREFIX, Result, finding_of, load_checks
from emulator.checks.properties import ANY, PERIOD, Effect, Predicate, always, eventually, leads_to, never
from emulator.drivers.conclude import judge_further
from emulator.drivers.session import Local, Session, over_zenoh
from emulator.fault_plan import PlannedFault
from emulator.radio.own_rules import Rule, load_rules
from emulator.records.events import Event
from emulator.records.run import Run
from emulator.records.run_folder import SCENARIO_FILE
from emulator.records.verdicts import Finding
from emulator.scenario.faults import Fault, OwnRule, parse_fault, refuse_router_restart
from emulator.scenario.loading import with_modules
from emulator.scenario.scenario import Scenario
from emulator.scenario.sections import DAY_S
from vnet.errors import ScenarioError, VnetError, did_you_mean
from vnet.units import NS_PER_S

CRASHES = "agents_alive", "no_exceptions", "progress", "own_rules"
"""Checks that fail a test which has not asked how its run ended."""
PATIENCE_S = 5.0
"""Time on the wall clock that programs have to yield once their test is over."""


class RunHarness:
    """See the module's text. An async context manager: the run starts when it is entered and ends when it is left.

    Raises ScenarioError if the scenario cannot be used, in a test or at all.
    """

    def __init__(self, scenario: Scenario, folder: Path, live: bool = False) -> None:
        if scenario.run.pacing != "lockstep":
            raise ScenarioError("run.pacing = 'realtime': a test steps a run in lockstep; for real time: vnet run")
        refuse_router_restart(scenario.fault)
        load_checks(scenario.program)
        load_rules(scenario.fault, scenario.program)
        self.folder = folder
        self.live = live
        with ThreadPoolExecutor(1) as pool:  # a test's thread may run an event loop
            self._run = pool.submit(Session, scenario, folder, over_zenoh if live else Local()).result()
        self._run.folder.open(self._run.emulation.scenario)
        self._emulation = self._run.emulation
        self._now_ns = 0
        self._open: list[str] = []
        self._folders: list[Path] = []
        self._judgement: Judgement | None = None
        self._promises: dict[str, Callable[[Run], Result]] = {}
        self._named: set[str] = set()
        """Names of the checks that the test has asked for: their failures have been told."""
        self._ended_by_test = False

    # What there is to see.

    @property
    def now_s(self) -> float:
        """Emulated seconds: all that happens before this instant has happened."""
        return self._now_ns / NS_PER_S

    @property
    def nodes(self) -> list[str]:
        """The ids of all vehicles."""
        return list(self._emulation.world.node_ids)

    @property
    def scenario(self) -> Scenario:
        """The scenario as it stands, with the faults that the test has injected."""
        return self._emulation.scenario

    @property
    def figures(self) -> Any:
        """The figures of the last period that is complete, or None."""
        rows = self._emulation.metrics.rows
        return rows[-1] if rows else None

    @property
    def events(self) -> list[Event]:
        """Events so far: joins, deaths, crashes, faults."""
        return list(self._emulation.folder.events)

    def states(self) -> pa.Table:
        """Estimates and truth of each vehicle, a row for each vehicle and period so far."""
        return self._emulation.metrics.states_table()

    def trace(self) -> pa.Table:
        """Outcome of each frame at each receiver so far."""
        return self._emulation.engine.trace.to_table()

    def halves(self) -> list[list[str]]:
        """The vehicles in two halves, drawn from the run's seed."""
        order = np.random.default_rng(self.scenario.run.seed).permutation(len(self.nodes))
        first = set(order[: len(order) // 2].tolist())
        return [[n for i, n in enumerate(self.nodes) if (i in first) is half] for half in (True, False)]

    @property
    def reproduce(self) -> str:
        """The command that reproduces the run."""
        return f"vnet {self._run.command} {shlex.quote(str(self.folder.absolute() / SCENARIO_FILE))}"

    # Its course.

    async def __aenter__(self) -> RunHarness:
        try:
            asyncio.get_running_loop()
        except RuntimeError:  # as within trio
            instead = 'with anyio a fixture anyio_backend returns "asyncio"'
            raise VnetError(f"an emulation needs asyncio, which does not run this test; {instead}") from None
        if self._run.started:
            raise VnetError("an emulation can be entered once: vnet_emulation(…) makes another one")
        try:
            await self._wait(self._run.start())
        except BaseException:  # a timeout while it starts: nobody calls `__aexit__` then
            with suppress(VnetError):
                await asyncio.to_thread(self.close)
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:  # Ctrl-C stays what it is, whatever the run comes to
            with suppress(VnetError) if issubclass(kind, asyncio.CancelledError) else nullcontext():
                await asyncio.to_thread(self.close)
            return
        try:
            judgement = await asyncio.to_thread(self._judge)
        except asyncio.CancelledError:  # by Ctrl-C; asyncio waits for its threads before pytest goes on
            with suppress(VnetError):
                await asyncio.to_thread(self._run.wait, PATIENCE_S)
            raise
        promised = {PREFIX + name for name in self._promises} - self._named
        broken = [each for each in judgement.checks if each.name in promised and _fails(each, allow_unknown=False)]
        if not self._ended_by_test:
            crashes = [each for each in judgement.checks if each.name in CRASHES and each.name not in self._named]
            broken += [each for each in crashes if _fails(each, allow_unknown=True)]
        if broken:
            raise AssertionError(self._complaint(broken))

    async def run_until(self, time_s: float) -> None:
        """Let emulated time pass up to `time_s`. Raises VnetError if the run ends before it."""
        while self._run.started and not self._run.stands.done():  # another step, which was cancelled, goes on
            await self._wait(self._run.stands)
        self._must_be_on("run_until")
        time_ns = round(time_s * NS_PER_S) if math.isfinite(time_s) else round(DAY_S * NS_PER_S) + 1
        if time_ns < self._now_ns:
            raise VnetError(f"run_until({time_s:g}): it is {self.now_s:g} s already")
        if time_ns > self._emulation.duration_ns:
            limit_s = self._emulation.duration_ns / NS_PER_S
            raise VnetError(f"run_until({time_s:g}): the run takes {limit_s:g} s; give it a longer duration=")
        self._must_not_outlast(time_s)
        if time_ns == self._now_ns:
            return
        self._now_ns = time_ns
        await self._wait(self._run.go(time_ns))
        if self._run.over:
            self._now_ns = self._emulation.emulated_ns
            last = self.events[-1]
            why = " ".join(filter(None, (last.node, last.kind, str(last.details.get("error", "")))))
            raise VnetError(f"run_until({time_s:g}): the run has ended at {self.now_s:g} s: {why}")

    async def run_for(self, duration_s: float) -> None:
        """Let so many emulated seconds pass."""
        await self.run_until(self.now_s + duration_s)

    def _must_not_outlast(self, time_s: float) -> None:
        healed_s = self.scenario.healed_s
        if self._open and time_s > healed_s + 1e-9:
            raise VnetError(
                f"run_until({time_s:g}): {', '.join(self._open)} would be healed at {healed_s:g} s, run.settle_s "
                "before the end: leave its block before, or give a longer duration= or a shorter settle="
            )

    def _must_be_on(self, what: str) -> None:
        if not self._run.started:
            raise VnetError(f"{what}: the run has not started: async with vnet_emulation(…) as emu:")
        if self._judgement is not None or self._run.over:
            raise VnetError(f"{what}: the run is over")
        if not self._run.stands.done():
            raise VnetError(f"{what}: the run is on its way to {self.now_s:g} s; wait for run_until")

    async def _wait(self, stands: Future[None]) -> None:
        # Shielded: a test that is cancelled must not take away what the run's thread will answer.
        await asyncio.shield(asyncio.wrap_future(stands))

    @contextmanager
    def fault(self, kind: str, **parameters: Any) -> Iterator[PlannedFault]:
        """A fault from now until the block is left, or so long as its `duration_s`, if that is given.

        `parameters` are the kind's, as in a scenario; lists of ids do for selectors. Raises ScenarioError.
        """
        self._must_be_on(f"fault {kind!r}")
        fault = parse_fault({"kind": kind, "duration_s": DAY_S, **parameters})
        if fault.kind == "router_restart" or (fault.kind == "emulator_restart" and not self.live):
            raise ScenarioError(f"fault {kind!r}: there is nothing here to restart")
        if self.now_s >= (healed_s := self.scenario.healed_s):
            raise ScenarioError(
                f"fault {kind!r} at {self.now_s:g} s: all have healed by {healed_s:g} s, run.settle_s before the "
                "end: give the run a longer duration= or a shorter settle="
            )
        planned = self._inject(fault)
        self._open.append(planned.label)
        try:
            yield planned
        finally:
            self._heal(planned)

    @contextmanager
    def rule(self, rule: str | Rule, kind: str = "custom", **parameters: Any) -> Iterator[PlannedFault]:
        """A rule of your own, from now until the block is left: a function of a module, or its entry.

        `kind` is "custom" or "custom_sender"; `parameters` are the kind's: `name`, `options`, selectors. Raises
        ScenarioError, also for a function that no module has: the run could not be reproduced.
        """
        entry, folder = rule_entry(rule)
        self._folders = [*self._folders, *([folder] if folder else [])]
        with self.fault(kind, rule=entry, **parameters) as planned:
            yield planned

    def _inject(self, fault: Fault) -> PlannedFault:
        if not isinstance(fault, OwnRule):
            return self._emulation.inject(fault, self._now_ns - 1)
        program = self.scenario.program
        program = program.model_copy(update={"folders": (*program.folders, *self._folders)})
        program, (ruled,) = with_modules(program, [fault], None)
        assert isinstance(ruled, OwnRule)
        return self._emulation.inject_rule(ruled, program, self._now_ns - 1)

    def _heal(self, planned: PlannedFault) -> None:
        if planned.label in self._open:
            self._open.remove(planned.label)
            # One that has begun lasts a nanosecond at least; another never acts, nor does it in the replay.
            has_begun = planned.start_ns <= self._now_ns
            self._emulation.heal(planned.label, max(self._now_ns - 1, planned.start_ns if has_begun else 0))

    # Promises, judged at its end as checks of one's own: `own:NAME`, by default the predicate's name.

    def always(self, predicate: Predicate, *, name: str | None = None, at: str = PERIOD) -> None:
        """Promise that a predicate is true at every moment (`emulator.checks.properties.always`).

        A promise that is broken, or unknown because nothing was seen of it, fails the test when its block is left,
        if no `check` has named it before. Raises VnetError for a name that has been taken, and once the run has
        ended; so do the other promises.
        """
        self._promise(name or _name_of(predicate), partial(always, predicate=predicate, at=at))

    def never(self, predicate: Predicate, *, name: str | None = None, at: str = PERIOD) -> None:
        """Promise that a predicate is true at no moment."""
        self._promise(name or _name_of(predicate), partial(never, predicate=predicate, at=at))

    def eventually(
        self,
        predicate: Predicate,
        *,
        within_s: float = math.inf,
        name: str | None = None,
        at: str = PERIOD,
        nodes: Collection[str] | None = None,
    ) -> None:
        """Promise that a predicate becomes true of each vehicle, or of `nodes`; see `properties.eventually`."""
        judge = partial(eventually, predicate=predicate, within_s=within_s, at=at, nodes=nodes)
        self._promise(name or _name_of(predicate), judge)

    def leads_to(
        self,
        cause: Predicate,
        effect: Effect,
        *,
        within_s: float,
        name: str | None = None,
        at: str = ANY,
        effect_at: str | None = None,
    ) -> None:
        """Promise that each cause is followed by an effect within so many seconds; see `properties.leads_to`."""
        judge = partial(leads_to, cause=cause, effect=effect, within_s=within_s, at=at, effect_at=effect_at)
        self._promise(name or _name_of(effect), judge)

    def _promise(self, name: str, judge: Callable[..., Result]) -> None:
        if self._judgement is not None:
            raise VnetError(f"{PREFIX}{name}: the run has ended, and has been judged")
        if name in self._promises:
            raise VnetError(f"{PREFIX}{name}: there is a promise of this name")
        self._promises[name] = partial(judge, name=name)

    def _kept(self) -> Iterator[Result]:
        """Judge the promises. Raises VnetError for a predicate that raises."""
        run = Run.open(self.folder)
        for name, judge in self._promises.items():
            try:
                yield judge(run)
            except VnetError:
                raise
            except Exception as error:
                raise VnetError(f"{PREFIX}{name}: the predicate raised {type(error).__name__}: {error}") from error

    # Its end.

    def end(self) -> Judgement:
        """End the run where it stands, or once all planned faults have healed, and judge it. Again: the same.

        Crashes and exceptions that nobody has handled fail a test otherwise: they are then for the test to judge.
        """
        self._ended_by_test = True
        return self._judge()

    def _judge(self) -> Judgement:
        if self._judgement is None:
            self._finish()
            self._judgement, verdict = self._run.close()
            checked: list[Finding] = [*self._judgement.checks, *self._judgement.not_exercised]
            taken = {check.name for check in checked}
            clashing = [name for name in self._promises if PREFIX + name in taken]
            for name in clashing:
                del self._promises[name]
            if self._promises:
                findings = [finding_of(result) for result in self._kept()]
                judge_further(self._emulation, self._judgement, verdict, findings)
            if clashing:
                said = "the scenario has a check of this name: give the promise another"
                raise VnetError(f"{PREFIX}{clashing[0]}: {said}")
        return self._judgement

    def close(self) -> None:
        """End the run, if it is on, whatever state it is in, and keep what can be kept of it.

        It ends where it stands; faults that are planned for later act all the same before. It is interrupted if a
        program does not yield for `PATIENCE_S`.
        """
        broken = self._run.stands.done() and self._run.stands.exception() is not None
        if not self._run.started or broken:
            return
        if self._judgement is None:
            self._now_ns = self._run.hold(PATIENCE_S)
            for planned in list(self._emulation.faults.faults):
                if planned.acts_at(self._now_ns) and not self._run.over:
                    self._emulation.heal(planned.label, max(self._now_ns - 1, planned.start_ns))
        self._judge()

    def _finish(self) -> None:
        if not self._run.started:
            raise VnetError("end: the run has not started: async with vnet_emulation(…) as emu:")
        self._run.stands.result()  # a test that was cancelled left it on its way
        if self._run.over:
            return
        for planned in list(self._emulation.faults.faults):
            self._heal(planned)
        last_ns = max(self._now_ns, self._emulation.faults.last_end_ns, self._emulation.world.period_ns)
        self._emulation.end_at(min(last_ns, self._emulation.duration_ns))
        self._run.go(None).result()
        self._now_ns = self._emulation.duration_ns

    def check(self, *names: str, within_s: float | None = None, allow_unknown: bool = False) -> Judgement:
        """End the run and judge it by these checks, or by all. Raises AssertionError if one of them fails.

        A check that has seen nothing is unknown, and fails unless `allow_unknown`; so does one that is named but
        was not exercised. `within_s` is how long the network may take to recover after a fault, by the checks that
        measure it. Raises VnetError for a name that no check has, or if nothing measured the recovery.
        """
        __tracebackhide__ = True
        judgement = self._judge()
        left_out = {skipped.name: skipped.reason for skipped in judgement.not_exercised}
        known = {check.name: check for check in judgement.checks}
        names = tuple(PREFIX + name if PREFIX + name in {*known, *left_out} else name for name in names)
        for name in names:
            if name not in known and name not in left_out:
                there = [*known, *left_out]
                raise VnetError(
                    f"no check is called {name!r}{did_you_mean(name, there)}; there are: {', '.join(there)}"
                )
        chosen = [check for check in judgement.checks if check.name in names or not names]
        self._named |= {check.name for check in chosen}
        failed = [check for check in chosen if _fails(check, allow_unknown)]
        failed += [
            CheckResult(name, Verdict.UNKNOWN, f"not exercised: {left_out[name]}")
            for name in names
            if name in left_out and not allow_unknown
        ]
        measured = [check for check in chosen if "recovered_s" in check.figures]
        if within_s is not None:
            failed += _too_slow(measured, within_s)
        if failed:
            raise AssertionError(self._complaint(failed))
        if within_s is not None and not measured:
            raise VnetError(f"within_s = {within_s:g}: none of these checks measured a recovery")
        return judgement

    def _complaint(self, failed: Sequence[CheckResult]) -> str:
        lines = [f"{check.name} is {check.verdict}: {check.text}" for check in failed]
        where = f"{len(self.nodes)} vehicles, {self.now_s:g} s, seed {self.scenario.run.seed}"
        return "\n  ".join([f"failed after {where}:", *lines, f"files: {self.folder}", f"again: {self.reproduce}"])


def _name_of(predicate: Callable[..., object]) -> str:
    """Return the name of a function; a lambda has none, and is then given one."""
    name = getattr(predicate, "__name__", "")
    if not callable(predicate):
        raise VnetError(f"a promise by {predicate!r}: a function of a moment is needed")
    if not name.isidentifier():
        raise VnetError('a promise by a lambda needs a name: name="…"')
    return name


def _fails(check: CheckResult, allow_unknown: bool) -> bool:
    return check.verdict is Verdict.INVALID or (check.verdict is Verdict.UNKNOWN and not allow_unknown)


def _too_slow(checks: Sequence[CheckResult], within_s: float) -> list[CheckResult]:
    """Checks that measured a recovery (`recovered_s`) longer than `within_s`, as failures."""
    slow = []
    for check in checks:
        longest_s = float(np.max(check.figures["recovered_s"], initial=0.0))
        if longest_s > within_s:
            text = f"recovered only {longest_s:.1f} s after a fault; within_s = {within_s:g}"
            slow.append(CheckResult(check.name, Verdict.INVALID, text, check.figures))
    return slow
