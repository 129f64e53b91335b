"""Adjustment problems whose state is the truth: cameras that observe one spline."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hub.bundle.problem import CAMERA_PARAMETERS, AdjustmentState, CameraState, Problem, TrackObservations, Trajectory
from hub.bundle.residuals import evaluate_residuals, jacobians
from hub.trajectory.splines import SplineBasis, fit_spline
from protocols.geometry.types import Bools, Floats, Ints
from tests.support.rigs import Path


def spline_of(path: Path, begin: float, end: float, spacing: float) -> Trajectory:
    """The spline that fits a path from ``begin`` to ``end`` with knots every ``spacing`` [s]."""
    basis, grid = SplineBasis.covering(np.array([begin]), np.array([end]), spacing), np.arange(begin, end, 0.02)
    return Trajectory(basis, fit_spline(basis, basis.weights(grid), path.at(grid), np.ones(len(grid))))


def pixels_of(camera: CameraState, path: Trajectory, time: Floats) -> Floats:
    """Where a camera sees a path at times (n,) of its own clock, (n, 2) [px]."""
    return camera.intrinsics.project(camera.pose.camera_from_world(path.at(camera.reference_time(time))))


def observed(
    cameras: Sequence[CameraState],
    path: Trajectory,
    times: Callable[[int], Floats],
    errors: Callable[[Floats], Floats],
    sigma: float = 0.5,
) -> tuple[Problem, AdjustmentState]:
    """What cameras see of a path. times: (n,) of a camera's rows. errors: (n, 2) [px] at times. sigma: [px]."""
    rows = []
    for i, camera in enumerate(cameras):
        time = times(i)
        seen = pixels_of(camera, path, time) + errors(time)
        rows.append(TrackObservations(i, 0, time, seen, np.ones(len(time), dtype=np.bool_)))
    lenses = tuple(camera.intrinsics for camera in cameras)
    return (
        Problem(tuple(rows), lenses, 0, (0, 1)),
        AdjustmentState(tuple(cameras), (path,), np.full(len(cameras), sigma)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedResiduals:
    """Linearised rows of one camera and label: residual (n, 2), Jacobians, spline support.

    point_jacobian: (n, 2, 3). camera_jacobian: (n, 2, columns). index (n,), weights (n, 4): control points of a row.
    """

    residual: Floats
    point_jacobian: Floats
    camera_jacobian: Floats
    index: Ints
    weights: Floats
    valid: Bools


def linearise(
    rows: TrackObservations, camera: CameraState, path: Trajectory, columns: int = CAMERA_PARAMETERS
) -> LinearisedResiduals:
    """Residuals of the used rows and their Jacobians by the point (n, 2, 3) and the camera (n, 2, columns)."""
    evaluation = evaluate_residuals(rows, camera, path)
    jacobian = jacobians(evaluation, camera, range(columns)).transpose(2, 0, 1)
    return LinearisedResiduals(
        evaluation.whitened(evaluation.residual).T,
        jacobian[:, :, :3],
        jacobian[:, :, 3:],
        evaluation.index,
        evaluation.weights,
        evaluation.valid,
    )
