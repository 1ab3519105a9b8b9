"""Frames to one receiver in both simulators: the share acknowledged, attempts, and frames a second."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.ns3.simulators import RADIO, MissingError, build
from emulator.radio.engine import Engine
from emulator.scenario.scenario import Radio
from vnet.radio import SentFrame

PROGRAM = Path(__file__).with_name("unicast.cc")
OUT = Path("build") / "ns3"
SIZE_BYTES = 300
RADIUS_M = 50.0
SATURATED_QUEUE = 3
"""Frames that a saturated sender has waiting, always: few, as ns-3 drops those that wait for 500 ms."""
NO_LATENCY = {"latency_ms": 0.001, "jitter_ms": 0.0}
"""Latency with which a saturated sender knows of a result before its queue is empty."""
SENDERS = (1, 2, 5, 10, 20)
LOSSES = (0.0, 0.3)
SHARE_LIMIT, ATTEMPTS_LIMIT, RATE_LIMIT = 0.015, 0.05, 0.03
"""Largest differences: of the share acknowledged, and relative ones of attempts and of frames a second."""


@dataclass(frozen=True)
class Exchange:
    """Frames to one receiver: the share acknowledged, mean attempts, and frames received in a second."""

    acknowledged: float
    attempts: float
    received_per_s: float


@dataclass(frozen=True)
class Case:
    """Saturated senders, or periodic ones with an interval in ms; the probability that a frame is lost."""

    senders: int
    loss: float
    interval_ms: float = 0.0


CASES = [
    *(Case(senders, loss) for loss in LOSSES for senders in SENDERS),
    *(Case(senders, loss, 20.0) for loss in LOSSES for senders in SENDERS if loss == 0 or senders <= 10),
]
"""20 senders with losses are left out: they send more than the medium can carry, and queues differ."""


def ns3_exchange(program: Path, case: Case, seconds: float) -> Exchange:
    """Return the figures of ns-3. Raise MissingError if the program fails."""
    arguments = [f"--senders={case.senders}", f"--loss={case.loss}", f"--interval_ms={case.interval_ms}"]
    arguments += [f"--seconds={seconds:g}", f"--bytes={SIZE_BYTES}", f"--radius={RADIUS_M}"]
    done = subprocess.run([program, *arguments], capture_output=True, text=True)
    if done.returncode:
        raise MissingError(f"{program.name} ended with status {done.returncode}: {done.stderr.strip()[-200:]}")
    found = json.loads(done.stdout)
    return Exchange(
        found["acked"] / found["begun"], found["transmitted"] / found["begun"], found["received"] / seconds
    )


def our_exchange(case: Case, seconds: float) -> Exchange:
    """Return the figures of vnet's engine."""
    angle = 2 * np.pi * np.arange(case.senders) / case.senders
    circle_m = RADIUS_M * np.column_stack([np.cos(angle), np.sin(angle)])
    radio = Radio.model_validate({**RADIO, "loss": case.loss, **NO_LATENCY})
    ids = [f"v{number}" for number in range(case.senders + 1)]
    engine = Engine(ids, radio, 1, np.vstack([[[0.0, 0.0]], circle_m]))
    end_ns = round(seconds * 1e9)
    (_saturate if case.interval_ms == 0 else _send_regularly)(engine, case, end_ns)
    trace = engine.trace
    acked = trace.to_table()["acked"].to_numpy(zero_copy_only=False)
    attempt, outcome = trace.to_table()["attempt"].to_numpy(), trace.to_table()["outcome"].to_pylist()
    begun, received = int((attempt == 1).sum()), outcome.count("delivered")
    return Exchange(float(acked.sum()) / begun, len(attempt) / begun, received / seconds)


def _send(engine: Engine, time_ns: int, sender: int) -> None:
    engine.transmit(time_ns, sender, [SentFrame("", bytes(SIZE_BYTES), to="v0")])


def _saturate(engine: Engine, case: Case, end_ns: int) -> None:
    """Have one more frame of a sender wait whenever the result of one is known."""
    for sender in range(1, case.senders + 1):
        for number in range(SATURATED_QUEUE):
            _send(engine, 100_000 * sender + number, sender)
    engine.look_ahead(end_ns, ())
    while (time_ns := engine.next_result_ns()) is not None and time_ns < end_ns:
        engine.advance(time_ns)
        for result in engine.take_results(time_ns):
            _send(engine, time_ns, result.sender)
        engine.look_ahead(end_ns, ())
    engine.advance(end_ns)


def _send_regularly(engine: Engine, case: Case, end_ns: int) -> None:
    """Have each sender send at a random instant of every interval."""
    interval_ns = round(case.interval_ms * 1e6)
    draws = np.random.default_rng(case.senders)
    starts_ns = np.arange(0, end_ns, interval_ns)[:, None]
    times_ns = starts_ns + draws.integers(0, interval_ns, (len(starts_ns), case.senders))
    order = np.argsort(times_ns, axis=None, kind="stable")
    for place in order.tolist():
        _send(engine, int(times_ns.ravel()[place]), 1 + place % case.senders)
    engine.drain()


@dataclass(frozen=True)
class Comparison:
    """One case in ns-3 and in vnet."""

    case: Case
    theirs: Exchange
    ours: Exchange

    @property
    def holds(self) -> bool:
        """True if both agree."""
        theirs, ours = self.theirs, self.ours
        return (
            abs(ours.acknowledged - theirs.acknowledged) <= SHARE_LIMIT
            and abs(ours.attempts / theirs.attempts - 1) <= ATTEMPTS_LIMIT
            and abs(ours.received_per_s / theirs.received_per_s - 1) <= RATE_LIMIT
        )

    def row(self) -> str:
        """Return a row of a table for the documentation."""
        kind = "always" if self.case.interval_ms == 0 else f"every {self.case.interval_ms:g} ms"
        theirs, ours = self.theirs, self.ours
        return (
            f"| {self.case.senders} | {kind} | {self.case.loss:g} "
            f"| {theirs.acknowledged:.3f} → {ours.acknowledged:.3f} | {theirs.attempts:.3f} → {ours.attempts:.3f} "
            f"| {theirs.received_per_s:.0f} → {ours.received_per_s:.0f} |"
        )

    def figures(self) -> dict[str, Any]:
        """Return the figures for a JSON file."""
        return {**asdict(self), "holds": self.holds}


def main() -> int:
    """Compare all cases: status 0 if they agree, 1 if not, 2 if ns-3 is not there."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ns3.acknowledged")
    parser.add_argument("--seconds", type=float, default=10.0, help="emulated time of each case")
    parser.add_argument("--out", type=Path, default=OUT, help="folder for a JSON file")
    options = parser.parse_args()
    comparisons = []
    try:
        with tempfile.TemporaryDirectory(prefix="vnet-ns3-") as folder:
            program = build(Path(folder), PROGRAM)
            for case in CASES:
                theirs = ns3_exchange(program, case, options.seconds)
                comparisons.append(Comparison(case, theirs, our_exchange(case, options.seconds)))
                print(comparisons[-1].row(), flush=True)
    except MissingError as error:
        print(error, file=sys.stderr)
        return 2
    options.out.mkdir(parents=True, exist_ok=True)
    figures = [one.figures() for one in comparisons]
    (options.out / "acknowledged.json").write_text(json.dumps(figures, indent=2) + "\n")
    return 0 if all(one.holds for one in comparisons) else 1


if __name__ == "__main__":
    sys.exit(main())
