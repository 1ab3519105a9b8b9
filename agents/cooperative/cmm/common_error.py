"""Particles of the common error: weighted hypotheses c of it, and what each of them was in the last seconds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vnet.types import Array


class CommonErrorParticles:
    """Hypotheses `common_m` (2, K) of the common error with log-weights (K,), and their past.

    past_m: (L, 2, K), what c was at `past_age_s` (L,) ago, in any order.
    """

    def __init__(self, common_m: Array) -> None:
        self.common_m = common_m
        self.past_age_s = np.zeros(1)
        self.past_m = common_m[None].copy()
        self.log_weight = np.zeros(common_m.shape[1])

    def __len__(self) -> int:
        return int(self.common_m.shape[1])

    @property
    def log_weight(self) -> Array:
        """Log-weights (K,), up to a constant."""
        return self._log_weight

    @log_weight.setter
    def log_weight(self, log_weight: Array) -> None:
        self._log_weight = log_weight
        self._weight: Array | None = None

    @property
    def weight(self) -> Array:
        """Normalized weights (K,)."""
        if self._weight is None:
            self._log_weight = self._log_weight - self._log_weight.max()
            weight = np.exp(self._log_weight)
            self._weight = weight / weight.sum()
        return self._weight

    @property
    def effective_sample_size(self) -> float:
        """1 / Σ w² (Kong, Liu and Wong 1994)."""
        return float(1.0 / (self.weight @ self.weight))

    @property
    def estimate_m(self) -> Array:
        """Weighted mean x = Σ w c, (2,)."""
        return np.asarray(self.common_m @ self.weight)

    @property
    def covariance_m2(self) -> Array:
        """Weighted covariance of c, (2, 2)."""
        spread = self.common_m - self.estimate_m[:, None]
        return np.asarray((spread * self.weight) @ spread.T)

    # Time.

    def predict(self, keep: float, spread_m: float, rng: np.random.Generator) -> None:
        """Draw c ← `keep` · c + noise with a deviation of `spread_m` an axis."""
        self.common_m *= keep
        self.common_m += spread_m * rng.standard_normal(self.common_m.shape)

    def remember(self, dt_s: float, memory_s: float) -> None:
        """Add the present c to the past, which is now `dt_s` older, and forget what is older than `memory_s`."""
        self.past_age_s += dt_s
        expired = self.past_age_s > memory_s
        if np.count_nonzero(expired) == 1:  # as a rule: the present takes its row, and nothing is copied
            row = int(expired.argmax())
            self.past_age_s[row], self.past_m[row] = 0.0, self.common_m
            return
        self.past_age_s = np.concatenate([[0.0], self.past_age_s[~expired]])
        self.past_m = np.concatenate([self.common_m[None], self.past_m[~expired]])

    @property
    def oldest_s(self) -> float:
        """Age of the oldest c that is remembered."""
        return float(self.past_age_s.max())

    def at(self, age_s: Array) -> Array:
        """Return c as it was at ages (m,) in seconds: (2, K) if that is now for all, else (m, 2, K)."""
        if not age_s.any():
            return self.common_m
        return np.asarray(self.past_m[np.abs(self.past_age_s - age_s[:, None]).argmin(axis=1)])

    # Resampling.

    def take(self, index: NDArray[np.intp]) -> None:
        """Go on with the particles `index` (n,), equally likely."""
        # np.take, and not [..., index], which would leave the particles scattered in memory
        self.common_m = self.common_m.take(index, axis=-1)
        self.past_m = self.past_m.take(index, axis=-1)
        self.log_weight = np.zeros(len(index))


def systematic(weight: Array, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Draw the indices (count,) of a systematic sample by normalized weights (Kitagawa 1996).

    One random number, and `count` equidistant pointers into the cumulated weights.
    """
    pointers = (np.arange(count) + rng.random()) / count
    index = np.searchsorted(np.cumsum(weight), pointers)
    return np.asarray(np.minimum(index, len(weight) - 1))
