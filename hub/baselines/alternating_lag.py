"""The asynchronous calibration paper's method: alternating estimation of lag and fundamental matrix (eqs. 9 to 22).

"Calibration of pose and shutter timing of multiple asynchronous cameras". Frames are indices: camera b's point of index
i + f corresponds to camera a's point of index i, with f = lag in frames. It converges for about ±9 frames from zero,
and the paper's other restrictions apply. Kept as a baseline for comparison.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.two_view.fundamental import epipolar_lines, line_distances, maximum_likelihood_fundamental
from protocols.core.errors import Refused
from protocols.geometry.types import Bools, Floats

_TOLERANCE = 1e-6  # relative decrease of E below which the iteration has converged (eq. 22)
_MAX_ITERATIONS = 60  # bounds the alternation


@dataclass(frozen=True, slots=True, eq=False)
class Iteration:
    """One iteration n. lag: f⁽ⁿ⁾ in frames. lags: f_i (eq. 14), NaN where no crossing. distance: E⁽ⁿ⁾ (eq. 21)."""

    lag: float
    lags: Floats
    fundamental: Floats
    distance: float


@dataclass(frozen=True, slots=True, eq=False)
class AlternatingLagResult:
    """lag: frames by which b's index is ahead at the same instant. fundamental: ``m_aᵀ F m_b = 0``."""

    lag: float
    fundamental: Floats
    distance: float
    iterations: tuple[Iteration, ...]


def estimate_alternately(a: Floats, b: Floats) -> AlternatingLagResult:
    """The paper's iteration on two tracks by frame index.

    a: (n, 2), b: (m, 2) undistorted pixels; NaN where a frame has no marker. Raises Refused where fewer
    than 8 indices correspond or no epipolar line crosses the other track.
    """
    points_a, points_b, _ = corresponding_points(a, b, 0.0)
    fundamental = maximum_likelihood_fundamental(points_a, points_b)
    iterations: list[Iteration] = [
        Iteration(0.0, np.full(len(a), np.nan), fundamental, _mean_line_distance(fundamental, points_a, points_b))
    ]
    while len(iterations) < _MAX_ITERATIONS:
        last = iterations[-1]
        lags = point_lags(last.fundamental, a, b, last.lag)
        lag = overall_lag(lags)
        points_a, points_b, _ = corresponding_points(a, b, lag)
        fundamental = maximum_likelihood_fundamental(points_a, points_b)
        iteration = Iteration(lag, lags, fundamental, _mean_line_distance(fundamental, points_a, points_b))
        iterations.append(iteration)
        # Eq. 22. From F⁽⁰⁾ the distance may rise once before the lag is first updated.
        if len(iterations) > 2 and not iteration.distance < last.distance * (1.0 - _TOLERANCE):
            break
    best = min(iterations[1:], key=lambda iteration: iteration.distance)
    return AlternatingLagResult(best.lag, best.fundamental, best.distance, tuple(iterations))


def search_start(lag: float) -> int:
    """Eq. 11: k = floor f for f >= 0, else ceil."""
    return int(np.floor(lag)) if lag >= 0 else int(np.ceil(lag))


def point_lags(fundamental: Floats, a: Floats, b: Floats, lag: float) -> Floats:
    """f_i (n,) of every point of a (eqs. 9 to 14, steps 1 to 4); NaN where its line crosses no segment."""
    lines = epipolar_lines(fundamental, np.nan_to_num(a))
    out = np.full(len(a), np.nan)
    begin = search_start(lag)
    for i in np.flatnonzero(np.isfinite(a).all(axis=1)):
        distance = b @ lines[i, :2] + lines[i, 2]
        out[i] = _search_crossing(distance, int(i), int(i) + begin)
    return out


def _search_crossing(distance: Floats, i: int, at: int) -> float:
    """Steps 1 to 4 for one point. distance: signed, of every point of b from the epipolar line."""
    size = len(distance)
    if not (0 <= at < size) or not np.isfinite(distance[at]):
        return np.nan
    before = abs(distance[at - 1]) if at >= 1 else np.inf
    after = abs(distance[at + 1]) if at + 1 < size else np.inf
    if not np.isfinite(before) and not np.isfinite(after):
        return np.nan
    direction = 1 if np.nan_to_num(before, nan=np.inf) >= np.nan_to_num(after, nan=np.inf) else -1  # eq. 12
    while 0 <= at + direction < size:
        here, there = distance[at], distance[at + direction]
        if not np.isfinite(there):
            return np.nan
        if here * there <= 0.0:  # step 2: the segment crosses the line
            total = abs(here) + abs(there)
            alpha = abs(here) / total if total > 0 else 0.0  # eq. 13, from the segment's start
            return float(at - i + direction * alpha)  # eq. 14
        if abs(there) >= abs(here):  # step 3
            return np.nan
        at += direction
    return np.nan


def overall_lag(lags: Floats) -> float:
    """Eqs. 16 to 18: the mean of the f_i in the fullest bin one frame wide. Raises Refused if there is none."""
    known = lags[np.isfinite(lags)]
    if len(known) == 0:
        raise Refused("no epipolar line crosses the other camera's track")
    bins = np.floor(known).astype(np.int64)
    values, counts = np.unique(bins, return_counts=True)
    peak = values[int(np.argmax(counts))]
    return float(known[bins == peak].mean())


def corresponding_points(a: Floats, b: Floats, lag: float) -> tuple[Floats, Floats, Bools]:
    """Point pairs at a lag (eqs. 19, 20): a_i and b interpolated at i + f. Returns also which i were used."""
    index = np.arange(len(a)) + lag
    low = np.floor(index).astype(np.int64)
    share = (index - low)[:, None]
    high = np.where(share[:, 0] > 0, low + 1, low)
    inside = (low >= 0) & (high < len(b))
    first, second = b[np.clip(low, 0, len(b) - 1)], b[np.clip(high, 0, len(b) - 1)]
    between = (1.0 - share) * first + share * second
    good: Bools = inside & np.isfinite(a).all(axis=1) & np.isfinite(between).all(axis=1)
    if good.sum() < 8:
        raise Refused(f"only {int(good.sum())} frames correspond at a lag of {lag:.1f} frames; 8 are needed")
    return a[good], between[good], good


def _mean_line_distance(fundamental: Floats, a: Floats, b: Floats) -> float:
    """E (eq. 21): mean distance of b's points from the epipolar lines of a's [px]."""
    return float(np.abs(line_distances(epipolar_lines(fundamental, a), b)).mean())
