"""Another order of events is the same in real processes as simulated, and follows its tape."""

import pytest

from tests.system.conftest import Vnet

RUN = ["scenarios/beacon.toml", "--program", "tests.support.window_programs:improvises", "--duration", "1.0"]
TOGETHER = ["--set", "radio.jitter_ms=0", "--set", "radio.access_jitter_ms=0"]
"""Frames of one instant arrive at one instant: there is something to decide."""


@pytest.mark.parametrize("nodes_per_process", [1, 3])
def test_a_live_run_in_another_order_is_the_simulated_one(vnet: Vnet, nodes_per_process: int) -> None:
    simulated = vnet("simulate", *RUN, *TOGETHER, "--order", "shuffle")
    tape = simulated.folder / "tape.jsonl"
    assert len(tape.read_text().splitlines()) > 10
    live = vnet("run", *RUN, *TOGETHER, "--order", "shuffle", "--set", f"run.nodes_per_process={nodes_per_process}")
    assert live.fingerprint == simulated.fingerprint, live.stderr + live.stdout
    assert (live.folder / "tape.jsonl").read_text() == tape.read_text()
    taped = vnet("simulate", *RUN, *TOGETHER, "--tape", str(tape))
    assert taped.fingerprint == simulated.fingerprint
    assert taped.verdict["order"]["left"] is None
