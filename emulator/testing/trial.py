"""One simulated run of a campaign in a worker process, with a time limit, and the shrinking of what has failed.

Whatever the run does, its campaign goes on. What fails is shrunk for as long as it fails in the same way: a
schedule of faults, or an order of events.
"""

from __future__ import annotations

import faulthandler
import os
import shutil
import sys
import tempfile
import threading
import time
import traceback
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, wait
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from emulator.cells.cells import BROKEN, MOST_TRIES, WorkerPool, worker_died
from emulator.cells.worker import Place, WorkerTimeoutError, call_fitly, temporary_prefix
from emulator.checks.judge import Verdict
from emulator.checks.replay import compare_tables, events_table, first_call
from emulator.drivers.determinism import calls_recorded, scattered
from emulator.drivers.emulation import Emulation
from emulator.drivers.session import Local, Session
from emulator.drivers.simulate import MOST_APART
from emulator.records.disk import DiskError
from emulator.records.period_figures import VECTORS
from emulator.records.run_folder import PROGRAMS_LOG, RunFolder
from emulator.records.tape import TapeEntry, described, parse_tape, tape_lines
from emulator.scenario.faults import Fault, Partition, Selector
from emulator.scenario.scenario import Scenario
from emulator.testing.scenarios import make_scenario
from vnet.errors import ScenarioError, VnetError

GREATEST = 1e6
"""No number that a vehicle reports exceeds true coordinates by more: metres, and their squares, in one town."""
HUNG, EMULATOR, REFUSED, GROWTH, REPLAY = "hung", "emulator", "refused", "growth", "replay"
STDOUT = 1
"""Descriptor of standard output."""
LOOK_S = 0.5
"""Interval at which a trial on an executor is looked at: a campaign may have been interrupted."""
STACKS_AT = 0.9
"""At this share of its time limit a trial writes down where it stands."""
Schedule = tuple[Fault, ...]
PARTS = 0.5, 0.75, 0.9
"""Parts of a time that are tried, the least one first."""
SHORTEST_S = 0.1
MOST_STEPS = 50
MOST_ORDER_STEPS = 150
"""Runs that shrink an order."""
SHORTEST_RUN_S = 0.2
MOST_SHOWN = 5
"""Deviations that a phrase tells."""
T = TypeVar("T")
Fails = Callable[[Scenario], bool]


@dataclass(frozen=True)
class Trial:
    """Result of a run: the verdict of each check, and the texts of those that failed."""

    verdicts: dict[str, Verdict]
    texts: dict[str, str]
    trace_sha256: str = ""
    wall_s: float = 0.0
    tape: tuple[TapeEntry, ...] = ()
    """Deviations from FIFO of a run that has failed."""
    apart: bool = False
    """True if each vehicle needed a process of its own, because one had ended that of all."""

    @property
    def failed(self) -> list[str]:
        """The checks that are invalid."""
        return [name for name, verdict in self.verdicts.items() if verdict is Verdict.INVALID]

    @classmethod
    def failure(cls, name: str, text: str) -> Trial:
        """A run that did not come as far as its checks."""
        return cls({name: Verdict.INVALID}, {name: text})


UNKNOWN = Trial({}, {})
"""Result of a run that was given up."""


def run_trial(scenario: Scenario, folder: RunFolder, twice: bool = False, apart: bool = False) -> Trial:
    """Simulate and judge a run in this process. Raises VnetError if it cannot be run.

    In a folder that is open its files are written, as of any other run. `twice` has it made again in another way;
    `apart` gives each vehicle a process of its own.
    """
    started = time.monotonic()
    session = Session(scenario, folder, Local(MOST_APART if apart else 1))
    emulation = session.emulation
    with calls_recorded(folder.path, twice):
        session.run()
    judgement = session.close()[0] if folder.is_open else session.judge()
    verdicts = {check.name: check.verdict for check in judgement.checks}
    texts = {check.name: check.text for check in judgement.checks if check.verdict is not Verdict.VALID}
    greatest, where = _greatest(emulation)
    grows = greatest > GREATEST + float(np.abs(emulation.world.area_m).max())
    verdicts[GROWTH] = Verdict.INVALID if grows else Verdict.VALID
    if grows:
        texts[GROWTH] = f"{where} holds {greatest:.3g}"
    if twice and not apart:  # the instant at which a process ends depends on processes and windows
        differs = _difference_of_another(emulation)
        verdicts[REPLAY] = Verdict.INVALID if differs else Verdict.VALID
        texts |= {REPLAY: differs} if differs else {}
    failed = Verdict.INVALID in verdicts.values()
    tape = tuple(emulation.orders.in_order()) if failed else ()
    return Trial(verdicts, texts, judgement.trace_sha256, time.monotonic() - started, tape)


def _difference_of_another(emulation: Emulation) -> str:
    """Simulate a run again, in two processes, without windows, at other addresses; returns what differs, or ""."""
    scenario = emulation.scenario
    scenario = scenario.model_copy(update={"run": scenario.run.model_copy(update={"windows": False})})
    with tempfile.TemporaryDirectory(prefix=temporary_prefix(os.getpid())) as name:
        folder = RunFolder.scratch(Path(name) / "run")
        again = Session(scenario, folder, Local(processes=2))
        with calls_recorded(folder.path, True), scattered():
            again.run()
        found = compare_tables(_tables(emulation), _tables(again.emulation))
        if found.verdict is Verdict.VALID:
            return ""
        call, _ = first_call(emulation.folder.path, folder.path)
    return "; ".join(filter(None, [found.text, call]))


def _tables(emulation: Emulation) -> tuple[pa.Table, ...]:
    """Return the tables that `TABLES` names."""
    metrics = emulation.metrics
    events = events_table(emulation.folder.events)
    return emulation.engine.trace.to_table(), metrics.states_table(), metrics.metrics_table(), events


def _greatest(emulation: Emulation) -> tuple[float, str]:
    """The greatest number of all estimates and covariances that were reported, and which of which vehicle it is."""
    states = emulation.metrics.states_table()
    declared = emulation.metrics.declared
    theirs = [(each.estimate, each.covariance) for each in declared.views.estimates]
    found = [(0.0, "")]
    for name in {*VECTORS, *chain(*theirs)} & declared.vectors.keys():
        column = states[name].combine_chunks()
        numbers = np.abs(np.asarray(pc.list_flatten(column), dtype=float))
        numbers[~np.isfinite(numbers)] = 0.0
        if len(numbers):
            row = pc.list_parent_indices(column)[int(numbers.argmax())].as_py()
            found.append((float(numbers.max()), f"{name} of {states['node'][row]}"))
    return max(found)


class TrialPool:
    """Runs trials in worker processes, each of which serves many, `limit_s` seconds each.

    May be used from several threads at once, each with a worker of its own. `close` ends all that are left, but for
    those on an executor, for which nobody waits any more.
    """

    def __init__(
        self, limit_s: float, scenario: Scenario, executor: Executor | None = None, twice: bool = False
    ) -> None:
        """Trials of changes of `scenario`, which have its programs and checks; `twice`: each in two ways."""
        self.limit_s = limit_s
        self._twice = twice
        self.closed = False
        self._place = Place.here(scenario)
        self._pool = WorkerPool()
        self._executor = executor
        self._scratch = Path(tempfile.mkdtemp(prefix="vnet-trials-"))
        self._forget = weakref.finalize(self, shutil.rmtree, self._scratch, ignore_errors=True)

    def run(self, scenario: Scenario, folder: Path, apart: bool = False) -> Trial:
        """Return a trial on this machine, whose files stay in `folder`.

        One that hangs has failed; one that ends its process is made again, as the machine may have ended it, and at
        last with a process a vehicle, so that the vehicle has died; so is any if `apart`. Nothing is known of one
        that was begun once closed.
        """
        return self._judged(lambda tries: self._here(scenario, folder, tries), MOST_TRIES if apart else 1)

    def run_anywhere(self, scenario: Scenario, apart: bool = False) -> Trial:
        """Return a trial that leaves no files, on the executor if there is one; VnetError if that is broken."""
        return self._judged(lambda tries: self._away(scenario, tries), MOST_TRIES if apart else 1)

    def _judged(self, run: Callable[[int], Trial], tries: int) -> Trial:
        try:
            if not self.closed:
                return run(tries)
        except WorkerTimeoutError as error:
            return Trial.failure(HUNG, f"{error}; logs/stacks.txt says where it stood")
        except BROKEN:
            if not self.closed:
                raise VnetError("the executor is broken") from None
        except Exception as error:
            if not worker_died(error):
                raise
            if not self.closed and tries == MOST_TRIES:
                return Trial.failure(EMULATOR, str(error))
            if not self.closed:
                return self._apart(run, error) if tries + 1 == MOST_TRIES else self._judged(run, tries + 1)
        return UNKNOWN

    def _apart(self, run: Callable[[int], Trial], error: Exception) -> Trial:
        """Return the trial again with a process a vehicle, so that the vehicle has died that ended all before."""
        trial = self._judged(run, MOST_TRIES)
        if trial.verdicts and not trial.failed:
            return Trial.failure(EMULATOR, f"{error}; not where each vehicle had a process of its own")
        return replace(trial, apart=True)

    def _here(self, scenario: Scenario, folder: Path | None, tries: int) -> Trial:
        self._pool.call(self._place, _get_ready)
        function = _run_unkept if folder is None else _run_in_worker
        place = self._scratch / str(threading.get_ident()) if folder is None else folder
        how = self.limit_s, self._twice, tries
        return self._pool.call(self._place, function, scenario, place, *how, limit_s=self.limit_s)

    def _away(self, scenario: Scenario, tries: int) -> Trial:
        if self._executor is None:
            return self._here(scenario, None, tries)
        how = self.limit_s, self._twice, tries
        future: Future[Trial] = self._executor.submit(
            call_fitly, self._place, _run_elsewhere, scenario, *how, limit_s=self.limit_s
        )
        while not self.closed:
            if wait([future], timeout=LOOK_S).done:
                return future.result()
        future.cancel()
        return UNKNOWN

    def close(self) -> None:
        """Have every trial that is on given up."""
        self.closed = True
        self._pool.close()
        self._forget()


def _get_ready() -> None:
    """Have a worker import all of this module before the time of a trial is measured."""


def _run_elsewhere(scenario: Scenario, limit_s: float, twice: bool, tries: int) -> Trial:
    """Run a trial in a worker on any machine, and keep nothing but its result."""
    with tempfile.TemporaryDirectory(prefix=temporary_prefix(os.getpid())) as name:
        return _run_unkept(scenario, Path(name) / "run", limit_s, twice, tries)


def _run_unkept(scenario: Scenario, scratch: Path, limit_s: float, twice: bool, tries: int) -> Trial:
    """Run a trial in a worker, and keep nothing but its result: files take as long as a small run's checks."""
    folder = RunFolder.scratch(scratch)
    # Checks of the user's own may read what programs have printed.
    log = folder.logs / PROGRAMS_LOG if scenario.program.checks else Path(os.devnull)
    return _run(scenario, folder, log, Path(os.devnull), limit_s, twice, tries)


def _run_in_worker(scenario: Scenario, folder: Path, limit_s: float, twice: bool, tries: int) -> Trial:
    """Run a trial in a worker. What its programs print, and where it stood if it hangs, is in the run's logs."""
    if tries > 1:
        shutil.rmtree(folder, ignore_errors=True)  # of the attempt before
    run_folder = RunFolder.create(folder, scenario)
    log, stacks = run_folder.logs / PROGRAMS_LOG, run_folder.logs / "stacks.txt"
    return _run(scenario, run_folder, log, stacks, limit_s, twice, tries)


def _run(
    scenario: Scenario,
    run_folder: RunFolder,
    log_path: Path,
    stacks_path: Path,
    limit_s: float,
    twice: bool,
    tries: int,
) -> Trial:
    with log_path.open("ab") as log, stacks_path.open("w") as stacks:
        before = os.dup(STDOUT)
        os.dup2(log.fileno(), STDOUT)
        faulthandler.dump_traceback_later(STACKS_AT * limit_s, file=stacks)
        try:
            return run_trial(scenario, run_folder, twice, tries == MOST_TRIES)
        except DiskError:
            raise
        except ScenarioError as error:  # a smaller one that cannot be does not fail as that which is shrunk
            return Trial.failure(REFUSED, str(error))
        except BaseException as error:
            traceback.print_exc(file=stacks)
            return Trial.failure(EMULATOR, f"{type(error).__name__}: {error}")
        finally:
            faulthandler.cancel_dump_traceback_later()
            sys.stdout.flush()
            os.dup2(before, STDOUT)
            os.close(before)


def shrink(
    schedule: Schedule, still_fails: Callable[[Schedule], bool], most: int = MOST_STEPS
) -> tuple[Schedule, int]:
    """The smallest schedule found that still fails, and how many were tried; `most` at most."""
    tried = {schedule}
    progress = True
    while progress:
        progress = False
        for candidate in _smaller(schedule):
            if candidate in tried:
                continue
            if len(tried) > most:
                break
            tried.add(candidate)
            if still_fails(candidate):
                schedule, progress = candidate, True
                break
    return schedule, len(tried) - 1


def _smaller(schedule: Schedule) -> Iterator[Schedule]:
    """Schedules a little smaller than this one; what makes it smallest comes first."""
    for number in range(len(schedule)):
        yield schedule[:number] + tuple(
            map(_with_its_draws, schedule[number + 1 :], range(number + 1, len(schedule)))
        )
    yield tuple(fault.model_copy(update={"draws_of": None}) for fault in schedule)
    for simpler in (partial(_fewer, parts=_halves), _shorter, partial(_fewer, parts=_without_one)):
        for number, fault in enumerate(schedule):
            for changed in simpler(fault):
                yield (*schedule[:number], changed, *schedule[number + 1 :])


def _with_its_draws(fault: Fault, number: int) -> Fault:
    """Return a fault that keeps its random draws when its number changes."""
    return fault if fault.draws_of is not None else fault.model_copy(update={"draws_of": number})


def _halves(items: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    if len(items) > 1:
        middle = len(items) // 2
        yield items[:middle]
        yield items[middle:]


def _without_one(items: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    for number in range(len(items) if len(items) > 2 else 0):
        yield (*items[:number], *items[number + 1 :])


def _fewer(fault: Fault, parts: Callable[[tuple[Any, ...]], Iterator[tuple[Any, ...]]]) -> Iterator[Fault]:
    """Propose schedules with fewer vehicles."""
    for name in type(fault).model_fields:
        value = getattr(fault, name)
        if isinstance(value, Selector):
            for ids in parts(value.ids or ()):
                yield fault.model_copy(update={name: Selector(ids=ids)})
    if isinstance(fault, Partition) and isinstance(fault.groups, tuple) and len(fault.groups) == 1:
        for ids in parts(fault.groups[0]):
            yield fault.model_copy(update={"groups": (ids,)})


def _shorter(fault: Fault) -> Iterator[Fault]:
    shorter_s = [*(part * fault.duration_s for part in PARTS), fault.duration_s - SHORTEST_S]
    for duration_s in dict.fromkeys(max(SHORTEST_S, round(each_s, 1)) for each_s in shorter_s):
        if duration_s < fault.duration_s:
            yield fault.model_copy(update={"duration_s": duration_s})


def with_faults(scenario: Scenario, schedule: Schedule) -> Scenario:
    """Return the scenario with these faults."""
    return make_scenario(scenario, {"faults": schedule})


def with_tape(scenario: Scenario, tape: Sequence[TapeEntry]) -> Scenario:
    """Return the scenario in FIFO order but for these deviations."""
    fifo = make_scenario(scenario, {"run.order": "fifo"})
    lines = tuple(tape_lines(tape)) or None
    return fifo.model_copy(update={"run": fifo.run.model_copy(update={"tape": lines})})


def order_text(lines: Sequence[str]) -> str:
    """Return a tape as a phrase: "FIFO, except v03: timer of tell before packet from v01, at 4.2 s"."""
    entries = parse_tape(lines, "run.tape")
    told = "; ".join(described(entry) for entry in entries[:MOST_SHOWN])
    more = f"; and {len(entries) - MOST_SHOWN} more" if len(entries) > MOST_SHOWN else ""
    return f"FIFO, except {told}{more}"


def shrink_order(
    scenario: Scenario, tape: Sequence[TapeEntry], still_fails: Fails, most: int = MOST_ORDER_STEPS
) -> tuple[Scenario, int]:
    """Return the scenario with the fewest deviations of its tape that still fail, and how many runs that took.

    FIFO itself is tried first. Where the tape does not fail either, the scenario comes back as it was; so it does
    if `most` runs are too few to try both.
    """
    if most < 2:
        return scenario, 0
    if still_fails(fifo := with_tape(scenario, ())):
        return fifo, 1
    if not tape or not still_fails(with_tape(scenario, tape)):
        return scenario, 2
    least, steps = fewest(tape, lambda some: still_fails(with_tape(scenario, some)), most - 2)
    return with_tape(scenario, least), steps + 2


def fewest(items: Sequence[T], still_fails: Callable[[Sequence[T]], bool], most: int) -> tuple[Sequence[T], int]:
    """Return items none of which can be left out, and how many choices were tried, at most `most`.

    Zeller and Hildebrandt, "Simplifying and isolating failure-inducing input", IEEE TSE 28 (2002): parts are left
    out, then halved, until each is one item.
    """
    parts, tried = 2, 0
    while len(items) > 1 and tried < most:
        for kept in _with_and_without_parts(items, parts):
            tried += 1
            if still_fails(kept):
                parts = 2 if len(kept) * 2 <= len(items) else max(parts - 1, 2)
                items = kept
                break
            if tried >= most:
                break
        else:
            if parts >= len(items):
                break
            parts = min(parts * 2, len(items))
    return items, tried


def _with_and_without_parts(items: Sequence[T], parts: int) -> Iterator[Sequence[T]]:
    """Yield each of so many parts alone, then all but each."""
    ends = [len(items) * number // parts for number in range(parts + 1)]
    pairs = list(pairwise(ends))
    for first, end in pairs:
        yield items[first:end]
    for first, end in pairs if parts > 2 else ():
        yield [*items[:first], *items[end:]]


def shrink_run(scenario: Scenario, still_fails: Fails, most: int) -> tuple[Scenario, int]:
    """Return the run with fewer vehicles and less time, as often as that fails, and how many runs it took.

    There are `most` of them at most.
    """
    steps = 0
    ways: list[Callable[[Scenario], Scenario | None]] = [_fewer_vehicles]
    ways += [partial(_less_time, part=part) for part in PARTS]
    for smaller in ways:
        while steps < most and (candidate := smaller(scenario)) is not None:
            steps += 1
            if not still_fails(candidate):
                break
            scenario = candidate
    return scenario, steps


def _fewer_vehicles(scenario: Scenario) -> Scenario | None:
    """Return the run with half of the vehicles; None if they are not drawn."""
    network = scenario.network
    if network.kind != "generated" or network.vehicles < 2:
        return None
    return _changed(scenario, "vehicles", (network.vehicles + 1) // 2 if network.vehicles > 2 else 1)


def _less_time(scenario: Scenario, part: float) -> Scenario | None:
    """Return the run of a part of its time; None if it would be too short, or end before a fault."""
    less_s = round(part * scenario.run.duration_s, 1)
    if not SHORTEST_RUN_S <= less_s < scenario.run.duration_s:
        return None
    return _changed(scenario, "duration", less_s)


def _changed(scenario: Scenario, name: str, value: float) -> Scenario | None:
    try:
        return make_scenario(scenario, {name: value})
    except VnetError:
        return None
