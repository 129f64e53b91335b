"""Comparison of models that differ by a few parameters: measured lenses, rolling-shutter readouts.

Both are score tests: the gain of freeing parameters is predicted by one Gauss-Newton step from the solution in which
they are fixed, with the paths and all other parameters free to follow.

A slightly wrong lens has nearly the same effect as a rolling shutter, and its errors are correlated from frame to
frame. So the gain of freeing the readouts is computed with noise scaled to the effective sample size (`noise_scale`).
On recordings whose lenses err by a pixel no gain remains, while readouts freed by plain least squares come out at -40
and +35 ms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from hub.bundle.adjustment import gauge_tangent
from hub.bundle.bordered_system import cho_solve_path, eliminate
from hub.bundle.noise_scale import correlation_inflation, modelled_inflation
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import CAMERA_PARAMETERS, CRYSTAL_RATE_STD, FOCAL, K1, RATE, READOUT, AdjustmentState, Problem
from hub.bundle.smoothness_prior import SmoothnessPrior, estimate_smoothness
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.rig import MAX_READOUT_S

_FALSE_ALARM_PROBABILITY = 1e-4
"""Probability that one of the lenses of a correct rig is refuted."""
_REFUTED_SIGMA = 4.0
"""Stds from which a rate is no crystal's: of a hundred cameras with crystals one in 160 is refuted."""
_WIDE_FOCAL_STD, _WIDE_K1_STD = 0.5, 0.2
"""Prior stds of a lens in the test: so wide that only the observations count."""


@dataclass(frozen=True, slots=True)
class LensTest:
    """Score test of one measured lens. camera: index. focal_change: by which the observations would change the focal
    length (relative), and its std. statistic: chi-squared of focal length and k1; refuted above limit."""

    camera: int
    focal_change: float
    focal_std: float
    statistic: float
    limit: float


def refuted_lenses(problem: Problem, state: AdjustmentState) -> list[LensTest]:
    """Measured lenses that the observations refute, most significant first.

    problem, state: adjusted with these lenses fixed. Forward selection: the lens whose focal length and k1 lower the
    cost most is freed, then the next one beside it, so that an honest lens is not blamed for another's error. Noise is
    scaled to the effective sample size.
    """
    if not problem.free_parameters.pose or problem.free_parameters.lens:
        return []
    cameras = range(len(state.cameras))
    given = [camera for camera in cameras if problem.lens_prior(camera) is None]
    if not given:
        return []
    wide = replace(problem.free_parameters, lens=True, focal_std=_WIDE_FOCAL_STD, k1_std=_WIDE_K1_STD)
    freed = replace(problem, free_parameters=wide)
    inflation = [
        max(correlation_inflation(problem, state, camera), modelled_inflation(problem, state, camera))
        for camera in cameras
    ]
    noisy = replace(state, sigma=state.sigma * np.sqrt(inflation))
    columns, normal, gradient = _reduced_system(freed, noisy, estimate_smoothness(problem, state))
    lens = {
        camera: np.flatnonzero(np.isin(columns, camera * CAMERA_PARAMETERS + np.array([FOCAL, K1]))) for camera in given
    }
    limit = float(chdtri(2, _FALSE_ALARM_PROBABILITY / len(given)))
    kept = np.setdiff1d(np.arange(len(columns)), np.concatenate(list(lens.values())))
    out: list[LensTest] = []
    tangent = gauge_tangent(freed, state)
    before = _reduction(normal, gradient, tangent, kept)[0]
    while len(out) < len(given):
        left = [camera for camera in given if camera not in [one.camera for one in out]]
        gains = {camera: _reduction(normal, gradient, tangent, np.union1d(kept, lens[camera])) for camera in left}
        camera = max(left, key=lambda one: gains[one][0])
        statistic = gains[camera][0] - before
        if not statistic > limit:
            break
        kept, before = np.union1d(kept, lens[camera]), gains[camera][0]
        focal = int(lens[camera][0])
        step, covariance = gains[camera][1:]
        out.append(LensTest(camera, float(step[focal]), float(np.sqrt(covariance[focal, focal])), statistic, limit))
    return out


def with_crystal_rates(problem: Problem, state: AdjustmentState) -> Problem:
    """The problem with rates held by the prior of crystals, but for those that the observations refute.

    problem, state: adjusted under the wide prior of rates. A rate is refuted where it differs from 1 by more than
    `_REFUTED_SIGMA` times the std of both the estimate and the prior: then the frame rate is another one.
    """
    if not problem.free_parameters.clock:
        return problem
    wide = replace(problem, crystal_rates=())
    inflation = [correlation_inflation(problem, state, camera) for camera in range(len(state.cameras))]
    noisy = replace(state, sigma=state.sigma * np.sqrt(inflation))
    columns, normal, gradient = _reduced_system(wide, noisy, estimate_smoothness(problem, state))
    covariance = _reduction(normal, gradient, gauge_tangent(wide, state), np.arange(len(columns)))[2]
    variance = dict(zip(columns.tolist(), np.diag(covariance).tolist(), strict=True))
    crystal = tuple(
        (camera.rate - 1.0) ** 2
        < _REFUTED_SIGMA**2 * (CRYSTAL_RATE_STD**2 + variance.get(i * CAMERA_PARAMETERS + RATE, 0.0))
        for i, camera in enumerate(state.cameras)
    )
    return replace(problem, crystal_rates=crystal)


def with_free_readouts(problem: Problem) -> Problem:
    """The problem with all readouts free that were not given."""
    return replace(problem, free_parameters=replace(problem.free_parameters, readout=True))


def are_readouts_observable(problem: Problem, state: AdjustmentState, prior: SmoothnessPrior) -> bool:
    """Whether free readouts lower the Bayesian information criterion, predicted by one step from the solution.

    state: adjusted with fixed readouts.
    """
    freed_problem = with_free_readouts(problem)
    columns = freed_problem.free_columns()
    readout_columns = columns % CAMERA_PARAMETERS == READOUT
    if not readout_columns.any():
        return False
    rows = sum(int(part.use.sum()) for part in problem.rows)
    bic_penalty = float(np.count_nonzero(readout_columns) * np.log(max(rows, 2)))
    # Scaling by the effective sample size only lowers the gain, and usually there is none: test the cheap bound first.
    if _cost_reduction(freed_problem, state, prior, readout_columns) < bic_penalty:
        return False
    inflation = np.array([correlation_inflation(problem, state, camera) for camera in range(len(state.cameras))])
    return (
        _cost_reduction(freed_problem, replace(state, sigma=state.sigma * np.sqrt(inflation)), prior, readout_columns)
        > bic_penalty
    )


def are_readouts_plausible(state: AdjustmentState) -> bool:
    """Whether all readouts are within the range of real cameras."""
    return all(abs(camera.readout) < MAX_READOUT_S for camera in state.cameras)


def _cost_reduction(problem: Problem, state: AdjustmentState, prior: SmoothnessPrior, readout_columns: Bools) -> float:
    """Predicted decrease of the cost in one step when the columns ``readout_columns`` (p,) are freed too."""
    _, normal, gradient = _reduced_system(problem, state, prior)
    tangent = gauge_tangent(problem, state)
    everything = np.arange(len(gradient))
    return (
        _reduction(normal, gradient, tangent, everything)[0]
        - _reduction(normal, gradient, tangent, everything[~readout_columns])[0]
    )


def _reduced_system(problem: Problem, state: AdjustmentState, prior: SmoothnessPrior) -> tuple[Ints, Floats, Floats]:
    """Free columns (p,), normal matrix (p, p) and gradient (p,) of the camera parameters, the paths eliminated."""
    system, _ = build_system(problem, state, prior, robust=False)
    parts = eliminate(system)
    gradient = system.gradient_cameras - system.border.T @ cho_solve_path(parts, system.gradient_path)
    return problem.free_columns(), parts.reduced, gradient


def _reduction(normal: Floats, gradient: Floats, tangent: Floats | None, kept: Ints) -> tuple[float, Floats, Floats]:
    """Predicted decrease of the cost in one step of the parameters ``kept``, the step (p,) and its covariance (p, p).

    tangent: (p, q) directions that keep the gauge, which fixes poses only.
    """
    directions: Floats = np.eye(len(gradient)) if tangent is None else tangent
    others = np.setdiff1d(np.arange(len(gradient)), kept)
    if len(others):
        directions = directions @ np.linalg.svd(directions[others])[2][len(others) :].T
    covariance = directions @ np.linalg.solve(directions.T @ normal @ directions, directions.T)
    step = -covariance @ gradient
    return float(-gradient @ step), step, covariance
