"""Two cameras on one shared clock: rows of the same time correspond, only the relative pose is sought."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hub.sync.alignment import PairFit, PairSettings, PairSolution
from hub.trajectory.discrete import lookup
from hub.trajectory.image_tracks import Track
from hub.two_view import relative_pose
from hub.two_view.refinement import Noise, PointPairs, Refined, refine

_LEAST_COMMON = 12
_CLOSE_PX = 3.0
_SEEDS = 4


def solve_shared_pair(
    tracks_a: Mapping[str, Track],
    tracks_b: Mapping[str, Track],
    names: tuple[str, str],
    settings: PairSettings | None = None,
) -> PairSolution:
    """Relative pose from all labels' rows of equal time (five-point RANSAC, then the Sampson distance)."""
    s = settings or PairSettings()
    parts_a, parts_b, times = [], [], []
    for label, a in tracks_a.items():
        if label in tracks_b:
            b = tracks_b[label]
            index, found = lookup(b.time, a.time)
            parts_a.append(a.points[found])
            parts_b.append(b.points[index[found]])
            times.append(a.time[found])
    count = sum(len(part) for part in parts_a)
    if count < _LEAST_COMMON:
        return PairSolution(*names, f"only {count} rows of the same time and label")
    a_points, b_points, time = np.concatenate(parts_a), np.concatenate(parts_b), np.concatenate(times)
    focal_a, focal_b = next(iter(tracks_a.values())).focal, next(iter(tracks_b.values())).focal
    noise = Noise(s.sigma_px / focal_a, s.sigma_px / focal_b, s.rate_std)
    still = np.zeros_like(a_points)
    zero = np.zeros(count)

    def sampler(slowness: float, middle: float) -> PointPairs:
        return PointPairs(a_points, b_points, still, zero)

    best: Refined | None = None
    for seed in range(_SEEDS):
        for start in relative_pose.five_point(a_points, b_points, 2.0 * _CLOSE_PX / min(focal_a, focal_b), seed):
            fit = refine(sampler, start, 0.0, 4.0, noise)
            if fit is not None and (best is None or fit.cost < best.cost):
                best = fit
    if best is None:
        return PairSolution(*names, "no geometry explains the rows of the same time")
    distance = np.abs(relative_pose.sampson(best.geometry.matrix, a_points, b_points, noise.sigma_a, noise.sigma_b))
    close = distance * s.sigma_px < _CLOSE_PX
    front = relative_pose.in_front(best.geometry, a_points[close], b_points[close])
    result = PairFit(
        rate=1.0,
        offset=0.0,
        geometry=best.geometry,
        cost=best.cost,
        sigma_px=float(np.median(distance)) / 0.6745 * s.sigma_px,
        inliers=float(close.mean()),
        front=float(front.mean()) if len(front) else 0.0,
        support=float(close.sum()) / 10.0,
        moving_overlap=float(count) / 10.0,
        middle=float(np.median(time)),
        parallax=relative_pose.parallax(best.geometry, a_points, b_points),
    )
    if result.inliers < s.accept_inliers:
        reason = f"only {100 * result.inliers:.0f} % of the {count} common rows agree with one geometry"
        return PairSolution(*names, reason, result)
    if result.front < s.accept_in_front:
        return PairSolution(*names, "the best geometry puts points behind a camera", result)
    return PairSolution(*names, "ok", result)
