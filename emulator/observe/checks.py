"""The checks: a run judged from its trace, states, metrics and events alone.

Each check is *valid*, *invalid* or *unknown* with its figures. A check that this scenario could not exercise (a cap
that nobody's neighbourhood exceeds) is left out and listed with its reason; one that should have seen something and
saw nothing is unknown.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.stats import binom

from emulator.channel.outcomes import Outcome
from emulator.observe.run_folder import Event, read_events
from emulator.observe.trace import read_trace, sha256_of_table
from emulator.world.links import load_links
from vnet.errors import VnetError
from vnet.roads.lanes import Array
from vnet.scenario import Scenario, load_scenario

LATE_SHARE_LIMIT = 0.001
LOSS_BAND = 0.999
IN_TRACE = tuple(o.name for o in Outcome if o not in (Outcome.pending, Outcome.out_of_range))


class Verdict(StrEnum):
    """What a check, or a run, comes to."""

    VALID = "valid"
    INVALID = "invalid"
    UNKNOWN = "unknown"

    @property
    def exit_status(self) -> int:
        """The exit status of a command that ends with this verdict."""
        return {Verdict.VALID: 0, Verdict.INVALID: 1, Verdict.UNKNOWN: 3}[self]


@dataclass(frozen=True)
class CheckResult:
    """One check's verdict, in words and figures."""

    name: str
    verdict: Verdict
    text: str
    figures: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class NotExercised:
    """A check that this run could not exercise, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class Evidence:
    """What the checks look at: the scenario, the three tables, and the events."""

    scenario: Scenario
    trace: pa.Table
    states: pa.Table
    metrics: pa.Table
    events: Sequence[Event]

    @cached_property
    def node_ids(self) -> list[str]:
        """The nodes in the order of their numbers, which is that of the states' rows."""
        first = self.states.filter(pc.equal(self.states["period"], 0))
        return [str(node) for node in first["node"].to_pylist()]

    @cached_property
    def number(self) -> dict[str, int]:
        """The number of each node."""
        return {node: number for number, node in enumerate(self.node_ids)}

    def number_of(self, node: str | None) -> int:
        """The number of a node that trace or events name. Raises VnetError if the states do not know it."""
        if node not in self.number:
            raise VnetError(f"node {node!r} in trace or events: the states know only {len(self.number)} others")
        return self.number[node]

    def column(self, name: str) -> NDArray[np.int64]:
        """A column of whole numbers of the trace."""
        return np.asarray(self.trace[name].to_numpy(), dtype=np.int64)

    def nodes(self, name: str) -> NDArray[np.intp]:
        """A column of node ids of the trace as numbers."""
        column = self.trace[name].combine_chunks()
        code = np.array([self.number_of(node) for node in column.dictionary.to_pylist()], dtype=np.intp)
        return np.asarray(code[column.indices.to_numpy()])

    def outcome_is(self, *names: str) -> NDArray[np.bool_]:
        """Which rows have one of these outcomes."""
        mask = pc.is_in(self.trace["outcome"].cast(pa.string()), pa.array(names))
        return np.asarray(mask.to_numpy(zero_copy_only=False), dtype=bool)

    def positions(self) -> Array:
        """True positions (periods, N, 2)."""
        flat = self.states["position_m"].combine_chunks().values.to_numpy()
        return np.asarray(flat, dtype=float).reshape(-1, len(self.node_ids), 2)

    @cached_property
    def links(self) -> NDArray[np.bool_] | None:
        """(N, N), who (row) hears whom (column), or None where the range decides. Raises ScenarioError."""
        return load_links(self.scenario.radio, len(self.node_ids))

    def event(self, *kinds: str) -> list[Event]:
        """The events of these kinds."""
        return [event for event in self.events if event.kind in kinds]

    def down_since_ns(self) -> Array:
        """(N,) since when each node was down; infinity for those that never were."""
        down = np.full(len(self.node_ids), np.inf)
        for event in self.event("died", "crashed", "finished", "spun"):
            if event.node is not None:
                number = self.number_of(event.node)
                down[number] = min(down[number], event.time_ns)
        return down


Check = Callable[[Evidence], CheckResult | NotExercised]


def _result(name: str, broken: int, text: str, broken_text: str, **figures: Any) -> CheckResult:
    if broken:
        return CheckResult(name, Verdict.INVALID, broken_text, figures)
    return CheckResult(name, Verdict.VALID, text, figures)


def _in_range(evidence: Evidence) -> NDArray[np.bool_]:
    """(N, N), rows are senders: who is in range of whom. Vehicles stand still but for their place in the lane."""
    if not len(evidence.states):  # a run that ended before its first period did
        return np.zeros((0, 0), dtype=bool)
    if evidence.links is not None:
        return evidence.links.T
    position_m = evidence.positions()[0]
    offset = position_m[:, None] - position_m[None]
    in_range = np.hypot(offset[..., 0], offset[..., 1]) <= evidence.scenario.radio.range_m
    np.fill_diagonal(in_range, False)
    return np.asarray(in_range)


def _nothing_seen(name: str, evidence: Evidence, text: str) -> CheckResult | NotExercised:
    """Nothing observed is unknown, unless there was nobody to observe it."""
    if not _in_range(evidence).any():
        return NotExercised(name, "no vehicle has another in range")
    return CheckResult(name, Verdict.UNKNOWN, text)


def check_conservation(evidence: Evidence) -> CheckResult | NotExercised:
    """Every frame has exactly one row, with exactly one outcome, for each receiver in range."""
    name = "conservation"
    if not len(evidence.trace):
        return _nothing_seen(name, evidence, "no frame was sent")
    sender, receiver = evidence.nodes("sender"), evidence.nodes("receiver")
    seq, copy = evidence.column("seq"), evidence.column("copy")
    rows = np.column_stack([sender, seq, receiver, copy])
    repeated = len(rows) - len(np.unique(rows, axis=0))
    frames, heard = np.unique(np.column_stack([sender, seq])[copy == 0], axis=0, return_counts=True)
    in_range = _in_range(evidence)
    wrong = int(np.sum(heard != in_range.sum(axis=1)[frames[:, 0]]))
    strangers = int(np.sum(~in_range[sender, receiver]))
    undecided = int(np.sum(~evidence.outcome_is(*IN_TRACE)))
    gaps = _missing_numbers(frames)
    broken = repeated + wrong + strangers + undecided + gaps
    figures = {
        "frames": len(frames),
        "pairs": len(rows),
        "repeated": repeated,
        "wrong_count": wrong,
        "not_in_range": strangers,
        "undecided": undecided,
        "missing_frames": gaps,
    }
    text = f"{len(frames):,} frames, {len(rows):,} pairs in range, each with one outcome"
    return _result(name, broken, text, f"{broken} frames or pairs without exactly one outcome", **figures)


def _missing_numbers(frames: NDArray[np.int64]) -> int:
    """How many sequence numbers below the last one of their sender are missing."""
    missing = 0
    for sender in np.unique(frames[:, 0]):
        seqs = frames[frames[:, 0] == sender, 1]
        missing += int(seqs.max()) + 1 - len(seqs)
    return missing


def check_range(evidence: Evidence) -> CheckResult | NotExercised:
    """Nothing reached a receiver out of range."""
    name = "range"
    delivered = evidence.outcome_is("delivered")
    if not delivered.any():
        return _nothing_seen(name, evidence, "nothing was delivered")
    reached = _in_range(evidence)[evidence.nodes("sender"), evidence.nodes("receiver")]
    beyond = int(np.sum(delivered & ~reached))
    count = int(delivered.sum())
    return _result(
        name,
        beyond,
        f"all {count:,} deliveries within range",
        f"{beyond} deliveries beyond range",
        delivered=count,
        beyond=beyond,
    )


def check_peer_cap(evidence: Evidence) -> CheckResult | NotExercised:
    """Each receiver hears its nearest `max_peers` live senders in range, and no other."""
    name = "peer_cap"
    cap = evidence.scenario.radio.max_peers
    in_range = _in_range(evidence)
    largest = int(in_range.sum(axis=0).max(initial=0))
    if largest <= cap:
        return NotExercised(name, f"no receiver has more than {cap} senders in range (at most {largest})")
    if not len(evidence.trace):
        return CheckResult(name, Verdict.UNKNOWN, "no frame was sent")
    sender, receiver, sent_ns = evidence.nodes("sender"), evidence.nodes("receiver"), evidence.column("sent_ns")
    capped = evidence.outcome_is("peer_cap")
    judged = capped | evidence.outcome_is("delivered", "lost", "receiver_down", "transport")
    wrong = 0
    down_ns = evidence.down_since_ns()
    edges = [-1.0, *sorted({float(t) for t in down_ns if np.isfinite(t)}), np.inf]
    for start, end in pairwise(edges):
        admitted = _admitted(evidence.positions()[0], in_range, down_ns > start, cap)
        # What was sent at the very instant of a death may have come before or after it: it is not judged.
        rows = judged & (sent_ns > start) & (sent_ns < end)
        wrong += int(np.sum(admitted[sender, receiver][rows] == capped[rows]))
    figures = {"cap": cap, "largest_in_range": largest, "capped": int(capped.sum()), "wrong": wrong}
    if not wrong and not capped.any():
        text = f"the cap of {cap} never acted, though up to {largest} are in range: those beyond it sent nothing"
        return CheckResult(name, Verdict.UNKNOWN, text, figures)
    text = f"{int(capped.sum()):,} pairs beyond the nearest {cap} (up to {largest} in range)"
    return _result(name, wrong, text, f"{wrong} pairs on the wrong side of the cap", **figures)


def _admitted(position_m: Array, in_range: NDArray[np.bool_], up: NDArray[np.bool_], cap: int) -> NDArray[np.bool_]:
    offset = position_m[:, None] - position_m[None]
    distance_m = np.where(in_range & up[:, None], np.hypot(offset[..., 0], offset[..., 1]), np.inf)
    admitted = np.zeros_like(in_range)
    for receiver in range(len(position_m)):
        nearest = sorted(range(len(position_m)), key=lambda s, r=receiver: (distance_m[s, r], s))[:cap]  # type: ignore[misc]
        admitted[[s for s in nearest if np.isfinite(distance_m[s, receiver])], receiver] = True
    return admitted


def check_loss_rate(evidence: Evidence) -> CheckResult | NotExercised:
    """The share of lost pairs lies in the binomial band of the scenario's loss."""
    name = "loss_rate"
    loss = evidence.scenario.radio.loss
    lost = int(evidence.outcome_is("lost").sum())
    drawn = lost + int(evidence.outcome_is("delivered", "receiver_down", "transport").sum())
    if drawn == 0:
        return _nothing_seen(name, evidence, "no pair came as far as the loss")
    low, high = (
        (int(edge) for edge in binom.interval(LOSS_BAND, drawn, loss)) if 0 < loss < 1 else (loss * drawn,) * 2
    )
    figures = {"lost": lost, "pairs": drawn, "rate": lost / drawn, "expected": loss, "low": low, "high": high}
    text = f"{lost:,} of {drawn:,} pairs lost, {lost / drawn:.2%}; {loss:.2%} expected"
    return _result(name, int(not low <= lost <= high), text, f"{text}: outside the {LOSS_BAND:.1%} band", **figures)


def check_transport(evidence: Evidence) -> CheckResult | NotExercised:
    """No message between agents and emulator went missing."""
    name = "transport"
    gaps = sum(int(event.details.get("count", 1)) for event in evidence.event("transport_gap"))
    lost = int(evidence.outcome_is("transport").sum())
    if gaps or lost:
        text = f"{gaps} gaps in sequence numbers, {lost} deliveries that never arrived: the machine, not the radio"
        return CheckResult(name, Verdict.UNKNOWN, text, {"gaps": gaps, "lost": lost})
    return CheckResult(name, Verdict.VALID, "no message between agents and emulator went missing", {"gaps": 0})


def check_agents_alive(evidence: Evidence) -> CheckResult | NotExercised:
    """No process died and no program crashed."""
    name = "agents_alive"
    gone = evidence.event("died", "crashed")
    if not gone and not evidence.event("started"):
        return CheckResult(name, Verdict.UNKNOWN, "no event says that the run started")
    if not gone:
        who = f"all {len(evidence.node_ids)} nodes" if evidence.node_ids else "all nodes"
        return CheckResult(name, Verdict.VALID, f"{who} to the end")
    first = gone[0]
    why = first.details.get("error") or first.details.get("how", "")
    when = f"{first.node} {first.kind} at {first.time_ns / 1e9:.3f} s"
    text = f"{len(gone)} of {len(evidence.node_ids) or 'the'} nodes: {when}: {why}"
    listed = [{"node": e.node, "time_ns": e.time_ns, "kind": e.kind, **e.details} for e in gone]
    return CheckResult(name, Verdict.INVALID, text, {"gone": listed})


def check_progress(evidence: Evidence) -> CheckResult | NotExercised:
    """The run came to its end: nobody span, nobody hung, nobody interrupted it."""
    name = "progress"
    if spun := evidence.event("spun"):
        event = spun[0]
        text = f"{event.node} goes on for ever at {event.time_ns / 1e9:.3f} s: {event.details.get('error')}"
        return CheckResult(name, Verdict.INVALID, text, {"node": event.node, **event.details})
    if stalled := evidence.event("stalled"):
        event = stalled[0]
        text = f"{event.node} hangs at {event.time_ns / 1e9:.3f} s: {event.details.get('error')}"
        return CheckResult(name, Verdict.UNKNOWN, text, {"node": event.node, **event.details})
    if interrupted := evidence.event("interrupted"):
        text = f"interrupted at {interrupted[0].time_ns / 1e9:.3f} s"
        return CheckResult(name, Verdict.UNKNOWN, text)
    if not evidence.event("ended"):
        return CheckResult(name, Verdict.UNKNOWN, "no event says that the run ended")
    due = evidence.scenario.duration_ns // evidence.scenario.period_ns
    if len(evidence.metrics) != due or len(evidence.states) != due * len(evidence.node_ids):
        text = f"{len(evidence.metrics)} periods kept, {due} due"
        return CheckResult(name, Verdict.UNKNOWN, text, {"periods": len(evidence.metrics), "due": due})
    return CheckResult(name, Verdict.VALID, f"{evidence.scenario.run.duration_s:g} s emulated to the end")


def check_finite(evidence: Evidence) -> CheckResult | NotExercised:
    """No report holds a number that is none."""
    name = "finite"
    reporting = int(np.sum(evidence.metrics["reporting"].to_numpy())) if len(evidence.metrics) else 0
    if reporting == 0:
        return NotExercised(name, "the program reports nothing")
    broken = int(np.sum(evidence.metrics["not_finite"].to_numpy()))
    return _result(
        name,
        broken,
        f"{reporting:,} reports, all numbers finite",
        f"{broken} reports with NaN or infinity",
        reports=reporting,
        not_finite=broken,
    )


def check_kept_up(evidence: Evidence) -> CheckResult | NotExercised:
    """Real time: the machine delivered on time."""
    name = "kept_up"
    if evidence.scenario.run.pacing != "realtime":
        return NotExercised(name, "in lockstep nothing can be late")
    late = evidence.event("late_deliveries")
    if not late or not late[-1].details["total"]:
        return CheckResult(name, Verdict.UNKNOWN, "no delivery was timed")
    figures = late[-1].details
    share = figures["count"] / figures["total"]
    text = f"{share:.3%} of {figures['total']:,} deliveries over 20 ms late (p99 {figures['p99_ms']:.1f} ms)"
    return CheckResult(name, Verdict.VALID if share <= LATE_SHARE_LIMIT else Verdict.UNKNOWN, text, figures)


CHECKS: tuple[Check, ...] = (
    check_conservation,
    check_range,
    check_peer_cap,
    check_loss_rate,
    check_transport,
    check_agents_alive,
    check_progress,
    check_finite,
    check_kept_up,
)
NEED_POSITIONS = (check_conservation, check_range, check_peer_cap, check_loss_rate)


@dataclass(frozen=True)
class Judgement:
    """All checks of a run and what they come to together: invalid wins over unknown, unknown over valid."""

    checks: list[CheckResult]
    not_exercised: list[NotExercised]
    trace_sha256: str

    @property
    def verdict(self) -> Verdict:
        """The verdict of the run."""
        verdicts = {check.verdict for check in self.checks}
        for verdict in (Verdict.INVALID, Verdict.UNKNOWN):
            if verdict in verdicts:
                return verdict
        return Verdict.VALID

    @property
    def exit_status(self) -> int:
        """The exit status of a command that ends with this judgement."""
        return self.verdict.exit_status


def judge(evidence: Evidence) -> Judgement:
    """Run all checks."""
    results = [_apply(check, evidence) for check in CHECKS]
    checks = [result for result in results if isinstance(result, CheckResult)]
    skipped = [result for result in results if isinstance(result, NotExercised)]
    return Judgement(checks, skipped, sha256_of_table(evidence.trace))


def _apply(check: Check, evidence: Evidence) -> CheckResult | NotExercised:
    """A run that ended within its first period has no states: who was in range of whom is not known."""
    if check in NEED_POSITIONS and not len(evidence.states):
        name = check.__name__.removeprefix("check_")
        return CheckResult(name, Verdict.UNKNOWN, "no period was completed, so nobody's position is known")
    return check(evidence)


def check_run(folder: Path) -> Judgement:
    """Judge a run from its folder. Raises VnetError if the folder is not a finished run's.

    A trace that is not the one whose hash the verdict holds makes the run invalid.
    """
    events = read_events(folder)
    try:
        trace = read_trace(folder / "trace.parquet")
        states = pq.read_table(folder / "states.parquet")
        metrics = pq.read_table(folder / "metrics.parquet")
        recorded = json.loads((folder / "verdict.json").read_text())["trace_sha256"]
    except (OSError, pa.ArrowInvalid, ValueError, KeyError) as error:
        raise VnetError(f"{folder}: not the folder of a finished run: {error}") from None
    judgement = judge(Evidence(load_scenario(folder / "scenario.toml"), trace, states, metrics, events))
    if judgement.trace_sha256 != recorded:
        text = f"the trace is not the one that verdict.json speaks of ({recorded[:12]}…)"
        judgement.checks.append(CheckResult("trace_sha256", Verdict.INVALID, text))
    return judgement
