"""Memory of a live run: growth is a note, and a process over its limit ends the run as unknown."""

from pathlib import Path

import pytest

from tests.system.conftest import Vnet

PROGRAMS = '''\
async def keeps(node, sizes) -> None:
    """Keep so many bytes of the first vehicle, period by period."""
    kept = []
    async for fix in node.gnss:
        await node.radio.broadcast(b"here")
        node.report(fix.position_m, fix.covariance_m2)
        size = next(sizes, 0) if node.id == "v01" else 0
        kept.append(bytes(range(256)) * (size // 256))


async def leak(node) -> None:
    """Keep 150 kB a second for ever."""
    await keeps(node, (15_104 for _ in iter(int, 1)))


async def once(node) -> None:
    """Take 5 MB once, at 20 s."""
    await keeps(node, iter([*[0] * 200, 5_000_000]))


async def hog(node) -> None:
    """Take 16 MB a period from 2 s on."""
    await keeps(node, (16_000_000 * (number > 20) for number, _ in enumerate(iter(int, 1))))
'''


@pytest.fixture
def programs(tmp_path: Path) -> Path:
    path = tmp_path / "keeping.py"
    path.write_text(PROGRAMS)
    return path


def test_a_leak_is_noted_with_its_rate_and_memory_taken_once_is_not(vnet: Vnet, programs: Path) -> None:
    options = ["--duration", "30", "--set", "network.vehicles=2", "--set", "run.settle_s=0"]
    leak = vnet("run", "scenarios/beacon.toml", "--program", f"{programs}:leak", *options)
    assert leak.status == 0, leak.stderr + leak.stdout
    check = leak.check("memory")
    (growing,) = check["figures"]["growing"]
    assert growing["node"] == "v01"
    assert growing["kb_per_s"] == pytest.approx(150, rel=0.1)
    assert check["text"].startswith("note: memory of 1 of 2 processes grows: v01 by 1")
    assert "note: memory of 1" in leak.stdout
    once = vnet("run", "scenarios/beacon.toml", "--program", f"{programs}:once", *options)
    assert once.status == 0, once.stderr + once.stdout
    assert once.check("memory")["figures"] == {"processes": 2}


@pytest.mark.parametrize(
    ("command", "named"),
    [
        (["run"], ["v01"]),
        (["run", "--set", "run.nodes_per_process=2"], ["v01", "v02"]),
        (["run", "--hosts", "2"], ["v01"]),
        (["simulate", "--quiet"], ["v01", "v02", "v03", "v04"]),
        (["simulate", "--quiet", "--processes", "2"], ["v01", "v02"]),
    ],
)
def test_a_process_over_its_limit_ends_the_run_as_unknown(
    vnet: Vnet, programs: Path, command: list[str], named: list[str]
) -> None:
    settings = ["network.vehicles=4", "radio.range_m=1e6", "run.memory_limit_mb=300"]
    options = ["--duration", "60", *(part for setting in settings for part in ("--set", setting))]
    done = vnet(command[0], "scenarios/beacon.toml", "--program", f"{programs}:hog", *command[1:], *options)
    assert done.status == 3, done.stderr + done.stdout
    (exceeded,) = done.events_of("memory_exceeded")
    assert (exceeded["node"], exceeded["nodes"], exceeded["limit_mb"]) == ("v01", named, 300)
    assert exceeded["memory_mb"] > 300
    for name in ("memory", "progress"):
        assert done.check(name)["verdict"] == "unknown"
        assert f"process v01 ({', '.join(named[:3])}" in done.check(name)["text"]
    assert {check["verdict"] for check in done.verdict["checks"]} == {"valid", "unknown"}
    assert 2e9 < exceeded["time_ns"] < 60e9
    assert max(row["sent_ns"] for row in done.trace()) <= exceeded["time_ns"] + 100_000_000
