"""Bundle adjustment of cameras around moving rigid bodies of known geometry.

Levenberg-Marquardt on the reprojection error of the bodies' points, each view at its own time: the body moves on a
spline of its pose (one pose an instant on a shared clock). Where clocks are independent, every view may have a time
error of its own, with a prior whose std is estimated from the data: webcams stamp frames when they are read. These
time errors are eliminated first, the bodies' poses next (a banded system), the cameras last.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import solveh_banded

from hub.bundle.adjustment import apply_camera_step
from hub.bundle.bordered_system import third_differences
from hub.bundle.problem import CAMERA_PARAMETERS
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
from hub.calibration.rigid_body.motion import POSE
from hub.calibration.rigid_body.noise import jitters, mark_inliers, noise, scatters, shape_stds
from hub.calibration.rigid_body.problem import BodyProblem, BodyState
from hub.trajectory.splines import SplineBasis
from protocols.session.calibration import AdjustmentStep

_ROUNDS, _STEPS = 5, 20  # of noise estimates; Levenberg-Marquardt steps in each
_TOLERANCE = 1e-5  # relative decrease of the cost at which it has converged


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
