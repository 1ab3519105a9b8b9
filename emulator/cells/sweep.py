"""A sweep: one scenario over values of its keys and over seeds; a row a run, curves with confidence intervals.

The folder of a sweep holds its cells, `sweep.parquet` and `sweep.html`. The same sweep there goes on where it was
interrupted; another one there uses the cells that it shares with it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from emulator.cells.cells import Cell, has_result, read_result, run_cells
from emulator.cells.worker import checked_function, entry_of, require_importable, with_folder_of
from emulator.records.disk import atomically, write_atomically
from emulator.records.run_folder import RUNS
from emulator.report.index import SWEEP_PAGE, SWEEP_TABLE, write_index
from emulator.report.sweep_page import PROGRAM, sweep_page
from emulator.scenario.loading import Source, hinting, scenario_of
from emulator.scenario.program import from_here
from emulator.scenario.scenario import Scenario
from vnet.errors import ScenarioError, VnetError, shown
from vnet.runtime.programs import Program

MOST_CELLS = 1_000_000
SEED, NETWORK_SEED = "seed", "network.seed"
FIXED = ("run.seed", "run.pacing")
"""Keys that a sweep sets itself."""


@dataclass(frozen=True)
class SweepPlan:
    """The cells of a sweep: every combination of values, each with every seed, seeds the fastest."""

    scenario: Scenario
    cells: tuple[Cell, ...]
    varied: tuple[str, ...]

    @classmethod
    def of(cls, plain: Scenario, vary: Mapping[str, Sequence[Any]], seeds: Iterable[int]) -> SweepPlan:
        """Return the plan; seeds draw a generated network, too, unless `network.seed` is set or varied.

        Raises ScenarioError that names the first combination that is no scenario.
        """
        values = {key: _values(key, given) for key, given in vary.items()}
        count = prod(map(len, values.values())) * (len(seeds) if isinstance(seeds, Sized) else 1)
        if count > MOST_CELLS:
            raise ScenarioError(f"a sweep of {count:,} runs: {MOST_CELLS:,} at most")
        numbers = _seeds(seeds)
        keeps_network = NETWORK_SEED in values or "seed" in plain.network.model_fields_set
        cells = []
        for combination in product(*values.values()):
            labels = dict(zip(values, combination, strict=True))
            try:
                one = scenario_of(plain, {key: _given_here(key, value) for key, value in labels.items()})
            except ScenarioError as error:
                raise ScenarioError(f"sweep, {_words(labels)}: {str(error).removeprefix('scenario: ')}") from None
            draws = not keeps_network and one.network.kind == "generated"
            cells += [Cell(_row(labels, seed), _seeded(one, seed, draws)) for seed in numbers]
        return cls(plain, tuple(cells), tuple(values))

    def shard(self, number: int, of: int) -> tuple[Cell, ...]:
        """Return the cells of shard `number`, counted from 1, of `of` shards."""
        return self.cells[number - 1 :: of]


@hinting
def sweep(
    scenario: Source,
    vary: Mapping[str, Sequence[Any]],
    *,
    seeds: int | Iterable[int] = 1,
    program: str | Program | None = None,
    duration_s: float | None = None,
    set: Mapping[str, Any] | None = None,
    checks: Sequence[str] = (),
    out: str | Path | None = None,
    executor: Executor | None = None,
    jobs: int | None = None,
) -> pa.Table:
    """Simulate a scenario over values of its keys and over seeds; returns a table with a row a run.

    `vary` has the values by "section.key", all of whose combinations are run; `seeds` is their number (1, 2, …) or
    the seeds. A seed draws a generated network too, unless `network.seed` is set or varied. `scenario`, `program`,
    `duration_s` (in seconds), `set` and `checks` are those of `emulator.simulate`; a program that is a function
    must be one that other processes can import.

    Runs are spread over `executor`, any concurrent.futures.Executor, or over `jobs` processes of this machine
    (default: as many as it has cores). Results are kept in the folder `out`, by default runs/sweep-NAME, with the
    table as sweep.parquet and its page as sweep.html; what is there already is not run again. The columns are the
    varied keys, `seed`, `verdict`, and every figure: docs/how-to/results.md. Raises VnetError, in one line, for
    input that cannot be used, and KeyboardInterrupt after Ctrl-C: finished runs stay.
    """
    require_importable(program, "sweep")
    named = {"run.duration_s": duration_s, "run.pacing": "lockstep", "program.entry": entry_of(program)}
    changes = {**(set or {}), **{key: value for key, value in named.items() if value is not None}}
    plain = with_folder_of(checked_function(program), scenario_of(scenario, changes, checks))
    numbers = range(1, seeds + 1) if isinstance(seeds, int) else seeds
    plan = SweepPlan.of(plain, vary, numbers)
    folder = default_folder(plan) if out is None else Path(out)
    run_cells(plan.cells, folder, title="sweep", executor=executor, jobs=jobs)
    return write_sweep(plan, folder)


def default_folder(plan: SweepPlan) -> Path:
    """Return the folder of a sweep for which none is named: the same scenario goes on there."""
    return RUNS / f"sweep-{plan.scenario.run.name}"


def missing_cells(plan: SweepPlan, folder: Path) -> int:
    """Return the number of cells that have no result in a folder."""
    return sum(not has_result(cell, folder) for cell in plan.cells)


def write_sweep(plan: SweepPlan, folder: Path) -> pa.Table:
    """Write the table of a sweep whose cells are all there, its page, and the list of runs that it is in.

    Returns the table. Raises VnetError.
    """
    rows = [read_result(cell, folder) for cell in plan.cells]
    table = _table(rows)
    with atomically(folder / SWEEP_TABLE) as part:
        pq.write_table(table, part, compression="zstd")
    programs = {cell.scenario.program.entry: cell.scenario.program for cell in plan.cells}
    page = sweep_page(plan.scenario.run, list(programs.values()), rows, plan.varied)
    write_atomically(folder / SWEEP_PAGE, page)
    if folder.resolve().parent.name == RUNS.name:
        write_index(folder.resolve().parent)
    return table


def _table(rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """A table with the columns of all rows, in the order in which they come first."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {}
    for name in names:
        values = [row.get(name) for row in rows]
        kinds = {type(value) for value in values} - {type(None)}
        if len(kinds) > 1 and not kinds <= {int, float}:
            values = [None if value is None else _text(value) for value in values]
        columns[name] = pa.array(values, pa.float64() if kinds <= {int, float} and kinds != {int} else None)
    return pa.table(columns)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _values(key: str, given: Any) -> list[Any]:
    if key in FIXED:
        raise ScenarioError(f"vary {key}: a sweep sets it itself; its seeds are given as seeds")
    values = [value.item() if hasattr(value, "item") else value for value in _listed(f"vary {key}", given)]
    if not values:
        raise ScenarioError(f"vary {key}: at least one value is needed")
    _refuse_repeated(f"vary {key}", values)
    return values


def _given_here(key: str, value: Any) -> Any:
    """Return the value of a key; a program's file that is there is meant from the current folder."""
    return from_here(value) if key == PROGRAM and isinstance(value, str) else value


def _seeds(given: Any) -> list[int]:
    seeds = [value.item() if hasattr(value, "item") else value for value in _listed("seeds", given)]
    if not seeds or any(type(seed) is not int for seed in seeds):
        raise ScenarioError(f"seeds = {shown(given)}: how many, at least 1, or a list of integers")
    _refuse_repeated("seeds", seeds)
    return seeds


def _refuse_repeated(name: str, values: Sequence[Any]) -> None:
    """Raise ScenarioError for a value that is there twice: the same run would count as a further sample."""
    for place, value in enumerate(values):
        if any(value == other and isinstance(value, bool) == isinstance(other, bool) for other in values[:place]):
            raise ScenarioError(f"{name}: {shown(value)} is given twice")


def _listed(name: str, given: Any) -> Iterator[Any]:
    with suppress(TypeError):
        if not isinstance(given, (str, Mapping)):
            return iter(given)
    raise ScenarioError(f"{name} = {shown(given)}: a list of values is needed")


def _row(labels: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """The labels of a cell; values that are no plain ones as text."""
    plain = {key: json.dumps(value) if isinstance(value, (list, dict)) else value for key, value in labels.items()}
    return {**plain, SEED: seed}


def _words(labels: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} = {shown(value)}" for key, value in labels.items())


def _seeded(scenario: Scenario, seed: int, draws_network: bool) -> Scenario:
    """The scenario with a seed, which draws its network too if it may."""
    return scenario_of(scenario, {"run.seed": seed, **({NETWORK_SEED: seed} if draws_network else {})})


def parse_shard(text: str) -> tuple[int, int]:
    """Return number and count of a shard written as i/n. Raises VnetError."""
    number, slash, count = text.partition("/")
    if slash and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count):
        return int(number), int(count)
    raise VnetError(f"--shard {text}: write it as i/n with 1 ≤ i ≤ n, for example 1/4")
