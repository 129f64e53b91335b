"""Timestamp jitter: exposure times of individual frames, estimated from residuals along the targets' motion.

A webcam's timestamp is the time at which a frame was fetched, not exposed: it errs by tens of milliseconds,
independently in every frame. All labels of a frame are then displaced along their motion by one common time shift, and
not across it; errors of lenses and paths have no preferred direction and are correlated from frame to frame. So one
time shift a frame is estimated, with a Gaussian prior whose std (the jitter, estimated too) is the camera's,
alternating with the adjustment. A single label then constrains the path across its motion more than along it. What a
clock's offset, rate, steps and a readout explain of the shifts is left to them, and what lasts is its wander.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.special import chdtri, fdtri

from hub.bundle.adjustment import adjust
from hub.bundle.covariance import middles_of_overlap
from hub.bundle.initialisation import SEEN_WITHIN_S
from hub.bundle.noise.clock_wander import Wander, fit_wander
from hub.bundle.normal_equations import CAUCHY_WIDTH
from hub.bundle.problem import AdjustmentState, Column, Problem, TrackObservations
from hub.bundle.residuals import ResidualEvaluation, evaluate_residuals, jacobians
from hub.trajectory.discrete import PointBasis
from protocols.geometry.types import Bools, Floats, Ints

_MIN_FRAMES = 25  # from which a variance ratio is known to a third
_FALSE_ALARM_PROBABILITY = 1e-4
"""False-alarm probability of the variance ratio (F-test, along against across the motion) without jitter."""
_WANDER_FALSE_ALARM = 0.01
"""Probability that a recording with even clocks has one that wanders: it costs a larger std. Of 60 simulated recordings
with 10 to 50 frames a second the largest gain was 2.9, where 8 is the limit."""
_MIN_VARIANCE_RATIO = 2.0
"""Smallest variance ratio: with jitter below the rows' own noise, estimating frame times is not worth it."""
_MAX_ROUNDS = 15  # a bound: it stops where times change no more
_CONVERGED_SHARE = 0.03
"""Change of the frame times relative to their jitter at which the iteration has converged."""
_REWEIGHTINGS = 4  # of outliers' weights
_OUTLIER_SIGMA = 6.0  # sigma beyond which a row or a frame is an outlier
_MIN_SIGMA_PX = 0.05  # px
_MAD_TO_SIGMA = 1.4826  # std of a Gaussian from its median absolute value
_MAX_JITTER_S = 0.1
"""s: upper limit of the estimated jitter."""


@dataclass(frozen=True, slots=True, eq=False)
class _FrameRows:
    """Rows of one camera grouped by frame.

    frame: (n,) index of a row's frame. stamp: (m,) timestamps [s]. clock: (m, k) derivatives of a frame's time with
    respect to the clock's parameters. residual: (n, 2) [px] at the timestamps. velocity: (n, 2) of the point [px/s];
    both over the rows' relative stds.
    """

    frame: Ints
    stamp: Floats
    clock: Floats
    residual: Floats
    velocity: Floats

    def sums(self, values: Floats) -> Floats:
        """Sums (m,) of values (n,) over the rows of each frame."""
        return np.asarray(np.bincount(self.frame, values, len(self.stamp)), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class _ObservedTimes:
    """Internal times (n,) of one camera's rows in use, and the median interval between them [s]."""

    camera: int
    times: Floats
    interval: float


def estimate_frame_times(
    problem: Problem, state: AdjustmentState, progress: Callable[[str], None] | None = None, *, newest: bool = False
) -> tuple[Problem, AdjustmentState]:
    """Estimate frame times and re-adjust; problem and state are returned unchanged where all clocks are even.

    problem, state: adjusted. newest: a clock that wanders is given by its newest rows, not by those in the middle of
    the span that it shares with the reference. Returns the problem with corrected row times, and the state with
    ``jitter`` (cameras,) [s], 0 = no jitter detected for that camera, and the clocks that wander.
    """
    if any(isinstance(path.basis, PointBasis) for path in state.trajectories) or not problem.free_parameters.clock:
        return problem, state
    cameras = range(len(state.cameras))
    found, fitted = problem, state
    jitter, wanders, settled = np.zeros(len(cameras)), dict[int, Wander](), True
    for round_index in range(_MAX_ROUNDS):
        parts = [_frames(problem, found, fitted, camera) for camera in cameras]
        jitter = np.array([_jitter_std(part, float(fitted.sigma[i])) for i, part in enumerate(parts)])
        instants = None if newest else middles_of_overlap(problem, fitted)[:, problem.clock_reference]
        before, wanders = wanders, _wanders(parts, fitted, jitter, instants, wanders, further=settled)
        if not jitter.any() and not wanders:
            return problem, state
        if round_index and settled and len(wanders) == len(before):
            break
        shifts = [
            _posterior_shifts(part, float(fitted.sigma[i]), float(jitter[i]), wanders.get(i))
            for i, part in enumerate(parts)
        ]
        shifted = _apply_shifts(problem, parts, shifts, wanders)
        steps = [after.time - before.time for after, before in zip(shifted.rows, found.rows, strict=True)]
        moved = float(np.sqrt(np.mean(np.concatenate(steps) ** 2)))
        found, fitted, _ = adjust(shifted, fitted, rounds=2, iterations=9)
        if progress is not None:
            progress(f"frame times {round_index + 1}: {float(np.median(fitted.sigma)):.2f} px")
        most = max([float(jitter.max()), *(float(one.values.std()) for one in wanders.values())])
        settled = moved < _CONVERGED_SHARE * most
    return found, replace(fitted, jitter=jitter if jitter.any() else None, wanders=tuple(wanders.values()))


def _wanders(
    parts: list[_FrameRows],
    state: AdjustmentState,
    jitter: Floats,
    instants: Floats | None,
    known: Mapping[int, Wander],
    *,
    further: bool,
) -> dict[int, Wander]:
    """The clocks that wander: those that are ``known`` to and still gain, and the one of the others that does most.

    further: whether one of the others may: not while the path still follows a known one. instants: (cameras,) internal
    times at which the even clocks agree with them; None = that of the last frames. The likelihood ratio has to be more
    than chance, and than all that correlated errors gain across the motion, where no clock shows: on two recorded
    rigs, whose lenses are 2 % off, it is at most 0.8 of that, on twelve with errors correlated over a second 0.9.
    """
    found, across = dict[int, Wander](), 0.0
    for camera, frames in enumerate(parts):
        sigma = float(state.sigma[camera])
        shift, information, transverse = _independent_shifts(frames, sigma)
        good = information > 0.0
        if np.count_nonzero(good) < _MIN_FRAMES:
            continue
        typical = _MAD_TO_SIGMA * float(np.median(np.abs(shift[good] - np.median(shift[good]))))
        good &= _is_inlier(shift, information, sigma, typical)
        if np.count_nonzero(good) < _MIN_FRAMES:
            continue
        noise = max(sigma**2, float((information * transverse**2)[good].mean()))
        weight = 1.0 / (noise / information[good] + jitter[camera] ** 2)
        stamp = frames.stamp[good]
        instant = stamp[-1] if instants is None else state.cameras[camera].camera_time(instants[[camera]])[0]
        along, aside = (fit_wander(camera, stamp, one[good], weight, float(instant)) for one in (shift, transverse))
        if along is not None and aside is not None:
            found[camera], across = along, across + aside.gain
    # A variance is on the border of its range: half of its statistic is 0.
    limit = across + float(chdtri(1, 2.0 * _WANDER_FALSE_ALARM / len(parts)))
    others = (one for one in found.values() if further and one.camera not in known and one.is_plausible)
    new = max(others, key=lambda one: one.gain, default=None)
    least = {camera: 0.0 if camera in known else limit for camera in found}
    return {i: one for i, one in found.items() if one.gain > least[i] and (i in known or one is new)}


def weighted_by_jitter(problem: Problem, state: AdjustmentState) -> tuple[Problem, AdjustmentState]:
    """Problem and state whose rows have the noise that jitter adds along their motion, where it is detected.

    What is tested in them is compared with jitter, and covariances are those of frame times that are estimated too. All
    rows of a frame share its error: together they tell a time with variance jitter² + noise² / sum of squared speeds.
    """
    rows, sigma = list(problem.rows), state.sigma.copy()
    for camera in range(len(state.cameras)):
        frames = _frames(problem, problem, state, camera)
        jitter = _jitter_std(frames, float(sigma[camera])) if state.jitter is None else float(state.jitter[camera])
        if not jitter:
            continue
        speed = np.maximum(np.linalg.norm(frames.velocity, axis=1), 1e-9)
        across = _transverse(frames.residual, frames.velocity) / speed
        noise = sigma[camera] = max(_MAD_TO_SIGMA * float(np.median(np.abs(across))), _MIN_SIGMA_PX)
        mine = [index for index, part in enumerate(rows) if part.camera == camera]
        square = [np.nan_to_num(np.square(_velocity(rows[index], state)[1]).sum(axis=1)) for index in mine]
        _, frame = np.unique(np.concatenate([rows[index].stamps for index in mine]), return_inverse=True)
        of_frame = np.bincount(frame, np.concatenate(square))[frame]
        for index, own in zip(mine, np.split(of_frame, np.cumsum([len(one) for one in square])[:-1]), strict=True):
            rows[index] = replace(rows[index], along_std=np.sqrt(1.0 + jitter**2 * own / noise**2))
    return replace(problem, rows=tuple(rows)), replace(state, sigma=sigma)


def _frames(stamped: Problem, current: Problem, state: AdjustmentState, camera: int) -> _FrameRows:
    """A camera's rows by frame, without those displaced across their motion, which no time shift explains, and those
    whose path is extrapolated.

    stamped: the problem with the original timestamps.
    """
    stamps, heights, residuals, velocities = [np.zeros(0)], [np.zeros(0)], [np.zeros((0, 2))], [np.zeros((0, 2))]
    for before, rows in zip(stamped.of_camera(camera), current.of_camera(camera), strict=True):
        seen, velocity = _velocity(rows, state)
        residual = (seen.whitened(seen.residual) * np.sqrt(seen.relative_information)).T
        residual -= velocity * (rows.time - before.time)[:, None]
        across = np.abs(_transverse(residual, velocity)) / np.maximum(np.linalg.norm(velocity, axis=1), 1e-9)
        good = seen.valid & np.isfinite(across) & _is_path_held(current, state, rows)
        good &= across < _OUTLIER_SIGMA * max(
            _MAD_TO_SIGMA * float(np.median(across[good])) if good.any() else 0.0, _MIN_SIGMA_PX
        )
        stamps.append(rows.stamps[good])
        heights.append(state.cameras[camera].row_offset(rows.pixels[good]))
        residuals.append(residual[good])
        velocities.append(velocity[good])
    stamp, frame = np.unique(np.concatenate(stamps), return_inverse=True)
    height = np.bincount(frame, np.concatenate(heights)) / np.bincount(frame)
    clock = _clock_parameters(current, state, camera, stamp, height)
    return _FrameRows(frame, stamp, clock, np.concatenate(residuals), np.concatenate(velocities))


def _is_path_held(problem: Problem, state: AdjustmentState, rows: TrackObservations) -> Bools:
    """Rows (n,) with rows of the same label by other cameras before and after them: beyond these its path is
    extrapolated, and all rows of such an end would be late or early together."""
    others = [one for one in _observed_times(problem, state)[rows.label] if one.camera != rows.camera]
    known = np.sort(np.concatenate([[-np.inf, np.inf], *(one.times for one in others)]))
    time = state.cameras[rows.camera].reference_time(rows.time)
    after, before = known[np.searchsorted(known, time)], known[np.searchsorted(known, time, "right") - 1]
    within = max([SEEN_WITHIN_S, *(one.interval for one in others)])
    return np.asarray(np.maximum(after - time, time - before) <= within)


@lru_cache(maxsize=1)  # for each camera in turn
def _observed_times(problem: Problem, state: AdjustmentState) -> dict[int, list[_ObservedTimes]]:
    """When each label is seen, by camera."""
    found: dict[int, list[_ObservedTimes]] = {}
    for label, parts in problem.by_label.items():
        for part in parts:
            times = state.cameras[part.camera].reference_time(part.time[part.use])
            interval = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
            found.setdefault(label, []).append(_ObservedTimes(part.camera, times, interval))
    return found


def _velocity(rows: TrackObservations, state: AdjustmentState) -> tuple[ResidualEvaluation, Floats]:
    """Residuals of all rows, and their velocities (n, 2) [px/s] over the rows' relative stds."""
    camera, every = state.cameras[rows.camera], rows.using(np.ones(len(rows.time), dtype=np.bool_))
    seen = evaluate_residuals(every, camera, state.trajectories[rows.label])
    velocity = jacobians(seen, camera, [Column.OFFSET])[:, 3] * np.sqrt(seen.relative_information)
    return seen, velocity.T * camera.rate


def _clock_parameters(problem: Problem, state: AdjustmentState, camera: int, stamp: Floats, height: Floats) -> Floats:
    """Derivatives (m, k) of frames' times with respect to a clock's free parameters.

    They are offset, rate, readout if it is free, and the sizes of clock steps. stamp: (m,) timestamps [s]. height: (m,)
    mean image row of their observations relative to the middle one.
    """
    readout = [height] if problem.is_readout_free(camera) else []
    steps = [stamp >= step.time for step in state.clock_steps if step.camera == camera]
    return np.column_stack([np.ones(len(stamp)), stamp - state.cameras[camera].centre, *readout, *steps])


def _transverse(residual: Floats, velocity: Floats) -> Floats:
    """Residuals (n,) across the motion, times the speed."""
    return np.asarray(residual[:, 1] * velocity[:, 0] - residual[:, 0] * velocity[:, 1])


def _independent_shifts(frames: _FrameRows, sigma: float) -> tuple[Floats, Floats, Floats]:
    """Maximum-likelihood time shift of each frame (m,) [s], its information (m,) [px²/s²], and the transverse analogue
    (m,) [s], which noise alone produces.
    """
    across = _transverse(frames.residual, frames.velocity)
    along = (frames.residual * frames.velocity).sum(axis=1)
    square = (frames.velocity**2).sum(axis=1)
    weight = np.ones(len(along))
    shift = transverse = information = np.zeros(len(frames.stamp))
    for _ in range(_REWEIGHTINGS):
        information = frames.sums(weight * square)
        over = 1.0 / np.where(information > 0.0, information, 1.0)
        shift, transverse = -frames.sums(weight * along) * over, frames.sums(weight * across) * over
        left = frames.residual + frames.velocity * shift[frames.frame, None]
        weight = 1.0 / (1.0 + (left**2).sum(axis=1) / (CAUCHY_WIDTH * sigma) ** 2)
    return shift, information, transverse


def _jitter_std(frames: _FrameRows, sigma: float) -> float:
    """Std [s] of one camera's timestamps; 0 unless residuals along the motion are significantly larger than across it.

    From differences of successive frames only: correlated errors come from the lens or the path, not from timestamps.
    """
    shift, information, transverse = _independent_shifts(frames, sigma)
    good = information > 0.0
    if np.count_nonzero(good) < _MIN_FRAMES:
        return 0.0
    fast = information >= np.median(information[good])
    typical = _MAD_TO_SIGMA * float(np.median(np.abs(np.diff(shift[fast])))) / np.sqrt(2.0)
    good &= _is_inlier(shift, information, sigma, typical)
    if np.count_nonzero(good) < _MIN_FRAMES:
        return 0.0
    weight = 2.0 / (1.0 / information[good][1:] + 1.0 / information[good][:-1])
    along = 0.5 * float((weight * np.diff(shift[good]) ** 2).sum())
    across = 0.5 * float((weight * np.diff(transverse[good]) ** 2).sum())
    threshold = max(_MIN_VARIANCE_RATIO, float(fdtri(len(weight), len(weight), 1.0 - _FALSE_ALARM_PROBABILITY)))
    if along < threshold * across:
        return 0.0
    return min(float(np.sqrt((along - across) / weight.sum())), _MAX_JITTER_S)


def _is_inlier(shift: Floats, information: Floats, sigma: float, jitter: float) -> Bools:
    """(m,) frames whose shift is explained by jitter and noise; the others are outliers."""
    return np.asarray(np.abs(shift) < _OUTLIER_SIGMA * np.sqrt(jitter**2 + sigma**2 / np.maximum(information, 1e-9)))


def _posterior_shifts(frames: _FrameRows, sigma: float, jitter: float, wander: Wander | None) -> Floats:
    """Posterior mean of each frame's time minus its timestamp (m,) [s] under the jitter prior, beside the clock's
    offset, rate, readout, steps and wander."""
    shift, information, transverse = _independent_shifts(frames, sigma)
    shift = shift if wander is None else shift - wander.at(frames.stamp)
    good = (information > 0.0) & _is_inlier(shift, information, sigma, jitter)
    if jitter == 0.0 or not good.any():
        return np.zeros(len(frames.stamp))
    # A common error of a frame's labels across the motion also exists along it: a lower bound of the frame's noise.
    noise = max(sigma**2, float((information * transverse**2)[good].mean()))
    weight = np.where(good, information / (noise + information * jitter**2), 0.0)
    root = np.sqrt(weight)
    free = shift - frames.clock @ np.linalg.lstsq(frames.clock * root[:, None], shift * root, rcond=None)[0]
    return np.where(good, free * (information * jitter**2) / (noise + information * jitter**2), 0.0)


def _apply_shifts(
    stamped: Problem, parts: list[_FrameRows], shifts: list[Floats], wanders: Mapping[int, Wander]
) -> Problem:
    """The problem with every frame at its estimated time, and all rows in use again."""
    out = []
    for rows in stamped.rows:
        stamp = parts[rows.camera].stamp
        frame_shift = np.zeros(len(rows.time))
        if len(stamp):
            index = np.clip(np.searchsorted(stamp, rows.stamps), 0, len(stamp) - 1)
            frame_shift = np.where(stamp[index] == rows.stamps, shifts[rows.camera][index], 0.0)
        if rows.camera in wanders:
            frame_shift = frame_shift + wanders[rows.camera].at(rows.stamps)
        all_rows = np.ones(len(rows.time), dtype=np.bool_)
        out.append(replace(rows, time=rows.time + frame_shift, stamp=rows.stamps, use=all_rows))
    return replace(stamped, rows=tuple(out))
