"""Plausibility of what others say about the common error: whether it is believed, and how much it may weigh.

A liar's increment or prior is bounded by what the vehicle itself knows, and compared with what it believes. One
period's lie may be small; so the deviations of each origin are summed up as well, and decay over seconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence, Set
from typing import Any, TypeVar

from agents.cooperative.cmm.information import Five, Information, Three, plain_moments

INCREMENT_FACTOR = 1.5
"""Largest trace of an increment, relative to one's own: what it says more is scaled down."""
SENDER_FACTOR = 3.0
"""Largest trace of all that one sender lists and few others do, relative to the largest of one increment."""
PRIOR_FACTOR = 2.0
"""Largest trace of a prior's matrix, relative to one's own."""
INCREMENT_GATE = 16.0
"""Largest squared deviation of an increment from what is believed."""
LANE_GATE = 8.0
"""The same of an origin's sum of few increments of lanes, where more than a few origins are heard."""
SUM_GATE = 4.0
"""Largest squared deviation of an origin's sum of many increments: the errors of what was believed partly cancel,
and one honest sum in ten thousand deviates by 3.5 (N2) to 4.5 (N1)."""
COMPARED_GATE = 3.0
"""The same, less what most sums deviate by, and relative to the sum's own covariance: one honest sum in fifty
deviates by more, in small networks and large ones."""
FAR = 4.0
"""So many times the deviation that the gate of a sum lets through is far beyond it."""
PRIOR_GATE = 4.0
"""Largest squared deviation of a prior's mean from one's own."""
SPREAD_GATE = 3.5
"""Largest distance of a prior's mean from the median of all, in deviations of their spread."""
MANY = 90.0
"""Number of increments in a sum, less what has decayed, from which on the gate of many applies; for one it is
`INCREMENT_GATE`, of lanes `LANE_GATE`."""
LEAN_LIMIT = 0.1
"""Largest mean distance of an origin's priors from the median of all, in deviations that both claim: in honest runs
one in a hundred has 0.07 (N1), 0.10 (N2), 0.18 (N3), where a few pass on what the others cannot know."""
SELF_SHARE = 0.3
"""Weight that a vehicle gives to its own prior before the others': what draws all along draws more slowly."""
SPREAD_FLOOR_M = 0.05
"""Distance (m) from the median that is always allowed."""
MAJORITY = 4
"""Least number of priors or increments of which a majority can be told."""
MEMORY_S = 10.0
"""Time (s) in which an origin's leans, and its sums about lanes, decay."""
SUM_MEMORY_S = 30.0
"""Time (s) in which its sums about c decay: c returns slowly from where one pulls, so small pulls must be found."""
COMMON_EVERY_S = 1.0
"""Time (s) after which what most sums deviate by is found again."""
COMMON_ROUNDS = 3
"""Rounds of weighing in which it is found, from the latest on."""
RAYLEIGH_MEDIAN = 1.1774
"""Median length of a normal vector in the plane, in deviations an axis."""
MAX_ORIGINS = 1024
"""Number of origins whose sums are kept: names cost an attacker nothing."""


Belief = tuple[Sequence[float], Three]
"""Mean (x, y) in m and covariance (xx, xy, yy) in m² of what is believed about c."""

Sums = tuple[float, float, float, float, float, float, float, float, float, float, float]
"""A time, and the sums of an origin's increments then: Λ C (xx, xy, yx, yy) with P = C Cᵀ, r = η − Λ x, Λ (xx, xy,
yy), their number."""
_TINY = 1e-300
"""Least squared deviation: that of an increment which says nothing is 0."""

# An increment may be that of a lane (`lane_memory`), with a negative third number.
# For the few dozens of a period plain numbers take less time than arrays, and are the same on each processor.


def scaled_down(information: Sequence[Five], largest_trace: float) -> list[Five]:
    """Return pieces of information with traces of at most `largest_trace`; means stay."""
    traces = traces_of(information)
    if max(traces, default=0.0) <= largest_trace:
        return [*information]
    return [
        numbers if trace <= largest_trace else scaled_by(numbers, largest_trace / trace)
        for numbers, trace in zip(information, traces, strict=True)
    ]


def scaled_by(information: Five, factor: float) -> Five:
    """Return what says `factor` times as much."""
    a, b, d, x, y = information
    if d < 0:
        root = math.sqrt(factor)
        return root * a, root * b, d, root * x, y
    return factor * a, factor * b, factor * d, factor * x, factor * y


def traces_of(information: Iterable[Five]) -> list[float]:
    """Return the traces (n,) of the matrices."""
    return [a + d if d >= 0 else a * a + b * b for a, b, d, _, _ in information]


def moved(information: Five, x_m: float, y_m: float) -> Five:
    """Return a belief or an increment whose mean is off by (`x_m`, `y_m`)."""
    a, b, d, x, y = information
    if d < 0:
        return a, b, d, x + a * x_m + b * y_m, y
    return a, b, d, x + a * x_m + b * y_m, y + b * x_m + d * y_m


def rooted_triangle(xx: float, xy: float, yy: float) -> Three:
    """Return C (xx, yx, yy), lower triangular, with C Cᵀ a positive definite matrix (xx, xy, yy)."""
    root_xx = math.sqrt(xx)
    root_yx = xy / root_xx
    return root_xx, root_yx, math.sqrt(max(yy - root_yx * root_yx, 0.0))


def prior_shares(priors: Sequence[Five], own: Five) -> list[float]:
    """Return the share (n,) of its weight that each prior has: 1 within `PRIOR_GATE`, beyond it gate : rᵀ S⁻¹ r.

    r is the difference of the means, S the sum of both covariances. Each prior, and one's `own`, is the mean (x, y)
    and the covariance (xx, xy, yy). Were a prior dropped, a vehicle that sees along one lane only, and begins two
    deviations off, would never believe those who are right.
    """
    own_x, own_y, own_xx, own_xy, own_yy = own
    shares = []
    for mean_x, mean_y, xx, xy, yy in priors:
        x, y = mean_x - own_x, mean_y - own_y
        a, b, d = xx + own_xx, xy + own_xy, yy + own_yy
        squared, gate = d * x * x - 2 * b * x * y + a * y * y, PRIOR_GATE * (a * d - b * b)
        shares.append(1.0 if squared < gate else gate / max(squared, _TINY))
    return shares


def spread_limit_m(priors: Sequence[Five]) -> tuple[tuple[float, float], float]:
    """Return the median (x, y) of the means, and the distance from it within which they are taken as they are.

    Estimates that are pooled in each period differ by less than each is uncertain, because they err together: who
    stays within its uncertainty, but always on one side, would draw all others along.
    """
    x, y = _median([prior[0] for prior in priors]), _median([prior[1] for prior in priors])
    if len(priors) < MAJORITY:
        return (x, y), math.inf
    distance_m = _median([math.hypot(prior[0] - x, prior[1] - y) for prior in priors])
    return (x, y), SPREAD_FLOOR_M + SPREAD_GATE * distance_m / RAYLEIGH_MEDIAN


def _median(values: list[float]) -> float:
    values.sort()
    return (values[(len(values) - 1) // 2] + values[len(values) // 2]) / 2


def cut_to(off_m: list[tuple[float, float]], limit_m: float) -> list[tuple[float, float]]:
    """Return offsets (x, y) with lengths of at most `limit_m`."""
    length_m = [math.hypot(x, y) for x, y in off_m]
    if max(length_m) <= limit_m:
        return off_m
    share = [min(1.0, limit_m / max(length, 1e-300)) for length in length_m]
    return [(x * part, y * part) for (x, y), part in zip(off_m, share, strict=True)]


def relative_to_most(shares: list[float], silent: int = 0) -> list[float]:
    """Return shares relative to their median: where most are below 1, what is believed is wrong, and not they.

    So many as are `silent` contradict nobody.
    """
    count = len(shares) + silent
    middle = sorted(shares)[count // 2] if MAJORITY - 1 <= count < 2 * len(shares) else 1.0
    return shares if middle >= 1 else [min(1.0, share / max(middle, _TINY)) for share in shares]


def _in_common(sums: Sequence[Sums], off: tuple[float, float], most: float) -> tuple[float, float] | None:
    """Return by what (x, y) most `sums` deviate, in deviations of the belief, found from `off` on.

    Beyond its own deviation a sum weighs less in proportion (Huber 1964), and so does one with a trace of more than
    `most`, so that a few do not draw it. None if the sums do not tell.
    """
    off_x, off_y = off
    for _ in range(COMMON_ROUNDS):
        s_xx = s_xy = s_yx = s_yy = s_x = s_y = 0.0
        for _, n_xx, n_xy, n_yx, n_yy, n_x, n_y, n_a, n_b, n_d, _ in sums:
            trace = n_a + n_d
            n_a, n_d = n_a + 1e-4 * trace + 1e-9, n_d + 1e-4 * trace + 1e-9
            r_x, r_y = n_x - n_xx * off_x - n_xy * off_y, n_y - n_yx * off_x - n_yy * off_y
            squared = (n_d * r_x * r_x - 2 * n_b * r_x * r_y + n_a * r_y * r_y) / (n_a * n_d - n_b * n_b)
            weight = (1 / math.sqrt(squared) if squared > 1 else 1.0) * (most / trace if trace > most else 1.0)
            s_xx += weight * n_xx
            s_xy += weight * n_xy
            s_yx += weight * n_yx
            s_yy += weight * n_yy
            s_x += weight * n_x
            s_y += weight * n_y
        if not (determinant := s_xx * s_yy - s_xy * s_yx):
            return None
        off_x, off_y = (s_yy * s_x - s_xy * s_y) / determinant, (s_xx * s_y - s_yx * s_x) / determinant
    return off_x, off_y


def all_of(sender: int) -> int:
    """Return the code of all that a sender passes on, in place of an origin."""
    return ~sender


class Origins:
    """Decaying sums of the deviations of each origin: of its increments, and of its priors."""

    def __init__(self) -> None:
        self._sums: dict[int, Sums] = {}
        self._leans: dict[int, tuple[float, float, float]] = {}  # its time, and the mean deviation (x, y)
        self._common_m: tuple[float, float] | None = None  # by most sums the belief is off by this
        self._common_s = -math.inf  # when that was found
        self._voters: set[int] = set()  # origins by whose sums it is found next
        self._most = math.inf  # the trace beyond which a sum claimed much more than most

    def __len__(self) -> int:
        """Number of origins whose increments are summed up."""
        return len(self._sums)

    @property
    def known(self) -> Set[int]:
        """The origins whose increments are summed up."""
        return self._sums.keys()

    def shares(
        self,
        codes: Sequence[int],
        increments: Sequence[Five],
        belief: Belief,
        now_s: float,
        is_about_lanes: bool = False,
        unvouched: Set[int] = frozenset(),
    ) -> list[float]:
        """Return the share (n,) of each increment (n,) of the origins `codes` that is used.

        It is 1 within the gates. Beyond that of one increment it is the gate relative to the squared deviation;
        beyond that of the origin's sum the square of this, as the influence must descend (Hampel 1974). Where few
        are heard, it is the root, and far beyond the gate less: three vehicles on nearly parallel lanes, or on a
        map, contradict each other for long and are right. What is beyond is summed up all the same: who has lied is
        believed again when it has decayed. Each is compared with the belief (x, P) when it came: c itself moves by
        a metre in the sum's memory. What most sums deviate by is the belief's error and does not count; sums
        about lanes (`is_about_lanes`) have nothing in common, because their beliefs differ. Those of `unvouched`
        origins do not say what it is; all that one sender passes on of such (`all_of`) says it once, and claims no
        more than most.
        """
        sums = self._sums
        if len(sums) + len(codes) > MAX_ORIGINS:
            sums = self._sums = _newest(sums, now_s)
        (mean_x, mean_y), covariance_m2 = belief
        c_xx, c_yx, c_yy = rooted_triangle(*covariance_m2)
        common_m = None if is_about_lanes else self._common_m
        gate_of_many = SUM_GATE if common_m is None else COMPARED_GATE
        off_x, off_y = common_m or (0.0, 0.0)
        off_x /= c_xx
        off_y = (off_y - c_yx * off_x) / c_yy
        memory_s = MEMORY_S if is_about_lanes else SUM_MEMORY_S
        are_few = common_m is None and (not is_about_lanes or len(sums) < MAJORITY)
        gate_of_few = LANE_GATE if is_about_lanes and not are_few else INCREMENT_GATE
        then_s, keep, keep_2 = now_s, 1.0, 1.0
        nothing: Sums = (now_s, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        shares = []
        for code, (a, b, d, x, y) in zip(codes, increments, strict=True):
            # The terms of the deviation, which may be summed up; Λ is the covariance of r given c.
            m_xx, m_xy, m_yx, m_yy = a * c_xx + b * c_yx, b * c_yy, b * c_xx + d * c_yx, d * c_yy
            x, y = x - a * mean_x - b * mean_y, y - b * mean_x - d * mean_y
            since_s, n_xx, n_xy, n_yx, n_yy, n_x, n_y, n_a, n_b, n_d, count = sums.get(code, nothing)
            if since_s != then_s:  # for most the same
                then_s, keep = since_s, math.exp((since_s - now_s) / memory_s)
                keep_2 = keep * keep  # covariances of sums whose parts have decayed
            n_xx, n_xy, n_yx, n_yy = m_xx + keep * n_xx, m_xy + keep * n_xy, m_yx + keep * n_yx, m_yy + keep * n_yy
            n_x, n_y, count = x + keep * n_x, y + keep * n_y, 1.0 + keep * count
            n_a, n_b, n_d = a + keep_2 * n_a, b + keep_2 * n_b, d + keep_2 * n_d
            sums[code] = now_s, n_xx, n_xy, n_yx, n_yy, n_x, n_y, n_a, n_b, n_d, count
            # rᵀ S⁻¹ r with S = Λ + (Λ C)(Λ C)ᵀ, of the sum and of the increment, written out: a function would be
            # called most of all. Less what is common, a sum has its own errors alone, Λ. A lane says nothing along
            # itself: a ten thousandth of the trace is added to S, so that rounding there is not counted.
            if common_m is None:
                n_a += n_xx * n_xx + n_xy * n_xy
                n_b += n_xx * n_yx + n_xy * n_yy
                n_d += n_yx * n_yx + n_yy * n_yy
            more = 1e-4 * (n_a + n_d) + 1e-9
            n_a += more
            n_d += more
            r_x, r_y = n_x - n_xx * off_x - n_xy * off_y, n_y - n_yx * off_x - n_yy * off_y
            in_sum = (n_d * r_x * r_x - 2 * n_b * r_x * r_y + n_a * r_y * r_y) / (n_a * n_d - n_b * n_b)
            a += m_xx * m_xx + m_xy * m_xy
            b += m_xx * m_yx + m_xy * m_yy
            d += m_yx * m_yx + m_yy * m_yy
            more = 1e-4 * (a + d) + 1e-9
            a += more
            d += more
            alone = (d * x * x - 2 * b * x * y + a * y * y) / (a * d - b * b)
            # What has a negative eigenvalue may deviate by less than nothing, which is no less a deviation.
            if code < 0 and common_m is not None and n_a + n_d > self._most:
                in_sum *= self._most / (n_a + n_d)
            gate = gate_of_many
            if not -gate < in_sum < gate:
                gate = gate_of_few + (gate - gate_of_few) * min(1.0, count / MANY)
            if -INCREMENT_GATE < alone < INCREMENT_GATE and -gate < in_sum < gate:
                shares.append(1.0)
            else:
                of_sum = min(1.0, gate / max(abs(in_sum), _TINY))
                of_sum = min(math.sqrt(of_sum), FAR * of_sum) if are_few else of_sum * of_sum
                shares.append(min(of_sum, INCREMENT_GATE / max(abs(alone), _TINY)))
        if not is_about_lanes:
            self._voters.update(codes if not unvouched else set(codes) - unvouched)
            if now_s >= self._common_s + COMMON_EVERY_S:
                voters = [known for code, known in sums.items() if code in self._voters]
                self._voters, self._common_s = set(), now_s
                traces = [n_a + n_d for *_, n_a, _, n_d, _ in voters]
                self._most = INCREMENT_FACTOR * max(0.0, _median(traces or [0.0]))
                common = _in_common(voters, (off_x, off_y), self._most) if len(voters) >= MAJORITY else None
                self._common_m = common and (c_xx * common[0], c_yx * common[0] + c_yy * common[1])
        return shares

    def without_lean(
        self, codes: Sequence[int], priors: Sequence[Five], own: Five, middle_m: tuple[float, float], now_s: float
    ) -> tuple[list[tuple[float, float]], list[bool] | None]:
        """Return by how much the means of `priors` of `codes` are off `middle_m`, less what is always to one side.

        The second value tells which priors lean so, None if none does. Each is a mean (x, y) and a covariance (xx,
        xy, yy), and may be off by as much as it and one's `own` claim. Deviations of the honest change sides in a
        second; a mean of more than `LEAN_LIMIT` deviations is taken off.
        """
        if len(self._leans) + len(codes) > MAX_ORIGINS:
            self._leans = _newest(self._leans, now_s)
        off_m: list[tuple[float, float]] = []
        leans: list[bool] = []
        _, _, own_xx, own_xy, own_yy = own
        middle_x, middle_y = middle_m
        leans_of, unknown, then_s, keep = self._leans, (now_s, 0.0, 0.0), now_s, 1.0
        for code, (mean_x, mean_y, xx, xy, yy) in zip(codes, priors, strict=True):
            # The deviation in terms of what is claimed: C⁻¹ off with C Cᵀ the sum of both covariances.
            root_xx = math.sqrt(xx + own_xx)
            root_yx = (xy + own_xy) / root_xx
            root_yy = math.sqrt(yy + own_yy - root_yx * root_yx)
            off_x, off_y = mean_x - middle_x, mean_y - middle_y
            x = off_x / root_xx
            y = (off_y - root_yx * x) / root_yy
            since_s, lean_x, lean_y = leans_of.get(code, unknown)
            if since_s != then_s:  # for most the same
                then_s, keep = since_s, math.exp((since_s - now_s) / MEMORY_S)
            lean_x, lean_y = x + keep * (lean_x - x), y + keep * (lean_y - y)
            leans_of[code] = now_s, lean_x, lean_y
            squared = lean_x * lean_x + lean_y * lean_y
            is_leaning = squared > LEAN_LIMIT**2
            if is_leaning:
                less = 1 - LEAN_LIMIT / math.sqrt(squared)
                off_x -= less * root_xx * lean_x
                off_y -= less * (root_yx * lean_x + root_yy * lean_y)
            off_m.append((off_x, off_y))
            leans.append(is_leaning)
        return off_m, leans if True in leans else None


T = TypeVar("T", bound=tuple[Any, ...])


def _newest(of_origins: dict[int, T], now_s: float) -> dict[int, T]:
    """Return what is known of the latest origins; it begins with its time."""
    kept = [code for code, known in of_origins.items() if now_s - known[0] < SUM_MEMORY_S]
    return {code: of_origins[code] for code in kept[-(MAX_ORIGINS // 2) :]}


def median_belief(priors: Sequence[Five]) -> Information:
    """Return a belief at the coordinate-wise median of the means of `priors`, as wide as the widest."""
    moments = [plain_moments(*prior) for prior in priors]
    x, y = _median([mean_x for mean_x, *_ in moments]), _median([mean_y for _, mean_y, *_ in moments])
    precision = 1 / max(xx + yy for _, _, xx, _, yy in moments)
    return Information((precision, 0.0, precision, precision * x, precision * y))
