"""Clock steps: where the stamps of a camera jump, found in its residuals, and their sizes.

Score tests of a `LinearisedModel`, as those of `model_comparison`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from hub.bundle.adjustment import apply_step
from hub.bundle.linearised_model import LinearisedModel, evidence_needed
from hub.bundle.noise.correlated_noise import MIN_INFLATION
from hub.bundle.noise.gauss_markov import estimate_correlated_noise
from hub.bundle.noise.noise_scale import correlation_inflation, modelled_inflation, residual_std, score_inflation
from hub.bundle.noise.timestamp_jitter import weighted_by_jitter
from hub.bundle.problem import AdjustmentState, ClockStep, Column, Problem, TrackObservations, UsedRows
from hub.bundle.residuals import StackedTrajectories, evaluate_labels, jacobians, residual_norms
from protocols.geometry.types import Floats

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
_FIRST_ROWS = 500
"""Rows of a camera in which half of that share is looked for first; of steps put into a recorded flight the same are
found (`python -m tests.bench.clock_steps --recorded`)."""
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


def find_clock_step(problem: Problem, state: AdjustmentState) -> ClockStep | None:
    """The clock step that the observations ask for most beside wrong lenses and readouts; None where none is needed.

    problem, state: adjusted without one. Slow errors of a wrong lens in a part of a recording look like a step, and a
    step like a rolling shutter of all cameras. So all lenses and readouts are free too, as far as is plausible, and the
    step has to explain what they do not.
    """
    if not problem.free_parameters.clock:
        return None
    # What the stamps would show must not hide another camera's.
    likely = [one for one in likely_clock_steps(problem, state) or () if _MIN_STEP_S < abs(one.size) <= MAX_STEP_S]
    best = max(likely, key=lambda one: one.statistic, default=None)
    if best is None or best.statistic <= needed_for_a_step(problem):
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
    linear, trials = LinearisedModel.of(problem, state, state.sigma * np.sqrt(np.median(inflation))), []
    needed = needed_for_a_step(problem)
    for camera in range(len(state.cameras)):
        used = [part.time[part.use] for part in problem.of_camera(camera)]
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
        parts = problem.of_camera(camera)
        if sum(int(np.count_nonzero(~part.use)) for part in parts) < _MIN_STEP_FRAMES:
            continue
        every = 1 + sum(len(part.time) for part in parts) // _FIRST_ROWS
        if _best_shift([part.every(every) for part in parts], state)[1] > _MIN_EXPLAINED / 2.0:
            step, explained = _best_shift(parts, state)
            found += [step] if explained > _MIN_EXPLAINED else []
    return max(found, key=lambda one: one.statistic, default=None)


def _best_shift(parts: Sequence[TrackObservations], state: AdjustmentState) -> tuple[ClockStep, float]:
    """The step of one camera's clock that explains most of what its rows cost, all else fixed, and the share."""
    number = parts[0].camera
    camera, most = state.cameras[number], max(_REJECTED_PX, _REJECTED_SIGMA * float(state.sigma[number]))
    times = np.concatenate([part.time for part in parts])
    order, costs = np.argsort(times, kind="stable"), []
    for size in STEP_SIZES:
        moved = (replace(part, time=part.time - size) for part in parts)
        norms = [residual_norms(part, camera, state.trajectories[part.label]) for part in moved]
        costs.append(np.fmin(np.concatenate(norms), most)[order] ** 2)
    time, before, after, cost = best_split(times[order], np.array(costs))
    gained = float(costs[len(costs) // 2].sum()) - cost
    step = ClockStep(number, time, after - before, np.inf, _REJECTED_SIGMA**2 * gained / most**2)
    return step, gained / max(gained + cost, 1e-12)


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
        few = sum(np.count_nonzero(part.use) for part in problem.of_camera(camera)) < _FEW_ROWS
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
    return evidence_needed(problem, 2, _STEP_TIMES)


def remaining_step(problem: Problem, state: AdjustmentState, camera: int, time: float) -> ClockStep:
    """What one Gauss-Newton step adds to a corrected clock step at camera time ``time``, with its std."""
    problem, state = weighted_by_jitter(problem, state)
    linear = LinearisedModel.in_its_noise(problem, state)
    return _with_its_noise(problem, state, linear, camera, np.array([time]))


def _with_its_noise(
    problem: Problem, state: AdjustmentState, linear: LinearisedModel, camera: int, times: Floats
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
    step, _, _ = LinearisedModel.of(problem, state, sigma).best_step(camera, times)
    effective = 2.0 * sum(int(part.use.sum()) for part in problem.of_camera(camera)) / inflation[camera]
    return replace(step, statistic=float(effective * np.log1p(step.statistic / effective)))


def _with_rows_of_a_step(problem: Problem, state: AdjustmentState) -> Problem:
    """The problem with all rows in use whose residuals a step of at most `MAX_STEP_S` could explain.

    A state that is adjusted robustly to many rows rejects the few after a step as outliers.
    """
    paths, rows = StackedTrajectories.of(state.by_label), []
    for part in problem.rows:
        camera, every = state.cameras[part.camera], part.using(np.ones_like(part.use))
        seen = evaluate_labels(UsedRows.of([every]), camera, paths)
        speed = np.linalg.norm(jacobians(seen, camera, [Column.OFFSET])[:, 3], axis=0)
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
