"""The consensus study: how far each rule's mean is off, by rounds, loss, delay, one-way links and churn.

Every vehicle holds one fixed input (`agents/averaging.py`), so that nothing but the consensus is measured; the
error is √(mean‖m_i − x̄‖²) over the vehicles, in units of the inputs' own spread √(mean‖x_i − x̄‖²). Beside it
stands the linear model of the same network, and the fastest-mixing weights (Xiao and Boyd 2004) as the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from emulator.analyze import (
    FASTEST,
    NO_CVXPY,
    Links,
    convergence_factor,
    fastest_mixing_matrix,
    has_cvxpy,
    hears_matrix,
    is_connected,
    max_degree_matrix,
    metropolis_matrix,
    mutual,
    ratio_matrix,
)
from emulator.cells.cells import Cell, read_series, run_cells, write_results
from emulator.pages.palette import PALETTE
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world
from studies.measure import study_cell
from studies.paper import PAPER_RANGE_M
from vnet.errors import VnetError
from vnet.types import Array

RULES = ("ratio", "metropolis", "max-degree")
LOSSES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
LATENCIES_MS = (50.0, 150.0, 250.0)
NEAR_MS = 2.0
ROUNDS = 300
PERIOD_S = 0.1
AFTER = (50, 100, 150)
TARGET, TARGET_LOSS, TARGET_ROUNDS = 1e-3, 0.3, 150
ONE_WAY_SHARE, CHURN_SHARE = 0.1, 0.1
AWAY_S = (6.0, 20.0)
LEAST_SLOPE = 1e-9
"""Slope a round up to which an error counts as constant: rounding makes a slope of about 1e-17."""
FLOOR = 1e-10
"""Smaller relative errors are rounding: the convergence factor is measured above."""
COLOURS = {
    "ratio": PALETTE["blue"].light,
    "metropolis": PALETTE["red"].light,
    "max-degree": PALETTE["green"].light,
    FASTEST: "0",
}
MARKERS = {"ratio": "o", "metropolis": "s", "max-degree": "^"}


@dataclass(frozen=True)
class Study:
    """Results of the study: the network's links (N, N), and a relative error (rounds + 1,) for each cell.

    Entry t of an error is after t exchanges of frames; NaN where no vehicle had a mean.
    """

    linked: Links
    labels: list[dict[str, Any]]
    errors: list[Array]

    def select(self, **wanted: Any) -> Array:
        """Errors (seeds, rounds + 1) of the cells with these labels."""
        pairs = zip(self.labels, self.errors, strict=True)
        return np.array([e for label, e in pairs if all(label[k] == v for k, v in wanted.items())])


def study_network(network: dict[str, Any], seeds: Sequence[int], out: Path, rounds: int = ROUNDS) -> str:
    """Run the study on a `[network]`, for so many rounds; returns its tables in Markdown.

    Writes consensus.parquet, consensus.png and consensus.svg into `out`, and goes on where it was interrupted.
    Raises VnetError if the network is not connected, or a cell cannot be run.
    """
    _, linked = graph(network)
    if not is_connected(linked):
        raise VnetError("the consensus study needs a network that is connected: its error is that of one mean")
    cells = consensus_cells(network, seeds, rounds)
    results = run_cells(cells, out, title="consensus")
    errors = [_relative_error(cell, out) for cell in cells]
    study = Study(linked, [dict(cell.labels) for cell in cells], errors)
    for result, error in zip(results, errors, strict=True):
        result |= {f"error_{after}": _at(error, after) for after in _columns(rounds)}
        result["convergence_factor"] = measured_factor(error) if _is_plain(result) else None
    write_results(results, out, "consensus")
    models = model_matrices(linked)
    draw(study, models, out / "consensus")
    return _markdown(study, results, models, seeds)


# Cells.


def consensus_cells(network: dict[str, Any], seeds: Sequence[int], rounds: int = ROUNDS) -> list[Cell]:
    """All runs of the study: each varies one thing, for each rule and seed."""
    node_ids, linked = graph(network)
    cells = []
    for rule in RULES:
        for seed in seeds:
            for loss in LOSSES:
                cells.append(_cell("loss", network, rule, seed, rounds, {"loss": loss}))
            for latency_ms in LATENCIES_MS:
                cells.append(_cell("delay", network, rule, seed, rounds, {"latency_ms": latency_ms}))
            radio = {"links": one_way_links(linked, seed).astype(int).tolist()}
            cells.append(_cell("one-way links", network, rule, seed, rounds, radio))
            silent = silent_vehicles(node_ids, linked, seed)
            cells.append(_cell("churn", network, rule, seed, rounds, {}, silent))
    return cells


def graph(network: dict[str, Any]) -> tuple[tuple[str, ...], Links]:
    """The vehicles of a `[network]`, and who of them are linked, (N, N)."""
    scenario = _scenario(network, "ratio", 1, 0)
    world = build_world(scenario)
    return world.node_ids, mutual(hears_matrix(scenario, world))


def _cell(
    study: str,
    network: dict[str, Any],
    rule: str,
    seed: int,
    rounds: int,
    radio: dict[str, Any],
    silent: dict[str, list[float]] | None = None,
) -> Cell:
    labels: dict[str, str | int | float] = {
        "study": study,
        "rule": rule,
        "loss": radio.get("loss", 0.0),
        "latency_ms": radio.get("latency_ms", NEAR_MS),
        "seed": seed,
    }
    return study_cell(labels, _scenario(network, rule, seed, rounds, radio, silent))


def _scenario(
    network: dict[str, Any],
    rule: str,
    seed: int,
    rounds: int,
    radio: dict[str, Any] | None = None,
    silent: dict[str, list[float]] | None = None,
) -> Scenario:
    return Scenario.model_validate(
        {
            "run": {"name": "consensus", "seed": seed, "duration_s": PERIOD_S * (rounds + 1)},
            "network": network,
            "world": {"gnss": {"rate_hz": 1 / PERIOD_S}},
            "radio": {"range_m": PAPER_RANGE_M, "latency_ms": NEAR_MS} | (radio or {}),
            "program": {"entry": "agents.averaging:main", "options": {"rule": rule, "silent": silent or {}}},
        }
    )


def one_way_links(linked: Links, seed: int) -> Links:
    """Directed links, row i hears column j, a tenth of which work in one direction only; still connected."""
    rng = np.random.default_rng([seed, 1])
    links = np.argwhere(np.triu(linked))
    wanted = round(ONE_WAY_SHARE * len(links))
    hears = linked.copy()
    for link in rng.permutation(links).tolist():
        if wanted == 0:
            break
        listener, speaker = rng.permutation(link).tolist()
        hears[listener, speaker] = False
        if is_connected(mutual(hears)):
            wanted -= 1
        else:
            hears[listener, speaker] = True
    return hears


def silent_vehicles(node_ids: Sequence[str], linked: Links, seed: int) -> dict[str, list[float]]:
    """A tenth of the vehicles, away for a while (`AWAY_S`); those who stay are still connected."""
    away: list[int] = []
    for number in np.random.default_rng([seed, 2]).permutation(len(node_ids)).tolist():
        stay = np.setdiff1d(np.arange(len(node_ids)), [*away, number])
        if len(away) < round(CHURN_SHARE * len(node_ids)) and is_connected(linked[np.ix_(stay, stay)]):
            away.append(number)
    return {node_ids[number]: list(AWAY_S) for number in sorted(away)}


# Figures of a cell.


def _relative_error(cell: Cell, folder: Path) -> Array:
    table = read_series(cell, folder)
    error, spread = (table[name].to_numpy() for name in ("consensus_error_m", "deviation_m"))
    return np.asarray(error / spread, dtype=float)


def _at(error: Array, after: int) -> float | None:
    return float(error[after]) if np.isfinite(error[after]) else None


def _columns(rounds: int) -> list[int]:
    return sorted({*(after for after in AFTER if after < rounds), rounds})


def _is_plain(labels: dict[str, Any]) -> bool:
    """Return True if the run was the linear iteration, with or without a delay."""
    return bool(labels["study"] == "delay" or (labels["study"] == "loss" and labels["loss"] == 0))


def measured_factor(error: Array) -> float | None:
    """By what factor a round reduces `error` (rounds + 1,): the slope of its logarithm, late but above rounding.

    None where fewer than ten rounds are left to measure, or the error does not fall.
    """
    good = np.isfinite(error) & (error > FLOOR)
    end = len(error) if good[-1] else int(np.flatnonzero(good).max(initial=-1)) + 1
    start = int(np.flatnonzero(good).min(initial=end))
    rounds = np.arange(start + (end - start) // 2, end)
    rounds = rounds[good[rounds]]
    if len(rounds) < 10:
        return None
    slope = float(np.polyfit(rounds, np.log(error[rounds]), 1)[0])
    return float(np.exp(slope)) if slope < -LEAST_SLOPE else None


# The linear model.


def model_matrices(linked: Links) -> dict[str, Array]:
    """The matrix of each rule, and the fastest-mixing one where cvxpy is installed."""
    models = {
        "ratio": ratio_matrix(linked),
        "metropolis": metropolis_matrix(linked),
        "max-degree": max_degree_matrix(linked),
    }
    return models | {FASTEST: fastest_mixing_matrix(linked)} if has_cvxpy() else models


def model_error(weights: Array, rounds: int) -> Array:
    """Relative error (rounds + 1,) that the linear model expects of independent inputs of equal variance.

    Masses s = Aᵗ x and w = Aᵗ 1; the ratio s/w is off by M (x − x̄) with M = diag(1/w) Aᵗ: where rows of A add up
    to 1, w stays 1 and this is plain averaging.
    """
    count = len(weights)
    apart = np.eye(count) - 1 / count
    power, errors = np.eye(count), []
    for _ in range(rounds + 1):
        errors.append(np.linalg.norm(power @ apart / power.sum(axis=1)[:, None]) / np.sqrt(count - 1))
        power = weights @ power
    return np.array(errors)


def rounds_to_percent(error: Array) -> int | None:
    """After how many rounds `error` (rounds + 1,) stays below 1 %; None if it does not."""
    above = np.flatnonzero(~(error < 0.01))
    first = int(above.max(initial=-1)) + 1
    return first if first < len(error) else None


# The picture.


def draw(study: Study, models: dict[str, Array], path: Path) -> None:
    """Error against rounds without loss, and after 150 rounds against loss: `path`.png and `path`.svg."""
    from matplotlib import rc_context  # slow to import, and only pictures need it
    from matplotlib.figure import Figure

    with rc_context({"svg.hashsalt": "vnet", "svg.fonttype": "none", "font.size": 10}):
        figure = Figure(figsize=(11, 5.4), layout="constrained")
        left, right = figure.subplots(1, 2)
        _draw_rounds(left, study, models)
        _draw_loss(right, study)
        figure.savefig(path.with_suffix(".png"), dpi=150)
        figure.savefig(path.with_suffix(".svg"), metadata={"Date": None})


def _draw_rounds(axes: Any, study: Study, models: dict[str, Array]) -> None:
    rounds = len(study.errors[0]) - 1
    for rule in RULES:
        errors = study.select(study="loss", rule=rule, loss=0.0)
        axes.plot(_geometric_mean(errors), color=COLOURS[rule], linewidth=2, label=f"{rule}, measured")
        axes.plot(
            model_error(models[rule], rounds), "--", color=COLOURS[rule], linewidth=1, label=f"{rule}, linear model"
        )
    if FASTEST in models:
        error = model_error(models[FASTEST], rounds)
        axes.plot(error, ":", color=COLOURS[FASTEST], linewidth=1.5, label=f"{FASTEST} weights, linear model")
    _finish(axes, "rounds, one every 0.1 s", f"{len(study.linked)} vehicles, no loss")
    axes.set_xlim(0, rounds)
    axes.set_ylim(1e-10, 20)


def _draw_loss(axes: Any, study: Study) -> None:
    after = min(TARGET_ROUNDS, len(study.errors[0]) - 1)
    for rule in RULES:
        errors = np.array([study.select(study="loss", rule=rule, loss=loss)[:, after] for loss in LOSSES])
        middle = np.array([_geometric_mean(row) for row in errors])
        reach = np.abs(np.array([errors.min(axis=1), errors.max(axis=1)]) - middle)
        percent = [100 * loss for loss in LOSSES]
        style = {"color": COLOURS[rule], "marker": MARKERS[rule], "capsize": 3, "label": rule}
        axes.errorbar(percent, middle, reach, **style)
    axes.axhline(TARGET, color="0.4", linestyle=":", label=f"{TARGET:g}: wanted of ratio at 30 %")
    _finish(axes, "loss of each frame at each receiver, %", f"after {after} rounds; bars span the seeds")


def _finish(axes: Any, label: str, title: str) -> None:
    axes.set_yscale("log")
    axes.set_xlabel(label)
    axes.set_ylabel("consensus error / spread of the inputs (no unit)")
    axes.set_title(title)
    axes.grid(True, which="major", alpha=0.3)
    axes.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.13), frameon=False)


def _geometric_mean(errors: Array) -> Any:
    return np.exp(np.mean(np.log(errors), axis=0))


# The table.


def _markdown(study: Study, results: list[dict[str, Any]], models: dict[str, Array], seeds: Sequence[int]) -> str:
    rounds = len(study.errors[0]) - 1
    lines = [
        "# Consensus",
        "",
        f"{len(study.linked)} vehicles, {int(study.linked.sum()) // 2} links, seeds {', '.join(map(str, seeds))}; "
        f"one round and one frame every {PERIOD_S:g} s. Errors are √(mean‖m_i − x̄‖²) over the vehicles that have a "
        "mean, as a share of the inputs' spread √(mean‖x_i − x̄‖²): mean over seeds (largest).",
        "",
        *_verdict(study),
        "## Error by rounds",
        "",
        *_error_table(results, rounds),
        "",
        "A dash: no vehicle has a mean yet. Ratio consensus serves none before its first epoch has settled, and "
        f"the old one after a change of members. Delay: what a frame takes; {NEAR_MS:g} ms otherwise. One-way "
        f"links: {ONE_WAY_SHARE:.0%} of all links. Churn: {CHURN_SHARE:.0%} of the vehicles are away from "
        f"{AWAY_S[0]:g} s to {AWAY_S[1]:g} s (rounds {AWAY_S[0] / PERIOD_S:.0f} to {AWAY_S[1] / PERIOD_S:.0f}) and "
        "start afresh; x̄ is the mean of those who are there.",
        "",
        "## Convergence without loss",
        "",
        *_factor_table(study, models, rounds),
        "",
        "![error by rounds and by loss](consensus.png)",
        "",
    ]
    return "\n".join(lines)


def _verdict(study: Study) -> list[str]:
    if len(study.errors[0]) <= TARGET_ROUNDS:
        return []
    worst = float(study.select(study="loss", rule="ratio", loss=TARGET_LOSS)[:, TARGET_ROUNDS].max())
    word = "met" if worst < TARGET else "**missed**"
    text = f"Wanted: ratio within {TARGET:g} of the spread after {TARGET_ROUNDS} rounds at {TARGET_LOSS:.0%} loss: "
    return [f"{text}{word}, {worst:.1e} at the worst seed.", ""]


def _error_table(results: list[dict[str, Any]], rounds: int) -> list[str]:
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for result in results:
        key = tuple(result[name] for name in ("study", "loss", "latency_ms", "rule"))
        groups.setdefault(key, []).append(result)
    order = {name: number for number, name in enumerate(("loss", "delay", "one-way links", "churn"))}
    columns = _columns(rounds)
    lines = [_row(["", "rule", *(f"{after} rounds" for after in columns)]), _row(["---"] * (2 + len(columns)))]
    for key in sorted(groups, key=lambda key: (order[key[0]], key[1], key[2], RULES.index(key[3]))):
        study, loss, latency_ms, rule = key
        what = {"loss": f"loss {loss:.0%}", "delay": f"delay {latency_ms:g} ms"}.get(study, study)
        cells = [_mean_and_largest([result[f"error_{after}"] for result in groups[key]]) for after in columns]
        lines.append(_row([what, rule, *cells]))
    return lines


def _mean_and_largest(values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "–"
    return f"{np.mean(known):.1e}" + (f" ({max(known):.1e})" if len(known) > 1 else "")


def _factor_table(study: Study, models: dict[str, Array], rounds: int) -> list[str]:
    headings = ["rule", "factor a round, measured", "linear model", "rounds to 1 %, measured", "linear model"]
    lines = [_row(headings), _row(["---"] * len(headings))]
    for rule, matrix in models.items():
        errors = study.select(study="loss", rule=rule, loss=0.0)
        factors = [factor for error in errors if (factor := measured_factor(error)) is not None]
        measured = f"{np.mean(factors):.4f}" if factors else "–"
        needed = [rounds_to_percent(error) for error in errors]
        known = [value for value in needed if value is not None]
        took = f"{np.mean(known):.0f}" if known and len(known) == len(needed) else "–"
        expected = rounds_to_percent(model_error(matrix, max(rounds, 1000)))
        model = [f"{convergence_factor(matrix):.4f}", "–" if expected is None else str(expected)]
        lines.append(_row([rule, measured, model[0], took, model[1]]))
    return lines if FASTEST in models else [*lines, "", NO_CVXPY]


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
