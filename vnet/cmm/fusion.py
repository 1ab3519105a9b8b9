"""Fusion: a vehicle's particles, mixed with its neighbours' (MODEL 5).

A share a_ij of the particles is replaced by hypotheses of neighbour j. The mixture of posteriors counts nothing
twice. What the neighbour could not know are the roads of those vehicles that it does not hear: these, and only
these, weigh its hypotheses here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vnet.cmm.rbpf import Rbpf, systematic
from vnet.cmm.weights import largest_remainder
from vnet.types import Array


@dataclass(frozen=True)
class Cloud:
    """A neighbour's equally likely hypotheses `common_m` (n, 2), and the vehicles whose fixes are in them."""

    common_m: Array
    known: frozenset[str]


def fuse(rbpf: Rbpf, clouds: Sequence[Cloud], weights: Array, rng: np.random.Generator) -> tuple[Array, int]:
    """Mix `clouds` into the filter by `weights` (1 + n,), its own first; the filter is changed in place.

    Returns the estimate (2,) right after stacking, before any road weighs the stack, and how many hypotheses were
    imported. Where the filter leaves the roads apart, none are looked at here either.
    """
    counts = largest_remainder(weights, rbpf.config.particles)
    used = [(cloud, int(count)) for cloud, count in zip(clouds, counts[1:], strict=True) if count]
    used = [(cloud, count) for cloud, count in used if len(cloud.common_m)]
    imported = sum(count for _, count in used)
    if not used:
        return rbpf.estimate_m, 0
    kept = rbpf.config.particles - imported
    own = systematic(rbpf.weight, kept, rng) if kept else np.empty(0, dtype=np.intp)
    common = np.concatenate([_evenly(cloud.common_m, count, rng) for cloud, count in used])
    stacked = (rbpf.common_m[:, own].sum(axis=1) + common.sum(axis=0)) / rbpf.config.particles
    supplied = rbpf.condition_on(common)
    if rbpf.config.separate_map_update:
        log_weight = np.zeros(kept + imported)
    else:
        batch = np.repeat(np.arange(len(used)), [count for _, count in used])
        evidence = _evidence(rbpf, [cloud for cloud, _ in used], batch, supplied[2])
        log_weight = np.concatenate([np.zeros(kept), evidence])
    rbpf.replace(own, common, supplied, log_weight)
    return np.asarray(stacked), imported


def _evidence(rbpf: Rbpf, clouds: Sequence[Cloud], batch: NDArray[np.intp], log_road: Array) -> Array:
    """Log-weights (n,) of imported hypotheses; `batch` says which cloud each is from, `log_road` is (M, n).

    They are the roads that the neighbour does not know, relative to what is usual in this filter's own cloud.
    """
    unknown = np.array([[v not in cloud.known for v in rbpf.vehicles] for cloud in clouds], dtype=float)
    if not unknown.any():
        return np.zeros(len(batch))
    own = unknown @ rbpf.own_log_road
    top = own.max(axis=1)
    usual = top + np.log(np.exp(own - top[:, None]) @ rbpf.weight)
    return np.asarray(np.einsum("nm,mn->n", unknown[batch], log_road) - usual[batch])


def _evenly(hypotheses: Array, count: int, rng: np.random.Generator) -> Array:
    """A systematic sample of `count` from equally likely `hypotheses` (n, 2)."""
    index = (np.arange(count) + rng.random()) * (len(hypotheses) / count)
    return hypotheses[index.astype(np.intp)]
