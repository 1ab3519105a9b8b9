"""The study of attackers: who lies, who counts, and what the report says."""

from __future__ import annotations

import pytest

from emulator.cells.cells import compute
from studies.attackers import ATTACKS, HONEST, attack_cells, report
from studies.commands import _select
from vnet.errors import VnetError

TINY = {"n1": {"kind": "generated", "vehicles": 6}}


def test_each_attack_has_a_cell_for_each_seed_in_which_the_same_vehicles_count() -> None:
    cells = attack_cells(TINY, [1, 2])
    assert [(cell.labels["attack"], cell.labels["seed"]) for cell in cells] == [
        (name, seed) for name in ATTACKS for seed in (1, 2)
    ]
    assert len({cell.digest for cell in cells}) == len(cells), "no two are the same run"
    excepted = [[node for each in cell.scenario.program.exceptions for node in each.nodes] for cell in cells]
    assert excepted == excepted[:1] * len(cells)
    for cell in cells:
        lying = [e for e in cell.scenario.program.exceptions if "lie" in e.options]
        assert len(lying) == ATTACKS[str(cell.labels["attack"])].attackers


def test_conditions_of_one_label_are_alternatives() -> None:
    cells = attack_cells(TINY, [1, 2])
    found = _select(cells, ["attack=none", "seed=2", "attack=gates, two"])
    assert [(cell.labels["attack"], cell.labels["seed"]) for cell in found] == [("none", 2), ("gates, two", 2)]
    with pytest.raises(VnetError, match="seed=3"):
        _select(cells, ["attack=none", "seed=3"])


@pytest.mark.slow
@pytest.mark.parametrize(("attack", "harms"), [("offset 50 m", False), ("offset 50 m, no defence", True)])
def test_figures_are_those_of_the_others(attack: str, harms: bool) -> None:
    cells = {str(cell.labels["attack"]): cell for cell in attack_cells(TINY, [1], 6.0)}
    results = [{**cells[name].labels, **compute(cells[name]).figures} for name in (HONEST, attack)]
    honest, lied_to = (result["others_rmse_m"] for result in results)
    assert (lied_to > 10 * honest) is harms
    assert (results[1]["others_divergent"] > 0) is harms
    text = report(results, 6.0)
    line = next(line for line in text.splitlines() if line.startswith(f"| {attack} "))
    assert f"{lied_to:.3f}" in line
    assert f"{lied_to / honest:.2f}" in line
    assert "6 s, counted from 3 s on; 1 seed" in text


def test_the_shortest_run_that_the_command_takes_can_be_made() -> None:
    assert {cell.scenario.run.duration_s for cell in attack_cells(TINY, [1], 2.0)} == {2.0}
