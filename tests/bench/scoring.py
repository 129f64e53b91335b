"""Scores of a result: trajectories, coverage, lags and poses against independent truth.

A trajectory is mapped to the truth with one similarity and one affine time map (rate within 2e-3 of 1), no
row is left out as an outlier, and only the time counts in which the truth moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize

from protocols.core.clocks import TimeMap
from protocols.geometry import so3
from protocols.geometry.pose import Pose, Similarity, fit_similarity
from protocols.geometry.types import Bools, Floats

MOVING = 0.3
"""The truth counts where it is faster [m/s]."""
RATE_WITHIN = 2e-3
SEEN_WITHIN = 0.2
_STEP = 0.1  # of the speeds that are correlated [s]
_LARGEST_GAP = 0.15  # an estimate is not interpolated across a longer gap [s]
_CANDIDATES = 4


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """An estimate mapped to the truth.

    rate, offset: truth time = rate * estimated time + offset. error: (n,) distances [truth's unit] at the
    truth's times (n,) that moved and have an estimate.
    """

    rate: float
    offset: float
    similarity: Similarity
    time: Floats
    error: Floats

    @property
    def rmse(self) -> float:
        """Root mean square error."""
        return float(np.sqrt(np.mean(self.error**2)))

    def figures(self) -> tuple[float, float, float, float]:
        """Mean, median, RMSE and 95th percentile."""
        return (
            float(self.error.mean()),
            float(np.median(self.error)),
            self.rmse,
            float(np.quantile(self.error, 0.95)),
        )


def speed_of(time: Floats, position: Floats) -> Floats:
    """Speed (n,) by differences over neighbours; NaN beside a gap."""
    if len(time) < 3:
        return np.full(len(time), np.nan)
    usual = float(np.median(np.diff(time)))
    speed = np.full(len(time), np.nan)
    span = time[2:] - time[:-2]
    inner = np.linalg.norm(position[2:] - position[:-2], axis=1) / span
    speed[1:-1] = np.where(span < 2.5 * max(usual, 1e-9) + 1e-9, inner, np.nan)
    return speed


def align(time: Floats, position: Floats, truth_time: Floats, truth: Floats) -> Alignment:
    """Map an estimate (n,), (n, 3) to the truth (m,), (m, 3), with no guess.

    Raises ValueError where fewer than ten moving rows of the truth have an estimate.
    """
    with np.errstate(invalid="ignore"):
        moving = speed_of(truth_time, truth) > MOVING
    fits = [
        _refine(shift, time, position, truth_time[moving], truth[moving])
        for shift in _shifts(time, position, truth_time, truth)
    ]
    found = [fit for fit in fits if fit is not None]
    if not found:
        raise ValueError("the estimate and the truth have no motion in common")
    # A shift that leaves a few rows only fits them however wrong it is.
    most = max(len(fit.error) for fit in found)
    return min((fit for fit in found if len(fit.error) >= 0.7 * most), key=lambda fit: fit.rmse)


def _shifts(time: Floats, position: Floats, truth_time: Floats, truth: Floats) -> list[float]:
    """Likely values of truth time - estimated time: where the two speeds correlate best."""
    grid = np.arange(time[0], time[-1], _STEP)
    smooth, there = _gridded_speed(time, position, grid)
    truth_grid = np.arange(truth_time[0], truth_time[-1], _STEP)
    other, known = _gridded_speed(truth_time, truth, truth_grid)
    shifts, scores = [], []
    least = max(60, int(0.5 * there.sum()))
    for lag in range(-len(grid) + 1, len(truth_grid)):
        a, b = max(0, -lag), min(len(grid), len(truth_grid) - lag)
        both = there[a:b] & known[a + lag : b + lag]
        if both.sum() < least:
            continue
        x, y = smooth[a:b][both], other[a + lag : b + lag][both]
        x, y = x - x.mean(), y - y.mean()
        size = float(np.sqrt((x @ x) * (y @ y)))
        shifts.append(truth_grid[0] - grid[0] + lag * _STEP)
        scores.append(float(x @ y) / size * np.sqrt(both.sum()) if size > 0 else 0.0)
    chosen: list[float] = []
    for index in np.argsort(scores)[::-1]:
        if all(abs(shifts[index] - old) > 1.0 for old in chosen):
            chosen.append(shifts[index])
        if len(chosen) == _CANDIDATES:
            break
    return chosen


def _gridded_speed(time: Floats, position: Floats, grid: Floats) -> tuple[Floats, Bools]:
    """Speed at grid times over 0.4 s, and where it is known."""
    reach = 0.2
    before, ok_before = interpolate(time, position, grid - reach, 0.5)
    after, ok_after = interpolate(time, position, grid + reach, 0.5)
    return np.linalg.norm(after - before, axis=1) / (2 * reach), ok_before & ok_after


def interpolate(time: Floats, position: Floats, at: Floats, gap: float = _LARGEST_GAP) -> tuple[Floats, Bools]:
    """Positions (k, 3) at times (k,), linear between rows no more than ``gap`` apart, and where that is."""
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    inside = (at >= time[0]) & (at <= time[-1]) & (time[after] - time[after - 1] <= gap)
    out = np.column_stack([np.interp(at, time, position[:, k]) for k in range(3)])
    return out, inside


def _refine(shift: float, time: Floats, position: Floats, truth_time: Floats, truth: Floats) -> Alignment | None:
    """Shift and rate of least RMSE, the similarity in closed form for each."""
    middle = float(np.median(time))
    extent = float(time[-1] - time[0])

    def solve(parameters: Floats) -> tuple[Similarity, Floats, Bools] | None:
        rate, at_middle = 1.0 + parameters[1] / max(extent, 1.0), middle + shift + parameters[0]
        estimate, there = interpolate(time, position, middle + (truth_time - at_middle) / rate)
        if there.sum() < 10:
            return None
        fitted = fit_similarity(estimate[there], truth[there])
        return fitted, np.linalg.norm(fitted.points(estimate[there]) - truth[there], axis=1), there

    def cost(parameters: Any) -> float:
        found = solve(parameters)
        if found is None or abs(parameters[1]) > RATE_WITHIN * extent:
            return 1e9
        return float(np.sqrt(np.mean(found[1] ** 2)))

    # parameters: shift [s], and seconds by which the rate moves the two ends apart
    start = np.zeros(2)
    for spread in (0.3, 0.03, 0.003):
        simplex = start + spread * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        options: Any = {"initial_simplex": simplex, "xatol": 1e-6, "fatol": 1e-8, "maxiter": 150}
        start = np.asarray(minimize(cost, start, method="Nelder-Mead", options=options).x)
    found = solve(start)
    if found is None or cost(start) >= 1e9:
        return None
    rate = 1.0 + float(start[1]) / max(extent, 1.0)
    offset = middle + shift + float(start[0]) - rate * middle
    return Alignment(rate, offset, found[0], truth_time[found[2]], found[1])


def coverage(path_time: Floats, seen: list[Floats], step: float = 0.02) -> float:
    """Share of the time in which two cameras saw the point within 0.2 s that has a path.

    path_time: (n,) sorted; seen: sorted times a camera, all on the reference clock.
    """
    times = [part for part in seen if len(part)]
    if len(times) < 2:
        return 0.0
    grid = np.arange(min(t[0] for t in times) - SEEN_WITHIN, max(t[-1] for t in times) + SEEN_WITHIN, step)
    wanted = np.sum([nearest(part, grid) <= SEEN_WITHIN for part in times], axis=0) >= 2
    usual = float(np.median(np.diff(path_time))) if len(path_time) > 1 else step
    have = nearest(path_time, grid) <= max(step, 0.75 * usual) if len(path_time) else np.zeros(len(grid), np.bool_)
    return float(have[wanted].mean()) if wanted.any() else 0.0


def nearest(times: Floats, grid: Floats) -> Floats:
    """Distance (k,) of grid times (k,) to the nearest of sorted times (n,)."""
    after = np.clip(np.searchsorted(times, grid), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    return np.minimum(np.abs(times[after] - grid), np.abs(times[before] - grid))


def lag_difference(a: TimeMap, b: TimeMap, true_a: TimeMap, true_b: TimeMap, reference_time: float) -> float:
    """By how many seconds the lag of two cameras differs from the truth's at one reference time."""
    time_a = (reference_time - a.time_offset) / a.clock_rate
    time_b = (reference_time - b.time_offset) / b.clock_rate
    moment = true_a.clock_rate * time_a + true_a.time_offset
    return (moment - true_b.time_offset) / true_b.clock_rate - time_b


def pose_differences(poses: dict[str, Pose], truth: dict[str, Pose]) -> dict[str, tuple[float, float]]:
    """Distance and angle [rad] of each camera from the truth after one similarity of the centres."""
    names = [name for name in truth if name in poses]
    fitted = fit_similarity(
        np.array([poses[name].position for name in names]), np.array([truth[name].position for name in names])
    )
    out = {}
    for name in names:
        moved = fitted.pose(poses[name])
        apart = float(np.linalg.norm(moved.position - truth[name].position))
        out[name] = apart, so3.angle_between(moved.rotation, truth[name].rotation)
    return out
