"""Fusion: a vehicle's particles, mixed with its neighbours' (MODEL 5).

A share a_ij of the particles is replaced by hypotheses of neighbour j. The mixture of posteriors counts nothing
twice. What the neighbour could not know are the roads of those vehicles that it does not hear: these, and only
these, weigh its hypotheses here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vnet.cmm.rbpf import Rbpf, systematic
from vnet.cmm.weights import largest_remainder
from vnet.roads.lanes import Array


@dataclass(frozen=True)
class Cloud:
    """A neighbour's equally likely hypotheses `common_m` (n, 2), and the vehicles whose fixes are in them."""

    common_m: Array
    known: frozenset[str]


def fuse(rbpf: Rbpf, clouds: Sequence[Cloud], weights: Array, rng: np.random.Generator) -> Array:
    """Mix `clouds` into the filter by `weights` (1 + n,), its own first; the filter is changed in place.

    Returns the estimate (2,) right after stacking, before the roads weigh the imported hypotheses.
    """
    counts = largest_remainder(weights, rbpf.config.particles)
    own = systematic(rbpf.weight, int(counts[0]), rng) if counts[0] else np.empty(0, dtype=np.intp)
    imported = [
        (cloud, cloud.common_m[systematic(_equal(cloud), int(count), rng)])
        for cloud, count in zip(clouds, counts[1:], strict=True)
        if count
    ]
    if not imported:
        return rbpf.estimate_m
    common = np.concatenate([hypotheses for _, hypotheses in imported])
    stacked = np.concatenate([rbpf.common_m[:, own].T, common]).mean(axis=0)
    _, log_road = rbpf.supply(common)
    log_weight = np.concatenate(
        [
            _evidence(rbpf, cloud, log_road[:, start : start + len(hypotheses)])
            for start, (cloud, hypotheses) in zip(_starts(imported), imported, strict=True)
        ]
    )
    rbpf.replace(own, common, log_weight)
    return np.asarray(stacked)


def _evidence(rbpf: Rbpf, cloud: Cloud, log_road: Array) -> Array:
    """Log-weights of a neighbour's hypotheses: the roads it does not know, relative to this filter's own cloud."""
    unknown = np.array([vehicle not in cloud.known for vehicle in rbpf.vehicles], dtype=bool)
    if not unknown.any():
        return np.zeros(log_road.shape[1])
    own = rbpf.own_log_road(unknown)
    top = own.max()
    usual = top + np.log(np.exp(own - top) @ rbpf.weight)
    return np.asarray(log_road[unknown].sum(axis=0) - usual)


def _equal(cloud: Cloud) -> Array:
    return np.full(len(cloud.common_m), 1 / len(cloud.common_m))


def _starts(imported: Sequence[tuple[Cloud, Array]]) -> list[int]:
    """Where each neighbour's hypotheses begin in the stack."""
    return [0, *np.cumsum([len(hypotheses) for _, hypotheses in imported])[:-1].tolist()]
