"""The asynchronous calibration paper's method: alternating estimation of lag and fundamental matrix (eqs. 9 to 22).

"Calibration of pose and shutter timing of multiple asynchronous cameras". Frames are indices: camera b's point of index
i + f corresponds to camera a's point of index i, with f = lag in frames. It converges for about ±9 frames from zero,
and the paper's other restrictions apply. Kept as a baseline for comparison; a camera pair of a session becomes a
`PairSolution`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.sync.hypothesis import PairSolution
from hub.sync.pair_solver import evaluate_alignment
from hub.trajectory.image_tracks import SmoothTrack
from hub.two_view import relative_pose
from hub.two_view.relative_pose import epipolar_lines, line_distances, maximum_likelihood_fundamental
from protocols.core.errors import Refused
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.observations import Track

_TOLERANCE = 1e-6  # relative decrease of E below which the iteration has converged (eq. 22)
_MAX_ITERATIONS = 60  # bounds the alternation

_SAME_RATE = 0.01  # relative difference of frame intervals up to which frame rates count as equal
_CONVERGED_PX = 5.0  # mean epipolar distance above which the iteration has not converged
_MAX_FRAMES = 200_000  # frames


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


def solve_pair_by_paper(
    smooth: tuple[dict[str, SmoothTrack], dict[str, SmoothTrack]],
    tracks: tuple[dict[str, Track], dict[str, Track]],
    lenses: tuple[Intrinsics, Intrinsics],
    names: tuple[str, str],
) -> PairSolution:
    """Lag, F and relative pose by the paper's alternating method, on the label with the most common rows."""
    labels = [label for label in smooth[0] if label in smooth[1]]
    if not labels:
        return PairSolution(*names, "no label that both cameras saw")
    label = max(labels, key=lambda name: min(len(smooth[0][name].time), len(smooth[1][name].time)))
    a, b = smooth[0][label], smooth[1][label]
    try:
        frames = _common_frames(tracks[0][label], tracks[1][label])
        intervals = [
            _fit_clock(frame, track.time)
            for frame, track in zip(frames, (tracks[0][label], tracks[1][label]), strict=True)
        ]
        (start_a, step_a), (start_b, step_b) = intervals
        if abs(step_a / step_b - 1.0) > _SAME_RATE:
            raise Refused(
                f"frame rates differ ({1 / step_a:.2f} and {1 / step_b:.2f} a second): not for the paper's method"
            )
        first = int(min(frames[0].min(), frames[1].min()))
        length = int(max(frames[0].max(), frames[1].max())) - first + 1
        if length > _MAX_FRAMES:
            raise Refused(f"frame numbers span {length}")
        points = [
            _by_frame_index(frame - first, track.pixels, lens, length)
            for frame, track, lens in zip(frames, (tracks[0][label], tracks[1][label]), lenses, strict=True)
        ]
        result = estimate_alternately(points[0], points[1])
    except Refused as refusal:
        return PairSolution(*names, str(refusal))
    # a's frame i and b's frame i + f are one instant.
    step = 0.5 * (step_a + step_b)
    offset = (start_a - a.time_origin) - (start_b - b.time_origin) - result.lag * step
    essential_ab = lenses[0].matrix.T @ result.fundamental @ lenses[1].matrix
    inliers_a, inliers_b = a.points, b.at(a.time - offset)
    both = np.isfinite(inliers_b).all(axis=1)
    if both.sum() < 8:
        return PairSolution(*names, "the tracks do not overlap at the lag found", fundamental=result.fundamental)
    pose = relative_pose.decompose_essential(essential_ab.T, inliers_a[both], inliers_b[both])
    fit = evaluate_alignment(a, b, offset, pose)
    status = "ok"
    if result.distance > _CONVERGED_PX:
        status = f"the iteration did not converge ({result.distance:.1f} px from the epipolar lines)"
    return PairSolution(*names, status, fit, fundamental=result.fundamental)


def _common_frames(a: Track, b: Track) -> tuple[Ints, Ints]:
    """Frame indices of both tracks: frame numbers, or computed from times where the numbers are unusable."""
    frames: list[Ints] = []
    for track in (a, b):
        numbered = len(np.unique(track.frame)) == len(track.frame) and bool((np.diff(track.frame) > 0).all())
        if not numbered:
            interval = float(np.median(np.diff(track.time)))
            frames.append(np.round((track.time - track.time[0]) / interval).astype(np.int64))
        else:
            frames.append(track.frame)
    if frames[0].max() < frames[1].min() or frames[1].max() < frames[0].min():
        frames = [frame - frame.min() for frame in frames]
    return frames[0], frames[1]


def _fit_clock(frame: Ints, time: Floats) -> tuple[float, float]:
    """Time of frame 0 and the frame interval, by least squares."""
    step, start = np.polyfit(frame.astype(np.float64), time - time[0], 1)
    if not step > 0:
        raise Refused("frame numbers do not increase with time")
    return float(start + time[0]), float(step)


def _by_frame_index(frame: Ints, pixels: Floats, lens: Intrinsics, length: int) -> Floats:
    """Undistorted pixels (length, 2) by frame index, NaN where the marker was not seen."""
    out = np.full((length, 2), np.nan)
    out[frame] = lens.unproject(pixels) @ lens.matrix[:2, :2].T + lens.matrix[:2, 2]
    return out
