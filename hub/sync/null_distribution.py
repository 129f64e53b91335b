"""How well unrelated pieces of two tracks fit one epipolar geometry: what an alignment must beat to be believed.

A search over all lags always finds some that fit. How well a wrong one fits depends on the motion and on how
much of it is common, and the recordings themselves tell: every stretch of one camera's track against every
other stretch of the other's is an experiment in which nothing corresponds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, gammainc, gammaln

from hub.sync.lag_scan import (
    PAIR_OF,
    GridTrack,
    PairMoments,
    Scan,
    eigen_costs,
    fixed_costs,
    in_grid,
    monomials,
    normalisation,
)
from hub.trajectory.image_tracks import SmoothTrack
from protocols.geometry.types import Floats, Ints

COST_FLOOR = 0.04
"""Of squared noise: smoothing brings the misfit below the noise, but that tells nothing."""
OWN_LAGS = 1.0
"""Seconds about an alignment that are no other alignment."""
_STEPS_A_STRETCH = 4
_MOST_STRETCHES = 24  # of one camera
_LEAST_STRETCHES = 25  # pairs of them
_LEAST_MOVING = 0.5
_LOW = 0.1  # the quantile that, beside the median, tells the spread of the misfits
_FREEDOM_LIMITS = (0.3, 12.0)
_LEAST_FREEDOM = 0.5
_HALVINGS = 14
_SHORTENED = 2.5  # stretches of up to this part of the shorter recording are plenty
_LEAST_LAGS = 3.0  # seconds of lags


@dataclass(frozen=True, slots=True)
class Chance:
    """Misfits of unrelated stretches: squared distance over noise, like a chi-square of ``freedom``.

    log_median: natural logarithm of (misfit + COST_FLOOR). count: pairs of stretches it rests on.
    """

    log_median: float
    freedom: float
    count: int

    def log10_probability(self, cost: float, share: float, cycles: float) -> float:
        """log10 of the chance that one wrong alignment fits as well as ``cost``.

        share: of the common motion that agrees, to which ``cost`` belongs; the rest counts as unrelated.
        cycles: bandwidth times seconds of the common motion.
        """
        k = self.freedom_of(cycles)
        if share <= 0.0 or k <= 0.0 or not math.isfinite(cost):
            return 0.0
        ratio = share * math.exp(math.log(cost + COST_FLOOR) - self.log_median) + 1.0 - share
        x = max(ratio, 1e-300) * float(chdtri(k, 0.5))
        tail = float(gammainc(0.5 * k, 0.5 * x))
        if tail > 1e-200:
            return math.log10(tail)
        # The first term of the series at 0, where the function itself underflows.
        return (0.5 * k * math.log(0.5 * x) - 0.5 * x - float(gammaln(0.5 * k + 1.0))) / math.log(10.0)

    def log10_gap(self, cost: float, next_cost: float, cycles: float) -> float:
        """log10 of the chance that the best of all wrong alignments leaves ``next_cost`` / ``cost`` times less
        than the second best: at 0 a chi-square's distribution is a power, so the scale of the misfits drops out.
        """
        k = self.freedom_of(cycles)
        if k <= 0.0 or not math.isfinite(cost) or not next_cost > cost:
            return 0.0
        return 0.5 * k * math.log10((cost + COST_FLOOR) / (next_cost + COST_FLOOR))

    def freedom_of(self, cycles: float) -> float:
        """Degrees of freedom of the misfit of ``cycles`` (bandwidth times seconds) of motion; 0 for none.

        A product of two coordinates has twice the bandwidth, so 4 cycles + 1 independent values, of which
        the geometry takes 7: no more than that, however alike the few stretches of a slow motion are.
        """
        k = min(self.freedom, 4.0 * cycles - 6.0)
        return k if k >= _LEAST_FREEDOM else 0.0


def chance(moments: PairMoments, scan: Scan, seconds: float, lag: float, known: Floats | None = None) -> Chance | None:
    """Misfits where nothing corresponds, for as much common motion as the alignment ``t_a = t_b + lag`` has.

    Short stretches are tried everywhere; for ones nearly as long as the recordings, all lags that leave as
    much in common are. seconds: of the common motion. known: (3, 3) ``m_aᵀ F m_b = 0`` of normalised points,
    where the geometry is given. None where the recordings are too short for either.
    """
    a, b = moments.a, moments.b
    support = float(scan.support[int(np.argmin(np.abs(scan.offset - lag)))])
    moving = min(float((track.weight > 0).any(axis=0).sum()) * track.step for track in (a, b))
    plenty = moving / _SHORTENED
    if seconds <= plenty:
        costs = _stretch_costs(a, b, seconds, support, lag, known)
        if len(costs) >= _LEAST_STRETCHES:
            return _summary(costs)
    alike = (scan.support > 0.7 * support) & (scan.support < 1.4 * support) & np.isfinite(scan.cost)
    alike &= np.abs(scan.offset - lag) > OWN_LAGS
    if alike.sum() * a.step >= _LEAST_LAGS:
        return _summary(scan.cost[alike])
    share = min(1.0, plenty / seconds)
    costs = _stretch_costs(a, b, share * seconds, share * support, lag, known)
    return None if len(costs) < _LEAST_STRETCHES else _summary(costs)


def _summary(costs: Floats) -> Chance:
    logs = np.log(costs + COST_FLOOR)
    median = float(np.median(logs))
    return Chance(median, _freedom(median - float(np.quantile(logs, _LOW))), len(costs))


def _stretch_costs(
    a: GridTrack, b: GridTrack, seconds: float, support: float, lag: float, known: Floats | None
) -> Floats:
    """Costs of stretches of ``seconds`` of motion with at least half of ``support``, the scan's weighted seconds."""
    # A track with holes needs longer stretches for as much in common.
    length = max(8, int(seconds / a.step / max(_density(a) * _density(b), 0.1)))
    starts = [_starts(track.weight.shape[1], length) for track in (a, b)]
    if not len(starts[0]) or not len(starts[1]):
        return np.zeros(0)
    parts_a = [monomials(a)[:, :, i : i + length] for i in starts[0]]
    parts_b = [monomials(b)[:, :, j : j + length] for j in starts[1]]
    lags = (a.begin + a.step * starts[0])[:, None] - (b.begin + b.step * starts[1])[None, :]
    moments = np.einsum("ilpn,jlqn->ijpq", np.stack(parts_a), np.stack(parts_b), optimize=True)
    weight = moments[:, :, 5, 5]
    use = (np.abs(lags - lag) > OWN_LAGS) & (weight * a.step > _LEAST_MOVING * support)
    if not use.any():
        return np.zeros(0)
    chosen = moments[use]
    if known is None:
        return eigen_costs(np.moveaxis(chosen, 0, 2), a.sigma, b.sigma)
    full = (chosen / weight[use][:, None, None])[:, PAIR_OF][:, :, :, PAIR_OF]
    moment, norm = full.transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9), normalisation(full, a.sigma, b.sigma)
    return fixed_costs(moment, norm, in_grid(known, a, b))


def _density(track: GridTrack) -> float:
    """Share of the samples in which the track exists and moves."""
    return float((track.weight > 0).any(axis=0).mean())


def _starts(samples: int, length: int) -> Ints:
    step = max(1, length // _STEPS_A_STRETCH, (samples - length) // _MOST_STRETCHES)
    return np.arange(0, samples - length + 1, step, dtype=np.int64)


def _freedom(spread: float) -> float:
    """Degrees of freedom at which the logarithm of a chi-square has this distance from median to low quantile."""

    def excess(k: float) -> float:
        return math.log(float(chdtri(k, 0.5)) / float(chdtri(k, 1.0 - _LOW))) - spread

    low, high = _FREEDOM_LIMITS
    if excess(low) < 0:
        return low
    if excess(high) > 0:
        return high
    for _ in range(_HALVINGS):  # scipy.optimize's own would take a tenth of a second to import
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return 0.5 * (low + high)


def bandwidth(track: SmoothTrack) -> float:
    """Highest frequency [Hz] of a track's motion, as if its speed had all frequencies up to it alike."""
    speed, acceleration = track.at(track.time, 1), track.at(track.time, 2)
    return float(np.sqrt(3.0 * (acceleration**2).mean() / max(float((speed**2).mean()), 1e-30)) / (2.0 * np.pi))
