"""Noise of the adjustment around rigid bodies, estimated from its residuals, and the rows that fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import solveh_banded
from scipy.special import chdtri

from hub.bundle.bordered_system import third_differences
from hub.bundle.problem import Column
from hub.bundle.residuals import jacobians
from hub.calibration.rigid_body.linear_system import assemble, linearised_rows
from hub.calibration.rigid_body.problem import BodyProblem, BodyState, pitch
from hub.trajectory.splines import SplineBasis
from protocols.geometry.types import Bools, Floats

_OUTLIER = 5.0  # sigma of the 2-D residual
_MIN_SIGMA_PX = 0.03  # the best corner detectors reach 0.05 px
_JITTER_QUANTILE = 0.999  # of chi-squared: time errors that noise of the image alone explains are none
_MIN_SHAPE = 1e-5  # of the distance of neighbouring points
_MIN_PRIOR = 1e-4  # of a path's scatter


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
