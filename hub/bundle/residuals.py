"""What a camera should have seen at a state: pixels, residuals, and their derivatives.

Arrays lie coordinate by coordinate, rows last: numpy is several times slower along axes of two or three. Callers get
transposed views, rows first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np

from hub.bundle.problem import (
    ASPECT,
    CAMERA_PARAMETERS,
    CENTRE,
    FOCAL,
    K1,
    K2,
    K3,
    OFFSET,
    P1,
    RATE,
    READOUT,
    CameraState,
    Rows,
    Trajectory,
)
from hub.trajectory.splines import combined
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Bools, Floats, Ints

# Knot intervals by which the path goes on beyond its ends while clocks move: a row that a step takes off the path costs
# as much as a gross error, so that one row at an end would hold every clock where it is.
_BEYOND = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """Rows of one camera and label at a state: residual (n, 2), derivatives, place in the spline."""

    residual: Floats
    by_point: Floats
    by_camera: Floats
    index: Ints
    weights: Floats
    valid: Bools


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """Used rows of one camera at a state, without derivatives.

    residual: (2, n) [px]. valid: (n,) whether the path is known and in front; elsewhere numbers are finite and mean
    nothing. time: (n,) on the camera's clock, its readout counted. index, weights, slopes: place in ``control``
    (size, 3), the path's or all paths' control points. local: (3, n) in camera axes. flat: (2, n) undistorted.
    distorting: (n, 2, 2) derivative of distorted by undistorted coordinates, where it came with the residuals.
    """

    residual: Floats
    valid: Bools
    time: Floats
    pixels: Floats
    control: Floats
    index: Ints
    weights: Floats
    slopes: Floats
    local: Floats
    flat: Floats
    distorting: Floats | None


@dataclass(frozen=True, slots=True, eq=False)
class Stacked:
    """The paths of all labels, one after the other. firsts: by label its first of the ``control`` points (size, 3)."""

    paths: tuple[Trajectory, ...]
    firsts: tuple[int, ...]
    control: Floats

    @classmethod
    def of(cls, paths: tuple[Trajectory, ...]) -> Stacked:
        """All paths of a state."""
        firsts = accumulate((path.basis.size for path in paths), initial=0)
        return cls(paths, tuple(firsts)[:-1], np.concatenate([np.zeros((0, 3)), *(path.control for path in paths)]))


def predict(rows: Rows, camera: CameraState, path: Trajectory) -> Floats:
    """Pixels (n, 2) at which the camera should have seen the point; NaN where the path is not known."""
    points = path.at(camera.reference_time(camera.shot(rows.time, rows.pixels)))
    return camera.intrinsics.project(camera.pose.camera_from_world(points))


def residual_norms(rows: Rows, camera: CameraState, path: Trajectory) -> Floats:
    """Distances (n,) [px] of rows from their predictions; NaN where the path is not known."""
    off = predict(rows, camera, path) - rows.pixels
    return np.asarray(np.sqrt(off[:, 0] ** 2 + off[:, 1] ** 2))


def look(rows: Rows, camera: CameraState, path: Trajectory) -> Look:
    """Residuals of the used rows of one label, and what derivatives need."""
    return look_together((replace(rows, label=0),), camera, Stacked((path,), (0,), path.control))


def look_together(parts: Sequence[Rows], camera: CameraState, paths: Stacked) -> Look:
    """The used rows of several labels of one camera, one label after the other.

    Some thirty rows a label are what a board gives: numpy takes as long for these as for all labels' at once.
    """
    pixels = np.concatenate([part.pixels[part.use] for part in parts])
    time = camera.shot(np.concatenate([part.time[part.use] for part in parts]), pixels)
    reference = camera.reference_time(time)
    ends = np.cumsum([np.count_nonzero(part.use) for part in parts])
    places = [
        paths.paths[part.label].basis.weights_both(mine, _BEYOND)
        for part, mine in zip(parts, np.split(reference, ends[:-1]), strict=True)
    ]
    index = np.concatenate([place[0] + paths.firsts[part.label] for place, part in zip(places, parts, strict=True)])
    weights, slopes = (np.concatenate([place[i] for place in places]) for i in (1, 2))
    inside = np.concatenate([place[3] for place in places])
    local = camera.pose.rotation @ (combined(paths.control, index, weights).T - camera.pose.position[:, None])
    z = local[2]
    valid = inside & (z > 1e-9)
    flat = np.where(valid, local[:2] / np.where(valid, z, 1.0), 0.0)
    lens = camera.intrinsics
    distorting = None
    if lens.fisheye:
        projected = lens.project_normalised(flat.T).T
        valid &= np.isfinite(projected).all(axis=0)
    else:
        distorted, distorting = lens.distort(flat.T)
        projected = lens.matrix[:2, :2] @ distorted.T + lens.matrix[:2, 2:]
        valid &= np.hypot(flat[0], flat[1]) < lens.fold
    if not valid.all():
        flat = np.where(valid, flat, 0.0)
        projected = np.where(valid, projected, lens.matrix[:2, 2:])
        if distorting is not None:
            distorting[~valid] = np.eye(2)
    residual = projected - pixels.T
    return Look(residual, valid, time, pixels, paths.control, index, weights, slopes, local, flat, distorting)


def derivatives(seen: Look, camera: CameraState, columns: Sequence[int]) -> Floats:
    """Derivatives (2, 3 + columns, n) of the residuals by the point and by those parameters of the camera."""
    out = np.empty((2, 3 + len(columns), len(seen.time)))
    lens, flat, local = camera.intrinsics, seen.flat, seen.local
    by_local = np.empty((2, 3, len(seen.time)))
    over = 1.0 / np.where(seen.valid, local[2], 1.0)
    matrix = lens.matrix[:2, :2]
    if seen.distorting is None:
        by_local[:, :2] = lens.pixel_jacobian(flat.T).transpose(1, 2, 0) * over
    else:
        distorting = seen.distorting.transpose(1, 2, 0) * over
        by_local[0, :2] = matrix[0, 0] * distorting[0] + matrix[0, 1] * distorting[1]
        by_local[1, :2] = matrix[1, 0] * distorting[0] + matrix[1, 1] * distorting[1]
    by_local[:, 2] = -by_local[:, 0] * flat[0] - by_local[:, 1] * flat[1]
    by_point = np.matmul(camera.pose.rotation.T, by_local, out=out[:, :3])
    along = radius2 = None
    for column, values in zip(columns, out[:, 3:].transpose(1, 0, 2), strict=True):
        if column < 3:  # a turn by w moves the point by w × local
            i, j = (column + 1) % 3, (column + 2) % 3
            np.subtract(local[i] * by_local[:, j], local[j] * by_local[:, i], out=values)
        elif column < OFFSET:
            np.negative(by_point[:, column - 3], out=values)
        elif column in (OFFSET, RATE, READOUT):
            if along is None:
                velocity = combined(seen.control, seen.index, seen.slopes).T
                along = (by_point * velocity).sum(axis=1)
            lever: Floats | float = 1.0
            if column == RATE:
                lever = seen.time - camera.centre
            elif column == READOUT:
                lever = camera.rate * camera.below_middle(seen.pixels)
            np.multiply(along, lever, out=values)
        else:
            if radius2 is None:
                radius2 = (flat**2).sum(axis=0)
            values[:] = _by_lens(seen, lens, column, radius2)
    return out


def _by_lens(seen: Look, lens: Intrinsics, column: int, radius2: Floats) -> Floats:
    """Derivative (2, n), or what broadcasts to it, by one of a lens's own parameters."""
    matrix, flat = lens.matrix[:2, :2], seen.flat
    if column in (CENTRE, CENTRE + 1):
        return np.eye(2)[:, column - CENTRE, None]
    if column in (FOCAL, ASPECT):
        about = seen.residual + seen.pixels.T - lens.matrix[:2, 2:]
        return about if column == FOCAL else about * np.array([[-0.5], [0.5]])
    if column >= P1:
        if lens.fisheye:
            return np.zeros((2, 1))
        x, y = flat
        both = 2 * x * y
        return np.asarray(
            matrix @ (np.stack([both, radius2 + 2 * y * y] if column == P1 else [radius2 + 2 * x * x, both]))
        )
    power = {K1: 0, K2: 1, K3: 2}[column]
    if not lens.fisheye:
        return np.asarray(matrix @ (flat * radius2 ** (power + 1)))
    radius = np.sqrt(radius2)
    angle = np.arctan(radius)
    return flat * (angle ** (3 + 2 * power) / np.maximum(radius, 1e-12)) * np.diag(matrix)[:, None]


def linearise(rows: Rows, camera: CameraState, path: Trajectory, columns: int = CAMERA_PARAMETERS) -> Linearised:
    """Residuals of the used rows and their derivatives by the point (n, 2, 3) and the camera (n, 2, columns)."""
    seen = look(rows, camera, path)
    slopes = derivatives(seen, camera, range(columns)).transpose(2, 0, 1)
    return Linearised(seen.residual.T, slopes[:, :, :3], slopes[:, :, 3:], seen.index, seen.weights, seen.valid)
