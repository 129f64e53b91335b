"""Errors that last for seconds: found where they are, and then counted for what they are.

Where residuals are alike from frame to frame, the adjustment is made again by generalised least squares
(`generalised`), and the lenses, whose errors look just like that, are estimated whole under priors of what a given
lens may be off by. With rows taken as separate a freed lens takes up what a detector errs by; with lasting errors and
two numbers of each lens free, these two take up the rest of the lens.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hub.bundle.adjustment import noise
from hub.bundle.covariance import turn_stds
from hub.bundle.gauss_markov import coloured
from hub.bundle.gls import Fit, fit, within_reach
from hub.bundle.noise_scale import together
from hub.bundle.normal_equations import camera_priors
from hub.bundle.problem import (
    ASPECT,
    CAMERA_PARAMETERS,
    CENTRE,
    FOCAL,
    K1,
    K2,
    K3,
    P1,
    LensPrior,
    Problem,
    State,
)
from hub.trajectory.discrete import PointBasis
from hub.trajectory.smoothness_prior import motion_prior
from protocols.geometry.camera import Intrinsics
from protocols.session.calibration import AdjustmentStep

_LEAST_ALIKE = 4.0
"""Residuals that must count as one before they are looked at for errors that last."""
_LARGEST_TURN_STD = 0.0175
"""Std [rad] of a camera's orientation beyond which too little is told for errors to be told from the path."""
_LENS = (FOCAL, CENTRE, CENTRE + 1, K1, K2, K3, ASPECT, P1, P1 + 1)


def tolerance(lens: Intrinsics) -> LensPrior:
    """What a lens that somebody measured may be off by in the field: a zoom's play, a crop, a stabiliser."""
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


def with_lasting_errors(problem: Problem, state: State) -> tuple[Problem, State]:
    """The adjustment made again where errors last; else both as they are.

    problem, state: adjusted. Both stay too where poses are given, where clocks are shared or frames' own times were
    found, where a recording is too long for it (`generalised.within_reach`), and where it would leave a camera's
    orientation looser than 1°.
    """
    unfit = state.jitter is not None or not problem.freedom.clock or not problem.freedom.pose
    if unfit or any(isinstance(path.basis, PointBasis) for path in state.trajectories):
        return problem, state
    cameras = range(len(state.cameras))
    if max(together(problem, state, camera) for camera in cameras) < _LEAST_ALIKE:
        return problem, state
    kinds = coloured(problem, state)
    if not within_reach(problem, kinds):
        return problem, state
    told = replace(problem, freedom=replace(problem.freedom, lens=False))
    found = replace(told, loose=tuple(tolerance(lens) for lens in problem.nominal))
    try:
        best = fit(found, state, motion_prior(found, state), kinds)
        if as_told(found, best):
            # The state may have been adjusted with other lenses: its residuals tell of these too.
            found, start = told, _with_told_lenses(told, state)
            best = fit(told, start, motion_prior(told, start), kinds)
            kinds = coloured(told, best.state)
            best = fit(told, best.state, motion_prior(told, best.state), kinds)
        loosest = _loosest_turn(found, best)
    except np.linalg.LinAlgError:
        return problem, state
    if not (np.isfinite(best.cost) and loosest <= _LARGEST_TURN_STD):
        return problem, state
    after = replace(best.state, sigma=noise(found, best.state), coloured=kinds)
    step = AdjustmentStep("lasting errors", float(np.sqrt(np.mean(after.sigma**2))))
    return found, replace(after, steps=(*after.steps, step))


def _with_told_lenses(problem: Problem, state: State) -> State:
    cameras = (
        camera if problem.lens_prior(i) is not None else replace(camera, intrinsics=problem.nominal[i])
        for i, camera in enumerate(state.cameras)
    )
    return replace(state, cameras=tuple(cameras))


def _loosest_turn(problem: Problem, best: Fit) -> float:
    """Std [rad] of the rotation of the camera that is least tied to any other."""
    stds = turn_stds(best.covariance_of(problem), best.state)
    np.fill_diagonal(stds, np.inf)
    return float(stds.min(axis=1).max())


def as_told(problem: Problem, best: Fit) -> bool:
    """Whether lenses exactly as told are likelier than ones that are off by about their tolerance.

    problem: with loose lenses. The ratio of the two likelihoods is that of the densities of "off by nothing" before
    and after the rows were seen (Savage and Dickey), with both taken as Gaussian.
    """
    columns = problem.free_columns()
    terms = {
        column: (value, std)
        for column, value, std in camera_priors(problem, best.state)
        if column % CAMERA_PARAMETERS in _LENS
        and not (problem.guessed and problem.guessed[column // CAMERA_PARAMETERS] is not None)
    }
    if not terms:
        return False  # nobody told any of them
    mine = np.array([i for i, column in enumerate(columns) if int(column) in terms], dtype=np.int64)
    off, std = np.array([terms[int(columns[i])] for i in mine]).T
    after = best.free[np.ix_(mine, mine)]
    surprise = float(off @ np.linalg.solve(after, off))
    return bool(surprise + np.linalg.slogdet(after)[1] < 2.0 * np.log(std).sum())


__all__ = ["as_told", "tolerance", "with_lasting_errors"]
