"""A weighted cloud of particles that affine maps move, carried out only when the cloud is weighed (MODEL 10).

In a period most of what happens to particles happens to all alike: dynamics, what others say, and the gain of a fix
are affine maps. Only noise and weights differ from particle to particle. So the cloud is kept as an affine image of
the deviations that it had when it was last weighed; maps are composed, and one product carries them all out.
`dot` is used because it takes a third of the time of `@` where arrays are small.
"""

from __future__ import annotations

import threading

import numpy as np

from vnet.cmm.common_error import systematic
from vnet.types import Array

DIFFUSING = 2
"""Number of the coordinates that diffuse, the first."""
LEAST_VARIANCE_M2 = 1e-4
"""Variance (m²) that is added to those of the coordinates that diffuse: so few particles may be left that their own
is none, and nothing is known to a centimetre."""
MAX_SHAPES = 32
"""Number of shapes of which an array is kept: the number of particles may vary."""
_ROOT_HALF = np.sqrt(0.5)


class _Scratch(threading.local):
    """An array of each shape that clouds of a thread write to in turns.

    New arrays would be cleared pages, and one for each of many clouds would not stay in the processor's caches.
    """

    def __init__(self) -> None:
        self._arrays: dict[tuple[int, ...], Array] = {}

    def of(self, basis: Array) -> Array:
        """Return an array of the shape of `basis` whose last row is ones."""
        array = self._arrays.get(basis.shape)
        if array is None:
            if len(self._arrays) >= MAX_SHAPES:
                self._arrays.clear()
            array = self._arrays[basis.shape] = np.ones_like(basis)
        return array

    def keep(self, basis: Array) -> None:
        """Keep `basis`, whose last row is ones, in place of what `of` has returned."""
        self._arrays[basis.shape] = basis


_scratch = _Scratch()


class AffineCloud:
    """A cloud of K points of n coordinates.

    weight: (K,), normalized. covariance: (n, n), with `mean` the moments of the cloud when it was last weighed,
    moved since as they are expected to, whatever the noise that was drawn.
    """

    def __init__(self, points: Array, log_weight: Array) -> None:
        """Begin with `points` (n, K) and the logarithms (K,) of their weights."""
        self._size, count = points.shape
        # Deviations from the origin, noise, a row of ones.
        self._basis = np.ones((self._size + DIFFUSING + 1, count))
        self._unmoved = np.eye(self._size, self._size + DIFFUSING + 2)
        self._affine = np.zeros((self._size + 2, self._size + DIFFUSING + 1))  # what `weigh` carries out
        self._linear = self._unmoved
        self.covariance = np.zeros((self._size, self._size))
        self._is_diffused = False
        self._log_weight = np.array(log_weight)
        self.weight = self._normalized()
        origin = points.mean(axis=1)
        np.subtract(points, origin[:, None], out=self._basis[: self._size])
        self._take_moments(origin)

    @property
    def mean(self) -> Array:
        """Mean (n,) of the cloud."""
        return self._linear[:, -1]

    @property
    def points(self) -> Array:
        """The points (n, K)."""
        return np.asarray(self._linear[:, :-2] @ self._basis[:-1] + self._linear[:, -2:-1])

    def move(self, matrix: Array, by: Array | None = None) -> None:
        """Map each point x to `matrix` x + `by`, (n, n) and (n,)."""
        self._linear = matrix.dot(self._linear)
        if by is not None:
            self._linear[:, -2:] += by[:, None]
        self.covariance = matrix.dot(self.covariance).dot(matrix.T)

    def diffuse(self, sigma: float, rng: np.random.Generator) -> None:
        """Add noise of deviation `sigma` to the coordinates that diffuse."""
        size = self._size
        if self._is_diffused:
            self._carry_out(self._linear[:, :-2] @ np.eye(size + DIFFUSING, size + DIFFUSING + 1))
            self._take_moments(self._linear[:, -2])
        self._is_diffused = True
        rng.standard_normal(out=self._basis[size:-1])
        for axis in range(DIFFUSING):
            self._linear[axis, size + axis] = sigma
            self.covariance[axis, axis] += sigma * sigma

    def weigh(self, measure: Array, value: Array, root: Array, gain: Array) -> None:
        """Weigh each point x by exp(−½ |`root` r|²) with r = `value` − `measure` x, and move it by `gain` r.

        `measure` is (2, n), `value` (2,), `root` (2, 2) and `gain` (n, 2). `settle` is to follow.
        """
        size = self._size
        seen = measure.dot(self._linear)  # the map, the origin and the mean as they are measured
        seen[:, -2:] -= value[:, None]
        self._linear -= gain.dot(seen)
        affine = self._affine
        affine[:size, :-1] = self._linear[:, :-2]
        affine[size:] = (_ROOT_HALF * root).dot(seen[:, :-1])
        self._carry_out(affine)
        squared = self._basis[size:-1]
        squared *= squared
        self._log_weight -= squared[0]
        self._log_weight -= squared[1]

    def settle(self, count: int, rng: np.random.Generator) -> None:
        """Go on with `count` points after they have been weighed: resample if it is due, and take the moments."""
        origin = self._linear[:, -2]
        self.weight = self._normalized()
        if count != len(self.weight) or 1 / self.weight.dot(self.weight) < count / 2:
            index = systematic(self.weight, count, rng)
            self._basis = self._basis.take(index, axis=1)
            self._log_weight = np.zeros(count)
            self.weight = np.full(count, 1 / count)
        self._take_moments(origin)

    def _carry_out(self, affine: Array) -> None:
        """Replace the first rows of the basis by `affine` times all of it."""
        spare = _scratch.of(self._basis)
        np.matmul(affine, self._basis, out=spare[: len(affine)])
        _scratch.keep(self._basis)
        self._basis = spare

    def _normalized(self) -> Array:
        self._log_weight -= np.maximum.reduce(self._log_weight)
        weight = np.exp(self._log_weight)
        weight /= np.add.reduce(weight)
        return np.asarray(weight)

    def _take_moments(self, origin: Array) -> None:
        """Compute the moments of the deviations from `origin` (n,), near the mean, and forget all moves."""
        off = self._basis[: self._size]
        mean_off = off.dot(self.weight)
        weighted = _scratch.of(self._basis)[: self._size]
        np.multiply(off, self.weight, out=weighted)
        self.covariance = weighted.dot(off.T) - mean_off[:, None] * mean_off
        for axis in range(DIFFUSING):
            self.covariance[axis, axis] += LEAST_VARIANCE_M2
        self._linear = self._unmoved.copy()
        self._linear[:, -2], self._linear[:, -1] = origin, origin + mean_off
        self._is_diffused = False
