"""Linearised rows of the adjustment around rigid bodies, and its normal equations."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from hub.bundle.bordered_system import THIRD_DIFFERENCE, third_difference_gradient, third_differences
from hub.bundle.problem import Column
from hub.bundle.residuals import ResidualEvaluation, SplineSupport, evaluate_points, jacobians
from hub.calibration.rigid_body.lag import rotations
from hub.calibration.rigid_body.problem import POSE, BodyProblem, BodyState, rotated
from hub.trajectory.splines import SUPPORT, SplineBasis
from protocols.geometry.types import Bools, Floats, Ints

BLOCK = SUPPORT * POSE
"""Parameters of a body's path that one view depends on."""
# Prior stds of a lens that only the board determines: wide, they matter where few views do not.
_PRIOR_STD = {Column.K1: 0.3, Column.K2: 0.3, Column.K3: 0.2, Column.ASPECT: 2e-3, Column.P1: 1e-3, Column.P1 + 1: 1e-3}
_CENTRE_STD = 0.02  # of the larger image side
_RATE_STD = 1e-3  # of a clock's rate: ten times a crystal's
_READOUT_STD = 0.02  # s: from none to a frame interval at 30 fps
NORM_STD = 0.1
"""Of a control quaternion's squared norm about 1."""
_RIDGE = 1e-10  # relative: gaps that only the smoothness prior bridges are singular to rounding
CAUCHY = 3.0
"""Scale of the robust loss [sigma of the 2-D residual]."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraRows:
    """Linearised rows of one camera at a state.

    evaluation: residuals of its n rows. index: (V,) first path parameter of each view. weights: (n, 4) of the
    four control points. pose_jacobian: (n, 3, 7) of the point by the interpolated pose. weight: (n,) information.
    turns: (n, 3, 3) world from body, where the shape is estimated.
    """

    evaluation: ResidualEvaluation
    index: Ints
    weights: Floats
    pose_jacobian: Floats
    weight: Floats
    turns: Floats | None


@dataclass(slots=True, eq=False)
class ReducedSystem:
    """Normal equations without the time errors. band: lower, (28, path). border: (path, columns): those of the cameras
    and, where it is estimated, of the shape."""

    band: Floats
    border: Floats
    corner: Floats
    gradient_path: Floats
    gradient_cameras: Floats


@dataclass(frozen=True, slots=True, eq=False)
class ViewTerms:
    """Of one camera's V views: sums over their rows of gradients and of products with the time error.

    columns: (c,) of the camera, and of the shape. path: (V, 28) gradient, camera: (V, c). time_path: (V, 28),
    time_camera: (V, c), time_gradient: (V,), time: (V,) second derivative by the time error, with its prior; inf where
    there is none.
    """

    columns: Ints
    path: Floats
    camera: Floats
    time_path: Floats
    time_camera: Floats
    time_gradient: Floats
    time: Floats


def linearised_rows(problem: BodyProblem, state: BodyState, camera: int, robust: bool) -> CameraRows:
    """A camera's rows at a state."""
    views, now = problem.views[camera], state.cameras[camera]
    index, weights, slopes, inside = _support(problem, state, camera)
    every = np.concatenate([body.control for body in state.bodies])
    control = every[index[:, None] + np.arange(SUPPORT)]
    # Rows of a rolling shutter are read at other times than the middle row: the view's pose moves on at its velocity.
    late = now.readout * now.row_offset(views.pixels) * now.rate if problem.clock else np.zeros(len(views.pixels))
    row_weights = weights[views.view] + late[:, None] * slopes[views.view]
    pose = np.einsum("nk,nkp->np", row_weights, control[views.view])
    velocity = np.einsum("vk,vkp->vp", slopes, control)[views.view]
    turned, by_quaternion = rotated(pose[:, 3:], views.points + state.shape[views.label])
    pose_jacobian = np.concatenate([np.broadcast_to(np.eye(3), (len(pose), 3, 3)), by_quaternion], axis=2)
    speed = np.einsum("nij,nj->ni", pose_jacobian, velocity)
    one = np.zeros((len(pose), SUPPORT))
    one[:, 0] = 1.0
    support = SplineSupport(np.vstack([speed, np.zeros((3, 3))]), np.arange(len(pose)), one, one)
    defined = inside[views.view]
    ones = np.ones(len(pose))
    found = evaluate_points(now, pose[:, :3] + turned, defined, views.time[views.view], views.pixels, support, ones)
    information = 1.0 / state.sigma[camera] ** 2
    squared = (found.residual**2).sum(axis=0) * information
    weight = information / (1.0 + squared / CAUCHY**2) if robust else np.full(len(pose), information)
    weight = np.where(found.valid & problem.use[camera], weight, 0.0)
    turns = rotations(pose[:, 3:]) if problem.free_shape else None
    return CameraRows(found, POSE * index, row_weights, pose_jacobian, weight, turns)


def view_index(problem: BodyProblem, state: BodyState, camera: int) -> Ints:
    """First path parameter (V,) of each view."""
    return POSE * _support(problem, state, camera)[0]


def _support(problem: BodyProblem, state: BodyState, camera: int) -> tuple[Ints, Floats, Floats, Bools]:
    """Of each view its body's first control point (V,) among all bodies', and the rest as ``BodyMotion.support``."""
    views = problem.views[camera]
    reference = state.cameras[camera].reference_time(views.time) + state.shift[camera]
    index, inside = np.zeros(len(views.time), dtype=np.int64), np.zeros(len(views.time), dtype=np.bool_)
    weights, slopes = np.zeros((2, len(views.time), SUPPORT))
    first = 0
    for number, body in enumerate(state.bodies):
        mine = views.body == number
        if mine.any():
            at, weights[mine], slopes[mine], inside[mine] = body.support(reference[mine])
            index[mine] = at + first
        first += len(body.control)
    return index, weights, slopes, inside


def assemble(problem: BodyProblem, state: BodyState, rows: list[CameraRows]) -> tuple[ReducedSystem, list[ViewTerms]]:
    """Normal equations over the bodies' paths and the cameras, without the time errors."""
    columns = [problem.columns(camera) for camera in range(len(rows))]
    starts = np.r_[0, np.cumsum([len(one) for one in columns])].astype(int)
    shape = starts[-1] + np.arange(state.shape.size if problem.free_shape else 0)
    width = int(starts[-1]) + len(shape)
    size = POSE * sum(len(body.control) for body in state.bodies)
    system = ReducedSystem(
        np.zeros((BLOCK, size)),
        np.zeros((size, width)),
        np.zeros((width, width)),
        np.zeros(size),
        np.zeros(width),
    )
    terms = []
    for camera, one in enumerate(rows):
        mine = np.r_[starts[camera] : starts[camera + 1], shape]
        terms.append(_add_camera(system, problem, state, camera, one, columns[camera], mine))
    if problem.free_shape:
        information = np.tile(state.shape_std**-2.0, len(state.shape))
        system.corner[shape, shape] += information
        system.gradient_cameras[shape] += information * state.shape.ravel()
    _add_priors(system, problem, state, columns, starts)
    system.band[0] *= 1.0 + _RIDGE
    return system, terms


def _add_camera(
    system: ReducedSystem,
    problem: BodyProblem,
    state: BodyState,
    camera: int,
    rows: CameraRows,
    columns: list[int],
    mine: Ints,
) -> ViewTerms:
    """Add one camera's rows, with the time errors of its views eliminated."""
    view, count = problem.views[camera].view, len(problem.views[camera].time)
    now = state.cameras[camera]
    # (2, 3 + columns, n): by the point, by the camera; the last column is the time's.
    by_point = jacobians(rows.evaluation, now, [*columns, Column.OFFSET])
    point, by_camera = by_point[:, :3].transpose(2, 0, 1), by_point[:, 3:].transpose(2, 0, 1)
    by_pose = point @ rows.pose_jacobian  # (n, 2, 7)
    by_path = (rows.weights[:, None, :, None] * by_pose[:, :, None, :]).reshape(len(view), 2, BLOCK)
    residual = rows.evaluation.residual.T[:, :, None]
    full = np.concatenate([by_path, by_camera, residual], axis=2)
    moments = _moments(full, rows.weight, view, count)  # (V, m, m)
    c = len(columns)
    crossed, shape_shape = np.zeros((count, full.shape[2], 0)), np.zeros((0, 0))
    if rows.turns is not None:
        label = problem.views[camera].label
        crossed, shape_shape = _shape_moments(
            full, point @ rows.turns, rows.weight, view, label, count, len(state.shape)
        )
    time, last = BLOCK + c, BLOCK + c + 1
    curvature = np.full(count, np.inf)
    time_gradient = np.zeros(count)
    if state.jitter[camera] > 0.0:
        prior = 1.0 / state.jitter[camera] ** 2
        curvature = moments[:, time, time] + prior
        time_gradient = moments[:, time, last] + prior * state.shift[camera]
    # Columns of the camera, then of the shape.
    by_corner = np.concatenate([moments[:, :, BLOCK:time], crossed], axis=2)
    path_path = moments[:, :BLOCK, :BLOCK]
    time_path, time_camera = moments[:, time, :BLOCK], by_corner[:, time]
    scaled_path, scaled_camera = time_path / curvature[:, None], time_camera / curvature[:, None]
    path_path = path_path - scaled_path[:, :, None] * time_path[:, None, :]
    path_camera = by_corner[:, :BLOCK] - scaled_path[:, :, None] * time_camera[:, None, :]
    camera_camera = np.zeros((len(mine), len(mine)))
    camera_camera[:c] = by_corner[:, BLOCK:time].sum(axis=0)
    camera_camera[c:, :c] = camera_camera[:c, c:].T
    camera_camera[c:, c:] = shape_shape
    camera_camera -= scaled_camera.T @ time_camera
    gradient_path = moments[:, :BLOCK, last] - scaled_path * time_gradient[:, None]
    gradient_camera = by_corner[:, last] - scaled_camera * time_gradient[:, None]
    order = np.argsort(rows.index, kind="stable")
    place, first = np.unique(rows.index[order], return_index=True)
    block = np.add.reduceat(path_path[order], first, axis=0)
    for i in range(BLOCK):
        for j in range(i + 1):
            system.band[i - j, place + j] += block[:, i, j]
    border = np.add.reduceat(path_camera[order], first, axis=0)
    gradient = np.add.reduceat(gradient_path[order], first, axis=0)
    for i in range(BLOCK):
        system.border[np.ix_(place + i, mine)] += border[:, i]
        system.gradient_path[place + i] += gradient[:, i]
    system.corner[np.ix_(mine, mine)] += camera_camera
    system.gradient_cameras[mine] += gradient_camera.sum(axis=0)
    return ViewTerms(mine, gradient_path, gradient_camera, time_path, time_camera, time_gradient, curvature)


def _moments(full: Floats, weight: Floats, view: Ints, count: int) -> Floats:
    """Sums over the rows of each view (count, m, m) of the weighted products of ``full`` (n, 2, m)."""
    each = np.bincount(view, minlength=count)
    place = np.arange(len(view)) - np.r_[0, np.cumsum(each)][:-1][view]
    width = full.shape[2]
    padded = np.zeros((count, int(each.max(initial=1)), 2, width))
    padded[view, place] = full * np.sqrt(weight)[:, None, None]
    flat = padded.reshape(count, -1, width)
    return np.asarray(np.matmul(flat.transpose(0, 2, 1), flat))


def _shape_moments(
    full: Floats, by_shape: Floats, weight: Floats, view: Ints, label: Ints, count: int, labels: int
) -> tuple[Floats, Floats]:
    """Weighted products with the derivatives by the labels' points ``by_shape`` (n, 2, 3).

    (count, m, 3 labels) of ``full`` (n, 2, m) by view, and (3 labels, 3 labels) of ``by_shape`` over all rows.
    """
    scaled = by_shape * weight[:, None, None]
    crossed = np.zeros((count, full.shape[2], labels, 3))
    crossed[view, :, label] = full.transpose(0, 2, 1) @ scaled  # a label is in a view at most once
    blocks = np.zeros((labels, 3, 3))
    np.add.at(blocks, label, by_shape.transpose(0, 2, 1) @ scaled)
    squares = np.zeros((labels, 3, labels, 3))
    squares[np.arange(labels), :, np.arange(labels)] = blocks
    return crossed.reshape(count, full.shape[2], 3 * labels), squares.reshape(3 * labels, 3 * labels)


def _add_priors(
    system: ReducedSystem, problem: BodyProblem, state: BodyState, columns: list[list[int]], starts: Ints
) -> None:
    for camera, column, difference, std in camera_priors(problem, state):
        if column in columns[camera]:
            place = int(starts[camera]) + columns[camera].index(column)
            system.corner[place, place] += 1.0 / std**2
            system.gradient_cameras[place] += difference / std**2
    first = 0
    for body, scatter in zip(state.bodies, state.scatter, strict=True):
        quaternion = body.control[:, 3:]
        off = (quaternion**2).sum(axis=1) - 1.0
        at = POSE * (first + np.arange(len(quaternion))) + 3
        for i in range(4):
            system.gradient_path[at + i] += 2.0 * quaternion[:, i] * off / NORM_STD**2
            for j in range(i + 1):
                system.band[i - j, at + j] += 4.0 * quaternion[:, i] * quaternion[:, j] / NORM_STD**2
        # Unseen instants would leave the system singular.
        system.band[0, POSE * first : POSE * (first + len(quaternion))] += 1e-9
        if scatter is not None and isinstance(body.basis, SplineBasis):
            begin, path = body.basis.interval_starts(), slice(POSE * first, POSE * (first + len(quaternion)))
            pull = third_differences(body.basis, body.control) / scatter**2
            system.gradient_path[path] += third_difference_gradient(body.basis, pull)
            for i, j in itertools.combinations_with_replacement(range(SUPPORT), 2):
                of_both = THIRD_DIFFERENCE[i] * THIRD_DIFFERENCE[j] / scatter**2
                for p in range(POSE):
                    np.add.at(system.band[POSE * (j - i)], POSE * (first + begin + i) + p, of_both[p])
        first += len(quaternion)


def camera_priors(problem: BodyProblem, state: BodyState) -> list[tuple[int, int, float, float]]:
    """Camera, column, difference and std of every prior on rates, readouts and lenses."""
    out: list[tuple[int, int, float, float]] = []
    for camera, (now, nominal) in enumerate(zip(state.cameras, problem.nominal, strict=True)):
        if problem.clock and camera != problem.reference:
            out.append((camera, Column.RATE, now.rate - 1.0, _RATE_STD))
        if problem.clock and problem.free_readout[camera]:
            out.append((camera, Column.READOUT, now.readout, _READOUT_STD))
        if not problem.free_lens[camera]:
            continue
        lens = now.intrinsics
        side = max(lens.width, lens.height)
        centre = np.array([0.5 * (lens.width - 1), 0.5 * (lens.height - 1)])
        off = lens.matrix[:2, 2] - centre
        aspect = np.log(lens.matrix[1, 1] / lens.matrix[0, 0])
        d = lens.distortions
        values = {
            Column.CENTRE: off[0],
            Column.CENTRE + 1: off[1],
            Column.ASPECT: aspect,
            Column.K1: d[0],
            Column.K2: d[1],
            Column.K3: d[2 if lens.fisheye else 4],
        }
        if not lens.fisheye:
            values |= {Column.P1: d[2], Column.P1 + 1: d[3]}
        out += [
            (camera, column, float(value), _PRIOR_STD.get(column, _CENTRE_STD * side))
            for column, value in values.items()
        ]
        out.append((camera, Column.FOCAL, float(np.log(lens.focal / nominal.focal)), 1.0))
    return out
