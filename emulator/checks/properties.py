"""Properties over time of a finished run: what is always, never or finally true, and what follows what.

A predicate is asked at each *moment*: once for each vehicle and period in which it is in the network, and at each
event. It answers True, False, or None where it has nothing to say. A moment that has no value of a name that the
predicate reads, as a vehicle that is down, is skipped. Each function returns a `Result`, for a check of one's own;
a failure says when, who, and what had happened to the vehicle before. What could be otherwise with events that were
left out, because a vehicle had too many, is unknown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from emulator.checks.own import Result
from emulator.records.events import EventKind
from emulator.records.parting import before
from emulator.records.run import Run
from vnet.errors import VnetError, counted
from vnet.units import NS_PER_S

MOST_TOLD = 10
"""Failures whose time and vehicle are told."""
PERIOD, EVENT, ANY = "period", "event", "any"
FAULT_EVENTS = (EventKind.fault_started, EventKind.fault_ended)
_ROUNDING_S = 1e-9


class NoValue(KeyError):
    """A moment has no value of this name."""


@dataclass(frozen=True)
class Moment:
    """One vehicle at one time: at a period's start, or at an event of it.

    `values` has, by name, what it reported last in the period (`m["speed_m_s"]`), and the columns of states, with
    the truth: `position_m`, `common_error_m` …; of an event its details. `fault_started` and `fault_ended` are
    events of each node on which the fault acted when it started, with `fault`, its label, and `kind`.
    """

    time_ns: int
    node: str
    event: str = ""
    """Name of the event of the program, or vnet's kind of event, as "crashed"; "" at a period."""
    values: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the event, as `name` of an event of `run.events`."""
        return self.event

    @property
    def time_s(self) -> float:
        """Emulated seconds."""
        return self.time_ns / NS_PER_S

    def __getitem__(self, name: str) -> Any:
        """Return a value. Raises NoValue where there is none: the property then skips the moment."""
        if name not in self:
            raise NoValue(name)
        return self.values[name]

    def __contains__(self, name: str) -> bool:
        return self.get(name) is not None

    def get(self, name: str, default: Any = None) -> Any:
        """Return a value, or the default where there is none: the property then asks of the moment all the same."""
        value = self.values.get(name)
        numbers = value if isinstance(value, list) and value else [value]  # `fix_m` in an outage is two of NaN
        is_missing = all(each is None or (isinstance(each, float) and math.isnan(each)) for each in numbers)
        return default if is_missing else value


Predicate = Callable[[Moment], bool | None]
Effect = Callable[[Moment, Moment], bool | None]
"""Predicate of an effect, which is given the moment of its cause, too."""


def moments(run: Run, at: str = PERIOD) -> list[Moment]:
    """Return the moments of a run in the order of time: `at` each "period", each "event", or "any" of both.

    Raises VnetError for another `at`.
    """
    if at not in (PERIOD, EVENT, ANY):
        raise VnetError(f"at = {at!r}: must be {PERIOD!r}, {EVENT!r} or {ANY!r}")
    periods = _periods(run) if at != EVENT else ()
    events = _events(run) if at != PERIOD else ()
    return sorted([*events, *periods], key=lambda moment: moment.time_ns)


def _periods(run: Run) -> Iterator[Moment]:
    rows = run.states.to_pylist()
    # Of what has no column, numbers are lists of one.
    lists = {name for row in rows for name, value in row.get("values") or () if len(value) != 1}
    for row in rows:
        if not np.isnan(row["position_m"]).any():
            more = {name: value if name in lists else value[0] for name, value in row.get("values") or ()}
            yield Moment(row["time_ns"], row["node"], values=more | row)


def _events(run: Run) -> Iterator[Moment]:
    kinds = {f"{fault.title}-{number}": fault.kind for number, fault in enumerate(run.scenario.fault)}
    affected: dict[str, list[str]] = {}
    for event in run.events:
        if event.kind in FAULT_EVENTS:
            label, nodes = str(event.details.get("fault")), event.details.get("nodes")
            affected.setdefault(label, nodes if isinstance(nodes, list) else [])
            for node in affected[label]:
                yield Moment(event.time_ns, node, event.kind, {"fault": label, "kind": kinds.get(label)})
        elif event.node is not None:
            yield Moment(event.time_ns, event.node, event.name, event.values)


def always(run: Run, name: str, predicate: Predicate, at: str = PERIOD) -> Result:
    """Judge that a predicate is true at every moment that has the values that it reads; unknown if none has.

    Raises VnetError for a predicate that answers anything but True, False or None; so do the other functions.
    """
    return _held(run, name, predicate, at, True)


def never(run: Run, name: str, predicate: Predicate, at: str = PERIOD) -> Result:
    """Judge that a predicate is true at no moment; unknown if it has nothing to say at any.

    A run without any event is valid for `at="event"`.
    """
    return _held(run, name, predicate, at, False)


def eventually(
    run: Run,
    name: str,
    predicate: Predicate,
    within_s: float = math.inf,
    at: str = PERIOD,
    nodes: Collection[str] | None = None,
) -> Result:
    """Judge that a predicate becomes true of each vehicle, within so many seconds of its coming into the network.

    `nodes` are the vehicles of which it is asked, by default all; one without any moment fails as well. With
    `within_s` it is asked of each stay in the network; one that is shorter, as before the end of the run, counts
    only if the predicate has come true. Unknown if the run has no vehicle of such a name.
    """
    _check_within(name, within_s)
    if missing := sorted({*(nodes or ())} - {*run.nodes}):
        return Result(name, "unknown", f"there is no vehicle {', '.join(missing)}")
    present = moments(run)
    among = [moment for moment in present if nodes is None or moment.node in nodes]
    stays = _stays(among, math.inf if math.isinf(within_s) else _period_ns(run))
    reached: dict[tuple[str, int], float] = {}
    for moment in present if at == PERIOD else moments(run, at):
        mine = stays.get(moment.node, ())
        entered_ns = max((since_ns for since_ns, _ in mine if since_ns <= moment.time_ns), default=None)
        if entered_ns is None or (moment.node, entered_ns) in reached:
            continue
        waited_s = (moment.time_ns - entered_ns) / NS_PER_S
        if waited_s <= within_s + _ROUNDING_S and _ask(name, predicate, moment):
            reached[moment.node, entered_ns] = waited_s
    late = [
        Moment(since_ns, node)
        for since_ns, node, last_ns in sorted((since, node, last) for node in stays for since, last in stays[node])
        if (node, since_ns) not in reached
        and (math.isinf(within_s) or since_ns + within_s * NS_PER_S <= last_ns + _period_ns(run) + 1)
    ]
    gone, within_ns = _events_gone(run, at), within_s * NS_PER_S
    if surely := [each for each in late if each.node not in gone or gone[each.node] > each.time_ns + within_ns]:
        limit = "" if math.isinf(within_s) else f" within {within_s:g} s"
        return _failed(run, name, surely, f"never came true{limit}")
    if late:
        return _unheard(run, name)
    if not reached:
        why = f"no vehicle is there for {within_s:g} s" if stays else "no such vehicle enters the network"
        return Result(name, "unknown", why)
    slowest_s = max(reached.values())
    text = f"true of {counted(len({node for node, _ in reached}), 'vehicle')} within {slowest_s:g} s"
    return Result(name, "valid", text, {"slowest_s": slowest_s})


def _stays(present: Sequence[Moment], gap_ns: float) -> dict[str, list[tuple[int, int]]]:
    """Return the first and the last time in ns of each stay of each vehicle; longer gaps end one."""
    stays: dict[str, list[tuple[int, int]]] = {}
    for moment in present:
        mine = stays.setdefault(moment.node, [])
        goes_on = mine and moment.time_ns - mine[-1][1] <= gap_ns
        since_ns = mine.pop()[0] if goes_on else moment.time_ns
        mine.append((since_ns, moment.time_ns))
    return stays


def leads_to(
    run: Run,
    name: str,
    cause: Predicate,
    effect: Effect,
    within_s: float,
    *,
    at: str = ANY,
    effect_at: str | None = None,
) -> Result:
    """Judge that each moment at which `cause` is true is followed, within so many seconds, by one of `effect`.

    `effect(moment, cause)` is given both moments: it says whether they belong together, for example
    `moment.node == cause.node`. A cause less than `within_s` before the end of the run counts only if its effect
    came. `at` says at what moments causes are looked for, `effect_at` the same of effects, by default as `at`. The
    time of a period is its start, and that of its last report is not recorded: what a period has as an effect
    counts if the period ends after its cause.
    """
    _check_within(name, within_s)
    causes = [moment for moment in moments(run, at) if _ask(name, cause, moment)]
    effects = moments(run, effect_at or at)
    times_ns = np.array([moment.time_ns for moment in effects], dtype=np.int64)
    period_ns, end_ns = _period_ns(run), _end_ns(run, effect_at or at)
    within_ns = round(min(within_s * NS_PER_S, end_ns))
    gone = _events_gone(run, effect_at or at)
    failed, delays_s, is_unheard = [], [], bool(_events_gone(run, at))
    for moment in causes:
        since_ns = moment.time_ns - (period_ns - 1 if moment.event else 0)
        first, last = np.searchsorted(times_ns, [since_ns, moment.time_ns + within_ns + 1])
        found = (each for each in effects[first:last] if each.time_ns >= moment.time_ns or not each.event)
        if effect_of := next((each for each in found if _ask(name, effect, each, moment)), None):
            delays_s.append(max(0.0, effect_of.time_s - moment.time_s))
        elif not (math.isinf(within_s) or moment.time_ns + within_ns < end_ns):
            continue
        elif any(since_ns <= moment.time_ns + within_ns for since_ns in gone.values()):
            is_unheard = True
        else:
            failed.append(moment)
    if failed:
        limit = "" if math.isinf(within_s) else f" within {within_s:g} s"
        return _failed(run, name, failed, f"was not followed{limit}", of=len(causes))
    if is_unheard:
        return _unheard(run, name)
    if not delays_s:
        late = f"{counted(len(causes), 'cause')} came less than {within_s:g} s before the end of the run"
        return Result(name, "unknown", late if causes else "the cause never came true")
    slowest_s = max(delays_s)
    text = f"{counted(len(delays_s), 'cause')} followed by an effect within {slowest_s:g} s"
    return Result(name, "valid", text, {"slowest_s": slowest_s})


def _period_ns(run: Run) -> int:
    return round(run.period_s * NS_PER_S)


def _end_ns(run: Run, at: str) -> int:
    """Return the time up to which a run has such moments: periods that are complete, or events to its end."""
    periods_ns = len(run.times_s) * _period_ns(run)
    ended = [event.time_ns for event in run.events if event.kind == EventKind.ended]
    return max([periods_ns, *ended]) if at == EVENT else periods_ns


def _left_out(run: Run) -> dict[str, int]:
    """Return how many events of each vehicle's program were left out."""
    told = [event for event in run.events if event.kind == EventKind.left_out and event.details["what"] == "event"]
    return {str(event.node): int(event.details["count"]) for event in told}


def _events_gone(run: Run, at: str) -> dict[str, int]:
    """Return the vehicles of which events among such moments were left out, with the time of the last one kept."""
    out = {} if at == PERIOD else _left_out(run)
    kept = [event for event in run.events if event.kind == EventKind.event and event.node in out]
    return {str(event.node): event.time_ns for event in kept}


def _unheard(run: Run, name: str) -> Result:
    """Return the result of a property that depends on events that were left out."""
    out = _left_out(run)
    first, others = min(out), f" and {counted(len(out) - 1, 'other')}" if len(out) > 1 else ""
    count = counted(sum(out.values()), "event")
    return Result(name, "unknown", f"{count} of {first}{others} were left out: there were too many")


def _check_within(name: str, within_s: float) -> None:
    if not within_s >= 0:
        raise VnetError(f"{name}: within_s = {within_s!r}: 0 or more seconds are needed")


def _ask(
    name: str, predicate: Callable[..., object], *moments: Moment, missing: set[str] | None = None
) -> bool | None:
    """Return the answer of a predicate; None also where a moment has no value that it reads.

    `missing` gets the name of that value. Numbers, as programs report them, are true or false as in Python.
    """
    try:
        answer = predicate(*moments)
    except NoValue as error:
        if missing is not None:
            missing.add(error.args[0])
        return None
    if answer is None or isinstance(answer, bool | np.bool_ | int | float | np.number):
        return None if answer is None else bool(answer)
    raise VnetError(f"{name}: the predicate answered {answer!r}: True, False or None is needed")


def _held(run: Run, name: str, predicate: Predicate, at: str, wanted: bool) -> Result:
    missing: set[str] = set()
    answers = [(moment, _ask(name, predicate, moment, missing=missing)) for moment in moments(run, at)]
    asked = [(moment, held) for moment, held in answers if held is not None]
    failed = [moment for moment, held in asked if held is not wanted]
    if failed:
        return _failed(run, name, failed, "is false" if wanted else "is true", of=len(asked))
    is_quiet = at == EVENT and not answers  # nothing has happened, so nothing that never may
    if not asked and (wanted or not is_quiet):
        values = "".join(f": none has a value {value!r}" for value in sorted(missing)[:1])
        return Result(name, "unknown", f"the predicate had nothing to say at any moment{values}")
    if _events_gone(run, at):
        return _unheard(run, name)
    of = f"{len(asked):,} of " if len(asked) < len(answers) else ""
    text = f"{'true' if wanted else 'false'} at {of}{counted(len(answers), 'moment')}"
    return Result(name, "valid", text, {"moments": len(asked)})


def _failed(run: Run, name: str, failed: list[Moment], problem: str, of: int | None = None) -> Result:
    """Return an invalid result that names the first failure, and what led there."""
    first = failed[0]
    many = f" ({len(failed)}{'' if of is None else f' of {of}'} in all)" if len(failed) > 1 else ""
    event = f", event {first.event}" if first.event else ""
    text = f"{problem}: first of {first.node} at {first.time_s:g} s{event}{many}"
    rows = [{"node": moment.node, "time_s": moment.time_s} for moment in failed[:MOST_TOLD]]
    led = before(run.trace, run.events, first.node, first.time_ns)
    return Result(name, "invalid", text, {"rows": rows, "before": led})
