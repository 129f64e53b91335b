"""Comparison of models that differ by a few parameters: measured lenses, rates of clocks, rolling-shutter readouts.

All are score tests of a `LinearisedModel`.

A slightly wrong lens has nearly the same effect as a rolling shutter, and its errors are correlated from frame to
frame. So the gain of freeing the readouts is computed with noise scaled to the effective sample size (`noise_scale`).
On recordings whose lenses err by a pixel no gain remains, while readouts freed by plain least squares come out at -40
and +35 ms.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.special import chdtri

from hub.bundle.block_matrix import BlockSum, ParameterCovariance
from hub.bundle.covariance import constrained_step
from hub.bundle.linearised_model import LinearisedModel, evidence_needed
from hub.bundle.noise.correlated_noise import lens_tolerance
from hub.bundle.noise.noise_scale import correlation_inflation, modelled_inflation
from hub.bundle.noise.timestamp_jitter import weighted_by_jitter
from hub.bundle.problem import CAMERA_PARAMETERS, CRYSTAL_RATE_STD, AdjustmentState, Column, Problem
from hub.bundle.smoothness_prior import estimate_smoothness
from protocols.geometry.types import Floats, Ints
from protocols.session.rig import MAX_READOUT_S

_FALSE_ALARM_PROBABILITY = 1e-4
"""Probability that one of the lenses of a correct rig is refuted."""
_READOUT_MARGIN = 0.25
"""Error of an estimated readout, in frame intervals, that is plausible: a global shutter's comes out at about 0."""
_REVERSED_EVIDENCE = 4.0
"""Of what a readout needs, for one below 0: seven stds. Slightly wrong lenses made readouts of -3.4 stds."""
_TESTED_AT_ONCE = 64  # cameras: of all, their columns would be as large as the matrix
_TANGENTIAL_SHARE = 0.25
"""Of what free principal points gain: a ninth of it at most in six mirrored rigs, all of it in others."""
REFUTED_SIGMA = 4.0
"""Stds from which a rate is no crystal's: of a hundred cameras with crystals one in 160 is refuted."""
LENS = (Column.FOCAL, Column.K1, Column.CENTRE, Column.CENTRE + 1)
"""What a measured lens is tested for: another focal length or distortion, and another part of the picture."""


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


def refuted_lenses(problem: Problem, state: AdjustmentState, *tested: tuple[int, ...]) -> list[ScoreTest]:
    """Measured lenses that the observations refute, most significant first.

    problem, state: adjusted with these lenses fixed. tested: sets of parameters, those that lenses are tested for
    (`LENS`), and others where none is refuted so. Forward selection: the lens whose parameters lower the cost most is
    freed, then the next one beside it, so that an honest lens is not blamed for another's error. Noise is scaled to the
    effective sample size. What the linear model predicts of each has to come true: in a short or narrow motion it may
    predict any focal length.
    """
    given = [camera for camera in range(len(state.cameras)) if problem.lens_prior(camera) is None]
    if not problem.free_parameters.pose or problem.free_parameters.lens or not given:
        return []
    linear = _with_any_lens(problem, state)
    found = (_refuted_lenses(problem, linear, given, parameters) for parameters in tested)
    return next(filter(None, found), [])


def mirrored_axis(problem: Problem, state: AdjustmentState) -> str:
    """The pixel coordinate that every camera with a measured lens counts from the other side, "u" or "v"; "" if none.

    problem, state: adjusted with these lenses fixed. Mirrored pictures fit a mirrored world, but for the principal
    points, which are mirrored with them: these then have to fit instead, by as much as refutes the given ones, and as
    well as free ones do, within what may be owed to the tangential distortions, which no parameter mirrors.
    """
    given = [camera for camera in range(len(state.cameras)) if problem.lens_prior(camera) is None]
    linear = _with_any_lens(problem, state)
    columns = linear.problem.free_columns
    kept = np.flatnonzero(np.isin(columns, problem.free_columns))
    own = np.flatnonzero(
        np.isin(columns, [i * CAMERA_PARAMETERS + Column.CENTRE + axis for i in given for axis in (0, 1)])
    )

    def best_step(free: Ints) -> tuple[Floats, ParameterCovariance]:
        normal, fixed = linear.parts.reduced.restricted(free), linear.fixed[:, free]
        return constrained_step(normal, -linear.gradient[free], fixed, np.zeros(len(fixed)))

    step, covariance = best_step(kept)
    coupling = linear.parts.reduced.columns(own)
    left = linear.gradient[own] + coupling[kept].T @ step
    with_centres = np.union1d(kept, own)
    gained = float(linear.gradient[kept] @ step - linear.gradient[with_centres] @ best_step(with_centres)[0])
    limit = float(chdtri(len(own), _FALSE_ALARM_PROBABILITY))
    for axis, name in enumerate("uv"):
        change = np.zeros((len(given), 2))
        change[:, axis] = [
            (problem.nominal[i].width, problem.nominal[i].height)[axis] - 1 - 2.0 * problem.nominal[i].matrix[axis, 2]
            for i in given
        ]
        moved = change.ravel()
        known = coupling[kept] @ moved
        gain = float(known @ (covariance @ known) - 2.0 * left @ moved - moved @ coupling[own] @ moved)
        if gain > limit and gained - gain < max(limit, _TANGENTIAL_SHARE * gained):
            return name
    return ""


def _with_any_lens(problem: Problem, state: AdjustmentState) -> LinearisedModel:
    """The model with all lenses free, its noise scaled to the effective sample size."""
    # So wide that only the observations count.
    wide = [
        replace(lens_tolerance(one), focal_std=0.5, centre_std=0.5 * one.width, k1_std=0.5) for one in problem.nominal
    ]
    freed = replace(problem, lens_tolerances=tuple(wide))
    modelled = [modelled_inflation(problem, state, camera) for camera in range(len(state.cameras))]
    inflation = np.maximum(correlation_inflation(problem, state), modelled)
    noisy = replace(state, sigma=state.sigma * np.sqrt(inflation))
    return LinearisedModel.about(freed, noisy, estimate_smoothness(problem, state))


def _refuted_lenses(
    problem: Problem, linear: LinearisedModel, given: list[int], tested: tuple[int, ...]
) -> list[ScoreTest]:
    """Those of the cameras ``given`` by one set of parameters. linear: with all lenses free."""
    columns, count = linear.problem.free_columns, len(problem.nominal)
    own = {camera: camera * CAMERA_PARAMETERS + np.array(tested) for camera in given}

    def with_lenses(chosen: Iterable[int]) -> Ints:
        """The columns of all other parameters and of these lenses."""
        wanted = np.concatenate([problem.free_columns, *(own[camera] for camera in chosen)])
        return np.flatnonzero(np.isin(columns, wanted))

    @cache
    def cost(*chosen: int) -> float:
        return linear.cost_after(with_lenses(chosen))

    limit = float(chdtri(len(tested), _FALSE_ALARM_PROBABILITY / len(given)))
    candidates = set(given)
    while True:
        kept = with_lenses(candidates)
        lens = {camera: np.searchsorted(columns[kept], own[camera]) for camera in sorted(candidates)}
        normal = linear.parts.reduced.restricted(kept)
        found = _forward_selection(normal, linear.gradient[kept], linear.fixed[:, kept], lens, limit)
        believed: tuple[int, ...] = ()
        for one in found:
            trial = *believed, one.camera
            # Far from where the model is linear, what it predicts does not come true. Of two cameras it has to: their
            # path follows any lens, and 6 of 65 right ones were refuted by an adjustment with the lens free.
            gains = cost(*believed) - cost(*trial) > limit
            if not gains and (count == 2 or linear.gain(one.camera, with_lenses(trial)) <= limit):
                candidates.remove(one.camera)
                break
            believed = trial
        if len(believed) == len(found):
            return found


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
    covariance = LinearisedModel.about(wide, noisy, estimate_smoothness(problem, state)).covariance
    variance = dict(zip(wide.free_columns.tolist(), covariance.diagonal().tolist(), strict=True))
    reference = state.cameras[problem.clock_reference].rate
    crystal = tuple(
        (camera.rate - reference) ** 2
        < REFUTED_SIGMA**2 * (CRYSTAL_RATE_STD**2 + variance.get(i * CAMERA_PARAMETERS + Column.RATE, 0.0))
        for i, camera in enumerate(state.cameras)
    )
    return replace(problem, crystal_rates=crystal)


def are_readouts_observable(problem: Problem, state: AdjustmentState) -> bool:
    """Whether the observations ask for the readout of a camera, beside wrong lenses and jitter.

    problem, state: adjusted with fixed readouts. Forward selection, with noise scaled to the effective sample size.
    """
    linear, needed = LinearisedModel.in_its_noise(*weighted_by_jitter(problem, state)), evidence_needed(problem, 1)
    return bool(_forward_selection(linear.parts.reduced, linear.gradient, linear.fixed, linear.readouts(), needed))


def with_free_readouts(problem: Problem) -> Problem:
    """The problem with all readouts free that were not given.

    Also of cameras that do not ask for it: where one rolls its shutter the others may, and held at 0 they bias it.
    """
    return replace(problem, free_parameters=replace(problem.free_parameters, readout=True))


def are_readouts_supported(problem: Problem, state: AdjustmentState) -> bool:
    """Whether all estimated readouts are plausible and one of them is significant."""
    return are_readouts_plausible(problem, state) and max(_readout_evidence(problem, state).values(), default=0.0) > 1.0


def _readout_evidence(problem: Problem, state: AdjustmentState) -> dict[int, float]:
    """By camera whose readout was not given, its chi-squared over what a parameter of a clock needs."""
    linear, needed = LinearisedModel.in_its_noise(*weighted_by_jitter(problem, state)), evidence_needed(problem, 1)
    variance = linear.covariance.diagonal() * needed
    return {camera: state.cameras[camera].readout ** 2 / variance[k] for camera, (k,) in linear.readouts().items()}


def are_readouts_plausible(problem: Problem, state: AdjustmentState) -> bool:
    """Whether all readouts are within the range of real cameras: up to a frame interval, in either direction.

    A sensor is read from its first row to its last before the next frame, in at most `MAX_READOUT_S`; given readouts
    may say otherwise. Of one that is mounted upside down and turns its picture, the last row is read first: that takes
    more evidence.
    """
    longest = np.array([problem.longest_readout(camera) for camera in range(len(state.cameras))])
    readout = np.array([camera.readout for camera in state.cameras])
    if (np.abs(readout) >= np.minimum((1.0 + _READOUT_MARGIN) * longest, MAX_READOUT_S)).any():
        return False
    below = set(np.flatnonzero(readout <= -_READOUT_MARGIN * longest).tolist())
    return not below or below <= _reversed_cameras(problem, state)


def _reversed_cameras(problem: Problem, state: AdjustmentState) -> set[int]:
    """Cameras that clearly read their last row first. Portrait pictures are as often turned to the left as right."""
    needed = [1.0 if lens.is_portrait else _REVERSED_EVIDENCE for lens in problem.nominal]
    evidence = _readout_evidence(problem, state)
    return {i for i, one in evidence.items() if one > needed[i] and state.cameras[i].readout < 0.0}


def without_negative_readouts(problem: Problem, state: AdjustmentState) -> tuple[Problem, AdjustmentState]:
    """The problem with readouts that came out below 0, but not clearly, held there: those of global shutters."""
    clear, given = _reversed_cameras(problem, state), problem.readout_given or (False,) * len(state.cameras)
    below = [camera.readout < 0.0 and i not in clear for i, camera in enumerate(state.cameras)]
    cameras = [replace(one, readout=0.0) if held else one for one, held in zip(state.cameras, below, strict=True)]
    held = tuple(a or b for a, b in zip(given, below, strict=True))
    return replace(problem, readout_given=held), replace(state, cameras=tuple(cameras))
