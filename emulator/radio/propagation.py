"""How strong a signal arrives: path loss, shadowing and fading.

Path loss and shadowing depend on where the two ends are and on nothing else, so that a pair's mean power neither
changes when others come nor depends on how it came there; fading is drawn for each frame and receiver.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv, ndtri

from emulator.scenario.radio import DualSlope, Fading, FreeSpace, LogDistance, Shadowing, TwoRay
from emulator.scenario.random_streams import Draws
from vnet.types import Array

LIGHT_M_S = 299_792_458.0
NEAREST_M = 1.0
"""Path losses are those at one metre up to there: nearer, antennas are in each other's near field."""
WAVES = 512
QUANTILES = 1 << 16
DIGITS = 6
"""Mean powers are whole millionths of a decibel, so that the last bit of a sum, in which libraries may differ with
the number of vehicles, decides nothing."""


def loss_db(model: FreeSpace | LogDistance | DualSlope | TwoRay, distance_m: Array) -> Array:
    """The path loss over distances of any shape."""
    far_m = np.maximum(distance_m, NEAREST_M)
    match model:
        case FreeSpace():
            return 20 * np.log10(4 * np.pi * far_m * model.frequency_ghz * 1e9 / LIGHT_M_S)
        case LogDistance():
            return model.reference_db + 10 * model.exponent * np.log10(far_m)
        case DualSlope():
            near = 10 * model.exponent * np.log10(np.minimum(far_m, model.break_m))
            beyond = 10 * model.far_exponent * np.log10(np.maximum(far_m, model.break_m) / model.break_m)
            return model.reference_db + near + beyond
        case TwoRay():
            return _two_ray_db(model, far_m)


def _two_ray_db(model: TwoRay, distance_m: Array) -> Array:
    """Sommer, Joerer and Dressler 2012, equations 3 to 6, with both antennas at one height."""
    wavelength_m = LIGHT_M_S / (model.frequency_ghz * 1e9)
    reflected_m = np.hypot(distance_m, 2 * model.antenna_m)
    phase_rad = 2 * np.pi * (distance_m - reflected_m) / wavelength_m
    sine, cosine = 2 * model.antenna_m / reflected_m, distance_m / reflected_m
    root = np.sqrt(model.permittivity - cosine**2)
    reflection = (sine - root) / (sine + root)
    rays = np.abs(1 + reflection * np.exp(1j * phase_rad))
    return np.asarray(20 * np.log10(4 * np.pi * distance_m / wavelength_m / np.maximum(rays, 1e-9)))


class ShadowField:
    """Shadowing as a random field over the places of both ends: a sum of plane waves of random direction.

    Its correlation is Gudmundson's exp(-Δ / d) for either end (1991), and for both the product (Wang, Tameh and
    Nix 2008). The wave vectors are those of the exponential covariance in the plane: Gaussian ones divided by the
    root of a χ² of one degree of freedom. The sum of both directions makes it the same both ways.
    """

    def __init__(self, shadowing: Shadowing, seed: int) -> None:
        self._sigma_db = shadowing.sigma_db
        self._decorrelation_m = shadowing.decorrelation_m
        uniform = Draws(seed, "shadowing").uniform(0, 0, 7 * WAVES).reshape(7, WAVES)
        self._here, self._there = (self._wave_vectors(uniform[first : first + 3]) for first in (0, 3))
        self._phase_rad = 2 * np.pi * uniform[6]

    def _wave_vectors(self, uniform: Array) -> Array:
        """(2, WAVES) from draws (3, WAVES)."""
        normal = ndtri(np.maximum(uniform, 1e-300))
        return np.asarray(normal[:2] / np.maximum(np.abs(normal[2]) * self._decorrelation_m, 1e-9))

    def between(self, position_m: Array, distance_m: Array) -> Array:
        """(N, N) decibels that are lost between positions (N, 2) at these distances (N, N)."""
        here = position_m @ self._here + self._phase_rad
        there = position_m @ self._there
        one_way = np.cos(here) @ np.cos(there).T - np.sin(here) @ np.sin(there).T
        # Near each other both directions are alike: their sum must not be stronger there.
        alike = np.exp(-2 * distance_m / self._decorrelation_m)
        return np.asarray(self._sigma_db * (one_way + one_way.T) / np.sqrt(WAVES * (1 + alike)))


class MeanPower:
    """The mean power of every pair."""

    def __init__(
        self, path_loss: FreeSpace | LogDistance | DualSlope | TwoRay, shadowing: Shadowing | None, seed: int
    ) -> None:
        self._path_loss = path_loss
        self._shadow = ShadowField(shadowing, seed) if shadowing is not None else None

    def dbm(self, position_m: Array, distance_m: Array) -> Array:
        """(N, N), rows are senders; the diagonal is the power that a sender sends with.

        Positions (N, 2) and the distances between them (N, N), in metres; where they are NaN, so is the power.
        """
        power_dbm = self._path_loss.tx_power_dbm - loss_db(self._path_loss, distance_m)
        if self._shadow is not None:
            power_dbm = power_dbm - self._shadow.between(position_m, distance_m)
        np.fill_diagonal(power_dbm, self._path_loss.tx_power_dbm)
        return np.round(power_dbm, DIGITS)


@lru_cache(maxsize=16)
def _quantiles(m: float) -> Array:
    """Of the gamma distribution of shape m and mean one, at the middles of equally likely steps."""
    return np.asarray(gammaincinv(m, (np.arange(QUANTILES) + 0.5) / QUANTILES) / m)


class Nakagami:
    """Fading: the factor that a frame's power has at a receiver is gamma distributed, of shape m and mean one.

    Nakagami 1960. Factors are those of a table of quantiles, at the middles of `QUANTILES` equally likely steps, so
    that none is above the one of a probability of 1 in 2¹⁷ (11.6 dB with m = 0.75).
    """

    def __init__(self, fading: Fading | None) -> None:
        self._until_m = np.array(fading.until_m if fading is not None else ())
        self._factor = np.concatenate([_quantiles(m) for m in fading.m]) if fading is not None else np.ones(1)

    def shape(self, distance_m: Array) -> NDArray[np.uint64]:
        """Which shape belongs to distances, as `factor` wants it."""
        return np.searchsorted(self._until_m, distance_m).astype(np.uint64) * np.uint64(QUANTILES)

    def factor(self, shape: NDArray[np.uint64], step: NDArray[np.uint64]) -> Array:
        """The factors of pairs by their shapes and the numbers of their steps."""
        if len(self._factor) == 1:
            return np.ones(step.shape)
        factor: Array = self._factor[step + shape]
        return factor
