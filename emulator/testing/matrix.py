"""A campaign as one HTML page that needs nothing else: the matrix of faults and checks, and every failure."""

from __future__ import annotations

import html
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from emulator.checks.judge import Verdict

SIGNS = {Verdict.VALID: "✓", Verdict.INVALID: "✗", Verdict.UNKNOWN: "?"}
# Colours of Okabe and Ito (2008), which those who are colour-blind tell apart; the signs say the same.
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem; color: #1b1b1b; background: #fff; }
h1 { font-size: 1.4rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; } caption { text-align: left; padding-bottom: .5rem; color: #444; }
th, td { border: 1px solid #bbb; padding: .25rem .5rem; text-align: center; white-space: nowrap; }
thead th { vertical-align: bottom; } thead th span { writing-mode: vertical-rl; transform: rotate(180deg); }
tbody th { text-align: left; font-weight: 600; }
td.valid { background: #d6e9f7; } td.unknown { background: #e4e4e4; }
td.invalid { background: #d55e00; color: #fff; font-weight: 700; } td.none { color: #666; }
pre { background: #f4f4f4; padding: .6rem; overflow-x: auto; } article { border-top: 1px solid #bbb; }
"""

Matrix = Mapping[str, Mapping[str, Counter[Verdict]]]


def column_of(check: str) -> tuple[str, str | None]:
    """The column of a check, and the kind whose row alone it belongs to, if it is the check of one fault."""
    match = re.fullmatch(r"(\w+):(\w+)-\d+", check)
    return (f"{match[1]} (its own)", match[2]) if match else (check, None)


def count_verdicts(runs: Iterable[tuple[Sequence[str], Mapping[str, Verdict]]]) -> Matrix:
    """Of runs, each with the kinds of its faults and the verdicts of its checks: verdicts by kind and check."""
    matrix: dict[str, dict[str, Counter[Verdict]]] = {}
    for kinds, verdicts in runs:
        for kind in sorted(set(kinds)):
            row = matrix.setdefault(kind, {})
            for check, verdict in verdicts.items():
                column, only = column_of(check)
                if only in (None, kind):
                    row.setdefault(column, Counter())[verdict] += 1
    return dict(sorted(matrix.items()))


def page(title: str, facts: Sequence[str], matrix: Matrix, failures: Sequence[Mapping[str, Any]]) -> str:
    """The whole page. A failure has number, seed, checks (name: text), schedule (TOML), command and folder."""
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head><body>",
        f"<h1>{html.escape(title)}</h1>",
        *(f"<p>{html.escape(fact)}</p>" for fact in facts),
        "<h2>Faults and checks</h2>",
        _table(matrix) if matrix else "<p>No run is over.</p>",
        f"<h2>Failures: {len(failures)}</h2>",
        *(_failure(failure) for failure in failures),
        "</body></html>",
    ]
    return "\n".join(parts) + "\n"


def _table(matrix: Matrix) -> str:
    columns = list(dict.fromkeys(column for row in matrix.values() for column in row))
    head = "".join(f'<th scope="col"><span>{html.escape(column)}</span></th>' for column in columns)
    rows = []
    for kind, row in matrix.items():
        cells = "".join(_cell(row.get(column, Counter())) for column in columns)
        rows.append(f'<tr><th scope="row">{html.escape(kind)}</th>{cells}</tr>')
    meaning = ", ".join(f"{sign} {verdict.value}" for verdict, sign in SIGNS.items())
    caption = f"Runs with a fault of this kind, and mostly others beside it, by what each check said: {meaning}"
    return (
        f'<div class="wide"><table><caption>{caption}; · not exercised</caption>'
        f'<thead><tr><th scope="col">fault</th>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
    )


def _cell(counts: Counter[Verdict]) -> str:
    if not counts:
        return '<td class="none">·</td>'
    worst = next(v for v in (Verdict.INVALID, Verdict.UNKNOWN, Verdict.VALID) if counts[v])
    text = " ".join(f"{counts[verdict]}&nbsp;{sign}" for verdict, sign in SIGNS.items() if counts[verdict])
    return f'<td class="{worst.value}">{text}</td>'


def _failure(failure: Mapping[str, Any]) -> str:
    checks = "".join(
        f"<li><b>{html.escape(name)}</b>: {html.escape(text)}</li>" for name, text in failure["checks"].items()
    )
    schedule = html.escape(failure["schedule"]) or "# without any fault"
    folder = html.escape(failure["folder"], quote=True)
    return (
        f'<article id="failure-{failure["number"]}"><h3>{failure["number"]}: seed {failure["seed"]}</h3>'
        f"<ul>{checks}</ul>"
        f"<p>The smallest schedule found that still fails:</p><pre>{schedule}</pre>"
        f'<p>Files: <a href="{folder}">{folder}</a></p><pre>{html.escape(failure["command"])}</pre></article>'
    )
