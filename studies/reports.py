"""Reports of the experiments in Markdown: means over seeds ± standard errors, beside the paper's figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from emulator.records.metrics import anees_band
from studies.paper import ALPHAS
from studies.paper_values import PAPER_RMSE_M
from studies.tables import (
    in_seeds,
    markdown_table,
    mean_and_error,
    paired_difference,
    paired_ratio,
    with_error,
)

Result = Mapping[str, Any]
BOUND_RATIO = 1.35
"""Optimized weights are wanted within so many times the bound, on each network and in each component."""

PAPER_TABLE1: dict[float | str, tuple[float, float]] = {
    "optimized": (0.13, 0.58),
    0.05: (0.38, 0.81),
    0.1: (0.33, 0.63),
    0.2: (0.28, 0.60),
    0.4: (0.21, 0.56),
    0.5: (0.20, 0.57),
    0.6: (0.21, 0.58),
    0.8: (0.33, 0.59),
    0.9: (0.46, 0.62),
    0.95: (0.68, 0.80),
}
"""√variance and √MSE in metres: Table I of Shen, Sun and Zhao, "Semi-Interpenetrating Cooperative Localization in
Connected Vehicle Networks"."""


def select(results: Sequence[Result], **labels: object) -> list[Result]:
    """The results with these labels, by seed."""
    found = [row for row in results if all(row[key] == value for key, value in labels.items())]
    return sorted(found, key=lambda row: int(row["seed"]))


def column(rows: Sequence[Result], name: str) -> list[float]:
    """One figure of each row."""
    return [row[name] for row in rows]


def unique(results: Sequence[Result], label: str) -> list[Any]:
    """The values of a label in the order in which they come."""
    return list(dict.fromkeys(row[label] for row in results))


def table1(results: Sequence[Result]) -> str:
    """Table I: the network's √variance and √MSE for each constant α, and for optimized weights."""
    rows = []
    for name in ("optimized", *(f"{alpha:g}" for alpha in ALPHAS)):
        found = select(results, weights=name)
        paper = PAPER_TABLE1["optimized" if name == "optimized" else float(name)]
        variance, error = column(found, "stacked_deviation_m"), column(found, "stacked_rmse_m")
        rows.append([name, mean_and_error(variance), mean_and_error(error), f"{paper[0]:.2f}", f"{paper[1]:.2f}"])
    header = ["α", "√variance [m]", "√MSE [m]", "the paper's √variance", "the paper's √MSE"]
    title = "# Table I: four vehicles on a directed ring"
    return f"{title}\n\n{markdown_table(header, rows)}\n\n{_table1_summary(results)}\n"


def _table1_summary(results: Sequence[Result]) -> str:
    means = {
        alpha: float(np.mean(column(select(results, weights=f"{alpha:g}"), "stacked_deviation_m")))
        for alpha in ALPHAS
    }
    best = min(means, key=lambda alpha: means[alpha])
    worst = max(means, key=lambda alpha: means[alpha])
    ratio, error = paired_ratio(
        column(select(results, weights="optimized"), "stacked_deviation_m"),
        column(select(results, weights=f"{best:g}"), "stacked_deviation_m"),
    )
    return (
        f"√variance is smallest at α = {best:g} and largest at α = {worst:g}; optimized weights have "
        f"{with_error(ratio, error, '.2f')} times that of the best constant. "
        f"{in_seeds(len(unique(results, 'seed')))}; estimates right after stacking, before the road weighs them."
    )


def table2(results: Sequence[Result]) -> str:
    """Table II: RMSE of each mechanism on each network, lanes bounded on one side (the paper's) and on two."""
    parts = ["# Table II: RMSE of the common error [m], the paper's profile"]
    for sides, name, title in (
        (1, "stacked_rmse_m", "Lanes bounded on one side, as the paper's; right after stacking"),
        (1, "rmse_m", "The same at the end of the period, once the roads have weighed the stack"),
        (2, "stacked_rmse_m", "Lanes bounded on both sides; right after stacking"),
    ):
        found = [row for row in results if row["sides"] == sides]
        if found:
            parts += [f"## {title}", _table2_section(found, name)]
    parts.append(f"{in_seeds(len(unique(results, 'seed')))}; 10 s.")
    return "\n\n".join(parts) + "\n"


def _table2_section(results: Sequence[Result], name: str) -> str:
    networks = unique(results, "network")
    rows = []
    for mechanism in unique(results, "mechanism"):
        row = [mechanism]
        for network in networks:
            row.append(mean_and_error(column(select(results, network=network, mechanism=mechanism), name)))
            row.append(f"{PAPER_RMSE_M[mechanism][network]:.2f}" if mechanism in PAPER_RMSE_M else "–")
        rows.append(row)
    row = ["random / optimized"]
    for network in networks:
        random, optimized = (
            column(select(results, network=network, mechanism=m), name) for m in ("random", "optimized")
        )
        ratio, error = paired_ratio(random, optimized)
        paper = PAPER_RMSE_M["random"][network] / PAPER_RMSE_M["optimized"][network]
        row += [with_error(ratio, error, ".2f"), f"{paper:.2f}"]
    header = ["mechanism", *(name for n in networks for name in (n.upper(), f"paper's {n.upper()}"))]
    return markdown_table(header, [*rows, row])


def default_profile(results: Sequence[Result]) -> str:
    """vnet's own profile: RMSE, the ratio to the bound, consistency and cost of each mechanism."""
    networks = unique(results, "network")
    mechanisms = unique(results, "mechanism")

    def table(title: str, cell: Callable[[list[Result], list[Result]], str]) -> str:
        rows = []
        for mechanism in mechanisms:
            row = [mechanism]
            for network in networks:
                found = select(results, network=network, mechanism=mechanism)
                bound = select(results, network=network, mechanism="bound")
                row.append(cell(*_same_seeds(found, bound)) if found else "–")
            rows.append(row)
        return f"## {title}\n\n" + markdown_table(["mechanism", *(n.upper() for n in networks)], rows)

    parts = [
        "# The default profile",
        _wanted(results, networks),
        table("RMSE of the common error [m]", lambda a, _: mean_and_error(column(a, "rmse_m"))),
        table("Relative to the bound, the same seeds", _ratio_to_bound),
        table("Relative to the bound, by component", _component_ratios),
        table("Network deviation [m]", lambda a, _: mean_and_error(column(a, "deviation_m"))),
        table("RMSE of the position [m]", lambda a, _: mean_and_error(column(a, "position_rmse_m"))),
        table("ANEES of the common error", lambda a, _: mean_and_error(column(a, "common_error_anees"), 2)),
        table("ANEES of the position", lambda a, _: mean_and_error(column(a, "position_anees"), 2)),
        table("Bytes a vehicle sends in a period; vehicles that diverged", _cost),
        _paired(results, networks),
        _notes(results),
    ]
    return "\n\n".join(parts) + "\n"


def _same_seeds(rows: list[Result], bound: list[Result]) -> tuple[list[Result], list[Result]]:
    seeds = {row["seed"] for row in rows}
    return rows, [row for row in bound if row["seed"] in seeds]


def _ratio_to_bound(rows: list[Result], bound: list[Result]) -> str:
    ratio, error = paired_ratio(column(rows, "rmse_m"), column(bound, "rmse_m"))
    return with_error(ratio, error, ".2f")


def _component_ratios(rows: list[Result], bound: list[Result]) -> str:
    return " / ".join(f"{ratio:.2f}" for ratio in _by_component(rows, bound)) or "–"


def _by_component(rows: list[Result], references: list[Result]) -> list[float]:
    """Ratios to the bound of each component; none if the components are not the same."""
    ours, bound = (np.array([row["component_rmse_m"] for row in some]) for some in (rows, references))
    if ours.shape != bound.shape:
        return []
    return [paired_ratio(a.tolist(), b.tolist())[0] for a, b in zip(ours.T, bound.T, strict=True)]


def _cost(rows: list[Result], _: list[Result]) -> str:
    size = [row["bytes"] for row in rows if row["bytes"] is not None]
    text = f"{np.mean(size):.0f} B" if size else "–"
    return f"{text}; {sum(row['divergent'] for row in rows)} in {len(rows)} runs"


def _wanted(results: Sequence[Result], networks: Sequence[str]) -> str:
    """The requirements on optimized weights, and whether they are met."""
    names = [f"at most {BOUND_RATIO} × the bound", "in each component", "no vehicle diverged"]
    names += [f"{a} not worse than {b}" for a, b in COMPARED]
    columns = []
    for network in networks:
        rows = select(results, network=network, mechanism="optimized")
        pair = _same_seeds(rows, select(results, network=network, mechanism="bound"))
        if not rows or len(pair[1]) != len(rows):
            columns.append(["–"] * len(names))
            continue
        ratio, error = paired_ratio(column(rows, "rmse_m"), column(pair[1], "rmse_m"))
        largest = max(_by_component(*pair), default=float("nan"))
        diverged = sum(column(rows, "divergent"))
        columns.append(
            [
                f"{_yes(ratio <= BOUND_RATIO)}: {with_error(ratio, error, '.2f')}",
                f"{_yes(largest <= BOUND_RATIO)}: {largest:.2f}",
                f"{_yes(diverged == 0)}: {diverged} in {len(rows)} runs",
                *(_not_worse(*_difference(results, network, a, b)) for a, b in COMPARED),
            ]
        )
    table = markdown_table(["", *(n.upper() for n in networks)], list(zip(names, *columns, strict=True)))
    return f"## What is wanted of optimized weights\n\n{table}"


COMPARED = (("optimized", "random"), ("random", "none"))
"""The first is wanted not worse than the second, by more than two standard errors of the paired difference."""


def _yes(so: bool) -> str:
    return "yes" if so else "**no**"


def _not_worse(difference: float, error: float, seeds: int) -> str:
    """Return whether a difference of errors is at most two standard errors above zero; unknown for one seed."""
    if seeds < 2:
        return "unknown" if seeds else "–"
    if difference > 2 * error:
        return f"**no**: worse by {difference:.3f} m"
    return "yes: better" if difference < -2 * error else "yes: no difference seen"


def _difference(results: Sequence[Result], network: str, a: str, b: str) -> tuple[float, float, int]:
    """RMSE of a less that of b over the seeds that both have: mean, standard error, seeds."""
    one, other = (select(results, network=network, mechanism=m) for m in (a, b))
    common = {row["seed"] for row in one} & {row["seed"] for row in other}
    values = [column([row for row in rows if row["seed"] in common], "rmse_m") for rows in (one, other)]
    return *paired_difference(*values), len(common)


def _paired(results: Sequence[Result], networks: Sequence[str]) -> str:
    rows = []
    for a, b in (*COMPARED, ("optimized", "optimized, one hop")):
        row = [f"{a} − {b}"]
        for network in networks:
            difference, error, seeds = _difference(results, network, a, b)
            row.append(
                f"{with_error(difference, error, '+.3f')} ({seeds} seed{'s' if seeds > 1 else ''})"
                if seeds
                else "–"
            )
        rows.append(row)
    return "## Paired differences [m]\n\n" + markdown_table(["", *(n.upper() for n in networks)], rows)


def _notes(results: Sequence[Result]) -> str:
    runs = len(unique(results, "seed"))
    low, high = anees_band(runs)
    return (
        f"100 s, counted from 20 s on; up to {in_seeds(runs)}. `bound` is a Kalman filter "
        "a connected component that hears every fix of it. `one hop` mixes particles as the paper does and passes "
        "no fixes on. Not worse: not by more than two standard errors of the paired difference. ANEES is 1 for a "
        f"consistent filter; the 95 % band of {runs} independent samples of two degrees of freedom is {low:.2f} to "
        f"{high:.2f} (the samples within a run are not independent)."
    )
