"""Single edits of a finished run's folder, and the check of `vnet check` that finds each.

The table of docs/checks.md is made from this list, and a test makes every edit.
"""

import hashlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from emulator.radio.trace import payload_digest, sha256_of_table
from emulator.records.metrics import rows_of, sha256_of_rows

MS = 1_000_000
Rows = list[dict[str, Any]]
Change = Callable[[Rows], Rows | None]


@dataclass(frozen=True)
class Edit:
    """An edit; `found_by` is the check that finds it though all digests were made again, or "" and `why` not."""

    what: str
    apply: Callable[[Path], None]
    found_by: str
    why: str = ""


def table(name: str, change: Change) -> Callable[[Path], None]:
    """Return what changes the rows of a table."""

    def apply(folder: Path) -> None:
        path = folder / f"{name}.parquet"
        kept = pq.read_table(path)
        rows = kept.to_pylist()
        changed = change(rows)
        pq.write_table(pa.Table.from_pylist(rows if changed is None else changed, schema=kept.schema), path)

    return apply


def each(
    name: str, column: str, new: Callable[[dict[str, Any]], Any], where: Callable[[dict[str, Any]], bool]
) -> Any:
    """Return what gives a column of a table another value in the rows that `where` chooses."""

    def change(rows: Rows) -> None:
        chosen = [row for row in rows if where(row)]
        assert chosen, f"no row of the {name} to edit"
        for row in chosen:
            row[column] = new(row)

    return table(name, change)


def one(
    name: str, column: str, new: Callable[[dict[str, Any]], Any], where: Callable[[dict[str, Any]], bool]
) -> Any:
    """Return the same for the first row alone."""

    def change(rows: Rows) -> None:
        row = next(row for row in rows if where(row))
        row[column] = new(row)

    return table(name, change)


def verdict(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    """Return what changes verdict.json."""

    def apply(folder: Path) -> None:
        path = folder / "verdict.json"
        data = json.loads(path.read_text())
        change(data)
        path.write_text(json.dumps(data))

    return apply


def events(change: Change) -> Callable[[Path], None]:
    """Return what changes the events."""

    def apply(folder: Path) -> None:
        path = folder / "events.jsonl"
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        changed = change(rows)
        path.write_text("".join(json.dumps(row) + "\n" for row in (rows if changed is None else changed)))

    return apply


def scenario(old: str, new: str) -> Callable[[Path], None]:
    """Return what changes a line of scenario.toml."""

    def apply(folder: Path) -> None:
        path = folder / "scenario.toml"
        assert path.read_text().count(old) == 1, old
        path.write_text(path.read_text().replace(old, new))

    return apply


def world(name: str, change: Callable[[Any], Any]) -> Callable[[Path], None]:
    """Return what changes an array of world.npz."""

    def apply(folder: Path) -> None:
        path = folder / "world.npz"
        arrays = dict(np.load(path))
        arrays[name] = change(arrays[name])
        file = io.BytesIO()
        np.savez_compressed(file, **arrays)
        path.write_bytes(file.getvalue())

    return apply


def forge(folder: Path) -> None:
    """Make all digests again, as a forger does who knows them."""
    path = folder / "verdict.json"
    data = json.loads(path.read_text())
    data["trace_sha256"] = sha256_of_table(pq.read_table(folder / "trace.parquet").unify_dictionaries())
    data["metrics_sha256"] = sha256_of_rows(rows_of(pq.read_table(folder / "metrics.parquet")))
    path.write_text(json.dumps(data))
    names = json.loads((folder / "manifest.json").read_text())
    digests = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}
    (folder / "manifest.json").write_text(json.dumps(digests))


def moved(row: dict[str, Any], column: str, by: float) -> list[float]:
    x, y = row[column]
    return [x + by, y]


def reported(row: dict[str, Any]) -> bool:
    return row["estimate_m"] is not None and row["period"] > 10


def later(row: dict[str, Any]) -> bool:
    return bool(row["period"] == 20)


def of_faults(row: dict[str, Any]) -> bool:
    return row["kind"] in ("fault_started", "fault_ended", "restarted")


def delivered(row: dict[str, Any]) -> bool:
    return bool(row["outcome"] == "delivered" and row["sent_ns"] > 500 * MS)


def lose_a_link(rows: Rows) -> None:
    """Lose all of one link, and deliver as many that were lost on others."""
    mine = [row for row in rows if delivered(row) and (row["sender"], row["receiver"]) == ("v01", "v02")]
    others = [row for row in rows if row["outcome"] == "lost" and row["sender"] != "v01"][: len(mine)]
    assert len(mine) == len(others) > 5
    for row, other in zip(mine, others, strict=True):
        late_ns = row["arrival_ns"] - row["sent_ns"]
        row["outcome"], row["arrival_ns"] = "lost", None
        other["outcome"], other["arrival_ns"] = "delivered", other["sent_ns"] + late_ns


def move_frames(rows: Rows) -> None:
    """Send all frames of the last second, and have them arrive, 1 ms later."""
    for row in rows:
        if row["sent_ns"] >= 3_000 * MS:
            row["sent_ns"] += MS
            row["arrival_ns"] = row["arrival_ns"] and row["arrival_ns"] + MS


def change_payload(rows: Rows) -> None:
    first = next(row for row in rows if delivered(row))
    mine = [row for row in rows if (row["sender"], row["seq"]) == (first["sender"], first["seq"])]
    for row in mine:
        row["payload_digest"] = payload_digest(b"another")


def swap_periods(rows: Rows) -> Rows:
    count = sum(row["period"] == 0 for row in rows)
    return [*rows[count : 2 * count], *rows[:count], *rows[2 * count :]]


def swapped(names: Any) -> Any:
    names[[0, 1]] = names[[1, 0]]
    return names


def shifted(array: Any) -> Any:
    array[0] += 1.0
    return array


def add_own_check(data: dict[str, Any]) -> None:
    data["checks"].append({"name": "own:safe", "verdict": "valid", "text": "nobody was hurt", "figures": {}})


def deny_a_check(data: dict[str, Any]) -> None:
    check = next(check for check in data["checks"] if check["name"] == "loss_rate")
    check["figures"]["lost"], check["text"] = 0, "nothing was lost"


def set_in(*path: str, to: Any) -> Callable[[dict[str, Any]], None]:
    """Return what sets a value of verdict.json; `to` may be a function of the value that is there."""

    def change(data: dict[str, Any]) -> None:
        for name in path[:-1]:
            data = data[name]
        data[path[-1]] = to(data[path[-1]]) if callable(to) else to

    return change


EDITS = [
    # The states.
    Edit(
        "all estimates are the truth", each("states", "estimate_m", lambda r: r["position_m"], reported), "metrics"
    ),
    Edit(
        "an estimate is 100 m off",
        one("states", "estimate_m", lambda r: moved(r, "estimate_m", 100), reported),
        "metrics",
    ),
    Edit("an estimate is NaN", one("states", "estimate_m", lambda r: [float("nan")] * 2, reported), "finite"),
    Edit("an estimate is missing", one("states", "estimate_m", lambda r: None, reported), "metrics"),
    Edit(
        "a covariance is negative",
        one("states", "covariance_m2", lambda r: [-1.0, 0.0, 0.0, -1.0], reported),
        "reports",
    ),
    Edit(
        "a reported common error is 1 m off",
        one(
            "states",
            "common_error_estimate_m",
            lambda r: moved(r, "common_error_estimate_m", 1),
            lambda r: r["common_error_estimate_m"] is not None,
        ),
        "metrics",
    ),
    Edit(
        "a true position is 1 m off",
        one("states", "position_m", lambda r: moved(r, "position_m", 1), later),
        "truth",
    ),
    Edit(
        "a heading is 0.1 rad off", one("states", "heading_rad", lambda r: r["heading_rad"] + 0.1, later), "truth"
    ),
    Edit("a fix is 1 m off", one("states", "fix_m", lambda r: moved(r, "fix_m", 1), later), "truth"),
    Edit(
        "the common error of a period is 1 m off",
        each("states", "common_error_m", lambda r: moved(r, "common_error_m", 1), later),
        "truth",
    ),
    Edit("two periods are swapped", table("states", swap_periods), "row_order"),
    Edit(
        "the last period is missing", table("states", lambda rows: [r for r in rows if r["period"] < 39]), "metrics"
    ),
    # The metrics.
    Edit("every position RMSE is 0", each("metrics", "position_rmse_m", lambda r: 0.0, lambda r: True), "metrics"),
    Edit(
        "one deviation is halved", one("metrics", "deviation_m", lambda r: r["deviation_m"] / 2, later), "metrics"
    ),
    Edit("the metrics are in reverse order", table("metrics", lambda rows: rows[::-1]), "row_order"),
    # verdict.json.
    Edit("a figure is halved", verdict(set_in("figures", "position_rmse_m", to=lambda f: f / 2)), "verdict_file"),
    Edit("the seed is another", verdict(set_in("seed", to=99)), "verdict_file"),
    Edit("there is one vehicle more", verdict(set_in("vehicles", to=lambda count: count + 1)), "verdict_file"),
    Edit(
        "a check of the user's own is invented",
        verdict(add_own_check),
        "",
        "the program declares checks, whose names only their code gives; found where it declares none",
    ),
    Edit("a check says something else", verdict(deny_a_check), "verdict_file"),
    Edit(
        "more was delivered", verdict(set_in("frames_by_outcome", "delivered", to=lambda n: n + 9)), "verdict_file"
    ),
    Edit("everything was delivered", verdict(set_in("packet_delivery_ratio", to=1.0)), "verdict_file"),
    Edit("the run took half as long", verdict(set_in("wall_s", to=lambda s: s / 2)), "verdict_file"),
    Edit(
        "programs took no CPU time",
        verdict(set_in("cost", "cpu_s", to=0.0)),
        "",
        "it was measured once, and is in no other file",
    ),
    # The events.
    Edit(
        "`restarted` is left out",
        events(lambda rows: [r for r in rows if r["kind"] != "restarted"]),
        "fault_events",
    ),
    Edit(
        "all events of faults are left out",
        events(lambda rows: [r for r in rows if not of_faults(r)]),
        "fault_events",
    ),
    Edit(
        "events of faults are 0.3 s later",
        events(lambda rows: [r | {"time_ns": r["time_ns"] + 300 * MS} if of_faults(r) else r for r in rows]),
        "fault_events",
    ),
    Edit(
        "a death is invented",
        events(lambda rows: [*rows, {"time_ns": 3_900 * MS, "kind": "died", "node": "v03"}]),
        "agents_alive",
    ),
    # world.npz.
    Edit("two vehicles have swapped names", world("node_ids", swapped), "truth"),
    Edit("a lane is 1 m off", world("lane_point_m", shifted), "truth"),
    # scenario.toml.
    Edit("`max_peers` is raised", scenario("max_peers = 3", "max_peers = 30"), "peer_cap"),
    Edit("`loss` is another", scenario("loss = 0.2", "loss = 0.22"), "outcomes"),
    Edit(
        "the program has another option",
        scenario("particles = 60", "particles = 61"),
        "",
        "only the program, run again, shows what it does with it",
    ),
    # The trace.
    Edit("rows are in reverse order", table("trace", lambda rows: rows[::-1]), "row_order"),
    Edit(
        "a vehicle sent nothing",
        table("trace", lambda rows: [r for r in rows if r["sender"] != "v04"]),
        "verdict_file",
    ),
    Edit(
        "the last second is missing",
        table("trace", lambda rows: [r for r in rows if r["sent_ns"] < 3_000 * MS]),
        "verdict_file",
    ),
    Edit("a link lost everything, and others less", table("trace", lose_a_link), "outcomes"),
    Edit(
        "an arrival is 1 µs later",
        one("trace", "arrival_ns", lambda r: r["arrival_ns"] + 1000, delivered),
        "outcomes",
    ),
    Edit(
        "frames are sent, and arrive, 1 ms later",
        table("trace", move_frames),
        "",
        "a frame's time is the program's choice; the radio treats it as before",
    ),
    Edit(
        "a payload is another",
        table("trace", change_payload),
        "",
        "the trace has a payload's digest only; the program chose it",
    ),
]
"""Forty edits."""


def listing() -> str:
    """Return the table of docs/checks.md: the edits that no reader finds once all digests are made again."""
    rows = [f"| {edit.what} | {edit.why} |" for edit in EDITS if edit.why]
    return "\n".join(["| edit | why no reader can find it |", "|---|---|", *rows])
