"""Live runs with windows are the simulated ones without, whatever their processes."""

import pytest

from tests.system.conftest import Finished, Vnet, command_in

RUN = ["scenarios/beacon.toml", "--program", "tests.support.window_programs:improvises", "--duration", "1.5"]


@pytest.fixture(scope="module")
def without_windows(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """The run in one process, instant by instant."""
    return command_in(tmp_path_factory.mktemp("simulated"))("simulate", *RUN, "--set", "run.windows=false")


@pytest.mark.parametrize("nodes_per_process", [1, 3])
def test_a_live_run_with_windows_is_the_simulated_one_without(
    vnet: Vnet, without_windows: Finished, nodes_per_process: int
) -> None:
    live = vnet("run", *RUN, "--set", f"run.nodes_per_process={nodes_per_process}")
    assert live.fingerprint == without_windows.fingerprint, live.stderr + live.stdout
    assert live.verdict["verdict"] == without_windows.verdict["verdict"]
