"""`vnet experiment`: the paper's tables and figures, and vnet's own, with one command each.

`pyproject.toml` beside this file registers it as an entry point of the group `vnet.commands`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console
from rich.markdown import Markdown

from emulator.cells.cells import Cell, run_cells, write_results
from emulator.cli.application import group
from emulator.cli.options import pair
from emulator.scenario.sections import DAY_S
from emulator.terminal.console import one_line_errors, tell
from studies import paper
from studies.paper import PAPER_RMSE_M
from vnet.errors import VnetError

app = group("Run the paper's experiments, and vnet's own: in a clone of vnet, no part of the wheel.")
FOLDER = Path("runs/experiments")

NetworksOption = Annotated[
    Path | None,
    typer.Option(metavar="FOLDER", help="With network_n1.csv, _n2, _n3; generated ones otherwise."),
]
OutOption = Annotated[
    Path | None, typer.Option(metavar="FOLDER", help="For the results; an interrupted run goes on there.")
]
WholeOption = Annotated[Path | None, typer.Option("--out", metavar="FOLDER", help="For the results.")]
"""The same of a study that cannot go on with an interrupted run."""
LiveOption = Annotated[
    bool, typer.Option("--live", metavar="", help="Run over Zenoh, a process a vehicle, and not simulated.")
]
OnlyOption = Annotated[
    list[str] | None,
    typer.Option(
        "--only", metavar="LABEL=VALUE", help="Only such cells, as network=n2; several of one label: any."
    ),
]
SeedsOption = Annotated[int, typer.Option(min=1, metavar="N", help="Seeds 1 … N.")]
DurationOption = Annotated[
    float, typer.Option(min=2, max=DAY_S, metavar="SECONDS", help="Emulated length of each run.")
]
# How the map of recorded trips lies.
MapSigmaOption = Annotated[
    float, typer.Option(min=0, metavar="METRES", help="How far true lanes stray from the map's.")
]
MapAsideOption = Annotated[
    float, typer.Option(metavar="METRES", help="How far right of the map's lanes vehicles drive.")
]
MapDatumOption = Annotated[
    str | None, typer.Option(metavar="EAST,NORTH", help="How far the map is moved, in metres: vnet map datum.")
]
MapDatumSigmaOption = Annotated[
    float, typer.Option(min=0, metavar="METRES", help="How far the whole map may still be shifted.")
]


@app.command()
def table1(
    seeds: SeedsOption = 20, out: OutOption = None, only: OnlyOption = None, live: LiveOption = False
) -> None:
    """Table I: four vehicles on a directed ring, constant α against optimized weights."""
    from studies import figures, reports

    with one_line_errors():
        folder = _folder(out, "table1")
        paper.write_crossing(folder / "crossing.csv")
        cells = paper.table1_cells(range(1, seeds + 1), folder / "crossing.csv")
        results = _run(cells, folder, "table1", only, live)
        if only is None:
            figures.alpha_curve(results, reports.PAPER_TABLE1, folder / "table1")
            _show(reports.table1(results), folder / "table1.md")


@app.command()
def table2(
    networks: NetworksOption = None,
    seeds: SeedsOption = 10,
    out: OutOption = None,
    only: OnlyOption = None,
    live: LiveOption = False,
) -> None:
    """Table II: the paper's profile on N1, N2 and N3, lanes bounded on one side and on two."""
    from studies import reports

    with one_line_errors():
        folder = _folder(out, "table2")
        cells = paper.table2_cells(paper.network_sections(networks), range(1, seeds + 1))
        results = _run(cells, folder, "table2", only, live)
        if only is None and not live:  # of live runs no series are kept
            _draw_against_time(cells, folder, folder)
        if only is None:
            _show(reports.table2(results), folder / "table2.md")


@app.command()
def default(
    networks: NetworksOption = None,
    seeds: SeedsOption = 10,
    out: OutOption = None,
    only: OnlyOption = None,
    live: LiveOption = False,
) -> None:
    """vnet's own profile on the same networks, against the hears-all bound. Takes hours for all."""
    from studies import reports

    with one_line_errors():
        folder = _folder(out, "default")
        cells = paper.default_cells(paper.network_sections(networks), range(1, seeds + 1))
        results = paper.with_bound(_run(cells, folder, "default", only, live))
        if any(row["mechanism"] == "bound" for row in results):
            _show(reports.default_profile(results), folder / "default.md")


@app.command()
def divergence(
    networks: NetworksOption = None,
    seeds: SeedsOption = 100,
    duration: Annotated[
        float, typer.Option(min=1, max=DAY_S, metavar="SECONDS", help="Emulated length of each run.")
    ] = 30.0,
    out: OutOption = None,
    only: OnlyOption = None,
) -> None:
    """Does the default profile ever diverge? Many seeds on each network, and the worst of them."""
    from studies import divergence as study

    with one_line_errors():
        folder = _folder(out, "divergence")
        cells = study.divergence_cells(paper.network_sections(networks), range(1, seeds + 1), duration)
        results = _run(cells, folder, "divergence", only)
        _show(study.report(results), folder / "divergence.md")


@app.command()
def attackers(
    networks: NetworksOption = None,
    seeds: SeedsOption = 3,
    duration: DurationOption = 30.0,
    out: OutOption = None,
    only: OnlyOption = None,
) -> None:
    """Attackers: the error that each kind of false frames costs the other vehicles, on the same seeds."""
    from studies import attackers as study

    with one_line_errors():
        folder = _folder(out, "attackers")
        cells = study.attack_cells(paper.network_sections(networks), range(1, seeds + 1), duration)
        results = _run(cells, folder, "attackers", only)
        _show(study.report(results, duration), folder / "attackers.md")


@app.command()
def compare(
    study: Annotated[
        Literal["ablation", "ablation-full", "baselines", "receivers", "churn"],
        typer.Argument(help="What the cooperative program is compared with."),
    ],
    networks: NetworksOption = None,
    seeds: SeedsOption = 10,
    duration: Annotated[
        float | None,
        typer.Option(min=1, max=DAY_S, metavar="SECONDS", help="Emulated length: 100, with churn 900."),
    ] = None,
    common: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A recorded common error in place of a drawn one.")
    ] = None,
    out: OutOption = None,
    only: OnlyOption = None,
) -> None:
    """Compare the cooperative program with parts removed, with textbook baselines, or in other worlds."""
    from studies import comparisons

    with one_line_errors():
        folder = _folder(out, study)
        duration_s = duration or (comparisons.CHURN_S if study == "churn" else paper.DEFAULT_S)
        world = {} if common is None else comparisons.recorded_common(common)
        sections = paper.network_sections(networks)
        cells = comparisons.comparison_cells(study, sections, range(1, seeds + 1), duration_s, world)
        results = _run(cells, folder, study, only)
        for picture in comparisons.draw(cells, folder):
            print(picture)
        _show(comparisons.report(study, results, duration_s), folder / f"{study}.md")


@app.command()
def city(
    trips: Annotated[
        Path | None, typer.Option(metavar="FILE", help="How vehicles drive; through a generated city otherwise.")
    ] = None,
    roads: Annotated[Path | None, typer.Option("--map", metavar="FILE", help="The roads they drive on.")] = None,
    map_sigma: MapSigmaOption = 0.0,
    map_aside: MapAsideOption = 0.0,
    map_datum: MapDatumOption = None,
    map_datum_sigma: MapDatumSigmaOption = 0.0,
    refuse_impossible: Annotated[
        bool, typer.Option("--refuse-impossible", metavar="", help="Refuse trips that no vehicle can drive.")
    ] = False,
    seeds: SeedsOption = 3,
    duration: DurationOption = 300.0,
    out: OutOption = None,
    only: OnlyOption = None,
    live: LiveOption = False,
) -> None:
    """Vehicles that drive: every mechanism on the same trips and roads, raw fixes beside. Takes hours for all."""
    from studies import city as study

    with one_line_errors():
        folder = _folder(out, "city")
        section = _map_section(map_sigma, map_aside, map_datum, map_datum_sigma)
        place = study.place(trips, roads, section, "refuse" if refuse_impossible else "leave_out")
        for note in study.notes(place, duration):
            tell(note)
        cells = study.city_cells(place, range(1, seeds + 1), duration)
        results = _run(cells, folder, "city", only, live)
        if not live:
            print(study.draw_against_time(cells, folder))
            if picture := study.draw_errors(cells, folder):
                print(picture)
        if only is None:
            _show(study.report(results, duration), folder / "city.md")


@app.command()
def roads(
    trips: Annotated[Path | None, typer.Option(metavar="FILE", help="Recorded trips beside the cities.")] = None,
    roads: Annotated[Path | None, typer.Option("--map", metavar="FILE", help="The roads of the trips.")] = None,
    map_sigma: MapSigmaOption = 0.0,
    map_aside: MapAsideOption = 0.0,
    map_datum: MapDatumOption = None,
    map_datum_sigma: MapDatumSigmaOption = 0.0,
    rate: Annotated[float, typer.Option(min=0.1, max=100, metavar="HZ", help="Fixes a second.")] = 10.0,
    seeds: SeedsOption = 3,
    duration: DurationOption = 300.0,
    out: OutOption = None,
    only: OnlyOption = None,
) -> None:
    """Roads that nobody tuned on: generated cities 101 to 103, and trips, each beside one filter that hears all."""
    from studies import city as driving
    from studies import roads as study

    with one_line_errors():
        folder = _folder(out, "roads")
        places = study.cities(study.CITIES)
        driven = driving.place(trips, roads, _map_section(map_sigma, map_aside, map_datum, map_datum_sigma))
        if "map" in driven:
            places["trips"] = driven
        cells = study.roads_cells(places, range(1, seeds + 1), duration, rate)
        results = _run(cells, folder, "roads", only)
        _show(study.report(results, duration, rate), folder / "roads.md")


@app.command()
def decomposition(
    networks: NetworksOption = None,
    seeds: SeedsOption = 5,
    duration: DurationOption = 100.0,
    out: WholeOption = None,
) -> None:
    """Decomposition: what loss, hops, caps and shares each cost, by oracles that give them back one at a time."""
    from studies import decomposition as study

    with one_line_errors():
        folder = _folder(out, "decomposition")
        results = [
            {"network": name, **row}
            for name, section in paper.network_sections(networks).items()
            for row in study.decompose(section, range(1, seeds + 1), duration)
        ]
        write_results(results, folder, "decomposition")
        _show(study.report(results, duration), folder / "decomposition.md")


@app.command("figures")
def draw_figures(
    networks: NetworksOption = None,
    seeds: SeedsOption = 3,
    out: OutOption = None,
    cells_from: Annotated[Path, typer.Option(metavar="FOLDER", help="Where Table II keeps its cells.")] = FOLDER
    / "table2",
) -> None:
    """The paper's pictures of N2 and N3: RMSE and deviation against time."""
    with one_line_errors():
        folder = _folder(out, "figures")
        sections = paper.network_sections(networks)
        cells = paper.table2_cells({n: sections[n] for n in ("n2", "n3")}, range(1, seeds + 1), sides=(1,))
        run_cells(cells, cells_from, title="figures")
        _draw_against_time(cells, cells_from, folder)


@app.command()
def consensus(networks: NetworksOption = None, seeds: SeedsOption = 3, out: OutOption = None) -> None:
    """Consensus alone: against rounds, loss, delay, one-way links and churn, beside the linear model."""
    from studies.consensus import study_network

    with one_line_errors():
        folder = _folder(out, "consensus")
        markdown = study_network(paper.network_sections(networks)["n1"], range(1, seeds + 1), folder)
        _show(markdown, folder / "consensus.md")


@app.command()
def capacity(
    seconds: Annotated[float, typer.Option(min=1, max=DAY_S, help="Emulated seconds of each network.")] = 5.0,
    seeds: SeedsOption = 2,
    out: WholeOption = None,
) -> None:
    """Capacity of an 802.11p channel: packet delivery ratio against the number of senders in range."""
    from studies import capacity as study

    with one_line_errors():
        folder = _folder(out, "capacity")
        points = study.study(seconds, range(1, seeds + 1))
        study.draw(points, folder / "capacity")
        _show(study.report(points), folder / "capacity.md")


def _map_section(sigma_m: float, aside_m: float, datum: str | None, datum_sigma_m: float) -> dict[str, Any]:
    """Return the keys of `[map]` that the options of recorded trips set."""
    section: dict[str, Any] = {"sigma_m": sigma_m, "aside_m": aside_m, "datum_sigma_m": datum_sigma_m}
    return section if datum is None else section | {"datum_m": pair("--map-datum", datum)}


def _folder(out: Path | None, name: str) -> Path:
    folder = out or FOLDER / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise VnetError(f"--out {folder}: {error.strerror}") from None
    return folder


def _run(
    cells: Sequence[Cell], folder: Path, name: str, only: list[str] | None, live: bool = False
) -> list[dict[str, Any]]:
    """Run the cells that are asked for; print the figures of single ones, keep all as Parquet."""
    wanted = _select(cells, only or [])
    results = run_cells(wanted, folder, live, name)
    if only is not None:
        for row in results:
            print({key: value for key, value in row.items() if value is not None})
    write_results(results, folder, f"{name}-live" if live else name)
    return results


def _select(cells: Sequence[Cell], only: Sequence[str]) -> list[Cell]:
    """Return the cells that fit; conditions of one label are alternatives."""
    labels = sorted({label for cell in cells for label in cell.labels})
    asked: dict[str, set[str]] = {}
    for condition in only:
        key, equals, value = condition.partition("=")
        if not equals or key not in labels:
            raise VnetError(f"--only {condition}: write it as label=value with one of {', '.join(labels)}")
        if value not in (values := sorted({str(cell.labels[key]) for cell in cells})):
            raise VnetError(f"--only {condition}: no such cell; {key} is one of {', '.join(values)}")
        asked.setdefault(key, set()).add(value)
    wanted = [cell for cell in cells if all(str(cell.labels[key]) in values for key, values in asked.items())]
    if not wanted:
        raise VnetError(f"--only {' --only '.join(only)}: no cell is all of that")
    return wanted


def _draw_against_time(cells: Sequence[Cell], cells_from: Path, folder: Path) -> None:
    from studies import figures

    for network in ("n2", "n3"):
        title = f"{network.upper()}, the paper's profile, lanes bounded on one side"
        references = {f"the paper's {m}": rmse[network] for m, rmse in PAPER_RMSE_M.items()}
        series = figures.series_of(cells, cells_from, network=network, sides=1)
        print(figures.against_time(series, folder / f"{network}_against_time", title, references))


def _show(markdown: str, path: Path) -> None:
    path.write_text(markdown)
    Console().print(Markdown(markdown))
    print(path)
