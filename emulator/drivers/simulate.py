"""The simulated driver: the same programs and the same engine on one machine, without Zenoh.

One virtual-time loop hosts all nodes, and its yields go straight to the barrier; or some processes, forked from
this one, host a part of the nodes each (`local.py`). In lockstep a live run and its simulation give the
same trace, and a test holds them to it.
"""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from operator import index
from typing import Literal

from emulator.drivers.emulation import Emulation
from emulator.drivers.local import InLoop, LocalProcesses, Pipes
from emulator.drivers.lockstep import HorizonCallback, Lockstep, no_horizon, run_in_lockstep
from emulator.drivers.signals import ENDING, gets_signals, signals_handled, tell_from_handler
from emulator.records.costs import Costs
from emulator.records.events import EventKind
from vnet.errors import VnetError, shown
from vnet.runtime.debug_target import DebugTarget
from vnet.runtime.programs import search_programs_in

MOST_APART = 100
"""Processes of the vehicles of a run that is made again because one of them has ended its process."""


def simulate(
    emulation: Emulation,
    before_horizon: HorizonCallback = no_horizon,
    stop: threading.Event | None = None,
    on_interrupt: Callable[[], None] = lambda: None,
    debug: DebugTarget | None = None,
    processes: int = 1,
    apart: str | None = None,
    stalled: bool = False,
) -> tuple[float, bool]:
    """Run `emulation` to its end; returns the wall-clock seconds, and whether it was interrupted.

    Ctrl-C ends the run early, with the event `interrupted` and without the window in which it comes; a second one
    ends it wherever it is, for programs that do not yield. Raises ProgramError if the program cannot be loaded.
    `before_horizon` sets the barrier's horizon: it is called before time 0, and whenever the run is held there.
    Setting `stop` is like a first Ctrl-C, for runs on other threads than the main one. `on_interrupt` is called, on
    a thread of its own, at the first Ctrl-C. `debug` has a debugger stop in a program. With `processes` above 1 so
    many processes run the programs, and not this one; the vehicles of one that ends before its time have died.
    `apart` is the vehicle that has ended the process of an earlier attempt, "" if unknown: each vehicle has a
    process of its own (beyond `MOST_APART` others, these share so many), and what they print has been printed then.
    If none dies now, that one has, at the end, unless it had `stalled`, as on a machine that stands; raises
    VnetError if it is unknown.
    """
    node_ids = emulation.world.node_ids
    groups = split_evenly(node_ids, processes)
    if apart is not None:
        others = [node for node in node_ids if node != apart]
        groups = [*([[apart]] if apart else []), *(split_evenly(others, MOST_APART) if others else [])]
    stop = stop or threading.Event()
    lockstep = Lockstep(emulation, groups, permanent=True)
    search_programs_in(emulation.scenario.program.folders)
    programs: LocalProcesses
    if len(groups) > 1 or apart is not None:
        programs = Pipes(emulation, groups, stop, prints=apart is None)
    else:
        programs = InLoop(emulation, stop, debug)
    emulation.folder.event(0, EventKind.started, start_up_s=0.0)
    started = time.monotonic()
    interrupted = False
    try:
        with (
            _ending_between_windows(programs, stop, on_interrupt),
            rare_collections(len(node_ids)),
        ):
            programs.run(run_in_lockstep(lockstep, programs, before_horizon))
        _take_endings(emulation, programs, emulation.duration_ns, ", after the run was over")
    except KeyboardInterrupt:
        _take_endings(emulation, programs, lockstep.now_ns)
        interrupted = not programs.is_cut_short
        if interrupted:
            emulation.folder.event(lockstep.now_ns, EventKind.interrupted)
        emulation.finish(lockstep.now_ns)
    if (
        apart is not None
        and not (stalled or interrupted or programs.is_cut_short)
        and not any(each.kind == EventKind.died for each in emulation.folder.events)
    ):
        if not apart:
            raise VnetError("a process of programs ended, and none did when each vehicle had one of its own")
        how = "ended the process of all vehicles, and not one of its own"
        emulation.folder.event(emulation.duration_ns, EventKind.died, apart, how=how)
    return time.monotonic() - started, interrupted


def _take_endings(emulation: Emulation, processes: LocalProcesses, time_ns: int, after: str = "") -> None:
    """Take what programs told as they were ended, what they have cost, and the processes that died in it."""
    for process_id, details in processes.ended().items():
        for node in processes.nodes_of(process_id):
            emulation.died(time_ns, node, how=f"{details['how']}{after}")
    emulation.take_final(time_ns, [each.final for each in processes.endings])
    cpu_ns, wake_ups = Counter[str](), Counter[str]()
    for each in processes.endings:
        cpu_ns.update(each.cpu_ns)
        wake_ups.update(each.wake_ups)
    emulation.costs = Costs("program", cpu_ns, wake_ups, processes=len(processes.pids))
    emulation.orders.steps = {node: count for each in processes.endings for node, count in each.order_steps.items()}


@contextmanager
def _ending_between_windows(
    processes: LocalProcesses, stop: threading.Event, on_interrupt: Callable[[], None]
) -> Iterator[None]:
    """Have the first Ctrl-C wait until programs have yielded: in their midst it would leave things half done.

    And SIGTERM, where they run in processes of their own: one that ends this process may be a program's.
    """

    def ask(number: int, frame: object) -> None:
        stop.set()
        for each in mine:
            signal.signal(each, signal.default_int_handler)
        tell_from_handler(on_interrupt)

    def can_raise(number: signal.Signals) -> bool:
        return signal.getsignal(number) not in (ask, signal.SIG_DFL, signal.SIG_IGN)

    before = {each: signal.getsignal(each) for each in ENDING if gets_signals()}
    mine = [each for each, by in before.items() if by is signal.default_int_handler]
    if isinstance(processes, Pipes) and before.get(signal.SIGTERM) is signal.SIG_DFL:
        mine.append(signal.SIGTERM)
    processes.no_signal_raises = lambda: not (stop.is_set() or any(map(can_raise, before)))
    with signals_handled(ask, *mine):  # others see to the rest
        yield


OBJECTS_A_VEHICLE = 100
"""Allocations a vehicle, less what is freed, between two collections: more than a vehicle keeps of a period."""


@contextmanager
def rare_collections(vehicles: int) -> Iterator[None]:
    """Let the collector run once in some periods, and not several times within each, while a simulation runs.

    What a period allocates grows with the number of vehicles, and so does what each collection looks at: with a
    fixed threshold their product takes a quarter of the time of a run of 1000 vehicles. A collector that is
    switched off stays so.
    """
    before = gc.get_threshold()
    if before[0]:
        gc.set_threshold(max(before[0], OBJECTS_A_VEHICLE * vehicles), *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


ProcessCount = int | Literal["auto"]
"""Number of processes that run programs, or "auto": as many as this process may use cores."""
VEHICLES_A_PROCESS = 10
"""Least number of vehicles for each process of "auto": with fewer the exchanges cost more than is gained."""


def process_count(asked: ProcessCount | str, vehicles: int) -> int:
    """Return the number of processes for so many vehicles. Raises VnetError for what is neither N nor "auto"."""
    if asked == "auto":
        return max(1, min(_usable_cores(), vehicles // VEHICLES_A_PROCESS))
    try:
        count = int(asked) if isinstance(asked, str) else index(asked)
    except (TypeError, ValueError):
        count = 0
    if count < 1 or isinstance(asked, bool):
        raise VnetError(f"processes = {shown(asked)}: a whole number from 1, or auto, is expected")
    return min(count, vehicles)


def _usable_cores() -> int:
    """Return the number of cores that this process may use; elsewhere than on Linux all there are."""
    usable = getattr(os, "sched_getaffinity", None)
    return len(usable(0)) if usable else os.cpu_count() or 1


def split_evenly(node_ids: Sequence[str], processes: int) -> list[list[str]]:
    """Split nodes into consecutive parts of nearly equal size, one for each process, and none of them empty."""
    processes = min(processes, len(node_ids))
    ends = [len(node_ids) * part // processes for part in range(processes + 1)]
    return [list(node_ids[start:end]) for start, end in pairwise(ends)]
