"""Bundle adjustment of cameras around moving rigid bodies of known geometry; its noise and its covariances.

Levenberg-Marquardt on the reprojection error of the bodies' points, each view at its own time: the body moves on a
spline of its pose (one pose an instant on a shared clock). Where clocks are independent, every view may have a time
error of its own, with a prior whose std is estimated from the data: webcams stamp frames when they are read. These
time errors are eliminated first, the bodies' poses next (a banded system), the cameras last.

Errors of the corners of one view are correlated (a bent board, a lens that is not exactly known), and those of
neighbouring views too. Where the scatter of the views' gradients, summed over clusters of views, is larger than what
independent rows would give, the stds are enlarged to it (the sandwich estimator: White, "Maximum likelihood estimation
of misspecified models", 1982).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solveh_banded
from scipy.special import chdtri

from hub.bundle.adjustment import apply_camera_step
from hub.bundle.bordered_system import third_differences
from hub.bundle.problem import CAMERA_PARAMETERS, Column
from hub.bundle.residuals import jacobians
from hub.calibration.rigid_body.linear_system import (
    BLOCK,
    CAUCHY,
    NORM_STD,
    CameraRows,
    ReducedSystem,
    ViewTerms,
    assemble,
    camera_priors,
    linearised_rows,
    view_index,
)
from hub.calibration.rigid_body.problem import POSE, BodyMotion, BodyProblem, BodyState, frame_interval, pitch, rotated
from hub.trajectory.discrete import PointBasis
from hub.trajectory.splines import SUPPORT, SplineBasis
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.calibration import AdjustmentStep

_ROUNDS, _STEPS = 5, 20  # of noise estimates; Levenberg-Marquardt steps in each
_TOLERANCE = 1e-5  # relative decrease of the cost at which it has converged

_CLUSTER_VIEWS, _CLUSTER_S = 3, 0.5
"""Views, and seconds, whose errors count as one."""
_WINDOW = 4  # control points on each side that the std of a pose is computed from
_OUTLIER = 5.0  # sigma of the 2-D residual
_MIN_SIGMA_PX = 0.03  # the best corner detectors reach 0.05 px
_JITTER_QUANTILE = 0.999  # of chi-squared: time errors that noise of the image alone explains are none
_MIN_SHAPE = 1e-5  # of the distance of neighbouring points
_MIN_PRIOR = 1e-4  # of a path's scatter


def adjust_bodies(problem: BodyProblem, state: BodyState) -> tuple[BodyProblem, BodyState]:
    """The adjusted state, and the problem with the rows that fit marked."""
    for round_ in range(_ROUNDS):
        robust = round_ < _ROUNDS - 1
        state = replace(state, scatter=scatters(state))
        state = _minimise(problem, state, robust)
        state = replace(state, sigma=noise(problem, state))
        stage = "robust" if robust else "fitting rows"
        rms = float(np.sqrt(np.mean(state.sigma**2)))
        state = replace(state, steps=(*state.steps, AdjustmentStep(stage, rms)))
        if 1 <= round_ < _ROUNDS - 1:
            state = replace(state, jitter=jitters(problem, state), shape_std=shape_stds(problem, state))
            # Frames that come evenly have no time errors: what was fitted to noise must not stay.
            shifts = zip(state.shift, state.jitter, strict=True)
            state = replace(state, shift=tuple(shift if std > 0.0 else np.zeros(len(shift)) for shift, std in shifts))
        if round_ == _ROUNDS - 2:
            problem = mark_inliers(problem, state)
    return problem, replace(state, sigma=noise(problem, state))


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
        damping = max(damping / 10.0, 1e-12)
        if gain < _TOLERANCE * cost:
            break
    return state


def _cost(problem: BodyProblem, state: BodyState, rows: list[CameraRows], robust: bool) -> float:
    gross = CAUCHY**2 * np.log1p((100.0 / CAUCHY) ** 2) if robust else 100.0**2
    total = 0.0
    for camera, one in enumerate(rows):
        squared = (one.evaluation.residual**2).sum(axis=0) / state.sigma[camera] ** 2
        loss = CAUCHY**2 * np.log1p(squared / CAUCHY**2) if robust else squared
        total += float(np.where(one.evaluation.valid, loss, gross)[problem.use[camera]].sum())
        if state.jitter[camera] > 0.0:
            total += float(((state.shift[camera] / state.jitter[camera]) ** 2).sum())
    total += sum((value / std) ** 2 for _, _, value, std in camera_priors(problem, state))
    if problem.free_shape:
        total += float(((state.shape / state.shape_std) ** 2).sum())
    for body, scatter in zip(state.bodies, state.scatter, strict=True):
        total += float((((body.control[:, 3:] ** 2).sum(axis=1) - 1.0) ** 2).sum()) / NORM_STD**2
        if scatter is not None and isinstance(body.basis, SplineBasis):
            total += float(((third_differences(body.basis, body.control) / scatter) ** 2).sum())
    return total


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
    for camera, now in enumerate(state.cameras):
        columns = problem.columns(camera)
        mine = camera_step[terms[camera].columns]
        full = np.zeros(CAMERA_PARAMETERS)
        full[columns] = mine[: len(columns)]
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
    shape = state.shape
    if problem.free_shape:
        shape = shape + camera_step[-shape.size :].reshape(-1, 3)
    return replace(state, cameras=tuple(cameras), bodies=tuple(bodies), shift=tuple(shifts), shape=shape)


@dataclass(frozen=True, slots=True, eq=False)
class BodyCovariance:
    """cameras: (18 n, 18 n), zero where a parameter is fixed. inflation: of stds, the cameras' median one."""

    cameras: Floats
    inflation: float
    system: ReducedSystem

    def std(self, camera: int, column: int) -> float:
        """Std of one parameter of a camera."""
        return float(np.sqrt(max(self.block(camera)[column, column], 0.0)))

    def block(self, camera: int) -> Floats:
        """(18, 18) covariance of one camera's parameters."""
        part = slice(camera * CAMERA_PARAMETERS, (camera + 1) * CAMERA_PARAMETERS)
        return self.cameras[part, part]


def body_covariance(problem: BodyProblem, state: BodyState) -> BodyCovariance:
    """The cameras' covariance at an adjusted state."""
    rows = [linearised_rows(problem, state, camera, False) for camera in range(len(problem.views))]
    system, terms = assemble(problem, state, rows)
    path = solveh_banded(system.band, system.border, lower=True)
    reduced = np.linalg.pinv(system.corner - system.border.T @ path, hermitian=True)
    scatter = _gradient_scatter(problem, state, terms, path)
    sandwich = reduced @ scatter @ reduced
    ratio = np.sqrt(np.maximum(np.diag(sandwich) / np.maximum(np.diag(reduced), 1e-300), 1.0))
    enlarged = reduced * ratio[:, None] * ratio[None, :]
    columns = np.concatenate(
        [camera * CAMERA_PARAMETERS + np.array(problem.columns(camera), dtype=int) for camera in range(len(rows))]
    ).astype(int)
    full = np.zeros((CAMERA_PARAMETERS * len(rows),) * 2)
    full[np.ix_(columns, columns)] = enlarged[: len(columns), : len(columns)]
    for camera, jitter in enumerate(state.jitter):
        # A clock is that of the mean time stamp, which is known as well as the mean of so many time errors.
        at = camera * CAMERA_PARAMETERS + Column.OFFSET
        for one in {camera, problem.reference}:
            extra = float(state.jitter[one]) ** 2 / max(len(problem.views[one].time), 1)
            full[at, at] += extra if camera != problem.reference and jitter >= 0.0 else 0.0
    return BodyCovariance(full, float(np.median(ratio)) if len(ratio) else 1.0, system)


def _gradient_scatter(problem: BodyProblem, state: BodyState, terms: list[ViewTerms], path: Floats) -> Floats:
    """Sum over clusters of views of the outer products of their gradients, without the paths' part."""
    total = np.zeros((path.shape[1], path.shape[1]))
    for camera, term in enumerate(terms):
        index = view_index(problem, state, camera)
        score = -np.einsum("vp,vpc->vc", term.path, path[index[:, None] + np.arange(BLOCK)])
        score[:, term.columns] += term.camera
        views = problem.views[camera]
        span = max(_CLUSTER_S, _CLUSTER_VIEWS * frame_interval(views))
        cluster = np.unique(np.floor((views.time - views.time.min()) / span), return_inverse=True)[1]
        sums = np.zeros((int(cluster.max()) + 1, score.shape[1]))
        np.add.at(sums, cluster, score)
        total += sums.T @ sums
    return total


@dataclass(frozen=True, slots=True, eq=False)
class PathCovariance:
    """Covariances (i, 28, 28) of a body's path by knot interval, with the cameras as they are. index: (i,) sorted
    first control points of the intervals that have one."""

    motion: BodyMotion
    index: Ints
    blocks: Floats

    def point_stds(self, point: Floats, time: Floats) -> Floats:
        """Stds (n,) of one axis of a point (3,) of the body at internal times (n,) within these intervals."""
        at, weights, _, _ = self.motion.support(time)
        pose = np.einsum("nk,nkp->np", weights, self.motion.control[at[:, None] + np.arange(SUPPORT)])
        by_quaternion = rotated(pose[:, 3:], np.tile(point, (len(time), 1)))[1]
        jacobian = np.concatenate([np.broadcast_to(np.eye(3), (len(time), 3, 3)), by_quaternion], axis=2)
        by_path = (weights[:, None, :, None] * jacobian[:, :, None, :]).reshape(len(time), 3, BLOCK)
        blocks = self.blocks[np.searchsorted(self.index, at)]
        variance = np.einsum("nip,npq,niq->n", by_path, blocks, by_path, optimize=True) / 3.0
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def path_covariance(state: BodyState, covariance: BodyCovariance, body: int, time: Floats) -> PathCovariance:
    """The path's covariances in the knot intervals of internal times (n,), each from a window of the path around it."""
    motion = state.bodies[body]
    first = sum(len(one.control) for one in state.bodies[:body])
    reach = 0 if isinstance(motion.basis, PointBasis) else _WINDOW
    index = np.unique(motion.support(time)[0])
    blocks = np.zeros((len(index), BLOCK, BLOCK))
    for number, at in enumerate(index.tolist()):
        low, high = max(at - reach, 0), min(at + SUPPORT + reach, len(motion.control))
        window = _dense(covariance.system.band, POSE * (first + low), POSE * (first + high))
        begin = POSE * (at - low)
        unit = np.eye(len(window))[:, begin : begin + BLOCK]
        try:
            blocks[number] = cho_solve(cho_factor(window, lower=True), unit)[begin : begin + BLOCK]
        except np.linalg.LinAlgError:
            blocks[number] = np.diag(np.full(BLOCK, np.inf))
    return PathCovariance(motion, index, covariance.inflation**2 * blocks)


def _dense(band: Floats, begin: int, end: int) -> Floats:
    """The diagonal block of a symmetric matrix in lower banded form."""
    size = end - begin
    out = np.zeros((size, size))
    for below in range(min(band.shape[0], size)):
        values = band[below, begin : end - below]
        out[np.arange(below, size), np.arange(size - below)] = values
        out[np.arange(size - below), np.arange(below, size)] = values
    return out


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


def noise(problem: BodyProblem, state: BodyState) -> Floats:
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


def jitters(problem: BodyProblem, state: BodyState) -> Floats:
    """Stds (cameras,) of the views' time errors: their squares over the number of them that the data determine.

    MacKay, "Bayesian interpolation", 1992, equation 4.8.
    """
    out = state.jitter.copy()
    for camera in range(len(problem.views)):
        if out[camera] <= 0.0:
            continue
        rows = linearised_rows(problem, state, camera, False)
        time = jacobians(rows.evaluation, state.cameras[camera], [Column.OFFSET])[:, 3]
        information = np.bincount(
            problem.views[camera].view, (time**2).sum(axis=0) * rows.weight, minlength=len(state.shift[camera])
        )
        seen = information > 0
        if not seen.any():
            continue
        known = information[seen] / (information[seen] + 1.0 / out[camera] ** 2)
        shift = state.shift[camera][seen]
        out[camera] = float(np.sqrt((shift**2).sum() / max(float(known.sum()), 1.0)))
        without_prior = (shift / known) ** 2 * information[seen]
        if without_prior.sum() <= chdtri(float(seen.sum()), 1.0 - _JITTER_QUANTILE):
            out[camera] = 0.0
    return out


def scatters(state: BodyState) -> tuple[Floats | None, ...]:
    """Stds (7,) of the third differences of each body's path, for its smoothness prior."""
    out: list[Floats | None] = []
    for body in state.bodies:
        if not isinstance(body.basis, SplineBasis):
            out.append(None)
            continue
        third = third_differences(body.basis, body.control)
        place, turn = (float(np.sqrt(np.mean(part**2))) for part in (third[:, :3], third[:, 3:]))
        extent = max(float(np.ptp(body.control[:, :3], axis=0).max()), 1e-9)
        out.append(np.r_[np.full(3, max(place, _MIN_PRIOR * extent)), np.full(4, max(turn, _MIN_PRIOR))])
    return tuple(out)


def shape_stds(problem: BodyProblem, state: BodyState) -> Floats:
    """Prior stds (3,) of the errors of a board's points, in its plane and across it, as ``jitters``."""
    if not problem.free_shape:
        return state.shape_std
    rows = [linearised_rows(problem, state, camera, False) for camera in range(len(problem.views))]
    system, _ = assemble(problem, state, rows)
    reduced = system.corner - system.border.T @ solveh_banded(system.band, system.border, lower=True)
    covariance = np.linalg.pinv(reduced, hermitian=True)
    variance = np.diag(covariance)[-state.shape.size :].reshape(-1, 3)
    known = np.clip(1.0 - variance / state.shape_std**2, 0.0, 1.0)
    out = np.empty(3)
    for axes in ([0, 1], [2]):
        out[axes] = np.sqrt((state.shape[:, axes] ** 2).sum() / max(float(known[:, axes].sum()), 1.0))
    return np.asarray(np.maximum(out, _MIN_SHAPE * pitch(problem)))
