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
from functools import cached_property, lru_cache

import numpy as np
from scipy.special import chdtri

from hub.bundle.adjustment import apply_step, gauge, minimise
from hub.bundle.block_matrix import BlockSum, ParameterCovariance
from hub.bundle.bordered_system import BorderedSystem, Elimination, border_block, eliminate
from hub.bundle.covariance import constrained_step
from hub.bundle.noise.correlated_noise import MIN_INFLATION, lens_tolerance
from hub.bundle.noise.gauss_markov import estimate_correlated_noise
from hub.bundle.noise.noise_scale import correlation_inflation, modelled_inflation, residual_std, score_inflation
from hub.bundle.noise.timestamp_jitter import weighted_by_jitter
from hub.bundle.normal_equations import assemble, build_system, weigh_residuals
from hub.bundle.problem import (
    CAMERA_PARAMETERS,
    CENTRE,
    CRYSTAL_RATE_STD,
    FOCAL,
    K1,
    OFFSET,
    RATE,
    READOUT,
    AdjustmentState,
    ClockStep,
    LensPrior,
    Problem,
)
from hub.bundle.residuals import StackedTrajectories, evaluate_labels, jacobians, residual_norms
from hub.bundle.smoothness_prior import SmoothnessPrior, estimate_smoothness
from hub.trajectory.banded import cho_solve_banded
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Ints
from protocols.session.rig import MAX_READOUT_S

_FALSE_ALARM_PROBABILITY = 1e-4
"""Probability that one of the lenses of a correct rig is refuted."""
_READOUT_MARGIN = 0.25
"""Error of an estimated readout, in frame intervals, that is plausible: a global shutter's comes out at about 0."""
_STEP_TIMES, _MIN_STEP_FRAMES = 24, 30
"""Times at which a clock step is tried, and frames on each side of one: as many as a camera of a network needs."""
_MIN_STEP_S = 5e-3
"""Smallest clock step [s] that is reported: less is jitter or a wandering clock."""
MAX_STEP_S = 0.2
"""Largest clock step [s] that is looked for among rejected rows: larger ones show in the stamps."""
STEP_SIZES = np.linspace(-MAX_STEP_S, MAX_STEP_S, 81)
"""Sizes [s] of a step that are tried where it is not linear: refined by the adjustment."""
_REJECTED_SIGMA, _REJECTED_PX, _MIN_EXPLAINED = 5.0, 20.0, 0.5
"""Residual, in sigma and px, from which a row counts as not explained; share of the cost that a step has to remove."""
_MIN_SIGMA_SHARE = 1.0 / 3.0
"""Of the cameras' median: noise that a camera has at least where a clock step is looked for."""
_FEW_ROWS, _FEW_PAIRS, _FEW_INFLATION = 300, 50, 2.5
"""Rows of a camera for which a step is looked for by fewer pairs of residuals, these, and rows per effective row: with
100 to 300 rows, steps of 20 to 80 ms had 3 to 25 in 19 of 20 recordings, and what jitter made of them at most 1.9."""
_STEP_CAMERAS = 3
"""Cameras whose best step is tested in its own noise: one that steps is among the first that seem to."""
_TRIED_SHARE = 0.4
"""Of the statistic that is needed: in noise that holds its own effect a real step has less; on recorded flights those
of 40 and 60 ms have 0.6 and more of it, and what is none at most 0.3."""
_TESTED_AT_ONCE = 64  # cameras: of all, their columns would be as large as the matrix
REFUTED_SIGMA = 4.0
"""Stds from which a rate is no crystal's: of a hundred cameras with crystals one in 160 is refuted."""
LENS = (FOCAL, K1, CENTRE, CENTRE + 1)
"""What a measured lens is tested for: another focal length or distortion, and another part of the picture."""
_STEP_SHARES = (1.0, 0.5)
"""Of a Gauss-Newton step, at which a refuted lens is tried."""
_MIN_TO_HOLD_A_PATH = 4  # cameras: three others determine a path without the one
_STEPS_ALONE, _FIRST_DAMPING, _TOLERANCE = 12, 1e-3, 1e-5
"""Steps of Levenberg and Marquardt, first damping and relative gain of the last one, with a refuted lens free."""


@dataclass(frozen=True, slots=True, eq=False)
class ScoreTest:
    """Score test of a camera's measured lens or readout. camera: index. change: (k,) by which the observations would
    change log focal length, k1 and the principal point [px], or the readout [s]; covariance: (k, k) of it. statistic:
    chi-squared; they would above limit."""

    camera: int
    change: Floats
    covariance: Floats
    statistic: float
    limit: float


def refuted_lenses(problem: Problem, state: AdjustmentState, tested: tuple[int, ...] = LENS) -> list[ScoreTest]:
    """Measured lenses that the observations refute, most significant first.

    problem, state: adjusted with these lenses fixed. Forward selection: the lens whose focal length, k1 and principal
    point lower the cost most is freed, then the next one beside it, so that an honest lens is not blamed for another's
    error. Noise is scaled to the effective sample size. What the linear model predicts of each has to come true: in a
    short or narrow motion it may predict any focal length.
    """
    if not problem.free_parameters.pose or problem.free_parameters.lens:
        return []
    cameras = range(len(state.cameras))
    given = [camera for camera in cameras if problem.lens_prior(camera) is None]
    if not given:
        return []
    freed = replace(problem, lens_tolerances=tuple(map(_any_lens, problem.nominal)))
    modelled = [modelled_inflation(problem, state, camera) for camera in cameras]
    inflation = np.maximum(correlation_inflation(problem, state), modelled)
    noisy = replace(state, sigma=state.sigma * np.sqrt(inflation))
    linear, columns = _Linearised.about(freed, noisy, estimate_smoothness(problem, state)), freed.free_columns()
    own = {camera: camera * CAMERA_PARAMETERS + np.array(tested) for camera in given}

    def with_lenses(chosen: list[int]) -> Ints:
        """The columns of all other parameters and of these lenses."""
        wanted = np.concatenate([problem.free_columns(), *(own[camera] for camera in chosen)])
        return np.flatnonzero(np.isin(columns, wanted))

    limit = float(chdtri(len(tested), _FALSE_ALARM_PROBABILITY / len(given)))
    while True:
        kept = with_lenses(given)
        lens = {camera: np.searchsorted(columns[kept], own[camera]) for camera in given}
        normal = linear.parts.reduced.restricted(kept)
        found = _forward_selection(normal, linear.gradient[kept], linear.fixed[:, kept], lens, limit)
        cost, believed = linear.cost_after(with_lenses([])) if found else 0.0, list[int]()
        for one in found:
            free = with_lenses([*believed, one.camera])
            last, cost = cost, linear.cost_after(free)
            # Far from where the model is linear, what it predicts does not come true. Of two cameras it has to: their
            # path follows any lens, and 6 of 65 right ones were refuted by an adjustment with the lens free.
            if not (last - cost > limit or (len(state.cameras) > 2 and linear.gain(one.camera, free) > limit)):
                break
            believed.append(one.camera)
        if len(believed) == len(found):
            return found
        given.remove(found[len(believed)].camera)


def _any_lens(lens: Intrinsics) -> LensPrior:
    """A prior so wide that only the observations count."""
    return replace(lens_tolerance(lens), focal_std=0.5, centre_std=0.5 * lens.width, k1_std=0.5)


def _forward_selection(
    normal: BlockSum, gradient: Floats, fixed: Floats, candidates: dict[int, Ints], limit: float
) -> list[ScoreTest]:
    """Tests of the cameras whose parameters, freed one after the other, lower the cost by more than ``limit`` each.

    normal (p, p), gradient (p,): of all parameters. fixed: (q, p) directions of the gauge. candidates: each
    camera's columns; all other columns are free.
    """
    kept = np.setdiff1d(np.arange(len(gradient)), np.concatenate([np.zeros(0, dtype=np.int64), *candidates.values()]))
    out: list[ScoreTest] = []
    while len(out) < len(candidates):
        step, covariance = constrained_step(
            normal.restricted(kept), -gradient[kept], fixed[:, kept], np.zeros(len(fixed))
        )
        found, rest = [], sorted(candidates.keys() - {one.camera for one in out})
        for first in range(0, len(rest), _TESTED_AT_ONCE):
            some = rest[first : first + _TESTED_AT_ONCE]
            columns = normal.columns(np.concatenate([candidates[camera] for camera in some]))
            known, end = covariance @ columns[kept], 0
            for camera in some:
                # What some parameters more lower the cost by: one step of them beside all others (Schur complement).
                own, mine = candidates[camera], slice(end, end + len(candidates[camera]))
                coupling, end = columns[kept, mine], mine.stop
                left = gradient[own] + coupling.T @ step
                inverse = np.linalg.inv(columns[own, mine] - coupling.T @ known[:, mine])
                found.append(ScoreTest(camera, -inverse @ left, inverse, float(left @ inverse @ left), limit))
        best = max(found, key=lambda one: one.statistic)
        if not best.statistic > limit:
            break
        kept = np.union1d(kept, candidates[best.camera])
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
    noisy = replace(state, sigma=state.sigma * np.sqrt(correlation_inflation(problem, state)))
    covariance = _Linearised.about(wide, noisy, estimate_smoothness(problem, state)).covariance
    variance = dict(zip(wide.free_columns().tolist(), covariance.diagonal().tolist(), strict=True))
    reference = state.cameras[problem.clock_reference].rate
    crystal = tuple(
        (camera.rate - reference) ** 2
        < REFUTED_SIGMA**2 * (CRYSTAL_RATE_STD**2 + variance.get(i * CAMERA_PARAMETERS + RATE, 0.0))
        for i, camera in enumerate(state.cameras)
    )
    return replace(problem, crystal_rates=crystal)


def are_readouts_observable(problem: Problem, state: AdjustmentState) -> bool:
    """Whether the observations ask for the readout of a camera, beside wrong lenses and jitter.

    problem, state: adjusted with fixed readouts. Forward selection, with noise scaled to the effective sample size.
    """
    linear, needed = _in_its_noise(*weighted_by_jitter(problem, state)), _evidence_needed(problem, 1)
    return bool(_forward_selection(linear.parts.reduced, linear.gradient, linear.fixed, linear.readouts(), needed))


def with_free_readouts(problem: Problem) -> Problem:
    """The problem with all readouts free that were not given.

    Also of cameras that do not ask for it: where one rolls its shutter the others may, and held at 0 they bias it.
    """
    return replace(problem, free_parameters=replace(problem.free_parameters, readout=True))


def are_readouts_supported(problem: Problem, state: AdjustmentState) -> bool:
    """Whether all estimated readouts are plausible and one of them is significant.

    A sensor is read from its first row to its last before the next frame, in at most `MAX_READOUT_S`; given readouts
    may say otherwise.
    """
    linear, needed = _in_its_noise(*weighted_by_jitter(problem, state)), _evidence_needed(problem, 1)
    values = {column: state.cameras[camera].readout for camera, (column,) in linear.readouts().items()}
    variance = linear.covariance.diagonal()
    return are_readouts_plausible(problem, state) and any(
        value**2 > needed * variance[column] for column, value in values.items()
    )


def are_readouts_plausible(problem: Problem, state: AdjustmentState) -> bool:
    """Whether all readouts are within the range of real cameras: from 0 to a frame interval.

    A sensor is read from its first row to its last before the next frame; given readouts may say otherwise.
    """
    for number, camera in enumerate(state.cameras):
        longest = problem.longest_readout(number)
        most = min((1.0 + _READOUT_MARGIN) * longest, MAX_READOUT_S)
        if not -_READOUT_MARGIN * longest < camera.readout < most:
            return False
    return True


def without_negative_readouts(problem: Problem, state: AdjustmentState) -> tuple[Problem, AdjustmentState]:
    """The problem with readouts that came out below 0 held there: those of global shutters."""
    below = [camera.readout < 0.0 for camera in state.cameras]
    given = problem.readout_given or (False,) * len(below)
    cameras = [replace(one, readout=max(one.readout, 0.0)) for one in state.cameras]
    held = tuple(a or b for a, b in zip(given, below, strict=True))
    return replace(problem, readout_given=held), replace(state, cameras=tuple(cameras))


def find_clock_step(problem: Problem, state: AdjustmentState) -> ClockStep | None:
    """The clock step that the observations ask for most beside wrong lenses and readouts; None where none is needed.

    problem, state: adjusted without one. Slow errors of a wrong lens in a part of a recording look like a step, and a
    step like a rolling shutter of all cameras. So all lenses and readouts are free too, as far as is plausible, and the
    step has to explain what they do not.
    """
    if not problem.free_parameters.clock:
        return None
    best = max(likely_clock_steps(problem, state) or (), key=lambda one: one.statistic, default=None)
    if best is None or best.statistic <= needed_for_a_step(problem) or abs(best.size) <= _MIN_STEP_S:
        return _step_of_rejected_rows(problem, state)
    return best


@lru_cache(maxsize=1)  # what the last search found is asked for once more
def likely_clock_steps(problem: Problem, state: AdjustmentState) -> tuple[ClockStep, ...] | None:
    """Steps in their own noise, of the cameras that seem to step; None where errors do not last, as a step's would.

    With free rates, those of a small step in much noise do not.
    """
    # What the path absorbs of a camera's noise would make its noise alone a step: in four 15 s worlds of 6 to 15 fps.
    floor = float(np.median(state.sigma)) * _MIN_SIGMA_SHARE
    state = replace(state, sigma=np.maximum(state.sigma, floor))
    problem, state = weighted_by_jitter(_with_rows_of_a_step(problem, state), state)
    inflation = correlation_inflation(problem, state)
    scores = (score_inflation(problem, state, camera) for camera in range(len(state.cameras)))
    if inflation.max() < MIN_INFLATION and max(scores) < MIN_INFLATION and not _last_in_few_rows(problem, state):
        return None
    # A camera that steps has the most correlated residuals of all, for that reason: here it must not count for less.
    linear, trials = _Linearised.of(problem, state, state.sigma * np.sqrt(np.median(inflation))), []
    needed = needed_for_a_step(problem)
    for camera in range(len(state.cameras)):
        used = [part.time[part.use] for part in problem.rows if part.camera == camera]
        times = np.unique(np.concatenate([np.zeros(0), *used]))
        if len(times) >= 2 * _MIN_STEP_FRAMES:
            first = max(0.05 * len(times), _MIN_STEP_FRAMES)
            tried = np.linspace(first, len(times) - first, _STEP_TIMES)
            trial = linear.best_step(camera, times[tried.astype(int)])[0]
            near = np.searchsorted(times, trial.time) + (tried[1] - tried[0]) * np.linspace(-1.0, 1.0, _STEP_TIMES)
            near = np.clip(near, _MIN_STEP_FRAMES, len(times) - _MIN_STEP_FRAMES)
            trials.append((trial, times[near.astype(int)]))
    trials = sorted(trials, key=lambda one: -one[0].statistic)[:_STEP_CAMERAS]
    return tuple(
        _with_its_noise(problem, state, linear, trial.camera, near)
        for trial, near in trials
        if trial.statistic > _TRIED_SHARE * needed
    )


def _step_of_rejected_rows(problem: Problem, state: AdjustmentState) -> ClockStep | None:
    """The clock step that explains most of what the rows rejected in a camera cost, cameras and paths fixed.

    A linear model does not reach a step in which the motion turns; but a state adjusted to the other rows is right.
    """
    found: list[ClockStep] = []
    for camera in range(len(state.cameras)):
        parts = [part for part in problem.rows if part.camera == camera]
        if sum(int(np.count_nonzero(~part.use)) for part in parts) < _MIN_STEP_FRAMES:
            continue
        times = np.concatenate([part.time for part in parts])
        order, most = np.argsort(times, kind="stable"), max(_REJECTED_PX, _REJECTED_SIGMA * float(state.sigma[camera]))
        costs = []
        for size in STEP_SIZES:
            moved = (replace(part, time=part.time - size) for part in parts)
            norms = [residual_norms(part, state.cameras[camera], state.trajectories[part.label]) for part in moved]
            costs.append(np.fmin(np.concatenate(norms), most)[order] ** 2)
        time, before, after, cost = best_split(times[order], np.array(costs))
        whole = float(costs[len(costs) // 2].sum())
        if cost < (1.0 - _MIN_EXPLAINED) * whole:
            statistic = _REJECTED_SIGMA**2 * (whole - cost) / most**2
            found.append(ClockStep(camera, time, after - before, np.inf, statistic))
    return max(found, key=lambda one: one.statistic, default=None)


def best_split(times: Floats, costs: Floats) -> tuple[float, float, float, float]:
    """Time of a clock step, what it adds to camera times before and from then on, one of them 0, and the cost.

    times: (n,) of the rows, increasing. costs: (sizes, n) of the rows if all stamps are late by each of `STEP_SIZES`.
    """
    until = np.cumsum(costs, axis=1)  # of the rows up to each one
    still = until[len(until) // 2]
    joint = np.stack([until + still[-1] - still, still + until[:, -1:] - until])
    is_after, k, last = np.unravel_index(int(np.argmin(joint)), joint.shape)
    size, time = float(STEP_SIZES[k]), float(times[min(int(last) + 1, len(times) - 1)])
    return time, 0.0 if is_after else size, size if is_after else 0.0, float(joint.min())


def _last_in_few_rows(problem: Problem, state: AdjustmentState) -> bool:
    """Whether errors last in a camera with too few rows for a precise estimate of that."""
    for camera in range(len(state.cameras)):
        few = sum(np.count_nonzero(part.use) for part in problem.rows if part.camera == camera) < _FEW_ROWS
        if few and score_inflation(problem, state, camera, _FEW_PAIRS) > _FEW_INFLATION:
            return True
    return False


def is_step_supported(problem: Problem, step: ClockStep) -> bool:
    """Whether a step's size, in the adjustment that estimates it, is as many stds as it takes to look for one.

    What was a step of a linear model, in noise that it explained, may be little once it is estimated.
    """
    return (step.size / step.std) ** 2 > needed_for_a_step(problem)


def needed_for_a_step(problem: Problem) -> float:
    """The chi-squared that one clock step needs, of all that are tried in a recording."""
    return _evidence_needed(problem, 2, _STEP_TIMES)


def _evidence_needed(problem: Problem, parameters: int, tried: int = 1) -> float:
    """The chi-squared that a clock's further parameters need: the Bayesian information criterion, for the best of so
    many that are tried in each camera."""
    rows = sum(int(part.use.sum()) for part in problem.rows)
    return float(parameters * np.log(max(rows, 2)) + 2.0 * np.log(tried * len(problem.nominal)))


def remaining_step(problem: Problem, state: AdjustmentState, camera: int, time: float) -> ClockStep:
    """What one Gauss-Newton step adds to a corrected clock step at camera time ``time``, with its std."""
    problem, state = weighted_by_jitter(problem, state)
    linear = _in_its_noise(problem, state)
    return _with_its_noise(problem, state, linear, camera, np.array([time]))


def _in_its_noise(problem: Problem, state: AdjustmentState) -> _Linearised:
    """The model in which clocks are tested, in noise scaled to the effective sample size."""
    return _Linearised.of(problem, state, state.sigma * np.sqrt(correlation_inflation(problem, state)))


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
    inflation = correlation_inflation(left, corrected)
    if inflation.max() >= MIN_INFLATION:
        corrected = replace(corrected, correlated_noise=estimate_correlated_noise(left, corrected))
        modelled = [modelled_inflation(left, corrected, one) for one in range(len(state.cameras))]
        inflation = np.maximum(inflation, modelled)
    sigma = state.sigma * residual_std(left, corrected) / residual_std(problem, state) * np.sqrt(inflation)
    step, _, _ = _Linearised.of(problem, state, sigma).best_step(camera, times)
    effective = 2.0 * sum(int(part.use.sum()) for part in problem.rows if part.camera == camera) / inflation[camera]
    return replace(step, statistic=float(effective * np.log1p(step.statistic / effective)))


def _with_rows_of_a_step(problem: Problem, state: AdjustmentState) -> Problem:
    """The problem with all rows in use whose residuals a step of at most `MAX_STEP_S` could explain.

    A state that is adjusted robustly to many rows rejects the few after a step as outliers.
    """
    paths, rows = StackedTrajectories.of(state.trajectories), []
    for part in problem.rows:
        camera, every = state.cameras[part.camera], part.using(np.ones_like(part.use))
        seen = evaluate_labels([every], camera, paths)
        speed = np.linalg.norm(jacobians(seen, camera, [OFFSET])[:, 3], axis=0)
        reach = MAX_STEP_S * speed
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


@dataclass(frozen=True, eq=False)
class _Linearised:
    """The model in which clocks and lenses are tested, about an adjusted state.

    prior: of the paths. system, parts: its normal equations and their elimination. path: (m,) the path's step with the
    cameras fixed, negative. gradient (p,): of the cameras' parameters, the path eliminated. fixed: (q, p) gauge.
    """

    problem: Problem
    state: AdjustmentState
    prior: SmoothnessPrior
    system: BorderedSystem
    parts: Elimination
    path: Floats
    gradient: Floats
    fixed: Floats

    @classmethod
    def of(cls, problem: Problem, state: AdjustmentState, sigma: Floats) -> _Linearised:
        """With lenses and readouts free under priors. sigma: (cameras,) noise of one pixel coordinate at the effective
        sample size."""
        wide = replace(
            problem,
            free_parameters=replace(problem.free_parameters, readout=True),
            lens_tolerances=problem.lens_tolerances or tuple(lens_tolerance(lens) for lens in problem.nominal),
        )
        noisy, prior = replace(state, sigma=sigma), estimate_smoothness(problem, state)
        # Fewer effective rows are no reason to smooth the paths more.
        share = float(np.median(state.sigma / sigma)) ** 2
        return cls.about(wide, noisy, replace(prior, weights=tuple(share * weight for weight in prior.weights)))

    @classmethod
    def about(cls, problem: Problem, state: AdjustmentState, prior: SmoothnessPrior) -> _Linearised:
        """The free parameters of the problem."""
        system, _ = build_system(problem, state, prior, robust=False)
        parts = eliminate(system)
        path = cho_solve_banded(parts.factor, system.gradient_path)
        gradient = system.gradient_cameras - system.border.transposed_times(path)
        return cls(problem, state, prior, system, parts, path, gradient, gauge(problem, state))

    @cached_property
    def covariance(self) -> ParameterCovariance:
        """(p, p) of the cameras' parameters."""
        none = np.zeros(len(self.fixed))
        return constrained_step(self.parts.reduced, -self.gradient, self.fixed, none)[1]

    def cost_after(self, free: Ints) -> float:
        """The lowest cost along a step of the paths and the parameters ``free`` (k,), the others held."""
        cameras, fixed = np.zeros(len(self.gradient)), self.fixed[:, free]
        normal = self.parts.reduced.restricted(free)
        cameras[free] = constrained_step(normal, -self.gradient[free], fixed, np.zeros(len(fixed)))[0]
        path = -(self.path + self.parts.a_inv_b @ cameras)
        trials = (apply_step(self.problem, self.state, share * path, share * cameras) for share in _STEP_SHARES)
        return min(weigh_residuals(self.problem, one, self.prior, robust=False).cost for one in trials)

    def gain(self, camera: int, free: Ints) -> float:
        """By how much less the rows cost at the best of a camera's parameters among ``free`` (k,).

        Beside three others or more all else is fixed, as the path is by these; else everything is free.
        """
        lenses = self.problem.lens_tolerances
        if len(lenses) < _MIN_TO_HOLD_A_PATH:
            given = self.problem.lens_priors or (None,) * len(lenses)
            costs = []
            for priors in (given, (*given[:camera], lenses[camera], *given[camera + 1 :])):
                problem = replace(self.problem, lens_tolerances=(), lens_priors=priors)
                state = minimise(problem, self.state, self.prior, False, _STEPS_ALONE, _TOLERANCE, [], False)
                costs.append(weigh_residuals(problem, state, self.prior, robust=False).cost)
            return costs[0] - costs[1]
        own = free[self.problem.free_columns()[free] // CAMERA_PARAMETERS == camera]
        problem = replace(self.problem, rows=tuple(part for part in self.problem.rows if part.camera == camera))
        state, damping, still = self.state, _FIRST_DAMPING, np.zeros_like(self.path)
        residuals = weigh_residuals(problem, state, self.prior, robust=False)
        first, system = residuals.cost, None
        for _ in range(_STEPS_ALONE):
            system = system or assemble(problem, state, self.prior, residuals)
            normal, step = system.corner.restricted(own).dense(), np.zeros(len(self.gradient))
            step[own] = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), system.gradient_cameras[own])
            trial = apply_step(problem, state, still, step)
            there = weigh_residuals(problem, trial, self.prior, robust=False)
            if there.cost < residuals.cost:
                gained = residuals.cost - there.cost
                state, residuals, system, damping = trial, there, None, 0.1 * damping
                if gained < _TOLERANCE * residuals.cost:
                    break
            else:
                damping *= 10.0
        return first - residuals.cost

    def readouts(self) -> dict[int, Ints]:
        """The column (1,) of each camera's readout that was not given."""
        columns = self.problem.free_columns()
        free = np.flatnonzero(columns % CAMERA_PARAMETERS == READOUT)
        return {int(columns[k]) // CAMERA_PARAMETERS: np.array([k]) for k in free}

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
        score = after @ (weighted * seen.whitened(seen.residual)).sum(axis=0) - solved.T @ system.gradient_path
        score -= coupling.T @ (self.covariance @ self.gradient)
        information = after @ cross[3] - (border * solved).sum(axis=0)
        information = np.maximum(information - (coupling * (self.covariance @ coupling)).sum(axis=0), 1e-9)
        k = int(np.argmax(score**2 / information))
        change, rate = float(score[k] / information[k]), float(state.cameras[camera].rate)
        cameras = -(self.covariance @ (self.gradient - coupling[:, k] * change))
        path = -(self.path + self.parts.a_inv_b @ cameras - solved[:, k] * change)
        statistic = float(score[k] ** 2 / information[k])
        step = ClockStep(camera, float(times[k]), change / rate, float(information[k] ** -0.5) / rate, statistic)
        return step, path, cameras
