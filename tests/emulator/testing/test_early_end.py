"""Runs that a test ends early replay from their folders, whatever their worlds are made of."""

import asyncio
import json
import math
import threading
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

import emulator
from emulator.testing.harness import RunHarness
from emulator.testing.scenarios import make_scenario
from vnet import Node
from vnet.errors import VnetError

pytestmark = pytest.mark.slow

NETWORK = """
def network(seed, vehicles, duration_s):
    return {f"v{n}": [(0, 0, 10 * n), (duration_s, 100, 10 * n)] for n in range(1, vehicles + 1)}
"""


async def talks(node: Node) -> None:
    async for fix in node.gnss:
        node.report(fix.position_m)
        await node.radio.broadcast(b"here")


SAME = "trace_sha256", "metrics_sha256", "verdict", "emulated_s", "driving"
GRADIENT = {"world.common_error.sigma_m": 3.0, "world.common_error.gradient_m_per_km": 1.0}


@pytest.mark.parametrize("until_s", [2.0, 2.05])  # the first one is a control instant, too
@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("city", {"vehicles": 8}),
        ("city", {"vehicles": 4, "network.kind": "driven", "network.driven.road": "map"}),
        ("beacon", {"vehicles": 4, "network.kind": "crossing.py:network"}),
        ("beacon", {"vehicles": 4, **GRADIENT}),
    ],
    ids=["trips", "driven", "own", "standing"],
)
def test_a_run_that_is_ended_early_replays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, changes: dict[str, Any], until_s: float
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "crossing.py").write_text(NETWORK)
    scenario = make_scenario(name, {**changes, "duration": 6, "settle": 0, "program": f"{__name__}:talks"})

    async def ends_early() -> None:
        async with RunHarness(scenario, tmp_path / "run") as emu:
            await emu.run_until(until_s)

    asyncio.run(ends_early())
    emulator.simulate(tmp_path / "run" / "scenario.toml", out=tmp_path / "again")
    first, again = (json.loads((tmp_path / name / "verdict.json").read_text()) for name in ("run", "again"))
    assert [first[key] for key in SAME] == [again[key] for key in SAME] and first["verdict"] == "valid"
    driven = [pq.read_table(file) for file in sorted(tmp_path.glob("*/driven.parquet"))]
    assert len(driven) == (2 if "network.driven.road" in changes else 0)
    assert len({len(table) for table in driven}) <= 1


@pytest.mark.parametrize("live", [False, True])
def test_a_run_whose_start_is_cancelled_is_ended(tmp_path: Path, live: bool) -> None:
    async def is_cancelled() -> None:
        scenario = make_scenario("beacon", {"vehicles": 2, "duration": 6, "program": f"{__name__}:talks"})
        entering = asyncio.create_task(RunHarness(scenario, tmp_path / "run", live=live).__aenter__())
        await asyncio.sleep(0)
        entering.cancel()
        with pytest.raises(asyncio.CancelledError):
            await entering

    asyncio.run(is_cancelled())
    for thread in (each for each in threading.enumerate() if each.name.startswith("vnet ")):
        thread.join(10)
        assert not thread.is_alive()
    assert (tmp_path / "run" / "verdict.json").exists() and not (tmp_path / "run" / "operator.json").exists()


@pytest.mark.parametrize("time_s", [math.inf, math.nan, 7.0])
def test_a_time_that_the_run_does_not_have_is_refused(time_s: float, tmp_path: Path) -> None:
    async def waits() -> None:
        async with RunHarness(make_scenario("beacon", {"vehicles": 1, "duration": 6}), tmp_path / "run") as emu:
            with pytest.raises(VnetError, match=r"the run takes 6 s"):
                await emu.run_until(time_s)

    asyncio.run(waits())


def test_files_that_a_dict_names_are_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here.csv").write_text("x_m,y_m\n0,0\n50,0\n")
    made = make_scenario({"network": {"kind": "file", "path": "here.csv"}}, {})
    assert made.network.path == tmp_path / "here.csv"
