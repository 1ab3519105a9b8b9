"""Information about the common error, as vehicles exchange it: pooled priors and added increments (MODEL 10).

A Gaussian belief about c is written as Λ = P⁻¹ and η = Λ x. What may be known in common, the *priors* of vehicles
that have heard each other, is averaged with weights that add up to 1 (covariance intersection, Julier and Uhlmann
1997); what is certainly new, what this period's fix says about c, the *increment*, is added. Only the sums of the
weights must be 1, so that losses and one-way links do no harm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vnet.types import Array


@dataclass(frozen=True)
class Information:
    """A Gaussian belief about c, or what is added to it: `matrix` Λ (2, 2) in 1/m², `vector` η (2,) in 1/m."""

    matrix: Array
    vector: Array

    @classmethod
    def of(cls, mean_m: Array, covariance_m2: Array) -> Information:
        """Return the belief with mean (2,) and covariance (2, 2)."""
        matrix = inverse(covariance_m2)
        return cls(matrix, matrix.dot(mean_m))

    def moments(self) -> tuple[Array, Array]:
        """Return mean (2,) in m and covariance (2, 2) in m²; the matrix must be positive definite."""
        covariance_m2 = inverse(self.matrix)
        return covariance_m2.dot(self.vector), covariance_m2

    def plus(self, other: Information) -> Information:
        """Return this belief with another piece of information added."""
        return Information(self.matrix + other.matrix, self.vector + other.vector)


def inverse(matrix: Array) -> Array:
    """Return the inverse of a symmetric matrix (2, 2), in closed form: numpy's takes longer than all else here."""
    (a, b), (_, d) = matrix.tolist()
    determinant = a * d - b * b
    return np.array([[d / determinant, -b / determinant], [-b / determinant, a / determinant]])


def square_root(matrix: Array) -> Array:
    """Return the symmetric square root of a positive definite matrix M (2, 2).

    In closed form (M + √det M · I) / √(tr M + 2 √det M).
    """
    (a, b), (_, d) = matrix.tolist()
    root = math.sqrt(max(a * d - b * b, 0.0))
    scale = math.sqrt(a + d + 2 * root)
    return np.array([[(a + root) / scale, b / scale], [b / scale, (d + root) / scale]])


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
        return Information(matrix, vector)
    kept = direction[:, value > 0]
    onto = kept @ kept.T
    return Information(onto @ matrix @ onto, onto @ vector)
