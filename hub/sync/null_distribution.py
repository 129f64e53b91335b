"""Null distribution of the epipolar misfit: how well one geometry fits unrelated stretches of two tracks.

A search over all lags always finds some that fit. How well a wrong one fits depends on the motion and on its length.
The recordings themselves show it: every stretch of one camera's track against every other stretch of the other's is an
experiment without correspondence. Their misfits are summarised as a scaled chi-square distribution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, gammainc, gammaln

from hub.sync.lag_scan import (
    MONOMIAL_INDEX,
    GridTrack,
    LagScan,
    PairMoments,
    costs_given_geometry,
    monomials,
    smallest_eigenvalues,
    taubin_normalisation,
    to_grid_coordinates,
)
from hub.trajectory.image_tracks import SmoothTrack
from protocols.geometry.order_statistics import median, quantile
from protocols.geometry.types import Floats, Ints

COST_FLOOR = 0.04
"""Over the squared noise: smoothing brings the misfit below the noise, which carries no information."""
EXCLUSION_WINDOW = 1.0
"""Half-width [s] about an alignment's lag that does not count as other lags."""
_STARTS_PER_STRETCH = 4  # starts of stretches in the length of one
_MAX_STRETCHES = 24  # of one camera
_MIN_STRETCH_PAIRS = 25  # for a distribution
_MIN_SUPPORT_RATIO = 0.5  # of the alignment's support, in a pair of stretches
_LOW_QUANTILE = 0.1  # quantile of the misfits that, with the median, gives their spread
_DOF_LIMITS = (0.3, 12.0)  # where the chi-squared fit of a few misfits is stable
_MIN_DOF = 0.5  # fewer count as none
_BISECTIONS = 14  # to 1e-4 of the interval
_RECORDING_PER_STRETCH = 2.5  # moving time of the shorter recording over the longest stretch taken everywhere
_MIN_LAG_SPAN = 3.0  # s of lags with similar support, for a distribution


@dataclass(frozen=True, slots=True)
class NullDistribution:
    """Scaled chi-square distribution of the misfit of unrelated stretches.

    Misfit: mean squared distance over the squared noise. log_median: natural log of the median of misfit + COST_FLOOR.
    dof: degrees of freedom, from the spread.
    """

    log_median: float
    dof: float

    def log10_false_alarm(self, cost: float, inlier_ratio: float, cycles: float) -> float:
        """log10 of the false-alarm probability: that one wrong alignment has a misfit of at most ``cost``.

        inlier_ratio: fraction of the common motion that ``cost`` is of; the rest counts as unrelated.
        cycles: bandwidth times seconds of the common motion.
        """
        k = self.effective_dof(cycles)
        if inlier_ratio <= 0.0 or k <= 0.0 or not math.isfinite(cost):
            return 0.0
        ratio = inlier_ratio * math.exp(math.log(cost + COST_FLOOR) - self.log_median) + 1.0 - inlier_ratio
        x = max(ratio, 1e-300) * float(chdtri(k, 0.5))
        tail = float(gammainc(0.5 * k, 0.5 * x))
        if tail > 1e-200:
            return math.log10(tail)
        # First term of the series at 0, where the incomplete gamma function underflows.
        return (0.5 * k * math.log(0.5 * x) - 0.5 * x - float(gammaln(0.5 * k + 1.0))) / math.log(10.0)

    def log10_gap(self, cost: float, next_cost: float, cycles: float) -> float:
        """log10 of the probability that the best wrong alignment is better than the second by ``next_cost`` / ``cost``.

        Near 0 the chi-square distribution is a power law, so the scale of the misfits drops out.
        """
        k = self.effective_dof(cycles)
        if k <= 0.0 or not math.isfinite(cost) or not next_cost > cost:
            return 0.0
        return 0.5 * k * math.log10((cost + COST_FLOOR) / (next_cost + COST_FLOOR))

    def effective_dof(self, cycles: float) -> float:
        """Degrees of freedom of the misfit of ``cycles`` (bandwidth times seconds) of motion; 0 for too few.

        A product of two coordinates has twice the bandwidth, so 4 cycles + 1 independent values, of which the
        geometry takes 7. That is the limit, however similar the few stretches of a slow motion are.
        """
        k = min(self.dof, 4.0 * cycles - 6.0)
        return k if k >= _MIN_DOF else 0.0


def fit_null_distribution(
    moments: PairMoments, scan: LagScan, seconds: float, lag: float, known_fundamental: Floats | None = None
) -> NullDistribution | None:
    """Null distribution for as much common motion as the alignment ``t_a = t_b + lag`` [s] has.

    From pairs of stretches all over the recordings where they are short; for stretches nearly as long as the
    recordings, from all other lags with similar support. seconds: of the common motion. known_fundamental: (3, 3)
    ``m_aᵀ F m_b = 0`` of normalised points, where the geometry is given. None where the recordings are too short.
    """
    a, b = moments.a, moments.b
    support = float(scan.support[int(np.argmin(np.abs(scan.offset - lag)))])
    recording = min(float((track.weight > 0).any(axis=0).sum()) * track.step for track in (a, b))
    longest = recording / _RECORDING_PER_STRETCH
    if seconds <= longest:
        costs = _stretch_costs(a, b, seconds, support, lag, known_fundamental)
        if len(costs) >= _MIN_STRETCH_PAIRS:
            return _fit_chi_square(costs)
    similar = (scan.support > 0.7 * support) & (scan.support < 1.4 * support) & np.isfinite(scan.cost)
    similar &= np.abs(scan.offset - lag) > EXCLUSION_WINDOW
    if similar.sum() * a.step >= _MIN_LAG_SPAN:
        return _fit_chi_square(scan.cost[similar])
    share = min(1.0, longest / seconds)
    costs = _stretch_costs(a, b, share * seconds, share * support, lag, known_fundamental)
    return None if len(costs) < _MIN_STRETCH_PAIRS else _fit_chi_square(costs)


def _fit_chi_square(costs: Floats) -> NullDistribution:
    logs = np.log(costs + COST_FLOOR)
    middle = median(logs)
    return NullDistribution(middle, _dof_from_spread(middle - quantile(logs, _LOW_QUANTILE)))


def _stretch_costs(
    a: GridTrack, b: GridTrack, seconds: float, support: float, lag: float, known_fundamental: Floats | None
) -> Floats:
    """Misfits (m,) of unrelated stretches of ``seconds`` of motion with at least half of ``support`` (weighted)."""
    # Tracks with gaps need longer stretches for as much common motion.
    length = max(8, int(seconds / a.step / max(_moving_ratio(a) * _moving_ratio(b), 0.1)))
    starts = [_stretch_starts(track.weight.shape[1], length) for track in (a, b)]
    if not len(starts[0]) or not len(starts[1]):
        return np.zeros(0)
    every_a, every_b = monomials(a), monomials(b)
    parts_a = [every_a[:, :, i : i + length] for i in starts[0]]
    parts_b = [every_b[:, :, j : j + length] for j in starts[1]]
    lags = (a.begin + a.step * starts[0])[:, None] - (b.begin + b.step * starts[1])[None, :]
    moments = np.einsum("ilpn,jlqn->ijpq", np.stack(parts_a), np.stack(parts_b), optimize=True)
    weight = moments[:, :, 5, 5]
    use = (np.abs(lags - lag) > EXCLUSION_WINDOW) & (weight * a.step > _MIN_SUPPORT_RATIO * support)
    if not use.any():
        return np.zeros(0)
    chosen = moments[use]
    if known_fundamental is None:
        return smallest_eigenvalues(np.moveaxis(chosen, 0, 2), a.sigma, b.sigma)
    full = (chosen / weight[use][:, None, None])[:, MONOMIAL_INDEX][:, :, :, MONOMIAL_INDEX]
    moment, norm = full.transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9), taubin_normalisation(full, a.sigma, b.sigma)
    return costs_given_geometry(moment, norm, to_grid_coordinates(known_fundamental, a, b))


def _moving_ratio(track: GridTrack) -> float:
    """Fraction of the samples in which the track exists and moves."""
    return float((track.weight > 0).any(axis=0).mean())


def _stretch_starts(samples: int, length: int) -> Ints:
    step = max(1, length // _STARTS_PER_STRETCH, (samples - length) // _MAX_STRETCHES)
    return np.arange(0, samples - length + 1, step, dtype=np.int64)


def _dof_from_spread(spread: float) -> float:
    """Degrees of freedom at which the log of a chi-square variable has this spread from low quantile to median."""

    def excess(k: float) -> float:
        return math.log(float(chdtri(k, 0.5)) / float(chdtri(k, 1.0 - _LOW_QUANTILE))) - spread

    low, high = _DOF_LIMITS
    if excess(low) < 0:
        return low
    if excess(high) > 0:
        return high
    for _ in range(_BISECTIONS):  # bisection: importing scipy.optimize would take a tenth of a second
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return 0.5 * (low + high)


def bandwidth(track: SmoothTrack) -> float:
    """Bandwidth [Hz] of a track's motion: of the flat speed spectrum with the same RMS acceleration over RMS speed."""
    speed, acceleration = track.point_and_velocity(track.time)[1], track.at(track.time, 2)
    return float(np.sqrt(3.0 * (acceleration**2).mean() / max(float((speed**2).mean()), 1e-30)) / (2.0 * np.pi))
