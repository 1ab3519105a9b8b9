"""`failure.html` in the folder of a failure: checks, parting from a run that passes, and timeline."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from emulator.pages.page import put_page, render, table
from emulator.report.source import Source, maybe
from emulator.report.timeline import timeline
from emulator.testing.explanation import Explanation

FAILURE_PAGE = "failure.html"
NS_PER_US = 1000


def write_failure_page(folder: Path, title: str, checks: Mapping[str, str], explanation: Explanation) -> Path:
    """Write the page of a failure whose run is in `folder`; `checks` has the texts of those that failed.

    Its timeline begins at the first failure of a program, else at the parting. Raises VnetError where the disk
    refuses.
    """
    source = Source(folder)
    first = explanation.partings[0].time_ns // NS_PER_US if explanation.partings else None
    page = render(
        "failure.html.j2",
        title=title,
        checks=checks,
        parting=shown_parting(explanation),
        timeline=maybe(lambda: timeline(source, at_us=first)),
    )
    return put_page(folder / FAILURE_PAGE, page)


def shown_parting(explanation: Explanation) -> dict[str, Any]:
    """Return the explanation as pages show it: its line, its table, and what came before."""
    rows = table(explanation.rows()) if explanation.partings else None
    node = explanation.partings[0].node if explanation.partings else ""
    return {"line": explanation.line(), "rows": rows, "node": node, "until": explanation.until}
