"""A sweep: its cells, its table, its page, and that it goes on where it stopped."""

from __future__ import annotations

import errno
import signal
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

import emulator
from emulator.cells import sweep as subject
from emulator.cells.cells import WALL_CLOCK, Cell, compute, judged_figures, read_result
from emulator.cells.sweep import SweepPlan, parse_shard
from emulator.cli.studies import sweep as command
from emulator.report.sweep_page import Mean, _means, differences, mean_of
from emulator.scenario.loading import scenario_of
from tests.support.cells import compute_here
from tests.support.cli import command_app
from vnet.errors import VnetError

TINY: dict[str, Any] = {
    "run": {"name": "tiny", "duration_s": 0.4},
    "network": {"kind": "generated", "vehicles": 3},
    "radio": {"range_m": 20_000.0},
}
VARY: dict[str, list[Any]] = {"radio.loss": [0, 0.5], "network.vehicles": [3, 4]}


def plan(vary: dict[str, list[Any]] = VARY, seeds: range = range(1, 3)) -> SweepPlan:
    return SweepPlan.of(scenario_of(TINY, {}), vary, seeds)


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> list[Cell]:
    """Run cells here; returns those that were run."""
    return compute_here(monkeypatch)


def test_the_cells_are_all_combinations_with_every_seed() -> None:
    cells = plan().cells
    assert [tuple(cell.labels.values()) for cell in cells] == [
        (loss, vehicles, seed) for loss in (0, 0.5) for vehicles in (3, 4) for seed in (1, 2)
    ]
    assert [cell.scenario.run.seed for cell in cells] == [1, 2] * 4
    assert [cell.scenario.network.seed for cell in cells] == [1, 2] * 4, "a seed draws the network"
    for pinned in (scenario_of(TINY, {"network.seed": 1}), scenario_of({**TINY, "network": {"seed": 1}}, {})):
        kept = SweepPlan.of(scenario_of(pinned, {"run.duration_s": 1}), VARY, range(1, 3)).cells
        assert {cell.scenario.network.seed for cell in kept} == {1}, "unless the scenario has a seed of its own"
    assert [cell.scenario.network.seed for cell in plan({"network.seed": [7, 8]}).cells] == [7, 7, 8, 8]
    assert len({cell.digest for cell in cells}) == len(cells)
    with pytest.raises(VnetError, match="twice"):
        plan({"radio.loss": [0, 0.0]})


def test_kinds_are_varied_with_the_defaults_of_each() -> None:
    kinds = ["lte-mode4", "nr-mode2", "80211p"]
    changes = {"radio.path_loss": {"kind": "winner_b1"}, "radio.mac": {"kind": kinds[0]}}
    cells = SweepPlan.of(scenario_of("beacon", changes), {"radio.mac.kind": kinds}, [1]).cells
    assert [cell.scenario.radio.mac.kind for cell in cells if cell.scenario.radio.mac] == kinds


def test_the_largest_payload_follows_the_varied_mac_unless_it_is_given() -> None:
    vary: dict[str, list[Any]] = {"radio.mac": [{"kind": "nr-mode2", "subchannels": 8}, {"kind": "80211p"}]}
    radio = {"path_loss": {"kind": "log_distance"}, "mac": {"kind": "nr-mode2"}}
    for given, expected in (({}, [1400, 1400]), ({"max_payload_bytes": 300}, [300, 300])):
        plan = SweepPlan.of(scenario_of({"radio": {**radio, **given}}, {}), vary, [1])
        assert [cell.scenario.radio.max_payload_bytes for cell in plan.cells] == expected
    plan = SweepPlan.of(scenario_of({"radio": radio}, {}), {"radio.mac.subchannels": [1, 2]}, [1])
    assert [cell.scenario.radio.max_payload_bytes for cell in plan.cells] == [190, 380]


def test_shards_are_the_whole_without_an_overlap() -> None:
    whole = plan()
    shards = [whole.shard(number, 3) for number in (1, 2, 3)]
    assert sorted(cell.digest for shard in shards for cell in shard) == sorted(cell.digest for cell in whole.cells)
    assert parse_shard("2/3") == (2, 3)
    for text in ("0/3", "4/3", "1", "a/b", "1/0"):
        with pytest.raises(VnetError, match=rf"^--shard {text}: write it as i/n"):
            parse_shard(text)


@pytest.mark.slow
def test_a_page_says_how_long_its_runs_are_where_that_varies(tmp_path: Path, in_this_process: list[Cell]) -> None:
    emulator.sweep(TINY, {"run.duration_s": [0.4, 0.6]}, seeds=[1], out=tmp_path)
    assert "2 runs of 0.4 to 0.6 s of emulated time" in (tmp_path / "sweep.html").read_text()


@pytest.mark.slow
def test_a_sweep_leaves_a_table_and_a_page_and_goes_on(tmp_path: Path, in_this_process: list[Cell]) -> None:
    table = emulator.sweep(TINY, VARY, seeds=[1, 2], out=tmp_path)
    assert len(in_this_process) == len(table) == 8
    assert table.column_names[:4] == ["radio.loss", "network.vehicles", "seed", "verdict"]
    rows = table.to_pylist()
    assert all(row["vehicles"] == row["network.vehicles"] and row["verdict"] == "valid" for row in rows)
    assert [row["packet_delivery_ratio"] == 1 for row in rows] == [True] * 4 + [False] * 4
    assert rows[0]["neighbours"] > rows[-1]["neighbours"] / 2 and rows[0]["last.neighbours"] == 2, "as reported"
    assert set(WALL_CLOCK) <= set(table.column_names)
    assert pq.read_table(tmp_path / "sweep.parquet").equals(table)
    page = (tmp_path / "sweep.html").read_text()
    assert "8 runs of 0.4 s of emulated time" in page and page.count("<figure") >= 3
    again = emulator.sweep(TINY, VARY | {"radio.loss": [0, 0.5, 1]}, seeds=2, out=tmp_path)
    assert len(in_this_process) == 12 == len(again), "what it shares with the first is not run again"


@pytest.mark.slow
def test_a_run_of_a_program_that_crashes_is_a_row(tmp_path: Path, in_this_process: list[Cell]) -> None:
    del in_this_process
    program = "tests.emulator.cells.test_sweep:crash"
    row = emulator.sweep(TINY, {}, program=program, out=tmp_path).to_pylist()[0]
    assert row["verdict"] == "invalid" and row["failed"] and row["failure"]
    assert "Not valid: 1" in (tmp_path / "sweep.html").read_text()
    (tmp_path / "t.toml").write_text("[run]\nduration_s = 0.4\n[network]\nvehicles = 3\n")
    result = CliRunner().invoke(
        command_app(command), [f"{tmp_path}/t.toml", "--program", program, "--out", f"{tmp_path}"]
    )
    assert f"first invalid: seed 1: {row['failed']}: {row['failure']}" in result.output


async def crash(node: Any) -> None:
    """Crash at once."""
    raise RuntimeError(node.id)


@pytest.mark.slow
@pytest.mark.usefixtures("default_signals")
def test_an_interrupted_sweep_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    signals = iter([signal.SIGINT, signal.SIGTERM])

    def one_only(jobs: list[Cell], *_: object) -> Any:
        yield jobs[0], compute(jobs[0])
        signal.raise_signal(next(signals))

    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text("[run]\nname = 'tiny'\nduration_s = 0.4\n[network]\nvehicles = 3\n")
    arguments = ["tiny.toml", "--vary", "radio.loss=0,0.5"]
    for done in (1, 2):
        monkeypatch.setattr("emulator.cells.cells.each_done", one_only)
        result = CliRunner().invoke(command_app(command), arguments)
        assert result.exit_code == 130
        assert f"interrupted: {done} of 2 runs are in runs/sweep-tiny; the same command goes on" in result.output
    monkeypatch.setattr("emulator.cells.cells.each_done", lambda jobs, *_: iter([1 / 0] if jobs else []))
    result = CliRunner().invoke(command_app(command), arguments)
    assert result.exit_code == 0, result.output
    assert "2 runs: 2 valid" in result.output
    assert "runs/sweep-tiny/sweep.html" in result.output


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_a_run_whose_files_the_disk_refuses_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def put(self: Path, target: Path) -> Path:
        if target.name == "world.npz":
            raise OSError(errno.ENOSPC, "No space left on device")
        return replace(self, target)

    replace = Path.replace
    with monkeypatch.context() as full:
        full.setattr(Path, "replace", put)
        with pytest.raises(VnetError, match=r"cell \{'seed': 1\}: .*world.npz: cannot write: No space left"):
            emulator.sweep(TINY, {}, out=tmp_path)
    assert [row["verdict"] for row in emulator.sweep(TINY, {}, out=tmp_path).to_pylist()] == ["valid"]


@pytest.mark.slow
def test_shards_may_run_anywhere_and_the_last_makes_the_table(tmp_path: Path, in_this_process: list[Cell]) -> None:
    (tmp_path / "tiny.toml").write_text("[run]\nname = 'tiny'\nduration_s = 0.4\n[network]\nvehicles = 3\n")
    given = [str(tmp_path / "tiny.toml"), "--seeds", "3", "--out", str(tmp_path / "out")]
    first = CliRunner().invoke(command_app(command), [*given, "--shard", "1/2"])
    assert (
        first.exit_code == 0 and "shard 1/2: 2 runs are in" in first.output and "1 of 3 are missing" in first.output
    )
    assert not (tmp_path / "out" / "sweep.parquet").exists()
    second = CliRunner().invoke(command_app(command), [*given, "--shard", "2/2"])
    assert "3 runs: 3 valid" in second.output and len(in_this_process) == 3


def test_confidence_intervals_are_those_of_student() -> None:
    assert mean_of([2.0]) == Mean(2.0, None, 1)
    three = mean_of([1.0, 2.0, 3.0])
    assert three.value == 2.0 and three.half == pytest.approx(4.302653 / 3**0.5)


@pytest.mark.parametrize(
    ("mean", "text"),
    [
        (Mean(2.0, None, 1), "2"),
        (Mean(2.0, 2.4842, 3), "2.0 ± 2.5"),
        (Mean(0.98765, 0.012345, 5), "0.988 ± 0.012"),
        (Mean(0.98765, 0.0996, 5), "0.99 ± 0.10"),
        (Mean(12345.6, 678.9, 5), "12350 ± 680"),
        (Mean(-0.5, 13.0, 5), "0 ± 13"),
        (Mean(3.0, 0.0, 5), "3 ± 0"),
        (Mean(2.0, 1.24e-16, 5), "2 ± 1.2e-16"),
        (Mean(float("nan"), float("nan"), 5), "nan ± nan"),
    ],
)
def test_a_mean_is_rounded_by_its_interval(mean: Mean, text: str) -> None:
    assert str(mean) == text


@pytest.mark.slow
def test_programs_are_compared_on_the_same_seeds(tmp_path: Path, in_this_process: list[Cell]) -> None:
    (tmp_path / "tiny.toml").write_text("[run]\nname = 'tiny'\nduration_s = 0.4\n[network]\nvehicles = 3\n")
    for name, share in {"a": 1, "b": 3}.items():
        (tmp_path / f"{name}.py").write_text(
            "async def main(node):\n    async for fix in node.gnss:\n"
            f"        node.report(east_m={share} + fix.position_m[0])\n"
        )
    files = [str(tmp_path / name) for name in ("a.py", "b.py")]
    given = [str(tmp_path / "tiny.toml"), "--program", ",".join(files), "--seeds=2", f"--out={tmp_path / 'o'}"]
    result = CliRunner().invoke(command_app(command), given)
    assert result.exit_code == 0, result.output
    assert "note: 2 seeds: too few for a confidence interval" in result.output
    rows = pq.read_table(tmp_path / "o" / "sweep.parquet").to_pylist()
    assert [(row["program.entry"], row["seed"]) for row in rows] == [(file, n) for file in files for n in (1, 2)]
    assert len({cell.scenario.program.entry for cell in in_this_process}) == 2
    told = differences(rows, ["program.entry"], {"east_m": "east"})
    assert told == [{"programs": f"{files[1]} − {files[0]}", "pairs": 2, "east": told[0]["east"]}]
    assert told[0]["east"].startswith("2 ±"), "receivers' noise is the same on both sides"
    assert 'id="differences"' in (tmp_path / "o" / "sweep.html").read_text()


@pytest.mark.parametrize(("first", "second"), [(0, 1), (False, True), (1, True)])
def test_differences_are_of_pairs_in_each_combination(first: float, second: float) -> None:
    rows = [
        {"loss": loss, "program.entry": program, "seed": seed, "pdr": pdr}
        for number, loss in enumerate((first, second))
        for program, of_seed in {"a": (1.0, 2.0, 3.0), "b": (1.5, 2.5 + number, None), "c": (1.0, 2.0, 3.0)}.items()
        for seed, pdr in enumerate(of_seed)
    ]
    del rows[-1]  # a pair of which one is missing
    names = ["loss", "program.entry"]
    assert differences(rows, names, {"pdr": "PDR"}) == [
        {"loss": first, "programs": "b − a", "pairs": 3, "PDR": "0.5 ± 0 (2)"},
        {"loss": first, "programs": "c − a", "pairs": 3, "PDR": "0 ± 0"},
        {"loss": second, "programs": "b − a", "pairs": 3, "PDR": "1.0 ± 6.4 (2)"},
        {"loss": second, "programs": "c − a", "pairs": 2, "PDR": "0 ± 0"},
    ]
    assert differences(rows, ["loss"], {"pdr": "PDR"}) == []
    of_b = [row for row in rows if row["program.entry"] == "b"]
    assert [row["PDR"] for row in _means(of_b, ["loss"], {"pdr": "PDR"})] == ["2.0 ± 6.4 (2)", "2 ± 13 (2)"]


def test_columns_of_several_kinds_are_texts() -> None:
    table = subject._table([{"a": 1, "b": "x", "c": None}, {"a": 2.5, "b": True, "d": 3}])
    assert table.to_pylist() == [
        {"a": 1.0, "b": "x", "c": None, "d": None},
        {"a": 2.5, "b": "true", "c": None, "d": 3},
    ]


def test_numbers_of_own_checks_are_columns() -> None:
    figures = {"slowest_s": 0.2, "late": 3, "who": "v02", "rows": [{"node": "v02"}]}
    checks = [
        {"name": "own:warned", "verdict": "invalid", "text": "3 late", "figures": figures},
        {"name": "conservation", "verdict": "valid", "figures": {"frames": 10}},
    ]
    names = ("verdict", "vehicles", "emulated_s", "trace_sha256", "metrics_sha256", "wall_s", "real_time_factor")
    verdict: dict[str, Any] = dict.fromkeys([*names, "packet_delivery_ratio"]) | {"verdict": "invalid"}
    row = judged_figures(verdict | {"checks": checks, "frames_by_outcome": {}, "figures": {}, "reported": {}})
    assert {name: value for name, value in row.items() if "." in name} == {
        "own:warned.slowest_s": 0.2,
        "own:warned.late": 3,
    }
    assert (row["failed"], row["failure"]) == ("own:warned", "3 late")


def test_a_figure_with_the_name_of_what_is_varied_is_another_column(tmp_path: Path) -> None:
    (cell,) = plan({"radio.loss": [0.5]}, range(3, 4)).cells
    (tmp_path / "cells").mkdir()
    (tmp_path / f"cells/{cell.digest}.json").write_text('{"radio.loss": 0.4, "seed": 7.5, "speed": 1}')
    row = read_result(cell, tmp_path)
    reported = {"reported.radio.loss": 0.4, "reported.seed": 7.5, "speed": 1}
    assert row == {"radio.loss": 0.5, "seed": 3} | reported


@pytest.mark.slow
def test_a_run_whose_program_stalls_is_a_row(tmp_path: Path) -> None:
    (tmp_path / "spin.py").write_text(SPIN)
    (tmp_path / "t.toml").write_text(
        "[run]\nduration_s = 0.4\nstall_timeout_s = 0.5\n[network]\nvehicles = 2\n[program]\nentry = 'spin:main'\n"
    )
    rows = emulator.sweep(tmp_path / "t.toml", {"program.options.spin": [0, 1]}, out=tmp_path / "out").to_pylist()
    assert [row["emulated_s"] for row in rows] == [0.4, 0.0]
    assert rows[1]["verdict"] == "unknown" and rows[1]["failed"].startswith("progress, ")
    result = CliRunner().invoke(
        command_app(command), [f"{tmp_path}/t.toml", "--option", "spin=1", "--out", f"{tmp_path / 'again'}"]
    )
    assert f"first unknown: seed 1: progress: {rows[1]['failure']}" in result.output


SPIN = """
async def main(node):
    while node.options["spin"] and node.id == "v02":
        pass
    async for fix in node.gnss:
        await node.radio.broadcast(b"")
"""


def test_rounding_of_a_constant_difference_is_no_spread() -> None:
    rows = [
        {"program.entry": program, "seed": seed, "gap_s": seed + more}
        for program, more in (("a", 0.1), ("b", 0.3))
        for seed in range(1, 6)
    ]
    (row,) = differences(rows, ["program.entry"], {"gap_s": "gap"})
    assert row["gap"] == "0.2 ± 0"


def test_small_spread_of_small_numbers_is_kept() -> None:
    assert str(mean_of([1e-13, 2e-13, 3e-13])).endswith("e-13")
    assert str(mean_of([1e-16, -3e-16, 2e-16], size=1.0)) == str(mean_of([0.0, 0.0, 0.0]))
