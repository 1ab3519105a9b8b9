"""Information about the common error, as vehicles exchange it: pooled priors and added increments (MODEL 10).

A Gaussian belief about c is written as Λ = P⁻¹ and η = Λ x. What may be known in common, the *priors* of vehicles
that have heard each other, is averaged with weights that add up to 1 (covariance intersection, Julier and Uhlmann
1997); what is certainly new, what this period's fix says about c, the *increment*, is added. Only the sums of the
weights must be 1, so that losses and one-way links do no harm.
"""

from __future__ import annotations

import math

import numpy as np

from vnet.types import Array

Three = tuple[float, float, float]
Five = tuple[float, float, float, float, float]


class Information:
    """A Gaussian belief about c, or what is added to it: Λ in 1/m² and η in 1/m.

    numbers: Λ_xx, Λ_xy, Λ_yy, η_x and η_y. So few are worked with as plain numbers: as arrays they take longer.
    """

    __slots__ = ("numbers",)

    def __init__(self, numbers: Five) -> None:
        self.numbers = numbers

    @classmethod
    def from_arrays(cls, matrix: Array, vector: Array) -> Information:
        """Return what Λ (2, 2) and η (2,) say."""
        (a, b), (_, d) = matrix.tolist()
        x, y = vector.tolist()
        return cls((a, b, d, x, y))

    @classmethod
    def of(cls, mean_m: Array, covariance_m2: Array) -> Information:
        """Return the belief with mean (2,) and covariance (2, 2)."""
        (p, q), (_, r) = covariance_m2.tolist()
        a, b, d = inverted(p, q, r)
        x, y = mean_m.tolist()
        return cls((a, b, d, a * x + b * y, b * x + d * y))

    @property
    def matrix(self) -> Array:
        """Λ (2, 2) in 1/m²."""
        a, b, d, _, _ = self.numbers
        return np.array([[a, b], [b, d]])

    @property
    def vector(self) -> Array:
        """η (2,) in 1/m."""
        return np.array(self.numbers[3:])

    def moments(self) -> tuple[Array, Array]:
        """Return mean (2,) in m and covariance (2, 2) in m²; the matrix must be positive definite."""
        x, y, p, q, r = plain_moments(*self.numbers)
        return np.array([x, y]), np.array([[p, q], [q, r]])

    def plus(self, other: Information) -> Information:
        """Return this belief with another piece of information added."""
        a, b, d, x, y = self.numbers
        more_a, more_b, more_d, more_x, more_y = other.numbers
        return Information((a + more_a, b + more_b, d + more_d, x + more_x, y + more_y))

    def minus(self, other: Information) -> Information:
        """Return what this belief says beyond another."""
        a, b, d, x, y = self.numbers
        less_a, less_b, less_d, less_x, less_y = other.numbers
        return Information((a - less_a, b - less_b, d - less_d, x - less_x, y - less_y))


NOTHING = Information((0.0, 0.0, 0.0, 0.0, 0.0))
"""A fix that is not used says this."""


# Symmetric matrices (xx, xy, yy) in plain numbers.


def inverted(a: float, b: float, d: float) -> Three:
    """Return the inverse of a symmetric matrix."""
    determinant = a * d - b * b
    return d / determinant, -b / determinant, a / determinant


def rooted(a: float, b: float, d: float) -> Three:
    """Return the symmetric square root of a positive definite matrix M: (M + √det M · I) / √(tr M + 2 √det M)."""
    root = math.sqrt(max(a * d - b * b, 0.0))
    scale = math.sqrt(a + d + 2 * root)
    return (a + root) / scale, b / scale, (d + root) / scale


def plain_moments(a: float, b: float, d: float, x: float, y: float) -> Five:
    """Return the mean (x, y) in m and the covariance (xx, xy, yy) in m² of a belief."""
    variance_x, covariance, variance_y = inverted(a, b, d)
    return variance_x * x + covariance * y, covariance * x + variance_y * y, variance_x, covariance, variance_y


# The same as arrays.


def inverse(matrix: Array) -> Array:
    """Return the inverse of a symmetric matrix (2, 2), in closed form: numpy's takes longer than all else here."""
    (a, b), (_, d) = matrix.tolist()
    a, b, d = inverted(a, b, d)
    return np.array([[a, b], [b, d]])


def square_root(matrix: Array) -> Array:
    """Return the symmetric square root of a positive definite matrix (2, 2)."""
    (a, b), (_, d) = matrix.tolist()
    a, b, d = rooted(a, b, d)
    return np.array([[a, b], [b, d]])


def transport(covariance_m2: Array, new_covariance_m2: Array) -> Array:
    """Return T (2, 2) that maps deviations of one Gaussian onto another's, moving them least (optimal transport).

    T = P^(-1/2) (P^(1/2) P' P^(1/2))^(1/2) P^(-1/2) (Olkin and Pukelsheim 1982), both positive definite.
    """
    root = square_root(covariance_m2)
    inverse_root = inverse(root)
    return np.asarray(inverse_root.dot(square_root(root.dot(new_covariance_m2).dot(root))).dot(inverse_root))


def gained(before: Information, after: Information) -> Information:
    """Return what has been added to a belief; directions in which less is known than before count as nothing."""
    matrix, vector = after.matrix - before.matrix, after.vector - before.vector
    value, direction = np.linalg.eigh(matrix)
    if value[0] >= 0:
        return Information.from_arrays(matrix, vector)
    kept = direction[:, value > 0]
    onto = kept @ kept.T
    return Information.from_arrays(onto @ matrix @ onto, onto @ vector)


def new_at_mean(before: Information, after: Information) -> Information:
    """Return how much more `after` says than `before`, about its own mean; less than nothing counts as nothing."""
    a, b, d, _, _ = after.minus(before).numbers
    middle, root = (a + d) / 2, math.hypot((a - d) / 2, b)
    if middle < root:  # of the eigenvalues one or both are negative
        share = max(middle + root, 0.0) / (2 * root)
        a, b, d = share * (a - middle + root), share * b, share * (d - middle + root)
    x, y, *_ = plain_moments(*after.numbers)
    return Information((a, b, d, a * x + b * y, b * x + d * y))
