"""Adjustment problems whose state is the truth: cameras that observe one spline."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hub.bundle.problem import AdjustmentState, CameraState, Problem, TrackObservations, Trajectory
from hub.trajectory.splines import SplineBasis, fit_spline
from protocols.geometry.types import Floats
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
