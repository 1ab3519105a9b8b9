"""A key figure is declared once: summary, report, comparison, list of runs and sweep then have it."""

import io
import json
from pathlib import Path
from typing import Any

from rich.console import Console

from emulator.api import simulate_into
from emulator.records.key_figures import KEY_FIGURES, KeyFigure
from emulator.report.compare_page import comparison_page
from emulator.report.comparison import Comparison
from emulator.report.index import index_page
from emulator.report.source import Source
from emulator.report.sweep_page import heading
from emulator.report.write import report_page
from emulator.scenario.scenario import Scenario
from emulator.terminal import summary
from vnet.node import Node

ADDED = KeyFigure("bias_m", "error of the mean", ("bias", "Error of the mean", "‖x̄ − c‖ (m)"), "mean's error (m)")


def printed(verdict: dict[str, Any]) -> str:
    console = Console(file=io.StringIO(), width=120)
    console.print(summary._figures(verdict))
    return console.file.getvalue()  # type: ignore[attr-defined]


async def say_nought(node: Node) -> None:
    """Report nought for the common error."""
    async for fix in node.gnss:
        node.report(fix.position_m, fix.covariance_m2, common_error_m=[0.0, 0.0])


def test_a_figure_is_added_in_one_place(tmp_path: Path) -> None:
    data = {
        "run": {"duration_s": 1.0, "settle_s": 0.0},
        "network": {"vehicles": 3},
        "program": {"entry": f"{__name__}:say_nought"},
    }
    run = simulate_into(Scenario.model_validate(data), tmp_path / "run")

    verdict = json.loads((run / "verdict.json").read_text())

    def shown() -> dict[str, str]:
        comparison = Comparison.of(run, run)
        return {
            "report": report_page(Source(run)),
            "comparison": comparison_page(comparison),
            "list of runs": index_page(tmp_path),
            "sweep": heading("bias_m"),
            "summary": printed(verdict),
        }

    titles = {"list of runs": "mean&#39;s error (m)"}
    assert not [page for page, text in shown().items() if titles.get(page, "error of the mean") in text]
    KEY_FIGURES.append(ADDED)
    try:
        assert not [page for page, text in shown().items() if titles.get(page, "error of the mean") not in text]
    finally:
        KEY_FIGURES.remove(ADDED)
