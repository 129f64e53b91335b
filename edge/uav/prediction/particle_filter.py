"""Generic particle filter: weighted samples, resampling, adaptive sample size, clustering.

A particle set is an array of states (n, d) with log-weights (n,). A ``Model`` provides the transition density and the
likelihood of an observation; everything here depends on these two only. Nothing is changed in place, and all
randomness comes from the generator that is passed in.

Sources: low-variance (systematic) resampling and the effective sample size as in Doucet, Godsill, Andrieu, "On
sequential Monte Carlo sampling methods" (2000); the adaptive number of particles as in Fox, "Adapting the sample size
in particle filters through KLD-sampling" (2003). Equation numbers are those of the background-aware tracking paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist
from typing import Protocol, TypeVar

import numpy as np

from protocols.geometry import kernels
from protocols.geometry.types import Bools, Floats, Ints

Observation_contra = TypeVar("Observation_contra", contravariant=True)
Observation = TypeVar("Observation")
_STRIDES = (1, 1 << 21, 1 << 42, 1 << 52)  # packs a cell's coordinates into one integer


class Model(Protocol[Observation_contra]):
    """State-space model: transition density and observation likelihood."""

    def propagate(self, states: Floats, rng: np.random.Generator) -> Floats:
        """One draw from p(x_k | x_{k-1}) per particle: (n, d) -> (n, d)."""

    def log_likelihood(self, states: Floats, observation: Observation_contra) -> Floats:
        """log p(y_k | x_k), up to a constant that is the same for all particles: (n, d) -> (n,)."""


@dataclass(frozen=True, slots=True, eq=False)
class Particles:
    """A weighted sample. states: (n, d). log_weights: (n,), normalised: their exponentials add up to 1."""

    states: Floats
    log_weights: Floats

    @classmethod
    def uniform(cls, states: Floats) -> Particles:
        """States (n, d) of equal weight; n of at least 1."""
        return cls(states, np.full(len(states), -np.log(len(states))))

    @property
    def weights(self) -> Floats:
        """(n,), adding up to 1."""
        return np.asarray(np.exp(self.log_weights), dtype=np.float64)

    def reweighted(self, log_likelihoods: Floats) -> Particles:
        """The posterior set: each weight times its likelihood (eq. 2.6), normalised (eq. 2.1)."""
        return Particles(self.states, normalise(self.log_weights + log_likelihoods))


@dataclass(frozen=True, slots=True)
class KldSampleSize:
    """Adaptive number of particles by KLD sampling.

    cell: (d,) bin widths of the histogram over the states, in their units (inf: that coordinate is ignored). error:
    bound on the Kullback-Leibler distance between the sample and the posterior, met with probability confidence.
    min_count, max_count: limits of the number.
    """

    cell: tuple[float, ...]
    error: float = 0.05
    confidence: float = 0.99
    min_count: int = 100
    max_count: int = 1000

    def size_for(self, states: Floats) -> int:
        """The number needed for a sample spread like states (n, d)."""
        wanted = kld_sample_size(occupied_cells(states, np.array(self.cell)), self.error, self.confidence)
        return min(max(wanted, self.min_count), self.max_count)


def normalise(log_weights: Floats) -> Floats:
    """Eq. (2.1): log-weights (n,) whose exponentials add up to 1.

    nan is treated as weight 0. If no particle has any weight, all get the same: an observation that is impossible for
    all of them is uninformative.
    """
    if not len(log_weights):
        return log_weights
    best = float(np.fmax.reduce(log_weights))
    if not np.isfinite(best):
        return np.full(len(log_weights), -np.log(len(log_weights)))
    scaled = np.where(np.isnan(log_weights), -np.inf, log_weights - best)
    return np.asarray(scaled - np.log(np.exp(scaled).sum()), dtype=np.float64)


def systematic_resample(weights: Floats, count: int, rng: np.random.Generator) -> Ints:
    """Low-variance resampling: count indices, each index drawn count * weight times, rounded up or down, unbiased.

    weights: (n,), adding up to 1.
    """
    positions = (np.arange(count) + rng.random()) / count
    found = np.searchsorted(np.cumsum(weights), positions, side="right")
    return np.asarray(np.minimum(found, len(weights) - 1), dtype=np.int64)


def effective_sample_size(weights: Floats) -> float:
    """1 / sum of squares: from 1 (one particle has all the weight) to n (uniform). weights add up to 1."""
    return float(1.0 / np.square(weights).sum())


def occupied_cells(states: Floats, cell: Floats) -> int:
    """Number of occupied cells of the widths (d,) for states (n, d); a width of inf ignores the coordinate."""
    index = np.floor(states[:, np.isfinite(cell)] / cell[np.isfinite(cell)]).astype(np.int64)
    return len(np.unique(_keys(index))) if index.size else 1


def kld_sample_size(cells: int, error: float, confidence: float) -> int:
    """Particles needed so that a sample over that many occupied cells is within error of the distribution.

    Fox's bound (the Wilson-Hilferty approximation of the chi-square quantile): for k cells and the standard normal
    quantile z of confidence, n = (k - 1) / (2 error) * (1 - 2 / (9 (k - 1)) + z sqrt(2 / (9 (k - 1))))^3. One cell
    needs one particle.
    """
    if cells <= 1:
        return 1
    free = cells - 1.0
    spread = 2.0 / (9.0 * free)
    root = 1.0 - spread + np.sqrt(spread) * NormalDist().inv_cdf(confidence)
    return int(np.ceil(free / (2.0 * error) * root**3))


def step(
    particles: Particles,
    model: Model[Observation],
    observation: Observation | None,
    rng: np.random.Generator,
    *,
    resample_below: float = 0.5,
    number: KldSampleSize | None = None,
) -> Particles:
    """One filter cycle: resample if necessary, propagate, reweight. Returns the posterior as a weighted set.

    observation: None predicts only. resample_below: resamples if the effective sample size is below this share of
    the particles. With number, the size of the set is adapted at every resampling.
    """
    weights = particles.weights
    if effective_sample_size(weights) < resample_below * len(weights):
        chosen = systematic_resample(weights, len(weights), rng)
        if number is not None:
            chosen = systematic_resample(weights, number.size_for(particles.states[chosen]), rng)
        particles = Particles.uniform(particles.states[chosen])
    moved = Particles(model.propagate(particles.states, rng), particles.log_weights)
    return moved if observation is None else moved.reweighted(model.log_likelihood(moved.states, observation))


def weighted_mean(values: Floats, weights: Floats) -> Floats:
    """(d,) of values (n, d); weights (n,) add up to 1."""
    return np.asarray(weights @ values, dtype=np.float64)


def weighted_covariance(values: Floats, weights: Floats) -> Floats:
    """(d, d) about the weighted mean of values (n, d); weights (n,) add up to 1."""
    centred = values - weights @ values
    return np.asarray((centred * weights[:, None]).T @ centred, dtype=np.float64)


def circular_mean(angles: Floats, weights: Floats) -> float:
    """The mean direction [rad], in (-pi, pi], of angles (n,)."""
    return float(np.arctan2(weights @ np.sin(angles), weights @ np.cos(angles)))


@dataclass(frozen=True, slots=True, eq=False)
class Cluster:
    """A subset of the particles. centre: (2,). weight: their total. members: (n,) mask."""

    centre: Floats
    weight: float
    members: Bools


def densest_cluster(points: Floats, weights: Floats, radius: float) -> Cluster:
    """The particles within radius of the mode of their density.

    points: (n, 2); weights: (n,). Mean shift with a flat kernel of that radius, started at the block of three by three
    cells of width radius with the most weight.
    """
    if kernels.AVAILABLE:
        inside, found = np.empty(len(points), np.bool_), np.empty(3)
        given = len(points), np.ascontiguousarray(points), np.ascontiguousarray(weights), radius
        kernels.call("densest_cluster", *given, np.empty(2 * len(points)), inside, found)
        return Cluster(found[:2], float(found[2]), inside)
    index = np.floor(points / radius).astype(np.int64)
    cells, inverse = np.unique(_keys(index), return_inverse=True)
    mass = np.bincount(inverse, weights, minlength=len(cells))
    around = np.zeros(len(cells))
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            wanted = cells + dx * _STRIDES[0] + dy * _STRIDES[1]
            at = np.minimum(np.searchsorted(cells, wanted), len(cells) - 1)
            around += np.where(cells[at] == wanted, mass[at], 0.0)
    fullest = inverse == int(np.argmax(around + 1e-9 * mass))
    centre = np.average(points[fullest], axis=0, weights=weights[fullest] + 1e-300)
    members = fullest
    for _ in range(10):
        within = np.square(points - centre).sum(axis=1) <= radius * radius
        if not weights[within].sum() > 0.0 or (within == members).all():
            break
        members = within
        centre = weights[members] @ points[members] / weights[members].sum()
    return Cluster(np.asarray(centre, dtype=np.float64), float(weights[members].sum()), members)


def clusters(
    points: Floats, weights: Floats, radius: float, max_clusters: int = 4, min_weight: float = 0.05
) -> tuple[Cluster, ...]:
    """Up to max_clusters separate clusters, heaviest first, each of at least min_weight; at least one.

    points: (n, 2); weights: (n,). After each, the particles within twice the radius of it are excluded.
    """
    found: list[Cluster] = []
    remaining = np.ones(len(points), dtype=np.bool_)
    while remaining.any() and len(found) < max_clusters:
        here = np.flatnonzero(remaining)
        part = densest_cluster(points[here], weights[here], radius)
        if found and part.weight < min_weight:
            break
        members = np.zeros(len(points), dtype=np.bool_)
        members[here[part.members]] = True
        found.append(Cluster(part.centre, part.weight, members))
        remaining &= np.square(points - part.centre).sum(axis=1) > 4.0 * radius * radius
        remaining &= ~members
    return tuple(found)


def _keys(index: Ints) -> Ints:
    """One integer per cell of index (n, d). Cells more than 2**20 apart may share one, which does not happen here."""
    if index.shape[1] > len(_STRIDES):
        return np.asarray(np.unique(index, axis=0, return_inverse=True)[1], dtype=np.int64).reshape(-1)
    return np.asarray(index @ np.array(_STRIDES[: index.shape[1]], dtype=np.int64), dtype=np.int64)
