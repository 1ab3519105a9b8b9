"""Runs from Python: `emulator.simulate` and `emulator.run`, which do what the commands of these names do.

A run's programs need a process with hash seed 0 and an arithmetic that no processor changes, as the commands have.
Where this process is not like that, a worker process runs them; only a function that no other process can import is
run here all the same, and then the verdict says that a replay is not warranted.
"""

from __future__ import annotations

import contextvars
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from html import escape
from pathlib import Path
from typing import Any

from emulator.cells.worker import (
    Place,
    Worker,
    call_fitly,
    checked_function,
    entry_of,
    is_fit,
    is_importable,
    name_of,
    require_importable,
    with_folder_of,
)
from emulator.drivers.session import Local, Session, over_zenoh
from emulator.drivers.simulate import ProcessCount
from emulator.records.run import Run
from emulator.scenario.loading import Source, hinting, scenario_of
from emulator.scenario.scenario import Scenario
from vnet.runtime.programs import Program, given_programs

__all__ = ["Run", "run", "simulate"]

HEIGHT_PX = 640
"""Height of a run's report in a notebook."""


@hinting
def simulate(
    scenario: Source,
    *,
    program: str | Program | None = None,
    seed: int | None = None,
    duration_s: float | None = None,
    set: Mapping[str, Any] | None = None,
    checks: Sequence[str] = (),
    out: str | Path | None = None,
    processes: ProcessCount = 1,
) -> Run:
    """Simulate a scenario, in lockstep, and return the finished run: what `vnet simulate` does.

    `scenario` is a path, the name of a scenario that is shipped ("twelve"; an existing path wins), or a dict with
    the sections of a scenario. What is given besides changes it: `program`, an async function of one argument or
    "module:function" or "file.py"; `seed`; `duration_s`, the emulated length in seconds; `set`, values by
    "section.key"; `checks`, checks of your own as "module:function" or "file.py", after those of the scenario.
    `out` is the folder of the run's files; by default the next free one of runs/NAME-SEED, NAME-SEED-2, ….
    `processes` run the programs side by side, with the same trace: a number, or "auto" for as many as there are
    cores.

    The same call gives the same trace, from a script, a notebook or a running event loop. A function that other
    processes cannot import (a notebook's, a closure) runs in this process; the verdict's check `replay` says why a
    replay is then not warranted. Raises VnetError, in one line, for input that cannot be used, and
    KeyboardInterrupt after Ctrl-C, once what there is has been written.
    """
    function = checked_function(program)
    changes = _changes(program, seed, duration_s, set) | {"run.pacing": "lockstep"}
    loaded = with_folder_of(function, scenario_of(scenario, changes, checks))
    folder = None if out is None else Path(out)
    if function is None or is_importable(function):
        if is_fit():
            path = _interruptible(lambda stop: simulate_into(loaded, folder, stop, processes=processes))
        else:
            how = loaded, folder, None, "", processes
            path = call_fitly(Place.here(loaded), simulate_into, *how, stall_limit_s=loaded.run.stall_timeout_s)
        return Run.open(path)
    why = _why_not_warranted(function)
    with given_programs({loaded.program.entry: function}):
        return Run.open(_interruptible(lambda stop: simulate_into(loaded, folder, stop, why, processes)))


@hinting
def run(
    scenario: Source,
    *,
    program: str | Program | None = None,
    pacing: str | None = None,
    seed: int | None = None,
    duration_s: float | None = None,
    set: Mapping[str, Any] | None = None,
    checks: Sequence[str] = (),
    out: str | Path | None = None,
) -> Run:
    """Run a scenario with a process for each vehicle, and return the finished run: what `vnet run` does.

    Arguments are those of `simulate`; and `pacing`, "lockstep" or "realtime". The vehicles' processes must be able
    to import the program: a function is taken if it is in a module that they find, else ProgramError says so.
    Raises VnetError, in one line, for input that cannot be used, and KeyboardInterrupt after Ctrl-C, once what
    there is has been written.
    """
    require_importable(program, "run")
    changes = _changes(program, seed, duration_s, set) | {"run.pacing": pacing}
    loaded = with_folder_of(checked_function(program), scenario_of(scenario, changes, checks))
    worker = Worker(Place.here(loaded))  # of its own: Zenoh's threads stay in it
    try:
        return Run.open(worker.call(run_into, loaded, None if out is None else Path(out)))
    finally:
        worker.close()


def simulate_into(
    scenario: Scenario,
    out: Path | None,
    stop: threading.Event | None = None,
    replay: str = "",
    processes: ProcessCount = 1,
) -> Path:
    """Simulate from this process and judge the run; returns its folder. `replay` says why none is warranted."""
    session = Session(scenario, out, Local(processes)).open()
    session.run(stop=stop)
    session.close(replay)
    return _folder_of(session)


def run_into(scenario: Scenario, out: Path | None) -> Path:
    """Run with real processes and judge the run; returns its folder."""
    session = Session(scenario, out, over_zenoh).open()
    session.run()
    session.close()
    return _folder_of(session)


def _folder_of(session: Session) -> Path:
    """Return the folder of a run that is over. Raises KeyboardInterrupt if it was interrupted."""
    if session.interrupted:
        raise KeyboardInterrupt
    return session.folder.path.absolute()


def _interruptible(work: Callable[[threading.Event], Path]) -> Path:
    """Do `work` on a thread of its own, because this one may run an event loop; Ctrl-C sets the event."""
    done: Future[Path] = Future()
    stop = threading.Event()
    context = contextvars.copy_context()

    def do() -> None:
        try:
            done.set_result(context.run(work, stop))
        except BaseException as error:
            done.set_exception(error)

    threading.Thread(target=do, name="vnet simulate", daemon=True).start()
    while True:
        try:
            return done.result()
        except KeyboardInterrupt:
            if done.done() or stop.is_set():
                raise
            stop.set()


# Programs.


def _changes(
    program: str | Program | None, seed: int | None, duration_s: float | None, more: Mapping[str, Any] | None
) -> dict[str, Any]:
    """The changes of a scenario, by key."""
    named = {"program.entry": entry_of(program), "run.seed": seed, "run.duration_s": duration_s}
    return {**(more or {}), **{key: value for key, value in named.items() if value is not None}}


def _why_not_warranted(function: Program) -> str:
    why = f"not warranted: the program is {name_of(function)}, which no command can import"
    if is_fit():
        return why
    return f"{why}, and this process has not PYTHONHASHSEED=0 and the arithmetic of other processors"


def framed_report(run: Run) -> str:
    """Return the report as a notebook shows it, in a frame that reaches nothing of the notebook.

    Raises VnetError if the folder is not a run's any more.
    """
    from emulator.report.source import Source  # slow to import, and only notebooks need it
    from emulator.report.write import report_page

    page = escape(report_page(Source(run.folder)))
    # Scripts run, but in an origin of their own: they see neither the notebook nor its cookies.
    return (
        f'<iframe title="vnet report" sandbox="allow-scripts" style="width:100%;height:{HEIGHT_PX}px;border:0" '
        f'srcdoc="{page}"></iframe>'
    )


Run.html = framed_report
