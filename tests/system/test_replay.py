"""Replay is exact: the same scenario and seed give the same trace and metrics, whatever the machine does."""

import multiprocessing
import os
from multiprocessing.synchronize import Event

from tests.system.conftest import Vnet

SCENARIO = "scenarios/twelve.toml"


def _burn(stop: Event) -> None:
    while not stop.is_set():
        sum(range(10_000))


def test_a_live_run_beside_a_busy_machine_is_the_simulated_one(vnet: Vnet) -> None:
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    burners = [context.Process(target=_burn, args=(stop,)) for _ in range(2 * (os.cpu_count() or 1))]
    for burner in burners:
        burner.start()
    try:
        busy = vnet("run", SCENARIO, "--duration", "2")
    finally:
        stop.set()
        for burner in burners:
            burner.join()
    assert busy.status == 0, busy.stderr + busy.stdout
    assert busy.fingerprint == vnet("simulate", SCENARIO, "--duration", "2").fingerprint


def test_another_seed_is_another_run(vnet: Vnet) -> None:
    one, two = (vnet("simulate", SCENARIO, "--duration", "1", "--seed", seed) for seed in "12")
    assert one.fingerprint != two.fingerprint
