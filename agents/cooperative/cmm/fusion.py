"""Fusion: one filter's particles mixed with those of its neighbours (MODEL 5).

A share a_ij of the particles is replaced by hypotheses of neighbour j. The mixture of posteriors counts nothing
twice. The neighbour could not know the roads of those vehicles that it does not receive: these, and only these,
weight its hypotheses here.

A hypothesis from outside brings no vehicles with it. It is paired with a particle of this filter, whose vehicles
and past are moved along their regression on c: what c does not determine keeps its spread, and its correlations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.cmm.common_error import systematic
from agents.cooperative.cmm.rbpf import Rbpf
from agents.cooperative.cmm.weights import largest_remainder
from vnet.types import Array

MIN_VARIANCE_M2 = 1e-6
"""Variance (m²) of c below which a cloud has collapsed: a millimetre tells nothing about a regression."""
MIN_VARIANCE_RATIO = 1e-6
"""Ratio of the smaller to the larger variance of c below which it has collapsed to a line."""


@dataclass(frozen=True)
class Cloud:
    """A neighbour's equally likely hypotheses `common_m` (n, 2), and the vehicles whose fixes are in them."""

    common_m: Array
    known: frozenset[str]


@dataclass(frozen=True)
class Slopes:
    """The regression on c, Cov(·, c) Cov(c)⁻¹, of what goes with a particle.

    mean: (M, 4, 2), of the vehicles' means. past: (L, 2, 2), of the past c. map_log_likelihood: (M, 2).
    """

    mean: Array
    past: Array
    map_log_likelihood: Array


@dataclass(frozen=True)
class Conditioned:
    """Hypotheses `common_m` (n, 2) with what a filter expects given each of them.

    mean: (M, 4, n). past_m: (L, 2, n). map_log_likelihood: (M, n), log P of each vehicle on a road.
    """

    common_m: Array
    mean: Array
    past_m: Array
    map_log_likelihood: Array


def regression_on_common_error(rbpf: Rbpf) -> Slopes:
    """Return the filter's regression on c.

    If the cloud has collapsed: −I for positions (a vehicle is where its fix says, less c), I for the past, and 0.
    """
    particles, tracks = rbpf.particles, rbpf.tracks
    covariance = particles.covariance_m2
    eigenvalues = np.linalg.eigvalsh(covariance)
    if eigenvalues[0] < MIN_VARIANCE_M2 or eigenvalues[0] < MIN_VARIANCE_RATIO * eigenvalues[1]:
        mean = np.zeros((len(tracks), 4, 2))
        mean[:, 0, 0] = mean[:, 1, 1] = -1.0
        return Slopes(mean, np.tile(np.eye(2), (len(particles.past_m), 1, 1)), np.zeros((len(tracks), 2)))
    spread_m = particles.common_m - particles.estimate_m[:, None]
    project = (spread_m * particles.weight).T @ np.linalg.inv(covariance)
    return Slopes(tracks.mean @ project, particles.past_m @ project, tracks.map_log_likelihood @ project)


def fuse(rbpf: Rbpf, clouds: Sequence[Cloud], weights: Array, rng: np.random.Generator) -> tuple[Array, int]:
    """Mix `clouds` into the filter by `weights` (1 + n,), its own first; the filter is changed in place.

    Returns the estimate (2,) right after fusion, before any road weights the particles, and how many hypotheses
    were imported. A filter with `separate_map_update` does not evaluate the map here either.
    """
    counts = largest_remainder(weights, rbpf.config.particles)
    used = [(cloud, int(count)) for cloud, count in zip(clouds, counts[1:], strict=True) if count]
    used = [(cloud, count) for cloud, count in used if len(cloud.common_m)]
    imported = sum(count for _, count in used)
    if not used:
        return rbpf.estimate_m, 0
    kept = rbpf.config.particles - imported
    own = systematic(rbpf.weight, kept, rng) if kept else np.empty(0, dtype=np.intp)
    common_m = np.concatenate([_evenly(cloud.common_m, count, rng) for cloud, count in used])
    fused_m = (rbpf.common_m[:, own].sum(axis=1) + common_m.sum(axis=0)) / rbpf.config.particles
    conditioned = condition_on(rbpf, common_m, rng)
    if rbpf.config.separate_map_update:
        log_weight = np.zeros(kept + imported)
    else:
        batch = np.repeat(np.arange(len(used)), [count for _, count in used])
        evidence = _evidence(rbpf, [cloud for cloud, _ in used], batch, conditioned.map_log_likelihood)
        log_weight = np.concatenate([np.zeros(kept), evidence])
    _replace(rbpf, own, conditioned, log_weight, rng)
    return np.asarray(fused_m), imported


def condition_on(rbpf: Rbpf, common_m: Array, rng: np.random.Generator) -> Conditioned:
    """Return what the filter expects given hypotheses (n, 2) from outside."""
    count = len(common_m)
    particles, tracks = rbpf.particles, rbpf.tracks
    partner = rng.permutation(systematic(particles.weight, count, rng))
    by_m = common_m.T - particles.common_m[:, partner]
    slopes = regression_on_common_error(rbpf)
    mean = tracks.mean.take(partner, axis=-1) + slopes.mean @ by_m
    past_m = particles.past_m.take(partner, axis=-1) + slopes.past @ by_m
    log_likelihood = rbpf.map_evidence.log_likelihood(tracks, mean)
    bare = tracks.without_candidate()
    if bare.any():  # on no lane just now: what the last one said still counts
        own = tracks.map_log_likelihood[bare][:, partner]
        log_likelihood[bare] = own + slopes.map_log_likelihood[bare] @ by_m
    return Conditioned(common_m, mean, past_m, log_likelihood)


def _evidence(rbpf: Rbpf, clouds: Sequence[Cloud], batch: NDArray[np.intp], map_log_likelihood: Array) -> Array:
    """Log-weights (n,) of imported hypotheses, from the roads of the vehicles that their senders do not know.

    `batch` (n,) is the index of each one's cloud and `map_log_likelihood` (M, n) its log P on road. Weights are
    relative to the mean likelihood in this filter's own cloud.
    """
    unknown = np.array([[v not in cloud.known for v in rbpf.vehicles] for cloud in clouds], dtype=float)
    if not unknown.any():
        return np.zeros(len(batch))
    own = unknown @ rbpf.tracks.map_log_likelihood
    top = own.max(axis=1)
    usual = top + np.log(np.exp(own - top[:, None]) @ rbpf.weight)
    return np.asarray(np.einsum("nm,mn->n", unknown[batch], map_log_likelihood) - usual[batch])


def _replace(
    rbpf: Rbpf,
    own: NDArray[np.intp],
    conditioned: Conditioned,
    log_weight: Array,
    rng: np.random.Generator,
) -> None:
    """Go on with the particles `own` (m,) and the hypotheses `conditioned` (n of them), resampled to K.

    `log_weight` (m + n,) are their weights, own first.
    """
    particles, tracks, count = rbpf.particles, rbpf.tracks, rbpf.config.particles
    weight = np.exp(log_weight - log_weight.max())
    index = systematic(weight / weight.sum(), count, rng)
    kept = own[index[index < len(own)]]
    imported = index[index >= len(own)] - len(own)
    past_m, mean, log_likelihood = conditioned.past_m, conditioned.mean, conditioned.map_log_likelihood
    particles.past_m = np.concatenate([particles.past_m[:, :, kept], past_m[:, :, imported]], axis=2)
    particles.common_m = np.concatenate([particles.common_m[:, kept], conditioned.common_m[imported].T], axis=1)
    particles.log_weight = np.zeros(count)
    tracks.mean = np.concatenate([tracks.mean[:, :, kept], mean[:, :, imported]], axis=2)
    own_log_likelihood = tracks.map_log_likelihood[:, kept]
    tracks.map_log_likelihood = np.concatenate([own_log_likelihood, log_likelihood[:, imported]], axis=1)


def _evenly(hypotheses: Array, count: int, rng: np.random.Generator) -> Array:
    """Draw a systematic sample of `count` from equally likely `hypotheses` (n, 2)."""
    index = (np.arange(count) + rng.random()) * (len(hypotheses) / count)
    return hypotheses[index.astype(np.intp)]
