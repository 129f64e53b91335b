"""Bundle adjustment of cameras around moving rigid bodies of known geometry.

Levenberg-Marquardt on the reprojection error of the bodies' points, each view at its own time: the body moves on a
spline of its pose (one pose an instant on a shared clock). Where clocks are independent, every view may have a time
error of its own, with a prior whose std is estimated from the data: webcams stamp frames when they are read. These
time errors are eliminated first, the bodies' poses next (a banded system), the cameras last.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solveh_banded

from hub.bundle.adjustment import apply_camera_step
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
    CameraState,
)
from hub.bundle.residuals import ResidualEvaluation, SplineSupport, evaluate_points, jacobians
from hub.calibration.rigid_body.motion import POSE, BodyMotion, rotated
from hub.calibration.rigid_body.views import CameraViews
from hub.trajectory.splines import SUPPORT, SplineBasis
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.calibration import AdjustmentStep

BLOCK = SUPPORT * POSE
"""Parameters of a body's path that one view depends on."""
LENS = (FOCAL, K1, CENTRE, CENTRE + 1, K2, K3, ASPECT, P1, P1 + 1)
"""Columns of a lens that is estimated; a fisheye lens has no P1, P1 + 1."""
# Prior stds of a lens that only the board determines: wide, they matter where few views do not.
_PRIOR_STD = {K1: 0.3, K2: 0.3, K3: 0.2, ASPECT: 2e-3, P1: 1e-3, P1 + 1: 1e-3}
_CENTRE_STD = 0.02  # of the larger image side
_RATE_STD = 1e-3
_NORM_STD = 0.1  # of a control quaternion's squared norm about 1
_CAUCHY, _OUTLIER = 3.0, 5.0  # sigma of the 2-D residual
_MIN_SIGMA_PX = 0.03
_JITTER_START, _MIN_JITTER = 0.1, 2e-4  # of a frame interval; s: less is none
_MIN_PRIOR = 1e-4  # of a path's scatter
_ROUNDS, _STEPS = 5, 20
_TOLERANCE = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class BodyProblem:
    """Fixed quantities of the adjustment, by camera.

    views: what was seen. nominal: prior means of the lenses. free_lens: whether it is estimated. fixed: whether the
    camera's pose is given. reference: the camera that fixes clock and, where no pose is given, the world. clock:
    whether clocks are estimated. readout: seconds from an image's first row to its last. use: rows that fit.
    """

    views: tuple[CameraViews, ...]
    nominal: tuple[Intrinsics, ...]
    free_lens: tuple[bool, ...]
    fixed: tuple[bool, ...]
    reference: int
    clock: bool
    readout: tuple[float, ...]
    use: tuple[Bools, ...]

    def columns(self, camera: int) -> list[int]:
        """The free parameters of a camera, as in ``hub.bundle.problem``."""
        out: list[int] = []
        if not self.fixed[camera] and (camera != self.reference or any(self.fixed)):
            out += range(6)
        if self.clock and camera != self.reference:
            out += [OFFSET, RATE]
        if self.free_lens[camera]:
            out += LENS[: 7 if self.nominal[camera].fisheye else None]
        return out


@dataclass(frozen=True, slots=True, eq=False)
class BodyState:
    """All estimated quantities. shift: by camera, time error (V,) of each view [s]. sigma: (cameras,) noise [px].
    jitter: (cameras,) std of the time errors [s], 0 = none. scatter: by body, stds (7,) of the path's third
    differences; None on a shared clock."""

    cameras: tuple[CameraState, ...]
    bodies: tuple[BodyMotion, ...]
    shift: tuple[Floats, ...]
    sigma: Floats
    jitter: Floats
    scatter: tuple[Floats | None, ...] = ()
    steps: tuple[AdjustmentStep, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class CameraRows:
    """Linearised rows of one camera at a state.

    evaluation: residuals of its n rows. index: (V,) first path parameter of each view. weights, slopes: (n, 4) of the
    four control points. pose_jacobian: (n, 3, 7) of the point by the interpolated pose. weight: (n,) information.
    """

    evaluation: ResidualEvaluation
    index: Ints
    weights: Floats
    slopes: Floats
    pose_jacobian: Floats
    weight: Floats


@dataclass(slots=True, eq=False)
class ReducedSystem:
    """Normal equations without the time errors. band: lower, (28, path). border: (path, cameras' columns)."""

    band: Floats
    border: Floats
    corner: Floats
    gradient_path: Floats
    gradient_cameras: Floats


@dataclass(frozen=True, slots=True, eq=False)
class ViewTerms:
    """Of one camera's V views: sums over their rows of gradients and of products with the time error.

    path: (V, 28) gradient, camera: (V, c). time_path: (V, 28), time_camera: (V, c), time_gradient: (V,), time: (V,)
    second derivative by the time error, with its prior; inf where there is none.
    """

    path: Floats
    camera: Floats
    time_path: Floats
    time_camera: Floats
    time_gradient: Floats
    time: Floats


def adjust_bodies(problem: BodyProblem, state: BodyState) -> tuple[BodyProblem, BodyState]:
    """The adjusted state, and the problem with the rows that fit marked."""
    for round_ in range(_ROUNDS):
        robust = round_ < _ROUNDS - 1
        state = replace(state, scatter=_scatters(state))
        state = _minimise(problem, state, robust)
        state = replace(state, sigma=_noise(problem, state))
        stage = "robust" if robust else "fitting rows"
        rms = float(np.sqrt(np.mean(state.sigma**2)))
        state = replace(state, steps=(*state.steps, AdjustmentStep(stage, rms)))
        if round_ >= 1:
            state = replace(state, jitter=_jitters(problem, state))
        if round_ == _ROUNDS - 2:
            problem = mark_inliers(problem, state)
    return problem, replace(state, sigma=_noise(problem, state))


def initial_jitter(problem: BodyProblem) -> Floats:
    """Prior stds (cameras,) of the time errors [s] before they are estimated."""
    return np.array(
        [_JITTER_START * frame_interval(views) if problem.clock else 0.0 for views in problem.views], dtype=np.float64
    )


def frame_interval(views: CameraViews) -> float:
    """Median time between the views of a body [s]."""
    steps = np.diff(views.time)[np.diff(views.body) == 0]
    return float(np.median(steps)) if len(steps) else 1.0


def mark_inliers(problem: BodyProblem, state: BodyState) -> BodyProblem:
    """The problem with only the rows within the outlier limit in use."""
    use = []
    for camera in range(len(problem.views)):
        residual = linearised_rows(problem, state, camera, False).evaluation
        norm = np.hypot(*residual.residual)
        use.append(residual.valid & (norm < _OUTLIER * state.sigma[camera]))
    return replace(problem, use=tuple(use))


def residuals(problem: BodyProblem, state: BodyState, camera: int) -> tuple[Floats, Bools]:
    """Residuals (n, 2) [px], predicted minus observed, of all rows of a camera, and which count (n,)."""
    found = linearised_rows(problem, state, camera, False).evaluation
    return found.residual.T, problem.use[camera] & found.valid


def _minimise(problem: BodyProblem, state: BodyState, robust: bool) -> BodyState:
    damping = 1e-4
    rows = [linearised_rows(problem, state, camera, robust) for camera in range(len(problem.views))]
    cost = _cost(problem, state, rows, robust)
    for _ in range(_STEPS):
        system, terms = assemble(problem, state, rows)
        improved = False
        while damping < 1e8:
            trial = _step(problem, state, system, terms, damping)
            if trial is not None:
                trial_rows = [linearised_rows(problem, trial, camera, robust) for camera in range(len(problem.views))]
                value = _cost(problem, trial, trial_rows, robust)
                if np.isfinite(value) and value < cost:
                    improved = True
                    break
            damping *= 10.0
        if not improved:
            break
        gain, cost = cost - value, value
        state, rows = trial or state, trial_rows
        damping = max(damping / 10.0, 1e-10)
        if gain < _TOLERANCE * cost:
            break
    return state


def linearised_rows(problem: BodyProblem, state: BodyState, camera: int, robust: bool) -> CameraRows:
    """A camera's rows at a state."""
    views, now = problem.views[camera], state.cameras[camera]
    reference = now.reference_time(views.time) + state.shift[camera]
    count = len(views.time)
    index, inside = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.bool_)
    weights, slopes, control = np.zeros((count, SUPPORT)), np.zeros((count, SUPPORT)), np.zeros((count, SUPPORT, POSE))
    first = 0
    for number, body in enumerate(state.bodies):
        mine = views.body == number
        if mine.any():
            at, weight, slope, defined = body.support(reference[mine])
            index[mine], weights[mine], slopes[mine], inside[mine] = POSE * (at + first), weight, slope, defined
            control[mine] = body.control[at[:, None] + np.arange(SUPPORT)]
        first += len(body.control)
    # Rows of a rolling shutter are read at other times than the middle row: the view's pose moves on at its velocity.
    late = problem.readout[camera] * now.row_offset(views.pixels) * now.rate
    row_weights = weights[views.view] + late[:, None] * slopes[views.view]
    pose = np.einsum("nk,nkp->np", row_weights, control[views.view])
    velocity = np.einsum("vk,vkp->vp", slopes, control)[views.view]
    turned, by_quaternion = rotated(pose[:, 3:], views.points)
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
    weight = information / (1.0 + squared / _CAUCHY**2) if robust else np.full(len(pose), information)
    weight = np.where(found.valid & problem.use[camera], weight, 0.0)
    return CameraRows(found, index, row_weights, slopes[views.view], pose_jacobian, weight)


def _cost(problem: BodyProblem, state: BodyState, rows: list[CameraRows], robust: bool) -> float:
    gross = _CAUCHY**2 * np.log1p((100.0 / _CAUCHY) ** 2) if robust else 100.0**2
    total = 0.0
    for camera, one in enumerate(rows):
        squared = (one.evaluation.residual**2).sum(axis=0) / state.sigma[camera] ** 2
        loss = _CAUCHY**2 * np.log1p(squared / _CAUCHY**2) if robust else squared
        total += float(np.where(one.evaluation.valid, loss, gross)[problem.use[camera]].sum())
        if state.jitter[camera] > 0.0:
            total += float(((state.shift[camera] / state.jitter[camera]) ** 2).sum())
    total += sum((value / std) ** 2 for _, _, value, std in _camera_priors(problem, state))
    for body, scatter in zip(state.bodies, state.scatter, strict=True):
        total += float((((body.control[:, 3:] ** 2).sum(axis=1) - 1.0) ** 2).sum()) / _NORM_STD**2
        if scatter is not None and isinstance(body.basis, SplineBasis):
            total += float(((_third_differences(body) / scatter) ** 2).sum())
    return total


def _camera_priors(problem: BodyProblem, state: BodyState) -> list[tuple[int, int, float, float]]:
    """Camera, column, difference and std of every prior on rates and lenses."""
    out: list[tuple[int, int, float, float]] = []
    for camera, (now, nominal) in enumerate(zip(state.cameras, problem.nominal, strict=True)):
        if problem.clock and camera != problem.reference:
            out.append((camera, RATE, now.rate - 1.0, _RATE_STD))
        if not problem.free_lens[camera]:
            continue
        lens = now.intrinsics
        side = max(lens.width, lens.height)
        centre = np.array([0.5 * (lens.width - 1), 0.5 * (lens.height - 1)])
        off = lens.matrix[:2, 2] - centre
        aspect = np.log(lens.matrix[1, 1] / lens.matrix[0, 0])
        d = lens.distortions
        values = {
            CENTRE: off[0],
            CENTRE + 1: off[1],
            ASPECT: aspect,
            K1: d[0],
            K2: d[1],
            K3: d[2 if lens.fisheye else 4],
        }
        if not lens.fisheye:
            values |= {P1: d[2], P1 + 1: d[3]}
        out += [
            (camera, column, float(value), _PRIOR_STD.get(column, _CENTRE_STD * side))
            for column, value in values.items()
        ]
        out.append((camera, FOCAL, float(np.log(lens.focal / nominal.focal)), 1.0))
    return out


def _third_differences(body: BodyMotion) -> Floats:
    """(m, 7) over every knot interval of a spline."""
    first = body.basis.interval_starts()
    c = body.control
    return np.asarray(c[first + 3] - 3.0 * c[first + 2] + 3.0 * c[first + 1] - c[first])


def _scatters(state: BodyState) -> tuple[Floats | None, ...]:
    """Stds (7,) of the third differences of each body's path, for its smoothness prior."""
    out: list[Floats | None] = []
    for body in state.bodies:
        if not isinstance(body.basis, SplineBasis):
            out.append(None)
            continue
        third = _third_differences(body)
        place, turn = (float(np.sqrt(np.mean(part**2))) for part in (third[:, :3], third[:, 3:]))
        extent = max(float(np.ptp(body.control[:, :3], axis=0).max()), 1e-9)
        out.append(np.r_[np.full(3, max(place, _MIN_PRIOR * extent)), np.full(4, max(turn, _MIN_PRIOR))])
    return tuple(out)


def assemble(problem: BodyProblem, state: BodyState, rows: list[CameraRows]) -> tuple[ReducedSystem, list[ViewTerms]]:
    """Normal equations over the bodies' paths and the cameras, without the time errors."""
    columns = [problem.columns(camera) for camera in range(len(rows))]
    starts = np.r_[0, np.cumsum([len(one) for one in columns])].astype(int)
    size = POSE * sum(len(body.control) for body in state.bodies)
    system = ReducedSystem(
        np.zeros((BLOCK, size)),
        np.zeros((size, starts[-1])),
        np.zeros((starts[-1], starts[-1])),
        np.zeros(size),
        np.zeros(starts[-1]),
    )
    terms = []
    for camera, one in enumerate(rows):
        mine = slice(starts[camera], starts[camera + 1])
        terms.append(_add_camera(system, problem, state, camera, one, columns[camera], mine))
    _add_priors(system, problem, state, columns, starts)
    return system, terms


def _add_camera(
    system: ReducedSystem,
    problem: BodyProblem,
    state: BodyState,
    camera: int,
    rows: CameraRows,
    columns: list[int],
    mine: slice,
) -> ViewTerms:
    """Add one camera's rows, with the time errors of its views eliminated."""
    view, count = problem.views[camera].view, len(problem.views[camera].time)
    now = state.cameras[camera]
    # (2, 3 + columns, n): by the point, by the camera; the last column is the time's.
    by_point = jacobians(rows.evaluation, now, [*columns, OFFSET])
    point, by_camera = by_point[:, :3].transpose(2, 0, 1), by_point[:, 3:].transpose(2, 0, 1)
    by_pose = point @ rows.pose_jacobian  # (n, 2, 7)
    by_path = (rows.weights[:, None, :, None] * by_pose[:, :, None, :]).reshape(len(view), 2, BLOCK)
    residual = rows.evaluation.residual.T[:, :, None]
    full = np.concatenate([by_path, by_camera, residual], axis=2)
    moments = _moments(full, rows.weight, view, count)  # (V, m, m)
    c = len(columns)
    time, last = BLOCK + c, BLOCK + c + 1
    curvature = np.full(count, np.inf)
    time_gradient = np.zeros(count)
    if state.jitter[camera] > 0.0:
        prior = 1.0 / state.jitter[camera] ** 2
        curvature = moments[:, time, time] + prior
        time_gradient = moments[:, time, last] + prior * state.shift[camera]
    path_path = moments[:, :BLOCK, :BLOCK]
    time_path, time_camera = moments[:, time, :BLOCK], moments[:, time, BLOCK:time]
    scaled_path, scaled_camera = time_path / curvature[:, None], time_camera / curvature[:, None]
    path_path = path_path - scaled_path[:, :, None] * time_path[:, None, :]
    path_camera = moments[:, :BLOCK, BLOCK:time] - scaled_path[:, :, None] * time_camera[:, None, :]
    camera_camera = moments[:, BLOCK:time, BLOCK:time].sum(axis=0) - scaled_camera.T @ time_camera
    gradient_path = moments[:, :BLOCK, last] - scaled_path * time_gradient[:, None]
    gradient_camera = moments[:, BLOCK:time, last] - scaled_camera * time_gradient[:, None]
    order = np.argsort(rows.index, kind="stable")
    place, first = np.unique(rows.index[order], return_index=True)
    block = np.add.reduceat(path_path[order], first, axis=0)
    for i in range(BLOCK):
        for j in range(i + 1):
            system.band[i - j, place + j] += block[:, i, j]
    border = np.add.reduceat(path_camera[order], first, axis=0)
    gradient = np.add.reduceat(gradient_path[order], first, axis=0)
    for i in range(BLOCK):
        system.border[place + i, mine] += border[:, i]
        system.gradient_path[place + i] += gradient[:, i]
    system.corner[mine, mine] += camera_camera
    system.gradient_cameras[mine] += gradient_camera.sum(axis=0)
    return ViewTerms(gradient_path, gradient_camera, time_path, time_camera, time_gradient, curvature)


def _moments(full: Floats, weight: Floats, view: Ints, count: int) -> Floats:
    """Sums over the rows of each view (count, m, m) of the weighted products of ``full`` (n, 2, m)."""
    each = np.bincount(view, minlength=count)
    place = np.arange(len(view)) - np.r_[0, np.cumsum(each)][:-1][view]
    width = full.shape[2]
    padded = np.zeros((count, int(each.max(initial=1)), 2, width))
    padded[view, place] = full * np.sqrt(weight)[:, None, None]
    flat = padded.reshape(count, -1, width)
    return np.asarray(np.matmul(flat.transpose(0, 2, 1), flat))


def _add_priors(
    system: ReducedSystem, problem: BodyProblem, state: BodyState, columns: list[list[int]], starts: Ints
) -> None:
    for camera, column, difference, std in _camera_priors(problem, state):
        if column in columns[camera]:
            place = int(starts[camera]) + columns[camera].index(column)
            system.corner[place, place] += 1.0 / std**2
            system.gradient_cameras[place] += difference / std**2
    third = np.array([-1.0, 3.0, -3.0, 1.0])
    first = 0
    for body, scatter in zip(state.bodies, state.scatter, strict=True):
        quaternion = body.control[:, 3:]
        off = (quaternion**2).sum(axis=1) - 1.0
        at = POSE * (first + np.arange(len(quaternion))) + 3
        for i in range(4):
            system.gradient_path[at + i] += 2.0 * quaternion[:, i] * off / _NORM_STD**2
            for j in range(i + 1):
                system.band[i - j, at + j] += 4.0 * quaternion[:, i] * quaternion[:, j] / _NORM_STD**2
        # Unseen instants would leave the system singular.
        system.band[0, POSE * first : POSE * (first + len(quaternion))] += 1e-9
        if scatter is not None and isinstance(body.basis, SplineBasis):
            begin = body.basis.interval_starts()
            value = _third_differences(body)
            for p in range(POSE):
                for i in range(SUPPORT):
                    np.add.at(
                        system.gradient_path, POSE * (first + begin + i) + p, third[i] * value[:, p] / scatter[p] ** 2
                    )
                    for j in range(i + 1):
                        at_j = POSE * (first + begin + j) + p
                        np.add.at(system.band[POSE * (i - j)], at_j, third[i] * third[j] / scatter[p] ** 2)
        first += len(quaternion)


def _step(
    problem: BodyProblem, state: BodyState, system: ReducedSystem, terms: list[ViewTerms], damping: float
) -> BodyState | None:
    """The state after a damped step; None where the system is singular."""
    band = system.band.copy()
    band[0] *= 1.0 + damping
    corner = system.corner + np.diag(damping * np.diag(system.corner))
    try:
        solved = solveh_banded(band, np.column_stack([system.border, system.gradient_path]), lower=True)
        reduced = corner - system.border.T @ solved[:, :-1]
        gradient = system.gradient_cameras - system.border.T @ solved[:, -1]
        camera_step = -np.linalg.solve(reduced, gradient) if len(gradient) else gradient
    except np.linalg.LinAlgError:
        return None
    path_step = -(solved[:, -1] + solved[:, :-1] @ camera_step)
    cameras, shifts = [], []
    at = 0
    for camera, now in enumerate(state.cameras):
        columns = problem.columns(camera)
        mine = camera_step[at : at + len(columns)]
        at += len(columns)
        full = np.zeros(CAMERA_PARAMETERS)
        full[columns] = mine
        cameras.append(apply_camera_step(now, full))
        term = terms[camera]
        if state.jitter[camera] > 0.0:
            index = view_index(problem, state, camera)
            local = path_step[index[:, None] + np.arange(BLOCK)]
            pull = term.time_gradient + (term.time_path * local).sum(axis=1) + term.time_camera @ mine
            shifts.append(state.shift[camera] - pull / term.time)
        else:
            shifts.append(state.shift[camera])
    bodies, at = [], 0
    for body in state.bodies:
        size = body.control.size
        bodies.append(replace(body, control=body.control + path_step[at : at + size].reshape(-1, POSE)))
        at += size
    return replace(state, cameras=tuple(cameras), bodies=tuple(bodies), shift=tuple(shifts))


def view_index(problem: BodyProblem, state: BodyState, camera: int) -> Ints:
    """First path parameter (V,) of each view."""
    views, now = problem.views[camera], state.cameras[camera]
    reference = now.reference_time(views.time) + state.shift[camera]
    index, first = np.zeros(len(views.time), dtype=np.int64), 0
    for number, body in enumerate(state.bodies):
        mine = views.body == number
        if mine.any():
            index[mine] = POSE * (body.support(reference[mine])[0] + first)
        first += len(body.control)
    return index


def _noise(problem: BodyProblem, state: BodyState) -> Floats:
    """Robust noise (cameras,) of one pixel coordinate, from the median residual.

    One for all cameras on a shared clock: separate ones would let the body follow one camera alone at every instant.
    """
    norms = []
    for camera in range(len(problem.views)):
        values, good = residuals(problem, state, camera)
        norms.append(np.hypot(*values[good].T))
    if not problem.clock:
        joined = np.concatenate(norms)
        unknown = 6 * sum(len(body.control) for body in state.bodies)
        freedom = max(2 * len(joined) - unknown, 0.1 * len(joined))
        pooled = float(np.median(joined)) / 1.1774 * float(np.sqrt(2 * len(joined) / freedom))
        return np.full(len(norms), max(_MIN_SIGMA_PX, pooled))
    return np.array(
        [
            max(_MIN_SIGMA_PX, float(np.median(values)) / 1.1774) if len(values) >= 8 else before
            for values, before in zip(norms, state.sigma, strict=True)
        ]
    )


def _jitters(problem: BodyProblem, state: BodyState) -> Floats:
    """Stds (cameras,) of the views' time errors: their squares over the number of them that the data determine.

    MacKay, "Bayesian interpolation", 1992, equation 4.8.
    """
    out = state.jitter.copy()
    for camera in range(len(problem.views)):
        if out[camera] <= 0.0:
            continue
        rows = linearised_rows(problem, state, camera, False)
        time = jacobians(rows.evaluation, state.cameras[camera], [OFFSET])[:, 3]
        information = np.bincount(
            problem.views[camera].view, (time**2).sum(axis=0) * rows.weight, minlength=len(state.shift[camera])
        )
        seen = information > 0
        if not seen.any():
            continue
        known = information[seen] / (information[seen] + 1.0 / out[camera] ** 2)
        value = float(np.sqrt((state.shift[camera][seen] ** 2).sum() / max(float(known.sum()), 1.0)))
        out[camera] = value if value > _MIN_JITTER else 0.0
    return out
