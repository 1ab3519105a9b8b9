"""Time to compute the radio's figures: python -m benchmarks.radio_figures."""

import math
import time

import numpy as np
import pyarrow as pa

from emulator.checks.judge import RecordedRun
from emulator.records.radio_metrics import radio_metrics
from emulator.records.tables import STATES
from emulator.scenario.scenario import Scenario

PERIOD_NS = 100_000_000


def large(links: int, frames: int) -> RecordedRun:
    """Vehicles in which each hears all others: links × frames rows."""
    count = round(math.sqrt(links))
    rng = np.random.default_rng(1)
    sender, receiver = (axis.ravel() for axis in np.nonzero(~np.eye(count, dtype=bool)))
    rows = len(sender) * frames
    names = pa.array([f"v{n}" for n in range(count)])
    outcome = rng.choice(2, rows, p=[0.9, 0.1]).astype(np.int32)
    sent_ns = np.repeat(np.arange(frames) * PERIOD_NS, len(sender))
    columns = {
        "sent_ns": pa.array(sent_ns),
        "seq": pa.array(sent_ns // PERIOD_NS),
        "sender": pa.DictionaryArray.from_arrays(pa.array(np.tile(sender, frames).astype(np.int32)), names),
        "receiver": pa.DictionaryArray.from_arrays(pa.array(np.tile(receiver, frames).astype(np.int32)), names),
        "outcome": pa.DictionaryArray.from_arrays(pa.array(outcome), pa.array(["delivered", "lost"])),
        "arrival_ns": pa.array(sent_ns + rng.integers(1_000_000, 5_000_000, rows), mask=outcome == 1),
        "copy": pa.array(np.zeros(rows, np.int16)),
    }
    states = [{"period": 0, "time_ns": 0, "node": name} for name in names.to_pylist()]
    table = pa.Table.from_pylist(states, schema=STATES.schema)
    return RecordedRun(Scenario(), pa.table(columns), table, pa.table({}), [], rng.uniform(0, 3000, (1, count, 2)))


def main() -> None:
    """A million rows, of few links and of many."""
    radio_metrics(large(100, 100))  # what is loaded at first use
    for links in (2500, 10_000, 1_000_000):
        recorded = large(links, 1_000_000 // links)
        started, cpu_s = time.perf_counter(), time.process_time()
        told = radio_metrics(recorded)
        taken_s, cpu_s = time.perf_counter() - started, time.process_time() - cpu_s
        print(f"{len(recorded.trace):,} rows, {len(told.links):,} links: {taken_s:.2f} s, {cpu_s:.2f} s of CPU")


if __name__ == "__main__":
    main()
