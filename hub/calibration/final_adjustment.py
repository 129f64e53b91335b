"""The final adjustment of a network: clock steps, frame times, readouts and lenses where the data support them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hub.bundle import clock_steps, model_comparison
from hub.bundle.adjustment import adjust
from hub.bundle.initialisation import Reconstruction, sigma_limit
from hub.bundle.noise.correlated_noise import refit_with_correlated_noise
from hub.bundle.noise.noise_scale import correlation_inflation
from hub.bundle.noise.timestamp_jitter import estimate_frame_times
from hub.bundle.problem import LARGE_NETWORK, AdjustmentState, ClockStep, Problem
from hub.bundle.residuals import residual_norms
from hub.calibration.acceptance import misfits, wrong_lens
from hub.calibration.pairs.pair_network import Progress
from protocols.geometry.types import Floats

MAX_CLOCK_STEPS, _STEP_ITERATIONS = 2, 2  # steps of all clocks in one recording; Gauss-Newton steps for each
_STEP_TOLERANCE = 0.5  # what is left of a size, in stds
_ONLINE_MIN_INFLATION = 2.0  # rows per effective row from which the noise of a recording that goes on is correlated
_MAX_ONLINE_ROW_RATE = 120.0  # rows a second, of all cameras


def _with_clock_steps(problem: Problem, state: AdjustmentState) -> tuple[Problem, AdjustmentState]:
    """Problem and state with the rows after clock steps corrected, as far as these explain the observations better."""
    for _ in range(MAX_CLOCK_STEPS):
        step = clock_steps.find_clock_step(problem, state)
        if step is None:
            break
        # Both from converged priors: with keypoints of people, more rounds alone gained more than a step.
        problem, state, _ = adjust(problem, state, rounds=2)
        trial, found = _with_sizes(problem, state, step)
        supported = all(clock_steps.is_step_supported(problem, one) for one in found.clock_steps)
        if not supported or not bic_prefers(trial, found, problem, state, 2):
            break
        problem, state = trial, found
    return problem, state


def _with_fewer_steps(
    even: tuple[Problem, AdjustmentState], found: tuple[Problem, AdjustmentState]
) -> tuple[Problem, AdjustmentState]:
    """What was ``found`` from ``even`` clocks; where all cameras but one step in it, the step of that one instead.

    A step is the same as opposite ones of all other cameras, which are not to be preferred unless they explain more.
    """
    state, steps = found[1], found[1].clock_steps
    alone = set(range(len(state.cameras))) - {one.camera for one in steps}
    if len(steps) < 2 or len(alone) > 1:
        return found
    last, size = alone.pop(), -float(np.mean([one.size for one in steps]))
    times = [state.cameras[one.camera].reference_time(np.array([one.time])) for one in steps]
    same = (ClockStep(last, float(state.cameras[last].camera_time(one)[0]), size, np.inf, 0.0) for one in times)
    best = max((_with_sizes(*even, one) for one in same), key=lambda tried: _gain(tried[0], tried[1], *even)[0])
    supported = clock_steps.is_step_supported(best[0], best[1].clock_steps[-1])
    return found if not supported or bic_prefers(*found, *best, 2 * (len(steps) - 1)) else best


def _steps_or_rates(
    even: tuple[Problem, AdjustmentState], found: tuple[Problem, AdjustmentState]
) -> tuple[Problem, AdjustmentState]:
    """What was ``found`` from the adjusted clocks ``even``; steps of clocks that all run alike if these explain more.

    Where a clock steps and its rate is free, a false rate explains most of the step.
    """
    problem, state = even
    if all(model_comparison.with_crystal_rates(*found).crystal_rates):
        return found
    # Free rates and steps explain no less than steps alone: where none seems to add to them, none replaces them.
    if clock_steps.likely_clock_steps(*found) == ():
        return found
    rate = float(np.median([camera.rate for camera in state.cameras]))
    alike = tuple(replace(camera, rate=rate) for camera in state.cameras)
    held = replace(problem, crystal_rates=(True,) * len(alike))
    stepped = _with_clock_steps(*adjust(held, replace(state, cameras=alike), rounds=4)[:2])
    # As much as it takes to look for the steps: lenses that are wrong by slow errors make false rates, and false steps.
    needed = len(stepped[1].clock_steps) * clock_steps.needed_for_a_step(problem)
    return stepped if needed and _gain(*stepped, *found)[0] > needed else found


def _with_sizes(problem: Problem, state: AdjustmentState, new: ClockStep) -> tuple[Problem, AdjustmentState]:
    """Problem and state adjusted with a further clock step corrected, all sizes iterated.

    A size is first of one Gauss-Newton step, which leaves a part of a large one, and of a model without this step.
    """
    steps, corrected = [*state.clock_steps, new], [*(one.size for one in state.clock_steps), 0.0]
    found, trial = problem, state
    for left in range(_STEP_ITERATIONS, -1, -1):
        found = problem
        for one, done in zip(steps, corrected, strict=True):
            change = replace(one, size=one.size - done)
            found = clock_steps.with_clock_step(found, change, state.cameras[one.camera].centre)
        found, trial, _ = adjust(found, trial, rounds=2)
        rest = [clock_steps.remaining_step(found, trial, one.camera, one.time) for one in steps]
        steps = [replace(one, std=more.std) for one, more in zip(steps, rest, strict=True)]
        if all(abs(more.size) < _STEP_TOLERANCE * more.std for more in rest) or not left:
            break
        steps = [replace(one, size=one.size + more.size) for one, more in zip(steps, rest, strict=True)]
    return found, replace(trial, clock_steps=tuple(steps))


def _with_readouts(problem: Problem, state: AdjustmentState, report: Progress) -> tuple[Problem, AdjustmentState]:
    """Problem and state with readouts estimated where the observations ask for them."""
    if not model_comparison.are_readouts_observable(problem, state):
        return problem, state
    report("adjusting the readouts", 0.78)
    found, trial, _ = adjust(model_comparison.with_free_readouts(problem), state, rounds=2)
    if any(camera.readout < 0.0 for camera in trial.cameras) and model_comparison.are_readouts_plausible(found, trial):
        found, trial, _ = adjust(*model_comparison.without_negative_readouts(found, trial), rounds=2)
    return (found, trial) if model_comparison.are_readouts_supported(found, trial) else (problem, state)


def final_adjustment(
    reconstruction: Reconstruction,
    report: Progress,
    *,
    warm: bool = False,
    online: bool = False,
    refine_lenses: bool = False,
    shared_errors: bool = False,
) -> Reconstruction:
    """The final adjustment, with readouts estimated where the data clearly support it.

    refine_lenses: measured lenses may change within their tolerance where the data clearly support it; else they are
    kept exactly. warm: the state is near the solution. online: a part of a recording that goes on. Then readouts are
    not estimated: on the first 70 to 110 s of a real rig they came out at -34 and +42 ms with stds of 10 ms, after
    130 s not at all. And the re-fit with correlated noise, which makes early stds honest, waits for less correlation.
    shared_errors: whether points are off together, as both ends of a box are: that passes for readouts, jitter and
    steps of clocks, of which none is looked for then.
    """
    report("adjusting", 0.75)
    problem, state = reconstruction.problem, reconstruction.state
    if warm and online and state.jitter is None:
        # Near the solution the re-fit alone converges; where it does not apply, the adjustment does.
        problem, state = estimate_frame_times(problem, state, newest=True)
        problem = model_comparison.with_crystal_rates(problem, state)
        refitted = _refit_online(problem, state, refine_lenses)
        if refitted[1] is not state:
            return replace(reconstruction, problem=refitted[0], state=refitted[1])
    if not online and any(one > sigma_limit(state, camera) for camera, one in enumerate(state.sigma)):
        lens = wrong_lens(problem, state)
        step = None if lens is None else clock_steps.find_clock_step(problem, state)
        if lens is not None and (step is None or step.statistic < lens.statistic):
            return reconstruction  # the camera will be left out
    rounds = 2 if warm or len(state.cameras) > LARGE_NETWORK else 4
    problem, state, _ = adjust(problem, state, rounds=rounds, progress=lambda text: report(text, 0.75))
    if not ((warm and online) or shared_errors):
        even = problem, state
        problem, state = _with_fewer_steps(even, _with_clock_steps(*even))
        problem, state = (problem, state) if online else _steps_or_rates(even, (problem, state))
    if not (online or shared_errors) and problem.free_parameters.clock:
        problem, state = _with_readouts(problem, state, report)
    if not shared_errors:
        problem, state = estimate_frame_times(problem, state, lambda text: report(text, 0.8), newest=online)
    problem = model_comparison.with_crystal_rates(problem, state)
    if refine_lenses and not warm:
        report("adjusting the lenses", 0.85)
        freed = replace(problem, free_parameters=replace(problem.free_parameters, lens=True))
        freed_problem, freed_state, _ = adjust(freed, state, rounds=2, progress=lambda text: report(text, 0.85))
        if bic_prefers(freed_problem, freed_state, problem, state, 2 * len(state.cameras)):
            problem, state = freed_problem, freed_state
    adjusted = replace(reconstruction, problem=problem, state=state)
    if misfits(adjusted) or wrong_lens(problem, state):
        return adjusted  # a camera that will be left out: its errors are no noise
    report("correlated noise", 0.92)
    refit = _refit_online if online else refit_with_correlated_noise
    refitted = refit(problem, state, refine_lenses)
    if refitted[1] is state and any(problem.crystal_rates):
        refitted = adjust(problem, state, rounds=1, iterations=9)[:2]  # the re-fit would have applied the rates' prior
    return replace(reconstruction, problem=refitted[0], state=refitted[1])


def _refit_online(problem: Problem, state: AdjustmentState, refine_lenses: bool) -> tuple[Problem, AdjustmentState]:
    """The re-fit with correlated noise, on a part of many rows: its cost grows with the cube of the rows a second.

    Eight cameras at 30 frames a second took 17 s for 60 s; errors correlated over tenths of a second are sampled often
    enough by a third of the rows.
    """
    begins, ends = zip(*((rows.time.min(), rows.time.max()) for rows in problem.rows if len(rows.time)), strict=True)
    duration = max(float(end - begin) for begin, end in zip(begins, ends, strict=True))
    rate = sum(len(rows.time) for rows in problem.rows) / max(duration, 1e-9)
    every = max(1, int(np.ceil(rate / _MAX_ONLINE_ROW_RATE)))
    thinned = problem
    if every > 1:
        thinned = replace(problem, rows=tuple(rows.every(every) for rows in problem.rows))
    refitted = refit_with_correlated_noise(thinned, state, refine_lenses, _ONLINE_MIN_INFLATION)
    return (problem, state) if refitted[1] is state else refitted


def bic_prefers(
    freed: Problem, freed_state: AdjustmentState, fixed: Problem, fixed_state: AdjustmentState, parameters: int
) -> bool:
    """Whether ``parameters`` more are justified (Bayesian information criterion).

    It uses the robust likelihood of all rows under each solution's own noise, at the effective sample size.
    """
    gain, rows = _gain(freed, freed_state, fixed, fixed_state)
    return bool(gain > parameters * np.log(max(rows, 2)))


def _gain(
    freed: Problem, freed_state: AdjustmentState, fixed: Problem, fixed_state: AdjustmentState
) -> tuple[float, float]:
    """By how much the deviance is less, and the effective rows."""
    inflation = correlation_inflation(freed, freed_state)
    rows = sum(len(part.time) / inflation[part.camera] for part in fixed.rows)
    return float(((deviances(fixed, fixed_state) - deviances(freed, freed_state)) / inflation).sum()), float(rows)


def deviances(problem: Problem, state: AdjustmentState) -> Floats:
    """(cameras,) twice the negative logarithm of the likelihood of each camera's rows."""
    total = np.zeros(len(state.cameras))
    for part in problem.rows:
        norms = residual_norms(part, state.cameras[part.camera], state.trajectories[part.label])
        norms = norms[np.isfinite(norms)]
        sigma = float(state.sigma[part.camera])
        total[part.camera] += float(np.minimum((norms / sigma) ** 2, 25.0).sum()) + 4.0 * len(norms) * np.log(sigma)
    return total
