"""The paper's linear model of a network of filters, x(t+1) = A x(t) + w(t): closed forms to compare results with.

Row i of A holds vehicle i's fusion weights, w its filter's own noise. With A 1 = 1 the mean of all estimates is a
random walk that no fusion bounds; what fusion does bound are the deviations from it.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from vnet.errors import VnetError
from vnet.types import Array


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
