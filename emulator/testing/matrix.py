"""A campaign as one HTML page that needs nothing else: the matrix of faults and checks, and every failure."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from emulator.pages.page import render
from emulator.records.verdicts import Verdict

WORST_FIRST = (Verdict.INVALID, Verdict.UNKNOWN, Verdict.VALID)
NO_FAULTS = "no faults"
"""Row of the runs without any fault."""
Matrix = Mapping[str, Mapping[str, Counter[Verdict]]]


def column_of(check: str) -> tuple[str, str | None]:
    """Return the column of a check; and for the check of a single fault the kind in whose row alone it stands."""
    match = re.fullmatch(r"(\w+):(\w+)-\d+", check)
    return (f"{match[1]} (its own)", match[2]) if match else (check, None)


def count_verdicts(runs: Iterable[tuple[Sequence[str], Mapping[str, Verdict]]]) -> Matrix:
    """Count the verdicts by kind of fault and check, of runs with the kinds of their faults and their verdicts."""
    matrix: dict[str, dict[str, Counter[Verdict]]] = {}
    for kinds, verdicts in runs:
        for kind in sorted(set(kinds)) or [NO_FAULTS]:
            row = matrix.setdefault(kind, {})
            for check, verdict in verdicts.items():
                column, only = column_of(check)
                if only in (None, kind):
                    row.setdefault(column, Counter())[verdict] += 1
    return dict(sorted(matrix.items()))


def page(
    title: str,
    facts: Sequence[str],
    matrix: Matrix,
    failures: Sequence[Mapping[str, Any]],
    failure_kinds: Sequence[object] = (),
) -> str:
    """Return the whole page.

    A failure has `number`, `seed`, `checks` (texts by name), `schedule` (TOML), `order` (a phrase), `command`,
    `folder` and `parting` (where it parts from a run that passes, or None); a kind of failures `check`, `text`,
    `first` (a number) and `runs`.
    """
    columns = list(dict.fromkeys(column for row in matrix.values() for column in row))
    kinds = {kind: [_cell(row.get(column, Counter())) for column in columns] for kind, row in matrix.items()}
    return render(
        "campaign.html.j2",
        title=title,
        facts=facts,
        columns=columns,
        kinds=kinds,
        failures=failures,
        failure_kinds=failure_kinds,
    )


def _cell(counts: Counter[Verdict]) -> tuple[Counter[Verdict], Verdict | None]:
    """A cell of the matrix: how often each verdict was given, and the worst of them."""
    return counts, next((verdict for verdict in WORST_FIRST if counts[verdict]), None)
