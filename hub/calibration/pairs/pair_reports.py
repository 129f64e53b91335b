"""Reports of pairs of cameras, from the joint solution or from the pair's own."""

from __future__ import annotations

import numpy as np

from hub.bundle.preprocessing import PreparedSession
from hub.bundle.problem import AdjustmentState
from hub.calibration.pairs.pair_network import coincide, pair_lag
from hub.calibration.solvers import Solution
from hub.sync.hypothesis import PairSolution
from hub.two_view.relative_pose import fundamental_from, relative_pose_between
from protocols.core.acceptance import PairReport
from protocols.geometry.types import Floats
from protocols.session.calibration import CameraCalibration


def pair_report(
    pair: PairSolution,
    cameras: dict[str, CameraCalibration],
    middles: Floats,
    state: AdjustmentState,
    names: list[str],
    solution: Solution,
) -> PairReport:
    """Report of a pair: from the joint solution where both cameras are in it, else from the pair's own solution."""
    fit = pair.fit
    a, b = cameras.get(pair.a), cameras.get(pair.b)
    if pair.fundamental is None and a is not None and b is not None:
        middle = float(middles[names.index(pair.a), names.index(pair.b)])
        time_a, time_b = (_camera_clock(state, names, name, middle, solution) for name in (pair.a, pair.b))
        matrices = a.intrinsics.matrix, b.intrinsics.matrix
        in_one_place = coincide(a.pose.position, b.pose.position)  # then they have no epipolar geometry
        return PairReport(
            cameras=(pair.a, pair.b),
            status=pair.status,
            lag_s=time_a - time_b,
            clock_rate=b.time_map.clock_rate / a.time_map.clock_rate,
            fundamental=None if in_one_place else fundamental_from(relative_pose_between(a.pose, b.pose), *matrices),
            inliers=None if fit is None else fit.inliers,
            rms_px=None if fit is None or not np.isfinite(fit.residual_px) else fit.residual_px,
            acceptance=pair.acceptance,
        )
    return isolated_pair_report(pair, solution.prepared)


def isolated_pair_report(pair: PairSolution, prepared: PreparedSession) -> PairReport:
    """Report of a pair from its own solution, where no joint solution contains both cameras."""
    fit = pair.fit
    if fit is None or not pair.solved:
        return PairReport((pair.a, pair.b), pair.status, fundamental=pair.fundamental, acceptance=pair.acceptance)
    matrix = pair.fundamental
    if matrix is None:
        lenses = [prepared.camera(name).intrinsics.matrix for name in (pair.a, pair.b)]
        matrix = fundamental_from(fit.geometry, *lenses)
    stds = (std / prepared.time_scale(pair.a) for std in (fit.total_lag_std, fit.lag_std))
    return PairReport(
        (pair.a, pair.b),
        pair.status,
        pair_lag(prepared, pair, fit),
        fit.rate * prepared.time_scale(pair.b) / prepared.time_scale(pair.a),
        matrix,
        fit.inliers,
        fit.residual_px,
        next(filter(np.isfinite, stds), None),
        pair.acceptance,
    )


def _camera_clock(state: AdjustmentState, names: list[str], name: str, internal: float, solution: Solution) -> float:
    """Time on a camera's own clock at an internal time."""
    prepared = solution.prepared
    observed = float(state.cameras[names.index(name)].camera_time(np.array([internal]))[0])
    return observed / prepared.time_scale(name) + prepared.time_origins[name]
