"""Re-fit of the adjustment where residuals are autocorrelated: generalised least squares with Gauss-Markov noise.

Where residuals are correlated from frame to frame, the adjustment is repeated by generalised least squares (`gls`).
Lens errors have the same appearance: on request all lens parameters are estimated too, under priors for how far given
intrinsics may be off. With independent rows a free lens absorbs the detector's errors; with correlated noise and only
two free parameters a lens, those two absorb the errors of its other parameters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hub.bundle.covariance import CameraCovariance, relative_rotation_stds
from hub.bundle.gls import GlsSolution, is_tractable, solve_gls
from hub.bundle.noise.gauss_markov import estimate_correlated_noise
from hub.bundle.noise.noise_scale import correlation_inflation, with_noise
from hub.bundle.normal_equations import camera_priors
from hub.bundle.problem import CAMERA_PARAMETERS, AdjustmentState, Column, LensPrior, Problem
from hub.bundle.smoothness_prior import estimate_smoothness
from hub.trajectory.discrete import PointBasis
from protocols.geometry.camera import Intrinsics
from protocols.session.calibration import AdjustmentStep

MIN_INFLATION = 4.0
"""Variance inflation by autocorrelation (rows per effective row) from which the noise is modelled as correlated. With
lenses that were not measured any significant one counts: what a path absorbs of a detector's slow errors, its residuals
do not show, and weak directions of these lenses follow it against their priors."""
_MAX_ROTATION_STD = 0.0175
"""Std [rad] of a camera's orientation above which correlated errors and trajectory cannot be distinguished."""


def lens_tolerance(lens: Intrinsics) -> LensPrior:
    """Prior for how far measured intrinsics may be off in the field: play of a zoom, a crop, an image stabiliser."""
    return LensPrior(
        focal=lens.focal,
        focal_std=0.01,
        centre=(float(lens.matrix[0, 2]), float(lens.matrix[1, 2])),
        centre_std=lens.width / 240.0,
        k1=float(lens.distortions[0]),
        k1_std=0.012,
        k2=float(lens.distortions[1]),
        k2_std=0.02,
        k3_std=0.005,
        tangential_std=1e-3,
        aspect_std=1e-3,
    )


def refit_with_correlated_noise(
    problem: Problem, state: AdjustmentState, refine_lenses: bool = False, min_inflation: float = MIN_INFLATION
) -> tuple[Problem, AdjustmentState]:
    """Problem and state after the re-fit where residuals are autocorrelated; otherwise both unchanged.

    problem, state: adjusted. refine_lenses: whether measured lenses may change within their tolerance. Both are also
    unchanged where poses are given, where clocks are shared, where frame times were estimated, where the recording is
    too long (`gls.is_tractable`), and where the re-fit would leave the std of a camera's orientation above 1°.
    """
    excluded = state.jitter is not None or not problem.free_parameters.clock or not problem.free_parameters.pose
    if excluded or any(isinstance(path.basis, PointBasis) for path in state.trajectories):
        return problem, state
    unmeasured = any(prior is not None for prior in problem.lens_priors)
    inflation = float(correlation_inflation(problem, state).max())
    if inflation <= 1.0 if unmeasured else inflation < min_inflation:
        return problem, state
    noise_model = estimate_correlated_noise(problem, state)
    if not is_tractable(problem, noise_model):
        return problem, state
    nominal_problem = replace(problem, free_parameters=replace(problem.free_parameters, lens=False))
    tolerances = tuple(lens_tolerance(lens) for lens in problem.nominal) if refine_lenses else ()
    found = replace(nominal_problem, lens_tolerances=tolerances)
    try:
        best = solve_gls(found, state, estimate_smoothness(found, state), noise_model)
        if refine_lenses and prefers_nominal_lenses(found, best):
            # The state may have been adjusted with other lenses, and its residuals contain their errors.
            found, start = nominal_problem, _with_nominal_lenses(nominal_problem, state)
            best = solve_gls(found, start, estimate_smoothness(found, start), noise_model)
        if unmeasured or (found is nominal_problem and refine_lenses):
            noise_model = estimate_correlated_noise(found, best.state)
            best = solve_gls(found, best.state, estimate_smoothness(found, best.state), noise_model)
        rotation_std = _largest_rotation_std(found, best)
    except np.linalg.LinAlgError:
        return problem, state
    if not (np.isfinite(best.cost) and rotation_std <= _MAX_ROTATION_STD):
        return problem, state
    prior = estimate_smoothness(found, best.state)
    refitted = replace(with_noise(found, best.state, prior), correlated_noise=noise_model)
    step = AdjustmentStep("correlated noise", float(np.sqrt(np.mean(refitted.sigma**2))))
    return found, replace(refitted, steps=(*refitted.steps, step))


def _with_nominal_lenses(problem: Problem, state: AdjustmentState) -> AdjustmentState:
    cameras = (
        camera if problem.lens_prior(i) is not None else replace(camera, intrinsics=problem.nominal[i])
        for i, camera in enumerate(state.cameras)
    )
    return replace(state, cameras=tuple(cameras))


def _largest_rotation_std(problem: Problem, best: GlsSolution) -> float:
    """Largest over the cameras of the smallest relative rotation std [rad] to any other camera."""
    covariance = CameraCovariance(problem.free_columns, len(best.state.cameras), best.free)
    stds = relative_rotation_stds(covariance, best.state)
    np.fill_diagonal(stds, np.inf)
    return float(stds.min(axis=1).max())


def prefers_nominal_lenses(problem: Problem, best: GlsSolution) -> bool:
    """Whether exactly nominal lenses have a higher marginal likelihood than lenses free within their tolerance.

    problem: with lens tolerances. The Bayes factor is the Savage-Dickey density ratio: prior over posterior density at
    zero lens offset, both taken as Gaussian.
    """
    columns = problem.free_columns
    terms = {
        column: (value, std)
        for column, value, std in camera_priors(problem, best.state)
        if column % CAMERA_PARAMETERS in Column.LENS
        and not (problem.lens_priors and problem.lens_priors[column // CAMERA_PARAMETERS] is not None)
    }
    if not terms:
        return False  # no lens was given
    lens_rows = np.array([i for i, column in enumerate(columns) if int(column) in terms], dtype=np.int64)
    offset, std = np.array([terms[int(columns[i])] for i in lens_rows]).T
    posterior = best.free.submatrix(lens_rows)
    quadratic = float(offset @ np.linalg.solve(posterior, offset))
    return bool(quadratic + np.linalg.slogdet(posterior)[1] < 2.0 * np.log(std).sum())
