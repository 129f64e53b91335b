"""The alternating lag method on a camera pair of a session: rows by frame index, result as a `PairSolution`."""

from __future__ import annotations

import numpy as np

from hub.baselines.alternating_lag import estimate_alternately
from hub.sync.hypothesis import PairSolution
from hub.sync.pair_solver import evaluate_alignment
from hub.trajectory.image_tracks import SmoothTrack
from hub.two_view import relative_pose
from protocols.core.errors import Refused
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Ints
from protocols.session.observations import Track

_SAME_RATE = 0.01  # relative difference of frame intervals up to which frame rates count as equal
_CONVERGED_PX = 5.0  # mean epipolar distance above which the iteration has not converged
_MAX_FRAMES = 200_000  # frames


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
