"""The progress line of a run: emulated time, real-time factor, RMSE, delivered and lost.

In a terminal one line is redrawn; elsewhere a plain line appears every few seconds.
"""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

from emulator.run.emulation import Emulation, PeriodView

PLAIN_LINE_EVERY_S = 5.0


class _Figures(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(task.fields["figures"], style="cyan")


class ProgressLine:
    """Shows how a run gets on, as a context manager around it."""

    def __init__(self, emulation: Emulation, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        self._duration_s = emulation.duration_ns / 1e9
        self._period_s = emulation.world.period_ns / 1e9
        self._started: float | None = None
        self._last_line = 0.0
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            _Figures(),
            console=self._console,
            transient=True,
        )
        self._task = self._progress.add_task("waiting", total=self._duration_s, figures="")
        emulation.watch(self._show)

    def state(self, text: str) -> None:
        """Say what is going on before the first period."""
        self._console.print(text, highlight=False)

    def __enter__(self) -> ProgressLine:
        if self._console.is_terminal:
            self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def _show(self, view: PeriodView) -> None:
        now = time.monotonic()
        if self._started is None:  # the first period includes every program's own start
            self._started = now
            self._first_s = (view.instant.period + 1) * self._period_s
            return
        emulated_s = (view.instant.period + 1) * self._period_s
        factor = (emulated_s - self._first_s) / max(now - self._started, 1e-9)
        figures = f"{emulated_s:6.1f} s  {factor:4.1f}× real time  {_figures(view)}"
        if self._console.is_terminal:
            self._progress.update(self._task, completed=emulated_s, description="running", figures=figures)
        elif now - self._last_line >= PLAIN_LINE_EVERY_S:
            self._last_line = now
            self._console.print(figures, highlight=False, soft_wrap=True)


def _figures(view: PeriodView) -> str:
    delivered = view.counts.get("delivered", 0)
    rmse_m = view.figures.common_error_rmse_m
    rmse = "" if rmse_m is None else f"RMSE {rmse_m:.2f} m  "
    lost = sum(count for name, count in view.counts.items() if name not in ("delivered", "out_of_range", "pending"))
    return f"{rmse}delivered {delivered:,}  not {lost:,}"
