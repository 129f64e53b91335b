"""Measurement model of the adjustment: predicted pixels, reprojection residuals, and their Jacobians.

Arrays are stored coordinate by coordinate, rows last: numpy is several times slower along axes of two or three. Callers
get transposed views, rows first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np

from hub.bundle.problem import CameraState, Column, TrackObservations, Trajectory, UsedRows
from hub.trajectory.discrete import PointBasis
from hub.trajectory.splines import SplineBasis, weighted_sums
from protocols.geometry import kernels
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Bools, Floats, Ints

# Knot intervals by which the path is extrapolated while clocks move: a row that a step takes off the path costs as much
# as a gross error, so a single row at an end would otherwise block every clock update.
_EXTRAPOLATION_INTERVALS = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class ResidualEvaluation:
    """Residuals of one camera's used rows at a state, with the intermediate values that the Jacobians need.

    residual: (2, n) [px]. valid: (n,) whether the path is defined and in front of the camera; elsewhere the numbers are
    finite but meaningless. time: (n,) on the camera's clock, corrected for readout. index, weights, slope_weights:
    support in ``control`` (size, 3), the path's or all paths' control points. camera_points: (3, n) in camera axes.
    normalised: (2, n) undistorted. distortion_jacobian: (2, 2, n) derivative of distorted by undistorted coordinates,
    None of a fisheye lens. relative_information: (n,) of the rows, by their relative stds. along: the
    directions of motion (2, n), and by what `whitened` ones are shortened along them (n,); None = not at all.
    """

    residual: Floats
    valid: Bools
    time: Floats
    pixels: Floats
    control: Floats
    index: Ints
    weights: Floats
    slope_weights: Floats
    camera_points: Floats
    normalised: Floats
    distortion_jacobian: Floats | None
    relative_information: Floats
    along: tuple[Floats, Floats] | None = None

    def whitened(self, vectors: Floats) -> Floats:
        """Vectors (2, ..., n) shortened along the motion."""
        if self.along is None:
            return vectors
        direction, factor = self.along
        direction = direction.reshape(2, *[1] * (vectors.ndim - 2), -1)
        return np.asarray(vectors + direction * ((factor - 1.0) * (direction * vectors).sum(axis=0)))


@dataclass(frozen=True, slots=True, eq=False)
class SplineSupport:
    """Of n rows: control points (size, 3), the first of four (n,), their weights and those of the velocity (n, 4)."""

    control: Floats
    index: Ints
    weights: Floats
    slope_weights: Floats


@dataclass(frozen=True, slots=True, eq=False)
class StackedTrajectories:
    """The paths of labels, concatenated: of each label its basis and the index of its first point in ``control``
    (size, 3). are_splines: all of them."""

    bases: dict[int, tuple[SplineBasis | PointBasis, int]]
    control: Floats
    are_splines: bool

    @classmethod
    def of(cls, paths: Mapping[int, Trajectory]) -> StackedTrajectories:
        """Paths by label."""
        firsts = accumulate((path.basis.size for path in paths.values()), initial=0)
        bases = {label: (path.basis, first) for (label, path), first in zip(paths.items(), firsts, strict=False)}
        control = np.concatenate([np.zeros((0, 3)), *(path.control for path in paths.values())])
        splines = all(isinstance(path.basis, SplineBasis) and len(path.basis.starts) for path in paths.values())
        return cls(bases, control, splines)

    def support(self, rows: UsedRows, time: Floats) -> tuple[Ints, Floats, Floats, Bools]:
        """Of rows at reference time (n,): first control points (n,), their weights and those of the slopes (n, 4), and
        whether the paths are defined there (n,)."""
        bases = [self.bases[label] for label in rows.labels]
        if kernels.AVAILABLE and self.are_splines:
            tables = [(basis.table, first) for basis, first in bases if isinstance(basis, SplineBasis)]
            index, weights, slopes, inside = kernels.label_weights(tables, rows.ends, time, _EXTRAPOLATION_INTERVALS)
            return index, weights.T, slopes.T, inside
        times = np.split(time, rows.ends[:-1])
        found = [
            basis.weights_and_derivatives(at, _EXTRAPOLATION_INTERVALS)
            for (basis, _), at in zip(bases, times, strict=True)
        ]
        index = np.concatenate([one[0] + first for one, (_, first) in zip(found, bases, strict=True)])
        weights, slopes, inside = (np.concatenate(one) for one in list(zip(*found, strict=True))[1:])
        return index, weights, slopes, inside


def predict(rows: TrackObservations, camera: CameraState, path: Trajectory) -> Floats:
    """Predicted pixels (n, 2) of the rows; NaN where the path is not defined."""
    points = path.at(camera.reference_time(camera.row_time(rows.time, rows.pixels)))
    return camera.intrinsics.project(camera.pose.camera_from_world(points))


def relative_residuals(rows: TrackObservations, camera: CameraState, path: Trajectory) -> Floats:
    """Residuals (n, 2) [px] over the rows' relative stds; NaN where the path is undefined."""
    residual = predict(rows, camera, path) - rows.pixels
    return residual if rows.relative_std is None else residual / rows.relative_std[:, None]


def residual_norms(rows: TrackObservations, camera: CameraState, path: Trajectory) -> Floats:
    """Distances (n,) [px] of rows from their predictions, over their relative stds; NaN where the path is undefined."""
    residual = relative_residuals(rows, camera, path)
    return np.asarray(np.sqrt(residual[:, 0] ** 2 + residual[:, 1] ** 2))


def evaluate_residuals(rows: TrackObservations, camera: CameraState, path: Trajectory) -> ResidualEvaluation:
    """Residuals of the used rows of one label, and what their Jacobians need."""
    return evaluate_labels(UsedRows.of([rows]), camera, StackedTrajectories.of({rows.label: path}))


def evaluate_labels(rows: UsedRows, camera: CameraState, paths: StackedTrajectories) -> ResidualEvaluation:
    """Residuals of the used rows of several labels of one camera."""
    time = camera.row_time(rows.time, rows.pixels)
    index, weights, slope_weights, inside = paths.support(rows, camera.reference_time(time))
    points = weighted_sums(paths.control, index, weights)
    support = SplineSupport(paths.control, index, weights, slope_weights)
    evaluation = evaluate_points(camera, points, inside, time, rows.pixels, support, rows.relative_information)
    if rows.along_std is None:
        return evaluation
    velocity = jacobians(evaluation, camera, [Column.OFFSET])[:, 3]
    direction = velocity / np.maximum(np.linalg.norm(velocity, axis=0), 1e-9)
    return replace(evaluation, along=(direction, 1.0 / rows.along_std))


def evaluate_points(
    camera: CameraState,
    points: Floats,
    inside: Bools,
    time: Floats,
    pixels: Floats,
    support: SplineSupport,
    relative_information: Floats,
) -> ResidualEvaluation:
    """Residuals of pixels (n, 2) of world points (n, 3), which are defined where ``inside`` (n,)."""
    camera_points, normalised, projected, distortion_jacobian, valid = _project(camera, points, inside)
    residual = projected - pixels.T
    return ResidualEvaluation(
        residual,
        valid,
        time,
        pixels,
        support.control,
        support.index,
        support.weights,
        support.slope_weights,
        camera_points,
        normalised,
        distortion_jacobian,
        relative_information,
    )


def _project(camera: CameraState, points: Floats, inside: Bools) -> tuple[Floats, Floats, Floats, Floats | None, Bools]:
    """What `kernels.project_points` gives; also by a fisheye lens, then without Jacobian."""
    pose, lens = camera.pose, camera.intrinsics
    if kernels.AVAILABLE and not lens.fisheye:
        given = (pose.rotation, pose.position), (lens.matrix, lens.distortions, lens.fold)
        return kernels.project_points(points, *given, inside)
    camera_points = pose.rotation @ (points.T - pose.position[:, None])
    z, jacobian = camera_points[2], None
    valid = inside & (z > 0.0)
    normalised = np.where(valid, camera_points[:2] / np.where(valid, z, 1.0), 0.0)
    if lens.fisheye:
        projected = lens.project_normalised(normalised.T).T
        valid &= np.isfinite(projected).all(axis=0)
    else:
        valid &= (normalised**2).sum(axis=0) < lens.fold**2
        distorted, rows_first = lens.distort(np.where(valid, normalised, 0.0).T)
        projected, jacobian = lens.matrix[:2, :2] @ distorted.T + lens.matrix[:2, 2:], rows_first.transpose(1, 2, 0)
    return (
        camera_points,
        np.where(valid, normalised, 0.0),
        np.where(valid, projected, lens.matrix[:2, 2:]),
        jacobian,
        valid,
    )


def jacobians(evaluation: ResidualEvaluation, camera: CameraState, columns: Sequence[int]) -> Floats:
    """Jacobian (2, 3 + columns, n) of the residuals by the point and by the given camera parameter columns."""
    out, velocity = np.empty((2, 3 + len(columns), len(evaluation.time))), None
    if not {Column.OFFSET, Column.RATE, Column.READOUT}.isdisjoint(columns):
        velocity = weighted_sums(evaluation.control, evaluation.index, evaluation.slope_weights).T
    place = np.array([3 + columns.index(k) if k in columns else -1 for k in range(Column.OFFSET)])
    if kernels.AVAILABLE and evaluation.distortion_jacobian is not None:
        rows = evaluation.camera_points, evaluation.normalised, evaluation.distortion_jacobian, evaluation.valid
        by_time = kernels.pose_jacobians(camera.pose.rotation, camera.intrinsics.matrix, rows, velocity, place, out)
    else:
        by_time = _pose_jacobians(evaluation, camera, velocity, place, out)
    radius2 = None
    for column, values in zip(columns, out[:, 3:].transpose(1, 0, 2), strict=True):
        if column in (Column.OFFSET, Column.RATE, Column.READOUT):
            factor: Floats | float = 1.0
            if column == Column.RATE:
                factor = evaluation.time - camera.centre
            elif column == Column.READOUT:
                factor = camera.rate * camera.row_offset(evaluation.pixels)
            np.multiply(by_time, factor, out=values)
        elif column > Column.OFFSET:
            if radius2 is None:
                radius2 = (evaluation.normalised**2).sum(axis=0)
            values[:] = _lens_jacobian(evaluation, camera.intrinsics, column, radius2)
    return evaluation.whitened(out)


def _pose_jacobians(
    evaluation: ResidualEvaluation, camera: CameraState, velocity: Floats | None, place: Ints, out: Floats
) -> Floats:
    """What `kernels.pose_jacobians` does; also of a fisheye lens."""
    normalised, camera_points, matrix = (
        evaluation.normalised,
        evaluation.camera_points,
        camera.intrinsics.matrix[:2, :2],
    )
    distortion = evaluation.distortion_jacobian
    bent = (
        camera.intrinsics.pixel_jacobian(normalised.T).transpose(1, 2, 0)
        if distortion is None
        else np.tensordot(matrix, distortion, 1)
    )
    jacobian = np.empty((2, 3, len(evaluation.time)))
    jacobian[:, :2] = bent / np.where(evaluation.valid, camera_points[2], 1.0)
    jacobian[:, 2] = -jacobian[:, 0] * normalised[0] - jacobian[:, 1] * normalised[1]
    by_point = np.matmul(camera.pose.rotation.T, jacobian, out=out[:, :3])
    for k, column in enumerate(place):
        if column >= 0 and k < 3:  # a rotation by w moves the point by w × camera_points
            i, j = (k + 1) % 3, (k + 2) % 3
            out[:, column] = camera_points[i] * jacobian[:, j] - camera_points[j] * jacobian[:, i]
        elif column >= 0:
            out[:, column] = -by_point[:, k - 3]
    return np.zeros((2, 0)) if velocity is None else np.asarray((by_point * velocity).sum(axis=1))


def _lens_jacobian(evaluation: ResidualEvaluation, lens: Intrinsics, column: int, radius2: Floats) -> Floats:
    """Jacobian (2, n), or an array that broadcasts to it, by one intrinsic parameter."""
    matrix, normalised = lens.matrix[:2, :2], evaluation.normalised
    if column in (Column.CENTRE, Column.CENTRE + 1):
        return np.eye(2)[:, column - Column.CENTRE, None]
    if column in (Column.FOCAL, Column.ASPECT):
        from_centre = evaluation.residual + evaluation.pixels.T - lens.matrix[:2, 2:]
        return from_centre if column == Column.FOCAL else from_centre * np.array([[-0.5], [0.5]])
    if column >= Column.P1:
        if lens.fisheye:
            return np.zeros((2, 1))
        x, y = normalised
        cross = 2 * x * y
        return np.asarray(
            matrix @ (np.stack([cross, radius2 + 2 * y * y] if column == Column.P1 else [radius2 + 2 * x * x, cross]))
        )
    power = {Column.K1: 0, Column.K2: 1, Column.K3: 2}[column]
    if not lens.fisheye:
        return np.asarray(matrix @ (normalised * radius2 ** (power + 1)))
    radius = np.sqrt(radius2)
    angle = np.arctan(radius)
    return normalised * (angle ** (3 + 2 * power) / np.maximum(radius, 1e-12)) * np.diag(matrix)[:, None]
