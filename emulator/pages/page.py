"""The style and the parts that all of vnet's HTML pages share: self-contained, light and dark, narrow and wide.

Everything that others wrote (names, programs' errors, scenarios) passes through `escape`.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from emulator.records.atomic import write_atomically
from emulator.records.verdicts import Verdict
from emulator.terminal.summary import cell

SIGNS = {Verdict.VALID: "✓", Verdict.INVALID: "✗", Verdict.UNKNOWN: "?"}
LONGEST_TEXT = 20_000
"""Characters of a text that others wrote."""

# Series have the colours of Okabe and Ito (2008), which the colour-blind tell apart, brighter on dark paper.
STYLE = """
:root { color-scheme: light dark;
  --paper: #ffffff; --panel: #f5f6f8; --ink: #1b1f24; --quiet: #59626d; --line: #d5d9df; --grid: #e6e9ed;
  --blue: #0072b2; --orange: #e69f00; --green: #009e73; --red: #d55e00; --purple: #cc79a7; --sky: #56b4e9;
  --grey: #8b929b; --sand: #bdb35c; --rust: #8a3a00; --navy: #004166; --link: #00609a;
  --good: #0b6b50; --good-paper: #d9f0e8; --bad: #ffffff; --bad-paper: #b54a00; --open: #6a4a00;
  --open-paper: #fbeac4;
}
@media (prefers-color-scheme: dark) { :root {
  --paper: #14171b; --panel: #1d2126; --ink: #e4e7ea; --quiet: #9ba4ae; --line: #363c44; --grid: #292e35;
  --blue: #3fa2e0; --orange: #f0b132; --green: #1fbf94; --red: #f5803a; --purple: #e29bc3; --sky: #8fd0f7;
  --grey: #7d858f; --sand: #8c8240; --rust: #c05a20; --navy: #2c6f9e; --link: #6cbcf0;
  --good: #7fe0c0; --good-paper: #123a30; --bad: #1b1206; --bad-paper: #f5803a; --open: #f5cf7d;
  --open-paper: #3d3010;
} }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 82rem; padding: 1.5rem clamp(1rem, 2.5vw, 2rem) 4rem; color: var(--ink);
  background: var(--paper); font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif;
  -webkit-text-size-adjust: 100%; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: .2rem 0 .6rem; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.75rem 0 .75rem; padding-top: 1rem; border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 0 0 .25rem; }
p { margin: .4rem 0; max-width: 46rem; } a { color: var(--link); } small, .quiet { color: var(--quiet); }
.quiet { font-size: .9rem; } code, pre { font-family: ui-monospace, "SF Mono", Menlo, Consolas, monospace;
  font-size: .85rem; }
pre { background: var(--panel); padding: .75rem .9rem; overflow-x: auto; border-radius: .4rem; margin: .5rem 0; }
nav { display: flex; flex-wrap: wrap; gap: .25rem 1.1rem; margin: 1rem 0 0; font-size: .95rem; }
.badge { display: inline-block; border-radius: .3rem; padding: .05rem .5rem; font-size: .85rem; font-weight: 600;
  white-space: nowrap; background: var(--panel); }
.badge.valid, td.valid { background: var(--good-paper); color: var(--good); }
.badge.invalid, td.invalid { background: var(--bad-paper); color: var(--bad); }
.badge.unknown, td.unknown { background: var(--open-paper); color: var(--open); }
h1 .badge { font-size: 1rem; vertical-align: .3rem; margin-left: .4rem; }
.wide { overflow-x: auto; max-width: 100%; }
table { border-collapse: collapse; font-size: .9rem; } caption { text-align: left; padding-bottom: .4rem;
  color: var(--quiet); }
th, td { padding: .3rem .7rem .3rem 0; text-align: left; vertical-align: top;
  border-bottom: 1px solid var(--grid); }
th { font-weight: 600; } thead th { color: var(--quiet); font-weight: 500; white-space: nowrap; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
dl.tiles { display: grid; grid-template-columns: repeat(auto-fill, minmax(9.5rem, 1fr)); gap: 1px; margin: 0;
  border: 1px solid var(--line); border-radius: .4rem; overflow: hidden; }
dl.tiles div { padding: .6rem .8rem; box-shadow: 0 0 0 1px var(--line); }
dl.tiles dt { color: var(--quiet); font-size: .8rem; line-height: 1.3; } dl.tiles dd { margin: .15rem 0 0;
  font-size: 1.2rem;
  font-variant-numeric: tabular-nums; }
dl.pairs { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1rem; margin: .4rem 0;
  font-size: .9rem; }
dl.pairs dt { color: var(--quiet); } dl.pairs dd { margin: 0; overflow-wrap: anywhere; min-width: 0; }
details > summary { cursor: pointer; }
"""


def escape(text: object, longest: int = LONGEST_TEXT) -> str:
    """Text that others wrote, for HTML: cut to `longest`, what is not printable as escapes, markup as text."""
    cut = str(text)
    if len(cut) > longest:
        cut = f"{cut[: longest - 1]}…"
    return html.escape("".join(c if c.isprintable() or c in "\n\t" else repr(c)[1:-1] for c in cut))


def page(title: str, body: Iterable[str], style: str = "", script: str = "") -> str:
    """A whole page. `body` is HTML; `style` and `script` are the page's own, in addition."""
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title><style>{STYLE}{style}</style></head><body>",
        *body,
        *([f"<script>{script}</script>"] if script else []),
        "</body></html>",
    ]
    return "\n".join(parts) + "\n"


def badge(verdict: Verdict | None, otherwise: str = "no verdict") -> str:
    """A verdict as a coloured word with a sign, as colour alone says nothing to some."""
    if verdict is None:
        return f'<span class="badge">{escape(otherwise)}</span>'
    return f'<span class="badge {verdict.value}">{SIGNS[verdict]} {verdict.value}</span>'


def pairs(rows: Mapping[str, object]) -> str:
    """Names and what they stand for, as text."""
    return f'<dl class="pairs">{"".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in rows.items())}</dl>'


def table(rows: Sequence[Mapping[str, Any]], caption: str = "", decimals: int | None = None) -> str:
    """Rows of named values; columns in which nothing stands are left out. `decimals` are those of all fractions."""

    def shown(value: Any) -> str:
        return cell(value) if decimals is None or not isinstance(value, float) else f"{value:,.{decimals}f}"

    names = dict.fromkeys(key for row in rows for key in row)
    columns = [name for name in names if any(row.get(name) not in (None, "") for row in rows)]
    numeric = {c for c in columns if all(isinstance(row.get(c), (int, float, type(None))) for row in rows)}
    head = "".join(f'<th scope="col"{_class(c in numeric)}>{escape(c)}</th>' for c in columns)
    body = "".join(
        f"<tr>{''.join(f'<td{_class(c in numeric)}>{escape(shown(row.get(c)), 300)}</td>' for c in columns)}</tr>"
        for row in rows
    )
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    return f'<div class="wide"><table>{title}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _class(is_number: bool) -> str:
    return ' class="number"' if is_number else ""


def put_page(path: Path, text: str) -> Path:
    """Put a page in place in one step. Raises VnetError where the disk refuses."""
    write_atomically(path, text)
    return path
