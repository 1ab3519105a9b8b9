"""The length of a run in decisions of a vehicle: PCT needs to know it, and counts them in a run in FIFO order."""

from __future__ import annotations

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

from emulator.drivers.emulation import Emulation
from emulator.drivers.simulate import simulate
from emulator.records.run_folder import RunFolder
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world


def with_order_steps(scenario: Scenario) -> Scenario:
    """Return a scenario that has `run.order_steps` if `run.order` is "pct", by simulating it in FIFO order.

    Raises KeyboardInterrupt, and VnetError if it cannot be simulated.
    """
    run = scenario.run
    if run.order != "pct" or run.order_steps is not None:
        return scenario
    fifo = scenario.model_copy(update={"run": run.model_copy(update={"order": "fifo"})})
    with TemporaryDirectory(prefix="vnet-order-") as name, redirect_stdout(StringIO()):
        emulation = Emulation(fifo, build_world(fifo), RunFolder.create(Path(name) / "run", fifo))
        emulation.orders.explores = True
        _, interrupted = simulate(emulation)
    if interrupted:
        raise KeyboardInterrupt
    steps = max([1, *emulation.orders.steps.values()])
    return scenario.model_copy(update={"run": run.model_copy(update={"order_steps": steps})})
