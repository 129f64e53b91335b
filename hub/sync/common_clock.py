"""Relative pose of two cameras on a common clock: rows of equal time correspond, no lag is estimated."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hub.sync.acceptance import acceptance_test, with_tests
from hub.sync.hypothesis import PairFit, PairSolution
from hub.sync.settings import PairSettings
from hub.trajectory.discrete import find_instants
from hub.trajectory.image_tracks import ImageTrack
from hub.two_view import relative_pose
from hub.two_view.refinement import NoiseModel, PointPairs, RefinementResult, refine

_MIN_ROWS = 12  # more than twice the five unknowns
_INLIER_PX = 3.0  # six stds of a good detector
_SEEDS = 4  # of RANSAC: one may end in a local minimum


def solve_common_clock_pair(
    tracks_a: Mapping[str, ImageTrack], tracks_b: Mapping[str, ImageTrack], names: tuple[str, str]
) -> PairSolution:
    """Relative pose from the rows of equal time of all labels: five-point RANSAC, then the Sampson distance.

    tracks_a, tracks_b: by label. names: of the two cameras. A pair without an acceptable pose is returned unsolved,
    with the reason. Support is counted as if rows came at 10 Hz.
    """
    s = PairSettings()
    parts_a, parts_b, times = [], [], []
    for label, a in tracks_a.items():
        if label in tracks_b:
            b = tracks_b[label]
            index, found = find_instants(b.time, a.time)
            parts_a.append(a.points[found])
            parts_b.append(b.points[index[found]])
            times.append(a.time[found])
    count = sum(len(part) for part in parts_a)
    if count < _MIN_ROWS:
        return PairSolution(*names, f"only {count} rows of the same time and label")
    a_points, b_points, time = np.concatenate(parts_a), np.concatenate(parts_b), np.concatenate(times)
    focal_a, focal_b = next(iter(tracks_a.values())).focal, next(iter(tracks_b.values())).focal
    noise = NoiseModel(s.sigma_px / focal_a, s.sigma_px / focal_b, s.rate_prior_std)
    still = np.zeros_like(a_points)
    zero = np.zeros(count)

    def sampler(inverse_rate: float, intercept: float) -> PointPairs:
        return PointPairs(a_points, b_points, still, zero)

    best: RefinementResult | None = None
    for seed in range(_SEEDS):
        for start in relative_pose.five_point(a_points, b_points, 2.0 * _INLIER_PX / min(focal_a, focal_b), seed):
            fit = refine(sampler, start, 0.0, 4.0, noise)
            if fit is not None and (best is None or fit.cost < best.cost):
                best = fit
    if best is None:
        return PairSolution(*names, "no geometry fits the rows of the same time")
    distance = np.abs(relative_pose.sampson(best.geometry.matrix, a_points, b_points, noise.sigma_a, noise.sigma_b))
    inlier = distance * s.sigma_px < _INLIER_PX
    front = relative_pose.in_front(best.geometry, a_points[inlier], b_points[inlier])
    result = PairFit(
        rate=1.0,
        offset=0.0,
        geometry=best.geometry,
        residual_px=float(np.median(distance)) / 0.6745 * s.sigma_px,
        inliers=float(inlier.mean()),
        in_front=float(front.mean()) if len(front) else 0.0,
        support=float(inlier.sum()) / 10.0,
        moving_overlap=float(count) / 10.0,
        mid_time=float(np.median(time)),
        parallax=relative_pose.parallax(best.geometry, a_points, b_points),
    )
    share = f"only {100 * result.inliers:.0f} % of the {count} common rows agree with one geometry"
    behind = "the best geometry puts points behind a camera"
    tests = (
        acceptance_test("inliers", result.inliers, s.min_inliers_long, share),
        acceptance_test("points in front of both cameras", result.in_front, s.min_in_front, behind),
    )
    return with_tests(PairSolution(*names, "ok"), tests, result)
