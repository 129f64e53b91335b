"""Noise of the adjustment around rigid bodies, estimated from its residuals, and the rows that fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import solveh_banded
from scipy.special import chdtri

from hub.bundle.bordered_system import THIRD_DIFFERENCE, third_differences
from hub.calibration.rigid_body.linear_system import BLOCK, assemble, linearised_rows, local_blocks, view_index
from hub.calibration.rigid_body.problem import POSE, BodyMotion, BodyProblem, BodyState, pitch
from hub.trajectory.splines import SUPPORT, SplineBasis
from protocols.geometry.types import Bools, Floats

_OUTLIER = 5.0  # sigma of the 2-D residual
_MIN_SIGMA_PX = 0.03  # the best corner detectors reach 0.05 px
_JITTER_QUANTILE = 0.999  # of chi-squared: time errors that noise of the image alone explains are none
_MIN_KNOWN = 1e-6  # share of a time error that the data determine, and that the prior does: of less is rounding
_MIN_SHAPE = 1e-5  # of the distance of neighbouring points
_MIN_PRIOR = 1e-4  # of a path's scatter
_AXES = slice(3), slice(3, POSE)  # of a control point: position, quaternion


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


def variance_components(problem: BodyProblem, state: BodyState) -> BodyState:
    """The state with the stds of time errors, of the paths' third differences and of the errors of a board's points, in
    its plane and across it: their squares over the number of them that the data determine.

    MacKay, "Bayesian interpolation", 1992, equation 4.8. Where one camera alone sees the body, its path takes up the
    time errors: such views determine none. Where views are sparser than
    control points, third differences are what the prior makes of them.
    """
    rows = [linearised_rows(problem, state, camera, False) for camera in range(len(problem.views))]
    system, terms = assemble(problem, state, rows)
    path = solveh_banded(system.band, system.border, lower=True)
    covariance = np.linalg.pinv(system.corner - system.border.T @ path, hermitian=True)
    jitter = state.jitter.copy()
    blocks = system.inverse_blocks()
    for camera in np.flatnonzero(jitter > 0.0).tolist():
        term, prior = terms[camera], jitter[camera] ** 2
        index = view_index(problem, state, camera)
        place = index[:, None] + np.arange(BLOCK)
        by_corner = -np.einsum("vp,vpc->vc", term.time_path, path[place])
        by_corner[:, term.columns] += term.time_camera
        of_path = local_blocks(blocks, index)
        variance = np.einsum("vp,vpq,vq->v", term.time_path, of_path, term.time_path, optimize=True)
        variance += np.einsum("vc,cd,vd->v", by_corner, covariance, by_corner, optimize=True)
        known = 1.0 - (1.0 / term.time + variance / term.time**2) / prior
        seen = known > _MIN_KNOWN
        shift, known = state.shift[camera][seen], np.minimum(known[seen], 1.0 - _MIN_KNOWN)
        jitter[camera] = float(np.sqrt((shift**2).sum() / max(float(known.sum()), 1.0)))
        if (shift**2 / (known * (1.0 - known) * prior)).sum() <= chdtri(float(seen.sum()), 1.0 - _JITTER_QUANTILE):
            jitter[camera] = 0.0
    state = replace(state, jitter=jitter, scatter=_scatters(state, blocks))
    if not problem.free_shape:
        return state
    variances = np.diag(covariance)[-state.shape.size :].reshape(-1, 3)
    determined = np.clip(1.0 - variances / state.shape_std**2, 0.0, 1.0)
    shape_std = np.empty(3)
    for axes in ([0, 1], [2]):
        shape_std[axes] = np.sqrt((state.shape[:, axes] ** 2).sum() / max(float(determined[:, axes].sum()), 1.0))
    return replace(state, shape_std=np.maximum(shape_std, _MIN_SHAPE * pitch(problem)))


def _scatters(state: BodyState, blocks: Floats) -> tuple[Floats | None, ...]:
    """``scatters`` from ``ReducedSystem.inverse_blocks`` at the state."""
    out: list[Floats | None] = []
    first = 0
    for body, prior in zip(state.bodies, state.scatter, strict=True):
        if isinstance(body.basis, SplineBasis) and prior is not None:
            of_path = local_blocks(blocks, first + POSE * body.basis.interval_starts())
            of_path = of_path.reshape(-1, SUPPORT, POSE, SUPPORT, POSE)
            variance = np.einsum("a,naibi,b->ni", THIRD_DIFFERENCE, of_path, THIRD_DIFFERENCE, optimize=True)
            known = np.clip(1.0 - variance / prior**2, 0.0, 1.0)
            third = third_differences(body.basis, body.control) ** 2
            ratio = [float(third[:, axes].sum()) / max(float(known[:, axes].sum()), 1.0) for axes in _AXES]
            out.append(_scatter(body, ratio))
        else:
            out.append(None)
        first += body.control.size
    return tuple(out)


def scatters(state: BodyState) -> tuple[Floats | None, ...]:
    """Stds (7,) of the third differences of each body's path as it is, for its smoothness prior."""
    return tuple(
        _scatter(body, [float(np.mean(third_differences(body.basis, body.control)[:, axes] ** 2)) for axes in _AXES])
        if isinstance(body.basis, SplineBasis)
        else None
        for body in state.bodies
    )


def _scatter(body: BodyMotion, variances: list[float]) -> Floats:
    """Stds (7,) of variances of positions' and of quaternions' third differences."""
    place, turn = np.sqrt(variances)
    extent = max(float(np.ptp(body.control[:, :3], axis=0).max()), 1e-9)
    return np.asarray(np.repeat([max(place, _MIN_PRIOR * extent), max(turn, _MIN_PRIOR)], [3, 4]))
