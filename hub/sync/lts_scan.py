"""The scan of all lags for tracks in which the detector took up another thing now and then.

A jump in a track tells that what comes after may be another thing. No single geometry then fits a whole
alignment, even the right one; so each lag is given several, each made of a few short runs of time, improved
on the bins of time that agree with it (least trimmed squares), and is judged by how much time agrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.sync.lag_scan import PAIR_OF, GridTrack, PairMoments, monomials, normalisation
from protocols.geometry.types import Bools, Floats, Ints

_BIN = 0.4  # s
_RUN = 3  # bins in a run
_RUNS = 2  # runs in a first geometry
_FIRST_STARTS, _MORE_STARTS = 12, 120
_BEST_SHARE = 0.2  # of the lags, looked at again
_IMPROVEMENTS = 2
_AGREES_PX = 6.0  # a bin's misfit: half a grid step of lag included
_FULL = 0.5  # of a bin must be there and move
_LEAST_BINS = _RUN * _RUNS + 2
_MOST_CELLS = 3_000_000  # lags times bins at a time


@dataclass(frozen=True, slots=True, eq=False)
class PieceScan:
    """agreeing: (n,) seconds that agree with one geometry, per lag of the moments; 0 where too little overlaps.

    misfit: (n,) mean squared distance over noise of those. matrix: (n, 3, 3) the geometry,
    ``m_aᵀ F m_b = 0`` of normalised points.
    """

    agreeing: Floats
    misfit: Floats
    matrix: Floats


def scan_pieces(moments: PairMoments, sigma_px: float, seed: int) -> PieceScan:
    """Agreeing seconds at every lag. sigma_px: the noise that the grids were made with."""
    a, b = moments.a, moments.b
    count = len(moments.lags)
    agreeing, misfit, matrix = np.zeros(count), np.full(count, np.inf), np.zeros((count, 3, 3))
    width = max(1, round(_BIN / a.step))
    bins = a.weight.shape[1] // width
    if bins < _LEAST_BINS:
        return PieceScan(agreeing, misfit, matrix)
    rng = np.random.default_rng(seed)
    limit = (_AGREES_PX / sigma_px) ** 2
    usual = _usual_weight(a) * _usual_weight(b) * width
    chunk = max(1, _MOST_CELLS // (bins * 36))
    for begin in range(0, count, chunk):
        part = np.arange(begin, min(begin + chunk, count))
        cells = _cells(a, b, moments.lags[part], width, bins)
        full = cells[:, :, 35] > _FULL * usual
        enough = full.sum(axis=1) >= _LEAST_BINS
        part, cells, full = part[enough], cells[enough], full[enough]
        if len(part) == 0:
            continue
        best = _best(cells, full, a, b, limit, _FIRST_STARTS, 1, rng)
        again = np.argsort(-best[0], kind="stable")[: max(8, int(_BEST_SHARE * len(part)))]
        more = _best(cells[again], full[again], a, b, limit, _MORE_STARTS, _IMPROVEMENTS, rng)
        better = more[0] > best[0][again]
        for whole, one in zip(best, more, strict=True):
            whole[again[better]] = one[better]
        agreeing[part], misfit[part] = best[0] * _BIN, best[1]
        matrix[part] = a.transform.T @ best[2].reshape(-1, 3, 3) @ b.transform
    return PieceScan(agreeing, misfit, matrix)


def _usual_weight(track: GridTrack) -> float:
    moving = track.weight[track.weight > 0]
    return float(np.median(moving)) if len(moving) else 1.0


def _cells(a: GridTrack, b: GridTrack, lags: Ints, width: int, bins: int) -> Floats:
    """(lags, bins, 36) sums of products of monomials of a and of b shifted, all labels together."""
    out = np.zeros((len(lags), bins, 6, 6))
    n_b = b.weight.shape[1]
    for of_a, of_b in zip(monomials(a), monomials(b), strict=True):
        # Samples of b that a bin of a meets at each lag; beyond the ends there is nothing.
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


def _best(
    cells: Floats,
    full: Bools,
    a: GridTrack,
    b: GridTrack,
    limit: float,
    starts: int,
    improvements: int,
    rng: np.random.Generator,
) -> tuple[Floats, Floats, Floats]:
    """Agreeing bins, their misfit, and the geometry (9,) of each lag: the best of several starts."""
    lags, bins = full.shape
    per_bin = np.where(full[:, :, None], cells / np.maximum(cells[:, :, 35:], 1e-9), 0.0)
    count, misfit, theta = np.zeros(lags), np.full(lags, np.inf), np.zeros((lags, 9))
    merit = np.zeros(lags)
    for _ in range(starts):
        use = np.zeros((lags, bins), dtype=np.bool_)
        for _ in range(_RUNS):
            begin = rng.integers(0, bins - _RUN + 1, lags)
            for k in range(_RUN):
                use[np.arange(lags), begin + k] = True
        use &= full
        found = np.zeros((lags, 9))
        costs = np.full((lags, bins), np.inf)
        for turn in range(improvements + 1):
            chosen = np.einsum("lb,lbk->lk", use.astype(np.float64), per_bin) / np.maximum(use.sum(axis=1), 1)[:, None]
            found = _smallest(chosen, a, b)
            costs = _bin_costs(per_bin, found, a, b)
            if turn < improvements:
                # The better half of what is there, and whatever agrees.
                half = np.where(full, costs, np.inf)
                cut = np.sort(half, axis=1)[np.arange(lags), np.maximum(full.sum(axis=1) // 3, _LEAST_BINS - 2)]
                use = full & (costs <= np.maximum(cut, limit)[:, None])
        agrees = full & (costs < limit)
        total = agrees.sum(axis=1)
        mean = np.where(agrees, costs, 0.0).sum(axis=1) / np.maximum(total, 1)
        # Bins count for what they agree by: three in four of the limit is hardly any agreement.
        value = np.where(agrees, 1.0 - costs / limit, 0.0).sum(axis=1)
        better = value > merit
        merit[better], count[better], misfit[better], theta[better] = (
            value[better],
            total[better],
            mean[better],
            found[better],
        )
    return merit, misfit, theta


def _moments(cells: Floats, a: GridTrack, b: GridTrack) -> tuple[Floats, Floats]:
    c = cells.reshape(-1, 6, 6)
    full = c[:, PAIR_OF][:, :, :, PAIR_OF]
    return full.transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9), normalisation(full, a.sigma, b.sigma)


def _smallest(cells: Floats, a: GridTrack, b: GridTrack) -> Floats:
    """Best geometry (n, 9) of summed cells (n, 36): smallest generalised eigenvector, by inverse iteration."""
    moment, norm = _moments(cells, a, b)
    scale = np.trace(moment, axis1=1, axis2=2)[:, None, None]
    # Repeated squaring: the smallest eigenvalue is far below the others where the geometry fits.
    inverse = np.linalg.inv(moment + (1e-12 * scale + 1e-15) * np.eye(9))
    power = inverse @ norm
    for turn in range(4):
        power = power @ power if turn else power
        power = power / np.maximum(np.linalg.norm(power, axis=(1, 2), keepdims=True), 1e-300)
    # Its columns are all multiples of the vector; the longest is the best conditioned.
    longest = np.argmax((power**2).sum(axis=1), axis=1)
    theta = power[np.arange(len(power)), :, longest]
    return np.asarray(theta / np.maximum(np.linalg.norm(theta, axis=1, keepdims=True), 1e-300))


_ROWS = np.array(
    [[PAIR_OF[i, j] * 6 + PAIR_OF[k, m] for j in range(3) for m in range(3)] for i in range(3) for k in range(3)]
)
"""(9, 9): which of the 36 sums is entry (i k, j m) of the moment matrix."""


def _bin_costs(per_bin: Floats, theta: Floats, a: GridTrack, b: GridTrack) -> Floats:
    """Mean squared distance over noise (lags, bins) of each bin under each lag's geometry."""
    square = np.einsum("li,lj->lij", theta, theta)
    weights = np.zeros((len(theta), 36))
    for i in range(9):
        for j in range(9):
            weights[:, _ROWS[i, j]] += square[:, i, j]
    value = np.einsum("lbk,lk->lb", per_bin, weights)
    m = theta.reshape(-1, 3, 3)
    plane = np.diag([1.0, 1.0, 0.0])
    of_b = np.einsum("lik,ij,ljm->lkm", m, plane, m)  # acts on b's monomials
    of_a = np.einsum("lik,km,ljm->lij", m, plane, m)
    norm = np.zeros_like(value)
    for i in range(3):
        for j in range(3):
            norm += a.sigma**2 * of_b[:, i, j, None] * per_bin[:, :, 30 + PAIR_OF[i, j]]
            norm += b.sigma**2 * of_a[:, i, j, None] * per_bin[:, :, PAIR_OF[i, j] * 6 + 5]
    return np.asarray(np.maximum(value, 0.0) / np.maximum(norm, 1e-30))
