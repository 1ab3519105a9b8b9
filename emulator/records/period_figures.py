"""The figures of periods: vnet's own, and those that a run's program declares.

They are computed of many periods at once: an operation on arrays costs the same for one period and for a hundred.
Every figure is the same bit by bit however many periods are computed together: a run's hash of its metrics has it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, make_dataclass, replace
from functools import cache, partial
from itertools import starmap
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, ValidationError

from emulator.scenario.own_functions import (
    CONSTANT,
    NoAnswerError,
    NonsenseError,
    call_bounded,
    declared,
    load_entry,
    told,
)
from emulator.scenario.program import Program
from emulator.scenario.sections import FAR_M, first_problem, validated
from emulator.world.world import Instant
from vnet.errors import ScenarioError, VnetError, printable, shown
from vnet.types import Array
from vnet.units import label_of, unit_of

VECTORS = {"estimate_m": 2, "covariance_m2": 4}
"""Columns of the states of which vnet's own figures are made, and the numbers that each entry has."""
SAME = 1e-9
"""Relative difference of two errors up to which they are those of the same positions."""
ROWS_TOGETHER = 20_000
"""States of which figures are computed together: what a program's function does with them is bounded in time."""
LONGEST_SHOWN = 400
"""Characters of a title, a label or a caption that a program declares."""
NUMBER, NUMBERS = "float | None", "list[float | None]"
"""Types of a figure, as annotations."""
_Mask: TypeAlias = NDArray[np.bool_]


@dataclass(frozen=True)
class PeriodFigures:
    """One row of the metrics. Lengths in metres; None where no node reported what is needed.

    ANEES are means of εᵀ P⁻¹ ε / 2, so that 1 is consistent (Bar-Shalom, Li, Kirubarajan 2001, 5.4).
    """

    period: int
    """Counts from 0."""
    time_ns: int
    """Its start."""
    reporting: int
    """Number of vehicles that reported in it."""
    position_rmse_m: float | None
    """RMSE of the vehicles' estimates of their positions."""
    fix_rmse_m: float | None
    """RMSE of the raw fixes."""
    position_anees: float | None
    """ANEES of the positions."""
    not_finite: int
    """Number of reports that held NaN or infinity."""


@dataclass(frozen=True)
class KeyFigure:
    """A figure of the periods, whose mean after the first fifth of a run is shown by `title`.

    Its unit is that in which its name ends (`age_ms`), if there is one.
    """

    name: str
    title: str
    chart: tuple[str, str, str] | None = None
    """Id, title and axis of its chart in a comparison."""
    column: str = ""
    """Title of its column in the list of runs."""
    is_less: bool = False
    """True if narrow screens go without that column."""
    of_positions: bool = False
    """True for an error of positions, shown only where programs estimate them."""
    of_agreement: bool = False
    """True for the deviation of vehicles' estimates from their mean, which `vnet analyze` explains."""
    live: tuple[str, str] | None = None
    """Label and remark of its line in the picture of a run that is on."""

    @property
    def heading(self) -> str:
        """The title with the unit, as in the heading of a column."""
        return label_of(self.name, self.title)

    def text(self, value: float) -> str:
        """Return a value with its unit, for people."""
        return f"{value:.3f} {unit_of(self.name)}".rstrip()


POSITION_FIGURES = (
    KeyFigure(
        "position_rmse_m",
        "position, RMSE of the estimates",
        ("position", "Position", "RMSE of position (m)"),
        of_positions=True,
    ),
    KeyFigure("fix_rmse_m", "position, RMSE of the raw fixes", of_positions=True),
)
"""vnet's own key figures."""


@dataclass(frozen=True)
class ReportedColumn:
    """A column of the states for the lists that programs report by one name; `size` is None for any length."""

    name: str
    size: int | None
    text: str


_Shown = Annotated[str, AfterValidator(partial(printable, longest=LONGEST_SHOWN))]
_Name = Annotated[str, Field(pattern=r"^[\w.-]{1,64}$")]
_Length = Annotated[float, Field(gt=0, le=FAR_M)]
_FEW = Field(max_length=64)


@dataclass(frozen=True)
class Estimate:
    """An estimate of two lengths that a recording shows around the truth: columns of the states by their names."""

    name: _Name
    title: _Shown
    estimate: _Name
    covariance: _Name
    truth: _Name
    rings_m: Annotated[tuple[_Length, ...], Field(min_length=1, max_length=64)]
    view_m: _Length
    """Half of what the view shows at first."""
    cloud: _Name | Literal[""] = ""
    """Column of points, x and y in turns."""


@dataclass(frozen=True)
class DeclaredChart:
    """A chart of figures that belong together: `lines` are their names by label."""

    id: _Name
    title: _Shown
    axis: _Shown
    lines: Annotated[Mapping[_Shown, _Name], Field(min_length=1, max_length=64)]
    text: _Shown
    """Its caption."""


@dataclass(frozen=True)
class Views:
    """A program's declarations that report, picture and recording show: a run's folder and its scene have them."""

    peers: Annotated[tuple[_Name, ...], _FEW] = ()
    """Names before a dot that stand for one value of each pair of vehicles: they stay in `values`."""
    charts: Annotated[tuple[DeclaredChart, ...], _FEW] = ()
    """Charts of report, picture and recording."""
    estimates: Annotated[tuple[Estimate, ...], _FEW] = ()
    """Estimates that a recording shows around the truth, beside positions."""


NO_VIEWS = Views()


def views_of(data: Mapping[str, Any]) -> Views:
    """Return views that are given as data. Raises VnetError for what cannot be."""
    try:
        return validated(Views, data)
    except ValidationError as error:
        raise VnetError(f"views: {first_problem(error, Views)}") from None


class FiguresError(VnetError):
    """Figures of a program that fail: how in one line, and the traceback `where`."""

    def __init__(self, said: str, where: str) -> None:
        super().__init__(said)
        self.where = where


@dataclass(frozen=True)
class ProgramFigures:
    """Figures that a run's program declares, with vnet's own: docs/how-to/results.md."""

    row: type = PeriodFigures
    """The class of a row of the metrics."""
    columns: Mapping[str, ReportedColumn] = field(default_factory=dict)
    """By reported name, the columns that the states have for its lists."""
    key: tuple[KeyFigure, ...] = POSITION_FIGURES
    """Figures that summary, report, comparison, sweep, list of runs and terminal show, in this order."""
    views: Views = NO_VIEWS
    compute: Callable[[Periods], Mapping[str, Sequence[Any]]] = lambda periods: {}
    entry: str = ""
    """The program's class, as `module:class`."""

    @property
    def own(self) -> dict[str, str]:
        """The program's figures by name, with their types."""
        known = {each.name for each in fields(PeriodFigures)}
        return {each.name: str(each.type) for each in fields(self.row) if each.name not in known}

    def computed(self, periods: Periods, count: int) -> dict[str, Sequence[Any]]:
        """Return the program's figures of so many periods. Raises FiguresError."""
        try:
            given = call_bounded(self.compute, periods)
            if not isinstance(given, Mapping):
                raise NonsenseError(f"{shown(given)}: figures by name are needed")
            return {name: _checked(name, kind, given.get(name), count) for name, kind in self.own.items()}
        except (Exception, SystemExit, NoAnswerError) as error:
            raise FiguresError(*told(error, __file__)) from error

    def absent(self) -> ProgramFigures:
        """Return the same figures with the program's unknown in each period."""
        nothing: dict[str, Any] = {name: None if kind == NUMBER else [] for name, kind in self.own.items()}
        return replace(
            self, compute=lambda periods: {name: [each] * len(periods["fix_m"]) for name, each in nothing.items()}
        )

    @property
    def vectors(self) -> dict[str, int]:
        """Columns of the states of which figures are made, and the numbers that each entry has."""
        return VECTORS | {each.name: each.size for each in self.columns.values() if each.size is not None}

    def is_of_peer(self, name: str) -> bool:
        """Return whether a reported name stands for a value of a pair of vehicles."""
        return name.partition(".")[0] in self.views.peers and "." in name


def program_figures(program: Program) -> ProgramFigures:
    """Return the figures of a scenario's program: of several that declare some, the first one's.

    Where the declared module cannot be imported there are none: its check says so. Raises ScenarioError for a
    declaration that cannot be.
    """
    try:
        entries = declared(program, "FIGURES")
    except ScenarioError:
        entries = []
    return _of_entry(entries[0]) if entries else ProgramFigures()


def figures_if_here(program: Program) -> ProgramFigures:
    """Return the figures of a scenario's program; vnet's own where what it declares cannot be imported."""
    try:
        return program_figures(program)
    except ScenarioError:
        return ProgramFigures()


@cache
def _of_entry(entry: str) -> ProgramFigures:
    kind = load_entry(entry)
    try:
        own = {each.name: each for each in fields(PeriodFigures)}
        theirs = {each.name: str(each.type) for each in fields(kind)}
        if wrong := [name for name, of in theirs.items() if name not in own and of not in (NUMBER, NUMBERS)]:
            raise TypeError(f"{wrong[0]}: {theirs[wrong[0]]}, where {NUMBER} or {NUMBERS} is allowed")
        # A figure of vnet's stands where the program's class has it: the order is part of the hash.
        names = [*(name for name in own if name not in theirs), *theirs]
        types = [(name, own[name].type if name in own else theirs[name]) for name in names]
        columns = getattr(kind, "COLUMNS", {}).items()
        return ProgramFigures(
            row=make_dataclass("PeriodFigures", types, frozen=True),
            columns={reported: ReportedColumn(*column) for reported, column in columns},
            key=(*(KeyFigure(**each) for each in getattr(kind, "KEY_FIGURES", ())), *POSITION_FIGURES),
            views=views_of(
                {
                    "peers": getattr(kind, "PEERS", ()),
                    "charts": [asdict(DeclaredChart(**each)) for each in getattr(kind, "CHARTS", ())],
                    "estimates": [asdict(Estimate(**each)) for each in getattr(kind, "ESTIMATES", ())],
                }
            ),
            compute=kind.compute,
            entry=entry,
        )
    except (AttributeError, TypeError, VnetError) as error:
        raise ScenarioError(f"{CONSTANT}: {entry!r} declares no figures of periods: {error}") from None


def shown_figures(key: Sequence[KeyFigure], figures: Mapping[str, float | None]) -> list[tuple[KeyFigure, float]]:
    """Return the key figures that a run has: errors of positions only where programs estimate them."""
    own = estimates_differ(figures.get("position_rmse_m"), figures.get("fix_rmse_m"))
    values = [(each, figures.get(each.name)) for each in key if own or not each.of_positions]
    return [(each, value) for each, value in values if value is not None]


def estimates_differ(estimate_m: float | None, fix_m: float | None) -> bool:
    """Return whether these errors (in metres) are those of estimates that are more than the raw fixes again."""
    return estimate_m is not None and (fix_m is None or not math.isclose(estimate_m, fix_m, rel_tol=SAME))


@dataclass(frozen=True)
class Period:
    """Truth of a period, and who reported in it. `component` (N,) labels each vehicle's connected component."""

    instant: Instant
    component: NDArray[np.intp]
    reporting: int
    """Number of vehicles that reported."""
    not_finite: int
    """Number of reports that held NaN or infinity."""


@dataclass(frozen=True)
class Periods:
    """K periods of N vehicles in which these form the same components: what figures are computed from.

    `columns` are arrays (K, N, size) of the states by name, NaN where nothing was reported, and (K, 1, 2) of the
    true `common_error_m`. The functions take such arrays, and return a number for each period, or None.
    """

    columns: Mapping[str, Array]
    component: NDArray[np.intp]

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]

    @property
    def components(self) -> list[_Mask]:
        """The vehicles (N,) of each connected component."""
        return [self.component == label for label in range(int(self.component.max()) + 1)]

    @staticmethod
    def mean(array: Array) -> Array:
        """Return the mean (K, 1, 2) of the vectors (K, N, 2) of each period, of those that are known."""
        known = _finite(array)
        whole, partly = _divide(known)
        means = np.full((len(array), 1, array.shape[2]), np.nan)
        if len(whole):
            means[whole] = array[whole].mean(axis=1, keepdims=True)
        for number in partly:
            means[number] = array[number][known[number]].mean(axis=0)
        return means

    @staticmethod
    def rms(array: Array) -> list[float | None]:
        """Return the root mean square of the vectors (K, N, 2) of each period, of those that are known."""
        means = _means_of_known(np.sum(array**2, axis=2), _finite(array))
        return [None if mean is None else math.sqrt(mean) for mean in means]

    @staticmethod
    def anees(error: Array, covariance: Array) -> list[float | None]:
        """Return the ANEES of errors (K, N, 2) whose covariances (K, N, 4) are positive definite."""
        matrix = covariance.reshape(*error.shape, 2)
        usable = _finite(error) & _finite(covariance)
        usable[usable] = _are_positive_definite(matrix[usable])
        inverse = np.linalg.inv(matrix[usable])
        x, y = error[usable].T
        # Not einsum, whose order of summation depends on the number of vehicles.
        (xx, xy), (yx, yy) = inverse.transpose(1, 2, 0)
        square = np.zeros(error.shape[:2])
        square[usable] = x * xx * x + x * xy * y + y * yx * x + y * yy * y
        return [None if mean is None else mean / 2 for mean in _means_of_known(square, usable)]


def vectors(values: Sequence[Sequence[float] | None], size: int) -> Array:
    """Return a column of the states as an array (rows, size); NaN where nothing was reported."""
    array = np.full((len(values), size), np.nan)
    reported = [row for row, value in enumerate(values) if value is not None]
    if reported:
        array[reported] = [value for value in values if value is not None]
    return array


def figures_of(
    periods: Sequence[Period], reported: Mapping[str, Array], of: ProgramFigures
) -> tuple[list[Any], tuple[Period, FiguresError] | None]:
    """Return the figures of each period, of the class `of.row`, and where and how those of the program fail.

    `reported` has the columns `of.vectors`, each an array (rows, size) with a row for each vehicle and period,
    vehicle by vehicle within a period. From the period on in which they fail, the program's figures are unknown.
    """
    found: list[Any] = []
    failure: tuple[Period, FiguresError] | None = None
    vehicles = len(periods[0].component)

    def compute(first: int, end: int) -> list[Any]:
        rows = slice(first * vehicles, end * vehicles)
        columns = {name: array[rows].reshape(end - first, vehicles, -1).copy() for name, array in reported.items()}
        return _figures(periods[first:end], columns, of if failure is None else of.absent())

    for first, end in _alike(periods, max(1, ROWS_TOGETHER // vehicles)):
        with suppress(FiguresError):
            found += compute(first, end)
            continue
        for number in range(first, end):
            try:
                found += compute(number, number + 1)
            except FiguresError as error:
                failure = periods[number], error
                found += compute(number, number + 1)
    return found, failure


def _alike(periods: Sequence[Period], most: int) -> Iterator[tuple[int, int]]:
    """Divide periods into ranges of at most `most`, in which vehicles form the same components."""
    first = 0
    for number, period in enumerate(periods):
        component = periods[first].component
        changes = period.component is not component and not np.array_equal(period.component, component)
        if changes or number - first == most:
            yield first, number
            first = number
    yield first, len(periods)


def _figures(periods: Sequence[Period], columns: dict[str, Array], of: ProgramFigures) -> list[Any]:
    """Return the figures of K periods whose `columns` are arrays (K, N, size)."""
    instants = [period.instant for period in periods]
    position, fix = np.array([each.position_m for each in instants]), np.array([each.fix_m for each in instants])
    columns |= {"position_m": position, "fix_m": fix}
    columns["common_error_m"] = np.array([each.common_error_m for each in instants])[:, None]
    together = Periods(columns, periods[0].component)
    error = columns["estimate_m"] - position
    found: dict[str, Sequence[Any]] = {
        "period": [each.period for each in instants],
        "time_ns": [each.time_ns for each in instants],
        "reporting": [period.reporting for period in periods],
        "position_rmse_m": together.rms(error),
        "fix_rmse_m": together.rms(fix - position),
        "position_anees": together.anees(error, columns["covariance_m2"]),
        "not_finite": [period.not_finite for period in periods],
    }
    found |= of.computed(together, len(periods))
    return list(starmap(of.row, zip(*(found[each.name] for each in fields(of.row)), strict=True)))


def _checked(name: str, kind: str, values: Any, count: int) -> list[Any]:
    """Return a figure of so many periods as numbers, with None for what is not finite. Raises NonsenseError."""
    if values is None or isinstance(values, str) or not isinstance(values, Collection) or len(values) != count:
        raise NonsenseError(f"{name} = {shown(values)}: a value for each of {count} periods is needed")
    try:
        return [_number(each) if kind == NUMBER else list(map(_number, each)) for each in values]
    except (TypeError, ValueError, OverflowError):
        raise NonsenseError(f"{name} = {shown(values)}: {kind} is needed for each period") from None


def _number(value: Any) -> float | None:
    if isinstance(value, str):
        raise TypeError
    return None if value is None or not math.isfinite(number := float(value)) else number


def _means_of_known(numbers: Array, known: _Mask) -> list[float | None]:
    """Return the mean of the numbers (K, N) of each period, of those that are known; None where none is."""
    found: list[float | None] = [None] * len(numbers)
    whole, partly = _divide(known)
    means = numbers[whole].mean(axis=1).tolist() if len(whole) else []
    for number, mean in zip(whole.tolist(), means, strict=True):
        found[number] = mean
    for number in partly:
        found[number] = float(numbers[number][known[number]].mean())
    return found


def _finite(array: Array) -> _Mask:
    """Return which of the vectors (K, N, size) are finite, as (K, N)."""
    finite: _Mask = np.all(np.isfinite(array), axis=2)
    return finite


def _divide(known: _Mask) -> tuple[NDArray[np.intp], list[int]]:
    """Return the numbers of the periods in which all vehicles are known, and of those in which only some are."""
    some = known.any(axis=1)
    whole = some & known.all(axis=1)
    return np.flatnonzero(whole), np.flatnonzero(some & ~whole).tolist()


def _are_positive_definite(matrix: Array) -> _Mask:
    """Return which of the matrices (n, 2, 2) are positive definite."""
    definite: _Mask = (np.linalg.det(matrix) > 1e-18) & (np.trace(matrix, axis1=1, axis2=2) > 0)
    return definite
