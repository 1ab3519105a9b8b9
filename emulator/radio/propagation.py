"""Propagation: path loss, shadowing and fading.

Path loss and shadowing are functions of the two positions alone: the mean power of a link depends neither on other
vehicles nor on the way by which the two came there. Fading is drawn for each frame and receiver.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from emulator.scenario.program import RoadsideUnit
from emulator.scenario.radio import DualSlope, Fading, FreeSpace, LogDistance, Shadowing, TwoRay
from emulator.scenario.random_streams import Draws
from vnet.types import Array

LIGHT_M_S = 299_792_458.0
"""Speed of light in m/s."""
VEHICLE_ANTENNA_M = 1.5
"""Height of a vehicle's antenna above the ground where the path loss does not say it."""
NEAREST_M = 1.0
"""Least distance of the path loss models: below it, antennas are in each other's near field."""
WAVES = 512
"""Plane waves whose sum is the shadowing."""
QUANTILES = 1 << 16
"""Equally likely values of the fading factor."""
DIGITS = 6
"""Mean powers are rounded to millionths of a decibel: the last bit of a sum, which may depend on the library and on
the number of vehicles, then decides nothing."""


PathLossModel = FreeSpace | LogDistance | DualSlope | TwoRay
"""A model of the path loss."""


def vehicle_antenna_m(model: PathLossModel) -> float:
    """Return the height in m of the antennas of vehicles."""
    return model.antenna_m if isinstance(model, TwoRay) else VEHICLE_ANTENNA_M


def loss_db(model: PathLossModel, distance_m: Array, height_m: tuple[Array, Array] | None = None) -> Array:
    """Return the path loss in dB over distances of any shape.

    `distance_m` are distances on the ground, and `height_m` the heights of both antennas; those of vehicles if
    left out.
    """
    far_m = np.maximum(distance_m, NEAREST_M)
    if isinstance(model, TwoRay):
        return _two_ray_db(model, far_m, *(height_m or (model.antenna_m, model.antenna_m)))
    if height_m is not None:
        far_m = np.maximum(np.hypot(distance_m, height_m[0] - height_m[1]), NEAREST_M)
    match model:
        case FreeSpace():
            return 20 * np.log10(4 * np.pi * far_m * model.frequency_ghz * 1e9 / LIGHT_M_S)
        case LogDistance():
            return model.reference_db + 10 * model.exponent * np.log10(far_m)
        case DualSlope():
            near = 10 * model.exponent * np.log10(np.minimum(far_m, model.break_m))
            beyond = 10 * model.far_exponent * np.log10(np.maximum(far_m, model.break_m) / model.break_m)
            return model.reference_db + near + beyond


def _two_ray_db(model: TwoRay, distance_m: Array, here_m: Array | float, there_m: Array | float) -> Array:
    """Return the two-ray path loss (Sommer, Joerer and Dressler 2012, equations 3 to 6) between two heights."""
    wavelength_m = LIGHT_M_S / (model.frequency_ghz * 1e9)
    direct_m, reflected_m = np.hypot(distance_m, here_m - there_m), np.hypot(distance_m, here_m + there_m)
    phase_rad = 2 * np.pi * (direct_m - reflected_m) / wavelength_m
    sine, cosine = (here_m + there_m) / reflected_m, distance_m / reflected_m
    root = np.sqrt(model.permittivity - cosine**2)
    reflection = (sine - root) / (sine + root)
    rays = np.abs(1 + reflection * np.exp(1j * phase_rad))
    return np.asarray(20 * np.log10(4 * np.pi * direct_m / wavelength_m / np.maximum(rays, 1e-9)))


def transmit_powers_dbm(
    model: PathLossModel | None, count: int, units: Sequence[RoadsideUnit] = ()
) -> list[float] | None:
    """Return the transmit powers in dBm of `count` nodes, of which the last are `units`; None without a model."""
    if model is None:
        return None
    of_units = [model.tx_power_dbm if unit.tx_power_dbm is None else unit.tx_power_dbm for unit in units]
    return [model.tx_power_dbm] * (count - len(units)) + of_units


class ShadowField:
    """Shadowing as a random field over the positions of both ends: a sum of plane waves of random direction.

    Its correlation is Gudmundson's exp(-Δ / d) for either end (1991), and the product of these for both (Wang,
    Tameh and Nix 2008). The wave vectors follow the spectrum of the exponential covariance in the plane: Gaussian
    vectors divided by the square root of a χ² variable of one degree of freedom. Adding both directions makes the
    field symmetric.
    """

    def __init__(self, shadowing: Shadowing, seed: int) -> None:
        self._sigma_db = shadowing.sigma_db
        self._decorrelation_m = shadowing.decorrelation_m
        uniform = Draws(seed, "shadowing").uniform(0, 0, 7 * WAVES).reshape(7, WAVES)
        self._here, self._there = (self._wave_vectors(uniform[first : first + 3]) for first in (0, 3))
        self._phase_rad = 2 * np.pi * uniform[6]

    def _wave_vectors(self, uniform: Array) -> Array:
        """Return wave vectors (2, WAVES) in rad/m from uniform draws (3, WAVES)."""
        from scipy.special import ndtri  # slow to import, and only shadowing needs it

        normal = ndtri(np.maximum(uniform, 1e-300))
        return np.asarray(normal[:2] / np.maximum(np.abs(normal[2]) * self._decorrelation_m, 1e-9))

    def between(self, position_m: Array, distance_m: Array) -> Array:
        """Return the shadowing loss (N, N) in dB between positions (N, 2) at these distances (N, N), in metres."""
        here = position_m @ self._here + self._phase_rad
        there = position_m @ self._there
        one_way = np.cos(here) @ np.cos(there).T - np.sin(here) @ np.sin(there).T
        # Both directions are correlated where the ends are close: the divisor keeps the variance of the sum.
        correlation = np.exp(-2 * distance_m / self._decorrelation_m)
        return np.asarray(self._sigma_db * (one_way + one_way.T) / np.sqrt(WAVES * (1 + correlation)))


class MeanPower:
    """Mean received power of every link: transmit power less path loss and shadowing.

    The last nodes are roadside `units`, with heights and powers of their own.
    """

    def __init__(
        self,
        path_loss: PathLossModel,
        shadowing: Shadowing | None,
        seed: int,
        units: Sequence[RoadsideUnit] = (),
    ) -> None:
        self._path_loss = path_loss
        self._units = tuple(units)
        self._shadow = ShadowField(shadowing, seed) if shadowing is not None else None

    def dbm(self, position_m: Array, distance_m: Array) -> Array:
        """Return the mean received power (N, N) in dBm; rows are senders, the diagonal is the transmit power.

        `position_m` (N, 2) are positions, `distance_m` (N, N) the distances between them; NaN gives NaN.
        """
        sent_dbm, height_m = self._antennas(len(position_m))
        power_dbm = sent_dbm - loss_db(self._path_loss, distance_m, height_m)
        if self._shadow is not None:
            power_dbm = power_dbm - self._shadow.between(position_m, distance_m)
        np.fill_diagonal(power_dbm, sent_dbm)
        return np.round(power_dbm, DIGITS)

    def _antennas(self, count: int) -> tuple[Array | float, tuple[Array, Array] | None]:
        """Return transmit powers (N, 1) in dBm and heights (N, 1) and (1, N) in m; one power without units."""
        if not self._units:
            return self._path_loss.tx_power_dbm, None
        of_vehicles_m = [vehicle_antenna_m(self._path_loss)] * (count - len(self._units))
        height_m = np.array(of_vehicles_m + [unit.height_m for unit in self._units])
        sent_dbm = np.array(transmit_powers_dbm(self._path_loss, count, self._units))
        return sent_dbm[:, None], (height_m[:, None], height_m[None, :])


@lru_cache(maxsize=16)
def _quantiles(m: float) -> Array:
    """Quantiles (QUANTILES,) of the gamma distribution of shape m and mean 1, at the middles of equal steps."""
    from scipy.special import gammaincinv  # slow to import, and only fading needs it

    return np.asarray(gammaincinv(m, (np.arange(QUANTILES) + 0.5) / QUANTILES) / m)


class Nakagami:
    """Nakagami fading: a frame's received power is multiplied by a gamma-distributed factor of mean 1.

    Nakagami 1960; the shape m depends on distance. Factors come from a table of quantiles at the middles of
    `QUANTILES` equally likely steps, so none exceeds the quantile of probability 1 - 2⁻¹⁷ (11.6 dB with m = 0.75).
    """

    def __init__(self, fading: Fading | None) -> None:
        self._until_m = np.array(fading.until_m if fading is not None else ())
        self._factor = np.concatenate([_quantiles(m) for m in fading.m]) if fading is not None else np.ones(1)

    def shape(self, distance_m: Array) -> NDArray[np.intp]:
        """Return the table offsets of the shapes at these distances (any shape), as `factor` takes them."""
        return np.asarray(np.searchsorted(self._until_m, distance_m) * QUANTILES)

    def factor(self, shape: NDArray[np.intp], step: NDArray[np.intp]) -> Array:
        """Return the factors for table offsets from `shape` and drawn steps in [0, QUANTILES)."""
        if len(self._factor) == 1:
            return np.ones(step.shape)
        factor: Array = self._factor[step + shape]
        return factor
