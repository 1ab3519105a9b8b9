"""A network by itself: its graph, and what the linear model says of each weight rule on it; no run is needed.

The graph is that of vehicles that hear each other, because consensus exchanges only there; the peer cap and
`radio.links` are taken into account, loss is not. Fastest-mixing weights (Xiao and Boyd 2004) are a bound for
symmetric weights, found by semidefinite programming with the optional cvxpy (`pip install vnet-emulator[sdp]`).

The paper's linear model is x(t+1) = A x(t) + w(t): row i of A holds vehicle i's fusion weights, w its filter's own
noise. With A 1 = 1 the mean of all estimates is a random walk that no fusion bounds; what fusion does bound are the
deviations from it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group
from rich.table import Table
from rich.text import Text
from scipy.linalg import solve_discrete_lyapunov
from scipy.sparse.csgraph import connected_components, shortest_path

from emulator.radio.topology import Topology, connectivity_of
from emulator.records.recorded_run import RecordedRun
from emulator.records.tables import METRICS
from emulator.scenario.scenario import Scenario, lookahead_ns
from emulator.world import neighbours
from emulator.world.world import World, build_world, components
from vnet.errors import ScenarioError, VnetError
from vnet.extras import is_installed, needs
from vnet.types import Array
from vnet.units import NS_PER_MS

Links = NDArray[np.bool_]
FASTEST = "fastest-mixing"
NO_CVXPY = f"fastest-mixing weights left out: this {needs('cvxpy')}"


def steady_state_covariance(transition: Array, noise: Array) -> Array:
    """Return the covariance P (N, N) of the steady state, P = A P Aᵀ + Q, for `transition` A and the covariance
    `noise` Q of w.

    The discrete Lyapunov equation. Raises VnetError if no such P exists: for a spectral radius of 1 or more.
    """
    radius = float(np.abs(np.linalg.eigvals(transition)).max())
    if radius >= 1 - 1e-12:
        raise VnetError(f"spectral radius {radius:.6g}: there is a steady state only below 1")
    return np.asarray(solve_discrete_lyapunov(transition, noise))


def deviation_covariance(weights: Array, noise: Array) -> Array:
    """Return the steady covariance (N, N) of x_i − x̄ for fusion weights with rows that add up to 1.

    With D = I − 11ᵀ/N the deviations y = D x follow y(t+1) = D A y(t) + D w(t), because A 1 = 1. Raises VnetError
    for other row sums, and for a network in which information does not reach every vehicle.
    """
    sums = weights.sum(axis=1)
    if not np.allclose(sums, 1.0):
        row = int(np.argmax(np.abs(sums - 1)))
        raise VnetError(f"weights of row {row} add up to {sums[row]:.6g}: 1 expected")
    deviation = np.eye(len(weights)) - 1 / len(weights)
    return steady_state_covariance(deviation @ weights, deviation @ noise @ deviation)


def convergence_factor(weights: Array) -> float:
    """Return the factor by which a round of x(t+1) = A x(t) contracts the deviations in the long run.

    The second-largest |eigenvalue| of A (Xiao and Boyd 2004); ρ(A − 11ᵀ/N) is the same only for doubly
    stochastic A.
    """
    if len(weights) == 1:
        return 0.0
    return float(np.sort(np.abs(np.linalg.eigvals(weights)))[-2])


def analyze(scenario: Scenario, run: Path | None = None) -> dict[str, Any]:
    """Analyze the scenario's network before any run, as plain numbers; `analysis_table` prints them.

    `lookahead_ms` is the longest window of a run in lockstep (docs/virtual-time.md).
    `components` are sizes, largest first, of who is linked both ways (`weak_components` counts links of one
    direction as well, as the metrics of a run do). Of each of the `rules`: `convergence_factor` (r_asym, 1.0 where
    the network is not connected), `spectral_gap` (1 less that), `deviation_variance`, the steady variance
    per axis of x_i − x̄, a mean over vehicles, with noise of unit variance a round (None where it grows for ever),
    and both for each component by itself, where x̄ is the component's mean. `run`, a run's folder, adds `measured`.
    Raises VnetError where the network or the run cannot be used.
    """
    if scenario.network.moves:
        raise ScenarioError("analyze: says what one graph is like, and where vehicles move the network has many")
    world = build_world(scenario)
    hears = hears_matrix(scenario, world)
    position_m = world.at(0).position_m
    weak = components(position_m, neighbours.Links.of_matrix(hears, position_m))
    result = {"weak_components": _sizes(weak)} | analyze_graph(hears)
    result["lookahead_ms"] = lookahead_ns(scenario) / NS_PER_MS
    if run is not None:
        result["measured"] = _measured(run, result["rules"])
    return result


def analyze_graph(hears: Links) -> dict[str, Any]:
    """The same from the matrix of who (row) hears whom (column), (N, N)."""
    linked = mutual(hears)
    degree = linked.sum(axis=1)
    values, counts = np.unique(degree, return_counts=True)
    connectivity = shortest_path(linked.astype(float), unweighted=True)
    laplacian = np.diag(degree) - linked.astype(float)
    label = _labels(linked)
    groups = [np.flatnonzero(label == number) for number in np.argsort(-np.bincount(label), kind="stable")]
    return {
        "vehicles": len(linked),
        "components": [len(group) for group in groups],
        "links": int(degree.sum()) // 2,
        "one_way_links": int((hears & ~hears.T).sum()),
        "degree": {"min": int(degree.min()), "median": float(np.median(degree)), "max": int(degree.max())},
        "degree_histogram": dict(zip(values.tolist(), counts.tolist(), strict=True)),
        "diameter": int(connectivity[np.isfinite(connectivity)].max()),
        "algebraic_connectivity": float(max(0.0, np.linalg.eigvalsh(laplacian)[1])) if len(linked) > 1 else None,
        "rules": {name: _rule_figures(make(linked), groups) for name, make in weight_rules().items()},
        "left_out": [] if has_cvxpy() else [NO_CVXPY],
    }


def _rule_figures(weights: Array, groups: list[NDArray[np.intp]]) -> dict[str, Any]:
    blocks = [weights[np.ix_(group, group)] for group in groups]
    factors = [convergence_factor(block) for block in blocks]
    variances = [float(np.trace(deviation_covariance(b, np.eye(len(b)))) / len(b)) for b in blocks]
    factor = factors[0] if len(blocks) == 1 else 1.0
    return {
        "convergence_factor": factor,
        "spectral_gap": 1 - factor,
        "deviation_variance": variances[0] if len(blocks) == 1 else None,
        "component_convergence_factor": factors,
        "component_deviation_variance": variances,
    }


def _measured(run: Path, rules: dict[str, Any]) -> dict[str, Any]:
    """The run's deviation (root of mean squares, in metres, after its first fifth) and what noise would explain it.

    `noise_m` is, by rule, the noise per axis and round with which the linear model deviates as much.
    """
    key = RecordedRun.open(run).record.key_figures
    figure = next((each.name for each in key if each.of_agreement), None)
    if figure is None:
        raise VnetError(f"{run}: its program declares no deviation between vehicles")
    values = RecordedRun.open(run, {METRICS: [figure]}).metrics[figure].to_pylist()
    settled = [value for value in values[len(values) // 5 :] if value is not None]
    if not settled:
        raise VnetError(f"{run}: no {figure} in it; its program reported nothing of the kind")
    deviation = float(np.sqrt(np.mean(np.square(settled))))
    variance = {name: figures["deviation_variance"] for name, figures in rules.items()}
    noise = {name: deviation / float(np.sqrt(2 * value)) for name, value in variance.items() if value}
    return {"deviation": deviation, "noise_m": noise}


# Graphs.


def hears_matrix(scenario: Scenario, world: World) -> Links:
    """Directed links at the start, (N, N), row i hears column j: range, links or path loss, and the peer cap."""
    connectivity = connectivity_of(scenario.radio, scenario.run.seed, world.radio_inputs)
    topology = Topology(world.at(0).position_m, connectivity, scenario.radio.max_peers)
    return topology.admitted_links().matrix().T


def mutual(hears: Links) -> Links:
    """Links that work in both directions, (N, N), without the diagonal."""
    linked: Links = hears & hears.T
    np.fill_diagonal(linked, False)
    return linked


def is_connected(linked: Links) -> bool:
    """Return True if the graph is connected."""
    return bool(_labels(linked).max() == 0)


def _labels(linked: Links) -> NDArray[np.intp]:
    _, label = connected_components(linked, directed=False)
    return np.asarray(label, dtype=np.intp)


def _sizes(label: NDArray[np.intp]) -> list[int]:
    return sorted(np.bincount(label).tolist(), reverse=True)


# Weight rules: matrices A (N, N) of x(t+1) = A x(t) on the links (N, N) of a graph.


def weight_rules() -> dict[str, Callable[[Links], Array]]:
    """By name; fastest-mixing only where cvxpy is installed."""
    rules: dict[str, Callable[[Links], Array]] = {
        "constant": constant_matrix,
        "metropolis": metropolis_matrix,
        "max-degree": max_degree_matrix,
    }
    return rules | {FASTEST: fastest_mixing_matrix} if has_cvxpy() else rules


def constant_matrix(linked: Links) -> Array:
    """1/(d_max + 1) on each link, with the largest degree of the whole network."""
    return _completed(linked, 1 / (1 + linked.sum(axis=1).max()))


def max_degree_matrix(linked: Links) -> Array:
    """1/(d_max + 1) on each link, with the largest degree of the component: as far as word of it comes."""
    degree, label = linked.sum(axis=1), _labels(linked)
    largest = np.array([degree[label == each].max() for each in label])
    return _completed(linked, 1 / (1 + largest[:, None]))


def metropolis_matrix(linked: Links) -> Array:
    """1/(1 + max(d_i, d_j)) on each link."""
    degree = linked.sum(axis=1)
    return _completed(linked, 1 / (1 + np.maximum.outer(degree, degree)))


def ratio_matrix(linked: Links) -> Array:
    """Mass matrix of a round of ratio consensus: A_ij = 1/(d_j + 1). Its columns add up to 1, not its rows."""
    return np.asarray((linked + np.eye(len(linked))) / (linked.sum(axis=0) + 1))


def _completed(linked: Links, weight: Array) -> Array:
    """Return the weights of the links, with the rest of each row for the vehicle itself."""
    weights = np.where(linked, weight, 0.0)
    np.fill_diagonal(weights, 1 - weights.sum(axis=1))
    return weights


def has_cvxpy() -> bool:
    """Return True if fastest-mixing weights can be computed (cvxpy is installed)."""
    return is_installed("cvxpy")


def fastest_mixing_matrix(linked: Links) -> Array:
    """Symmetric weights with the smallest convergence factor, component by component; some may be negative.

    min ‖I − B diag(w) Bᵀ − 11ᵀ/N‖₂ over the weights w of the links (Xiao and Boyd 2004, 3.1 and 5.1). Raises
    VnetError without cvxpy, and where its solver finds no optimum.
    """
    if not has_cvxpy():
        raise VnetError(NO_CVXPY)
    label = _labels(linked)
    weights = np.eye(len(linked))
    for number in range(int(label.max()) + 1):
        group = np.flatnonzero(label == number)
        if len(group) > 1:
            weights[np.ix_(group, group)] = _solve_sdp(linked[np.ix_(group, group)])
    return weights


def _solve_sdp(linked: Links) -> Array:
    cp: Any = importlib.import_module("cvxpy")
    count = len(linked)
    first, second = np.nonzero(np.triu(linked))
    incidence = np.zeros((count, len(first)))
    incidence[first, np.arange(len(first))] = 1
    incidence[second, np.arange(len(first))] = -1
    weight, bound = cp.Variable(len(first)), cp.Variable()
    away = np.eye(count) - 1 / count - incidence @ cp.diag(weight) @ incidence.T
    problem = cp.Problem(cp.Minimize(bound), [bound * np.eye(count) >> away, away >> -bound * np.eye(count)])
    problem.solve(solver="CLARABEL")
    if problem.status != "optimal":
        raise VnetError(f"fastest-mixing weights of {count} vehicles: cvxpy says {problem.status}")
    return np.asarray(np.eye(count) - incidence @ np.diag(weight.value) @ incidence.T)


# Printing.


def analysis_table(analysis: dict[str, Any]) -> Group:
    """An analysis for the terminal."""
    graph = Table(title="network", title_justify="left")
    graph.add_column("figure")
    graph.add_column("value", overflow="fold")
    for name, value in _graph_rows(analysis):
        graph.add_row(name, value)
    parts: list[Any] = [graph, _rules_table(analysis), *map(Text, analysis["left_out"])]
    if "measured" in analysis:
        parts.append(f"measured: deviation {analysis['measured']['deviation']:.4g} m")
    return Group(*parts)


def _graph_rows(analysis: dict[str, Any]) -> list[tuple[str, str]]:
    degree, connectivity = analysis["degree"], analysis["algebraic_connectivity"]
    histogram = "  ".join(f"{value}:{count}" for value, count in analysis["degree_histogram"].items())
    return [
        ("vehicles", str(analysis["vehicles"])),
        ("components (vehicles)", ", ".join(map(str, analysis["components"]))),
        ("links, both ways / one way", f"{analysis['links']} / {analysis['one_way_links']}"),
        ("degree: min / median / max", f"{degree['min']} / {degree['median']:g} / {degree['max']}"),
        ("degree:vehicles", histogram),
        ("diameter (hops)", str(analysis["diameter"])),
        ("algebraic connectivity", "–" if connectivity is None else f"{connectivity:.4g}"),
        *([("lookahead (ms)", f"{analysis['lookahead_ms']:g}")] if "lookahead_ms" in analysis else []),
    ]


def _rules_table(analysis: dict[str, Any]) -> Table:
    noise = analysis.get("measured", {}).get("noise_m")
    table = Table(
        title="linear model, by weight rule (noise of unit variance a round)",
        title_justify="left",
        caption="of components: each by itself, in the order above" if len(analysis["components"]) > 1 else None,
    )
    headings = ["rule", "r_asym", "spectral gap", "variance of deviations", "r_asym of components"]
    for heading in [*headings, *(["noise that explains the run, m"] if noise is not None else [])]:
        table.add_column(heading)
    for name, figures in analysis["rules"].items():
        variance = figures["deviation_variance"]
        row = [
            name,
            f"{figures['convergence_factor']:.4f}",
            f"{figures['spectral_gap']:.4f}",
            "unbounded" if variance is None else f"{variance:.4g}",
            " ".join(f"{factor:.4f}" for factor in figures["component_convergence_factor"]),
        ]
        if noise is not None:
            row.append(f"{noise[name]:.3g}" if name in noise else "–")
        table.add_row(*row)
    return table
