"""The rule by which a vehicle weighs what its neighbours send, as its options say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agents.cooperative.cmm.weights import (
    ExactWeights,
    OptimizedWeights,
    Points,
    constant_weights,
    max_degree_weights,
    metropolis_weights,
    no_fusion_weights,
    random_weights,
)
from agents.cooperative.options import Options
from vnet.types import Array


class FusionRule:
    """The rule of `options`; random weights come from `rng`.

    largest_degree: the largest number of neighbours of any vehicle, as far as this one knows.
    """

    def __init__(self, options: Options, rng: np.random.Generator) -> None:
        self._options = options
        self._rng = rng
        solver = ExactWeights if options.chosen_solver == "exact" else OptimizedWeights
        self._optimized = solver(options.self_floor, options.ridge_m2 or None)
        self.largest_degree = 0

    def notice(self, largest_degrees: Sequence[int], own_degree: int) -> None:
        """Take note of the largest degrees that others know, and of the own."""
        self.largest_degree = max([self.largest_degree, own_degree, *largest_degrees])

    def weights(
        self, estimates_m: Points, variances_m2: Sequence[float], mean_m: Array | None, degrees: Sequence[int]
    ) -> list[float]:
        """Return weights (1 + n,) of the vehicle itself and n neighbours that hear `degrees` others.

        Estimates (1 + n, 2) and the traces (1 + n,) of their covariances are the vehicle's own first; `mean_m` (2,)
        is the network's mean as far as it is known.
        """
        count = len(estimates_m)
        if self._options.fusion == "optimized":
            mean_m = np.mean(estimates_m, axis=0) if mean_m is None else mean_m
            return self._optimized.solve_by_variance(estimates_m, variances_m2, mean_m.tolist())
        return list(self._simple_weights(count, degrees).tolist())

    def _simple_weights(self, count: int, degrees: Sequence[int]) -> Array:
        """Return the weights (count,) of a rule that depends on numbers of neighbours alone."""
        match self._options.fusion:
            case "random":
                return random_weights(count, self._rng)
            case "constant":
                return constant_weights(count, self._options.alpha)
            case "metropolis":
                return metropolis_weights(count - 1, degrees)
            case "max-degree":
                return max_degree_weights(count, max(self.largest_degree, count - 1))
            case _:
                return no_fusion_weights(count)
