"""Least-trimmed-squares scan of all lags, for tracks that follow several objects by turns.

After a discontinuity a track may follow another object. No single geometry then fits a whole alignment, not even the
right one. So each lag gets several geometries, each from a few short runs of time bins, refined on the bins that agree
with it (concentration steps of FAST-LTS, Rousseeuw and Van Driessen), and is scored by the time that agrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.sync.lag_scan import MONOMIAL_INDEX, GridTrack, PairMoments, monomials, taubin_normalisation
from protocols.geometry.types import Bools, Floats, Ints

_BIN_S = 0.4  # s: length of a time bin
_RUN_BINS = 3  # bins in a run
_RUNS_PER_START = 2  # runs that make an initial geometry
_COARSE_STARTS, _FINE_STARTS = 12, 120  # initial geometries per lag
_FINE_SHARE = 0.2  # of the lags, refined with _FINE_STARTS
_CONCENTRATION_STEPS = 2  # of fast LTS (Rousseeuw and Van Driessen 1999), which takes two as well
_INLIER_PX = 6.0  # RMS distance of an inlier bin, half a grid step of lag included
_MIN_BIN_WEIGHT = 0.5  # of a bin's usual weight: less is not enough motion
_MIN_BINS = _RUN_BINS * _RUNS_PER_START + 2
_MAX_CELLS = 3_000_000  # lags times bins in a batch
_MOMENT_INDEX = np.array(
    [
        [MONOMIAL_INDEX[i, j] * 6 + MONOMIAL_INDEX[k, m] for j in range(3) for m in range(3)]
        for i in range(3)
        for k in range(3)
    ]
)
"""(9, 9): index among the 36 sums of entry (i k, j m) of the moment matrix."""


@dataclass(frozen=True, slots=True, eq=False)
class LtsScan:
    """Trimmed agreement with one geometry at every lag.

    inlier_seconds: (n,) time in bins that agree with one geometry, per lag of the moments, each bin weighted by how far
    its cost is below the limit; 0 where too little overlaps. misfit: (n,) mean squared distance of those bins over the
    squared noise. matrix: (n, 3, 3) that geometry, ``m_aᵀ F m_b = 0`` of normalised points.
    """

    inlier_seconds: Floats
    misfit: Floats
    matrix: Floats


def scan_lags_lts(moments: PairMoments, sigma_px: float) -> LtsScan:
    """LTS scan of all lags. sigma_px: image noise std of the grids [px]."""
    a, b = moments.a, moments.b
    count = len(moments.lags)
    inlier_seconds, misfit, matrix = np.zeros(count), np.full(count, np.inf), np.zeros((count, 3, 3))
    width = max(1, round(_BIN_S / a.step))
    bins = a.weight.shape[1] // width
    if bins < _MIN_BINS:
        return LtsScan(inlier_seconds, misfit, matrix)
    rng = np.random.default_rng(0)  # of the initial geometries
    limit = (_INLIER_PX / sigma_px) ** 2
    usual = _median_weight(a) * _median_weight(b) * width
    chunk = max(1, _MAX_CELLS // (bins * 36))
    for begin in range(0, count, chunk):
        part = np.arange(begin, min(begin + chunk, count))
        cells = _bin_moments(a, b, moments.lags[part], width, bins)
        filled = cells[:, :, 35] > _MIN_BIN_WEIGHT * usual
        usable = filled.sum(axis=1) >= _MIN_BINS
        part, cells, filled = part[usable], cells[usable], filled[usable]
        if len(part) == 0:
            continue
        best = _best_of_starts(cells, filled, a, b, limit, _COARSE_STARTS, 1, rng)
        refined_lags = np.argsort(-best[0], kind="stable")[: max(8, int(_FINE_SHARE * len(part)))]
        refined = _best_of_starts(
            cells[refined_lags], filled[refined_lags], a, b, limit, _FINE_STARTS, _CONCENTRATION_STEPS, rng
        )
        better = refined[0] > best[0][refined_lags]
        for whole, one in zip(best, refined, strict=True):
            whole[refined_lags[better]] = one[better]
        inlier_seconds[part], misfit[part] = best[0] * _BIN_S, best[1]
        matrix[part] = a.transform.T @ best[2].reshape(-1, 3, 3) @ b.transform
    return LtsScan(inlier_seconds, misfit, matrix)


def _median_weight(track: GridTrack) -> float:
    moving = track.weight[track.weight > 0]
    return float(np.median(moving)) if len(moving) else 1.0


def _bin_moments(a: GridTrack, b: GridTrack, lags: Ints, width: int, bins: int) -> Floats:
    """(lags, bins, 36) sums of products of monomials of a and of b shifted by the lags, all labels together."""
    out = np.zeros((len(lags), bins, 6, 6))
    n_b = b.weight.shape[1]
    for of_a, of_b in zip(monomials(a), monomials(b), strict=True):
        # Samples of b that correspond to a bin of a at each lag; zero beyond the ends.
        low, high = int(lags[0]), int(lags[-1])
        padded = np.zeros((6, bins * width + high - low + 1))
        first = max(0, low)
        last = min(n_b, bins * width + high)
        if last > first:
            padded[:, first - low : last - low] = of_b[:, first:last]
        windows = np.lib.stride_tricks.sliding_window_view(padded, width, axis=1)
        for k in range(bins):
            here = windows[:, k * width : k * width + len(lags)]
            out[:, k] += np.einsum("pw,qlw->lpq", of_a[:, k * width : (k + 1) * width], here, optimize=True)
    return out.reshape(len(lags), bins, 36)


def _best_of_starts(
    cells: Floats,
    filled: Bools,
    a: GridTrack,
    b: GridTrack,
    limit: float,
    starts: int,
    concentration_steps: int,
    rng: np.random.Generator,
) -> tuple[Floats, Floats, Floats]:
    """Score [bins], misfit and geometry (lags, 9) of each lag: the best of several random starts."""
    lags, bins = filled.shape
    per_bin = np.where(filled[:, :, None], cells / np.maximum(cells[:, :, 35:], 1e-9), 0.0)
    merit, misfit, theta = np.zeros(lags), np.full(lags, np.inf), np.zeros((lags, 9))
    for _ in range(starts):
        use = np.zeros((lags, bins), dtype=np.bool_)
        for _ in range(_RUNS_PER_START):
            begin = rng.integers(0, bins - _RUN_BINS + 1, lags)
            for k in range(_RUN_BINS):
                use[np.arange(lags), begin + k] = True
        use &= filled
        found = np.zeros((lags, 9))
        costs = np.full((lags, bins), np.inf)
        for iteration in range(concentration_steps + 1):
            chosen = np.einsum("lb,lbk->lk", use.astype(np.float64), per_bin) / np.maximum(use.sum(axis=1), 1)[:, None]
            found = _smallest_eigenvectors(chosen, a, b)
            costs = _bin_costs(per_bin, found, a, b)
            if iteration < concentration_steps:
                # Concentration step: the better third of the bins, and all inliers.
                cost = np.where(filled, costs, np.inf)
                cut = np.sort(cost, axis=1)[np.arange(lags), np.maximum(filled.sum(axis=1) // 3, _MIN_BINS - 2)]
                use = filled & (costs <= np.maximum(cut, limit)[:, None])
        inlier = filled & (costs < limit)
        mean = np.where(inlier, costs, 0.0).sum(axis=1) / np.maximum(inlier.sum(axis=1), 1)
        # A bin scores by how far its cost is below the limit: three quarters of it is hardly agreement.
        value = np.where(inlier, 1.0 - costs / limit, 0.0).sum(axis=1)
        better = value > merit
        merit[better], misfit[better], theta[better] = value[better], mean[better], found[better]
    return merit, misfit, theta


def _moment_matrices(cells: Floats, a: GridTrack, b: GridTrack) -> tuple[Floats, Floats]:
    c = cells.reshape(-1, 6, 6)
    full = c[:, MONOMIAL_INDEX][:, :, :, MONOMIAL_INDEX]
    return full.transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9), taubin_normalisation(full, a.sigma, b.sigma)


def _smallest_eigenvectors(cells: Floats, a: GridTrack, b: GridTrack) -> Floats:
    """Best geometry (n, 9) of moments (n, 36): smallest generalised eigenvector, by inverse iteration."""
    moment, norm = _moment_matrices(cells, a, b)
    scale = np.trace(moment, axis1=1, axis2=2)[:, None, None]
    # Repeated squaring converges fast: the smallest eigenvalue is far below the others where the geometry fits.
    inverse = np.linalg.inv(moment + (1e-12 * scale + 1e-15) * np.eye(9))
    power = inverse @ norm
    for iteration in range(4):
        power = power @ power if iteration else power
        power = power / np.maximum(np.linalg.norm(power, axis=(1, 2), keepdims=True), 1e-300)
    # All columns are multiples of the eigenvector; the longest is the best conditioned.
    longest = np.argmax((power**2).sum(axis=1), axis=1)
    theta = power[np.arange(len(power)), :, longest]
    return np.asarray(theta / np.maximum(np.linalg.norm(theta, axis=1, keepdims=True), 1e-300))


def _bin_costs(per_bin: Floats, theta: Floats, a: GridTrack, b: GridTrack) -> Floats:
    """Mean squared distance over the squared noise (lags, bins) of each bin under each lag's geometry."""
    square = np.einsum("li,lj->lij", theta, theta)
    weights = np.zeros((len(theta), 36))
    for i in range(9):
        for j in range(9):
            weights[:, _MOMENT_INDEX[i, j]] += square[:, i, j]
    value = np.einsum("lbk,lk->lb", per_bin, weights)
    m = theta.reshape(-1, 3, 3)
    plane = np.diag([1.0, 1.0, 0.0])
    of_b = np.einsum("lik,ij,ljm->lkm", m, plane, m)  # multiplies b's monomials
    of_a = np.einsum("lik,km,ljm->lij", m, plane, m)
    norm = np.zeros_like(value)
    for i in range(3):
        for j in range(3):
            norm += a.sigma**2 * of_b[:, i, j, None] * per_bin[:, :, 30 + MONOMIAL_INDEX[i, j]]
            norm += b.sigma**2 * of_a[:, i, j, None] * per_bin[:, :, MONOMIAL_INDEX[i, j] * 6 + 5]
    return np.asarray(np.maximum(value, 0.0) / np.maximum(norm, 1e-30))
