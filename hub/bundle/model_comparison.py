"""Comparison of models that differ by a few parameters: measured lenses, rolling-shutter readouts, clock steps.

All are score tests: the gain of freeing parameters is predicted by one Gauss-Newton step from the solution in which
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

from hub.bundle.adjustment import apply_step, estimate_noise, gauge
from hub.bundle.bordered_system import BorderedSystem, Elimination, border_block, eliminate
from hub.bundle.correlated_noise import lens_tolerance
from hub.bundle.covariance import constrained_step
from hub.bundle.gauss_markov import estimate_correlated_noise
from hub.bundle.noise_scale import correlation_inflation, modelled_inflation
from hub.bundle.normal_equations import build_system
from hub.bundle.problem import (
    CAMERA_PARAMETERS,
    CRYSTAL_RATE_STD,
    FOCAL,
    K1,
    OFFSET,
    RATE,
    READOUT,
    AdjustmentState,
    ClockStep,
    Problem,
)
from hub.bundle.residuals import StackedTrajectories, evaluate_labels, jacobians
from hub.bundle.smoothness_prior import SmoothnessPrior, estimate_smoothness
from hub.trajectory.banded import cho_solve_banded
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.rig import MAX_READOUT_S

_FALSE_ALARM_PROBABILITY = 1e-4
"""Probability that one of the lenses of a correct rig is refuted."""
_READOUT_MARGIN = 0.25
"""Error of an estimated readout, in frame intervals, that is plausible: a global shutter's comes out at about 0."""
_STEP_TIMES, _MIN_STEP_ROWS = 24, 60
"""Times at which a clock step is tried, and rows of a camera below which none is."""
_MIN_STEP_S = 5e-3
"""Smallest clock step [s] that is reported: less is jitter or a wandering clock."""
_MAX_STEP_S = 0.2
"""Largest clock step [s] that is looked for among rejected rows: larger ones show in the stamps."""
_STEP_CAMERAS = 3
"""Cameras whose best step is tested in its own noise: one that steps is among the first that seem to."""
_TRIED_SHARE = 0.4
"""Of the statistic that is needed: in noise that holds its own effect a real step has less; on recorded flights those
of 40 and 60 ms have 0.6 and more of it, and what is none at most 0.3."""
_MIN_STEP_INFLATION = 4.0
"""Rows per effective row below which no residuals are correlated, as a step's would be."""
REFUTED_SIGMA = 4.0
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
    modelled = [modelled_inflation(problem, state, camera) for camera in cameras]
    inflation = np.maximum(correlation_inflation(problem, state), modelled)
    noisy = replace(state, sigma=state.sigma * np.sqrt(inflation))
    columns, normal, gradient = _reduced_system(freed, noisy, estimate_smoothness(problem, state))
    lens = {
        camera: np.flatnonzero(np.isin(columns, camera * CAMERA_PARAMETERS + np.array([FOCAL, K1]))) for camera in given
    }
    limit = float(chdtri(2, _FALSE_ALARM_PROBABILITY / len(given)))
    kept = np.setdiff1d(np.arange(len(columns)), np.concatenate(list(lens.values())))
    out: list[LensTest] = []
    while len(out) < len(given):
        _, step, covariance = _reduction(normal, gradient, gauge(freed, state), kept)
        found = []
        for camera in set(given) - {one.camera for one in out}:
            # What two parameters more lower the cost by: one step of them beside all others (Schur complement).
            two = lens[camera]
            left = gradient[two] + normal[two] @ step
            inverse = np.linalg.inv(normal[np.ix_(two, two)] - normal[two] @ covariance @ normal[:, two])
            statistic, std = float(left @ inverse @ left), float(np.sqrt(inverse[0, 0]))
            found.append(LensTest(camera, -float(inverse[0] @ left), std, statistic, limit))
        best = max(found, key=lambda one: one.statistic)
        if not best.statistic > limit:
            break
        kept = np.union1d(kept, lens[best.camera])
        out.append(best)
    return out


def with_crystal_rates(problem: Problem, state: AdjustmentState) -> Problem:
    """The problem with rates held by the prior of crystals, but for those that the observations refute.

    problem, state: adjusted under the wide prior of rates. A rate is refuted where it differs from the reference's by
    more than `REFUTED_SIGMA` times the std of both the estimate and the prior: then the frame rate is another one.
    """
    if not problem.free_parameters.clock:
        return problem
    wide = replace(problem, crystal_rates=())
    inflation = correlation_inflation(problem, state)
    noisy = replace(state, sigma=state.sigma * np.sqrt(inflation))
    columns, normal, gradient = _reduced_system(wide, noisy, estimate_smoothness(problem, state))
    covariance = _reduction(normal, gradient, gauge(wide, state), np.arange(len(columns)))[2]
    variance = dict(zip(columns.tolist(), np.diag(covariance).tolist(), strict=True))
    reference = state.cameras[problem.clock_reference].rate
    crystal = tuple(
        (camera.rate - reference) ** 2
        < REFUTED_SIGMA**2 * (CRYSTAL_RATE_STD**2 + variance.get(i * CAMERA_PARAMETERS + RATE, 0.0))
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
    inflation = correlation_inflation(problem, state)
    return (
        _cost_reduction(freed_problem, replace(state, sigma=state.sigma * np.sqrt(inflation)), prior, readout_columns)
        > bic_penalty
    )


def are_readouts_plausible(problem: Problem, state: AdjustmentState) -> bool:
    """Whether all readouts are within the range of real cameras: from 0 to a frame interval, and no longer than 0.1 s.

    A sensor is read from its first row to its last before the next frame; given readouts may say otherwise.
    """
    for number, camera in enumerate(state.cameras):
        steps = [np.diff(np.unique(part.stamps)) for part in problem.rows if part.camera == number]
        interval = min((float(np.median(step)) for step in steps if len(step)), default=MAX_READOUT_S)
        margin = _READOUT_MARGIN * interval
        if not -margin < camera.readout < min(interval + margin, MAX_READOUT_S):
            return False
    return True


def without_negative_readouts(problem: Problem, state: AdjustmentState) -> tuple[Problem, AdjustmentState]:
    """The problem with readouts that came out below 0 held there: those of global shutters."""
    below = [camera.readout < 0.0 for camera in state.cameras]
    given = problem.readout_given or (False,) * len(below)
    cameras = [replace(one, readout=max(one.readout, 0.0)) for one in state.cameras]
    held = tuple(a or b for a, b in zip(given, below, strict=True))
    return replace(problem, readout_given=held), replace(state, cameras=tuple(cameras))


def _cost_reduction(problem: Problem, state: AdjustmentState, prior: SmoothnessPrior, readout_columns: Bools) -> float:
    """Predicted decrease of the cost in one step when the columns ``readout_columns`` (p,) are freed too."""
    _, normal, gradient = _reduced_system(problem, state, prior)
    fixed, everything = gauge(problem, state), np.arange(len(gradient))
    free, held = (_reduction(normal, gradient, fixed, kept)[0] for kept in (everything, everything[~readout_columns]))
    return free - held


def _reduced_system(problem: Problem, state: AdjustmentState, prior: SmoothnessPrior) -> tuple[Ints, Floats, Floats]:
    """Free columns (p,), normal matrix (p, p) and gradient (p,) of the camera parameters, the paths eliminated."""
    system, _ = build_system(problem, state, prior, robust=False)
    parts = eliminate(system)
    gradient = system.gradient_cameras - system.border.transposed_times(
        cho_solve_banded(parts.factor, system.gradient_path)
    )
    return problem.free_columns(), parts.reduced, gradient


def _reduction(normal: Floats, gradient: Floats, fixed: Floats, kept: Ints) -> tuple[float, Floats, Floats]:
    """Predicted decrease of the cost in one step of the parameters ``kept``, the step (p,) and its covariance (p, p).

    fixed: (q, p) directions of the gauge, of poses only.
    """
    step, covariance = np.zeros_like(gradient), np.zeros_like(normal)
    step[kept], covariance[np.ix_(kept, kept)] = constrained_step(
        normal[np.ix_(kept, kept)], -gradient[kept], fixed[:, kept], np.zeros(len(fixed))
    )
    return float(-gradient @ step), step, covariance


def find_clock_step(problem: Problem, state: AdjustmentState) -> ClockStep | None:
    """The clock step that the observations ask for most beside wrong lenses and readouts; None where none is needed.

    problem, state: adjusted without one. Slow errors of a wrong lens in a part of a recording look like a step, and a
    step like a rolling shutter of all cameras. So all lenses and readouts are free too, as far as is plausible, and the
    step has to explain what they do not.
    """
    if not problem.free_parameters.clock:
        return None
    problem = _with_rows_of_a_step(problem, state)
    inflation = correlation_inflation(problem, state)
    if inflation.max() < _MIN_STEP_INFLATION:
        return None
    # A camera that steps has the most correlated residuals of all, for that reason: here it must not count for less.
    linear, trials = _Linearised.of(problem, state, state.sigma * np.sqrt(np.median(inflation))), []
    needed = needed_for_a_step(problem)
    for camera in range(len(state.cameras)):
        used = [part.time[part.use] for part in problem.rows if part.camera == camera]
        times = np.unique(np.concatenate([np.zeros(0), *used]))
        if len(times) >= _MIN_STEP_ROWS:
            first, last, width = 0.05 * (len(times) - 1), 0.95 * (len(times) - 1), 0.9 * len(times) / (_STEP_TIMES - 1)
            trial = linear.best_step(camera, times[np.linspace(first, last, _STEP_TIMES).astype(int)])[0]
            near = np.searchsorted(times, trial.time) + width * np.linspace(-1.0, 1.0, _STEP_TIMES)
            trials.append((trial, times[np.clip(near, 1, len(times) - 1).astype(int)]))
    trials = sorted(trials, key=lambda one: -one[0].statistic)[:_STEP_CAMERAS]
    found = [
        _with_its_noise(problem, state, linear, trial.camera, near)
        for trial, near in trials
        if trial.statistic > _TRIED_SHARE * needed
    ]
    best = max(found, key=lambda one: one.statistic, default=None)
    return None if best is None or best.statistic <= needed or abs(best.size) <= _MIN_STEP_S else best


def needed_for_a_step(problem: Problem) -> float:
    """The chi-squared that a clock step needs: by the Bayesian information criterion of its size, and by how many are
    tried."""
    rows = sum(int(part.use.sum()) for part in problem.rows)
    return float(2.0 * np.log(max(rows, 2)) + 2.0 * np.log(_STEP_TIMES * len(problem.nominal)))


def remaining_step(problem: Problem, state: AdjustmentState, camera: int, time: float) -> ClockStep:
    """What one Gauss-Newton step adds to a corrected clock step at camera time ``time``, with its std."""
    linear = _Linearised.of(problem, state, state.sigma * np.sqrt(correlation_inflation(problem, state)))
    return _with_its_noise(problem, state, linear, camera, np.array([time]))


def _with_its_noise(
    problem: Problem, state: AdjustmentState, linear: _Linearised, camera: int, times: Floats
) -> ClockStep:
    """The best of a camera's steps at camera times (k,), in the noise that is left once it is corrected.

    As a part of the noise, the step's own effect would hide it. The statistic is that of a ratio of variances, which is
    what a likelihood ratio with unknown noise comes to: n log(1 + chi²/n) with n the effective rows.
    """
    step, path, cameras = linear.best_step(camera, times)
    left = with_clock_step(problem, step, -np.inf)
    left = replace(left, rows=tuple(a.using(b.use) for a, b in zip(left.rows, problem.rows, strict=True)))
    corrected = apply_step(linear.problem, state, path, cameras)
    corrected = replace(corrected, correlated_noise=estimate_correlated_noise(left, corrected))
    modelled = [modelled_inflation(left, corrected, one) for one in range(len(state.cameras))]
    inflation = np.maximum(correlation_inflation(left, corrected), modelled)
    sigma = estimate_noise(left, corrected) * np.sqrt(inflation)
    step, _, _ = _Linearised.of(problem, state, sigma).best_step(camera, times)
    effective = 2.0 * sum(int(part.use.sum()) for part in problem.rows if part.camera == camera) / inflation[camera]
    return replace(step, statistic=float(effective * np.log1p(step.statistic / effective)))


def _with_rows_of_a_step(problem: Problem, state: AdjustmentState) -> Problem:
    """The problem with all rows in use whose residuals a step of at most `_MAX_STEP_S` could explain.

    A state that is adjusted robustly to many rows rejects the few after a step as outliers.
    """
    paths, rows = StackedTrajectories.of(state.trajectories), []
    for part in problem.rows:
        camera, every = state.cameras[part.camera], part.using(np.ones_like(part.use))
        seen = evaluate_labels([every], camera, paths)
        speed = np.linalg.norm(jacobians(seen, camera, [OFFSET])[:, 3], axis=0)
        reach = _MAX_STEP_S * speed
        rows.append(part.using(part.use | (seen.valid & (np.linalg.norm(seen.residual, axis=0) < reach))))
    return replace(problem, rows=tuple(rows))


def with_clock_step(problem: Problem, step: ClockStep, middle: float) -> Problem:
    """The problem with the rows beyond a step, seen from camera time ``middle``, at the times of an even clock."""
    rows = []
    for part in problem.rows:
        if part.camera == step.camera:
            beyond = (part.time >= step.time) == (step.time > middle)
            shifted = part.time - np.where(beyond, np.copysign(1.0, step.time - middle) * step.size, 0.0)
            part = replace(part, time=shifted, stamp=part.stamps, use=np.ones_like(part.use))
        rows.append(part)
    return replace(problem, rows=tuple(rows))


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    """The model in which clock steps are tested, about an adjusted state: lenses and readouts are free under priors.

    system, parts: its normal equations and their elimination. path: (m,) the path's step with the cameras fixed,
    negative. gradient (p,), covariance (p, p): of the cameras' parameters, the path eliminated.
    """

    problem: Problem
    state: AdjustmentState
    system: BorderedSystem
    parts: Elimination
    path: Floats
    gradient: Floats
    covariance: Floats

    @classmethod
    def of(cls, problem: Problem, state: AdjustmentState, sigma: Floats) -> _Linearised:
        """sigma: (cameras,) noise of one pixel coordinate at the effective sample size."""
        wide = replace(
            problem,
            free_parameters=replace(problem.free_parameters, readout=True),
            lens_tolerances=problem.lens_tolerances or tuple(lens_tolerance(lens) for lens in problem.nominal),
        )
        noisy, prior = replace(state, sigma=sigma), estimate_smoothness(problem, state)
        # Fewer effective rows are no reason to smooth the paths more.
        share = float(np.median(state.sigma / sigma)) ** 2
        prior = replace(prior, weights=tuple(share * weight for weight in prior.weights))
        system, _ = build_system(wide, noisy, prior, robust=False)
        parts = eliminate(system)
        path = cho_solve_banded(parts.factor, system.gradient_path)
        gradient, fixed = system.gradient_cameras - system.border.transposed_times(path), gauge(wide, state)
        _, covariance = constrained_step(parts.reduced, gradient, fixed, np.zeros(len(fixed)))
        return cls(wide, noisy, system, parts, path, gradient, covariance)

    def best_step(self, camera: int, times: Floats) -> tuple[ClockStep, Floats, Floats]:
        """The best of a camera's steps at camera times (k,); what the paths (m,) and the cameras (p,) do with it."""
        state, system, columns = self.state, self.system, self.problem.free_columns()
        seen = evaluate_labels(
            [part for part in self.problem.rows if part.camera == camera],
            state.cameras[camera],
            StackedTrajectories.of(state.trajectories),
        )
        mine = np.flatnonzero(columns // CAMERA_PARAMETERS == camera)
        own = (columns[mine] % CAMERA_PARAMETERS).tolist()
        jacobian = jacobians(seen, state.cameras[camera], [OFFSET, *own])
        weight = np.where(seen.valid, seen.relative_information / state.sigma[camera] ** 2, 0.0)
        after = seen.time >= times[:, None]
        weighted = jacobian[:, 3] * weight
        cross = (weighted[:, None] * jacobian).sum(axis=0)
        border = border_block(seen.index, seen.weights, cross[:3, None] * after, len(system.gradient_path))
        corner = np.zeros((len(columns), len(times)))
        corner[mine] = cross[4:] @ after.T
        solved = cho_solve_banded(self.parts.factor, border)
        coupling = corner - system.border.transposed_times(solved)
        score = after @ (weighted * seen.residual).sum(axis=0) - solved.T @ system.gradient_path
        score -= coupling.T @ (self.covariance @ self.gradient)
        information = after @ cross[3] - (border * solved).sum(axis=0)
        information = np.maximum(information - (coupling * (self.covariance @ coupling)).sum(axis=0), 1e-9)
        k = int(np.argmax(score**2 / information))
        change, rate = float(score[k] / information[k]), float(state.cameras[camera].rate)
        cameras = -self.covariance @ (self.gradient - coupling[:, k] * change)
        path = -(self.path + self.parts.a_inv_b @ cameras - solved[:, k] * change)
        statistic = float(score[k] ** 2 / information[k])
        step = ClockStep(camera, float(times[k]), change / rate, float(information[k] ** -0.5) / rate, statistic)
        return step, path, cameras
