"""docs/reference/checks.md: every check, what it claims, and when a run gets which verdict."""

from __future__ import annotations

from collections.abc import Sequence

from docs.generate.markdown import page as whole_page
from docs.generate.markdown import table
from emulator.checks.folder import FOLDER_CHECKS, VERDICT_FILE_CHECK
from emulator.checks.judge import CHECKS, Check, Subject

INTRODUCTION = """
Every check of a run. [checks.md](../checks.md) explains verdicts and classes, and has checks of your own. LABEL is
the name of a fault, such as `kill-0`.
"""
FROM_THE_FOLDER = (
    *(
        [
            f"`{check.name}`",
            check.claims,
            check.invalid,
            "the folder is of an earlier format",
            check.not_applicable,
            Subject.RUN.value,
        ]
        for check in (*FOLDER_CHECKS, VERDICT_FILE_CHECK)
    ),
    [
        "`replay`",
        "The same scenario gives the same trace, states, metrics and events. Judged with `--check-determinism`.",
        "a row differs; the first is shown, with its frame, vehicle and line of the program",
        "a repetition failed",
        "the run ran once",
        Subject.RUN.value,
    ],
    [
        "`trace_sha256`",
        "The trace is the one that `verdict.json` names. Judged by `vnet check`.",
        "it is not",
        "",
        "",
        Subject.RUN.value,
    ],
)
"""Rows of the checks that compare files instead of judging a run."""


def page() -> str:
    """Return the whole page: a chapter for each `chapter` of the table, in its order."""
    parts = [INTRODUCTION]
    for title in dict.fromkeys(check.chapter for check in CHECKS):
        rows = [_row(check) for check in CHECKS if check.chapter == title]
        parts += [f"## {title}", _table(rows)]
    parts += ["## Files", _table(FROM_THE_FOLDER)]
    return whole_page("Checks", *parts)


def _table(rows: Sequence[Sequence[str]]) -> str:
    return table(["check", "claims", "invalid", "unknown", "not applicable", "class"], rows)


def _row(check: Check) -> list[str]:
    verdicts = [check.invalid, check.unknown, check.not_applicable]
    return [f"`{check.name}`", check.claims, *verdicts, check.subject.value]
