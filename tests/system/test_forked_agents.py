"""Agents that are forked from one process: they share nothing that they must not, and outlive it."""

import asyncio
import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from emulator.drivers.attachment import LiveOptions
from emulator.drivers.conclude import conclude
from emulator.drivers.live import run_live
from emulator.drivers.simulate import simulate
from emulator.scenario.loading import load_scenario
from tests.support.processes import has_ended
from tests.support.recorded import prepared
from tests.system.conftest import TIMEOUT_S, Vnet, running_agents, zygote_of
from tests.system.test_faults import write
from vnet.transport.access import Access

NODES = [["v01"], ["v02"], ["v03"]]
SHORT = ("scenarios/beacon.toml", "--duration", "0.3", "--set", "network.vehicles=2")


def memory_of(pid: int) -> Iterator[bytes]:
    """Everything that a process can read of its own memory."""
    with Path(f"/proc/{pid}/mem").open("rb", buffering=0) as memory:
        for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
            span, access, *_ = line.split()
            start, end = (int(bound, 16) for bound in span.split("-"))
            if access.startswith("r") and not line.endswith(("[vvar]", "[vsyscall]", "[vvar_vclock]")):
                memory.seek(start)
                yield memory.read(end - start)


def secrets_in(pid: int, access: Access) -> set[str]:
    """The users whose passwords are in the memory of a process."""
    parts = list(memory_of(pid))
    return {user for user, password in access.passwords.items() if any(password.encode() in part for part in parts)}


class Witness:
    """Kills the process from which agents are forked in mid-run, and looks through all memory near the end."""

    def __init__(self, folder: Path, access: Access) -> None:
        self._folder = folder
        self._access = access
        self.zygotes: list[int] = []
        self.secrets: list[set[str]] = []
        self.pipes: list[list[str]] = []

    def look(self, view: Any) -> None:
        if view.instant.period in (2, 12):
            self.zygotes.append(zygote_of(os.getpid()))
        if view.instant.period == 2:
            os.kill(self.zygotes[0], signal.SIGKILL)
            assert has_ended(self.zygotes[0], TIMEOUT_S)
        if view.instant.period == 12:
            for pid in (*running_agents(self._folder), self.zygotes[-1]):
                self.secrets.append(secrets_in(pid, self._access))
                links = [str(path.readlink()) for path in Path(f"/proc/{pid}/fd").iterdir()]
                self.pipes.append([link for link in links if link.startswith("pipe:")])


def test_no_agent_has_the_password_of_another_and_all_go_on_without_their_zygote(tmp_path: Path) -> None:
    access = Access.create("faulty", NODES)
    restart = {"kind": "restart", "at_s": 0.4, "duration_s": 0.3, "nodes": {"ids": ["v02"]}}
    run = {"duration_s": 1.5, "settle_s": 0.2, "start": "fork"}
    scenario = load_scenario(Path(write(tmp_path, [restart], run=run, network={"vehicles": 3})))
    traces = []
    for name in ("live", "simulated"):
        emulation = prepared(scenario, tmp_path / name)
        if name == "live":
            witness = Witness(tmp_path / name, access)
            emulation.watch(witness.look)
            wall_s, _ = asyncio.run(run_live(emulation, LiveOptions(access)))
        else:
            wall_s, _ = simulate(emulation)
        _, verdict = conclude(emulation, wall_s, name)
        traces.append((verdict["verdict"], verdict["trace_sha256"], verdict["metrics_sha256"]))
    assert traces[0] == traces[1]
    assert traces[0][0] == "valid"
    first, second = witness.zygotes
    assert 0 not in (first, second) and first != second, "a new one was started for the restart"
    assert sorted(map(sorted, witness.secrets)) == [[], ["node-v01"], ["node-v02"], ["node-v03"]]
    pipes = [pipe for of_one in witness.pipes for pipe in of_one]
    assert len(pipes) == len(set(pipes)) == 3, "each has its own, and the zygote none"
    assert zygote_of(os.getpid()) == 0


def test_a_program_sees_the_same_process_forked_or_spawned(vnet: Vnet) -> None:
    said = {}
    for start in ("fork", "spawn"):
        program = ("--program", "tests.system.programs:describes_process")
        done = vnet("run", *SHORT, *program, "--set", f"run.start={start}")
        assert done.verdict["checks"], done.stderr
        for node in ("v01", "v02"):
            said[start, node] = json.loads((done.folder / "logs" / f"{node}.log").read_text().splitlines()[0])
    assert said["fork", "v01"]["random"] != said["fork", "v02"]["random"], "no two vehicles draw the same"
    for node in ("v01", "v02"):
        for option in ("--connect", "--files"):  # the port, and the disk of this run
            arguments = {start: said[start, node]["arguments"] for start in ("fork", "spawn")}
            place = arguments["spawn"].index(option) + 1
            arguments["fork"][place] = arguments["spawn"][place]
        assert said["fork", node] == said["spawn", node]
