"""A run in a notebook: its report, in a frame that reaches nothing of the notebook."""

from __future__ import annotations

from html import escape

from emulator.records.run import Run

__all__ = ["Run", "framed_report"]

HEIGHT_PX = 640


def framed_report(run: Run) -> str:
    """Return the report as an element of HTML. Raises VnetError if the folder is not a run's any more."""
    from emulator.report.source import Source  # slow to import, and only notebooks need it
    from emulator.report.write import report_page

    page = escape(report_page(Source(run.folder)))
    # Scripts run, but in an origin of their own: they see neither the notebook nor its cookies.
    return (
        f'<iframe title="vnet report" sandbox="allow-scripts" style="width:100%;height:{HEIGHT_PX}px;border:0" '
        f'srcdoc="{page}"></iframe>'
    )


Run.html = framed_report
