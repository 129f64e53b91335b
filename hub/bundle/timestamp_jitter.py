"""Stamps that jitter: every frame's own time, found from where its labels lie along their motion.

A webcam's stamp is when its picture was fetched, not when it was taken: tens of milliseconds either way, another in
every frame. What a frame shows then lies off along the motion by one time for all its labels, and not across it; errors
of lenses and paths have no such reason, and last from frame to frame. So one time a frame is found, held by how much
the camera's stamps jitter (found as well), in turn with the adjustment; a label alone is then trusted across its motion
more than along it. Mean and trend of these times stay the clock's own offset and rate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtri

from hub.bundle.adjustment import adjust
from hub.bundle.problem import OFFSET, Problem, State
from hub.bundle.residuals import linearise
from hub.trajectory.discrete import PointBasis
from protocols.geometry.types import Bools, Floats, Ints

_LEAST_FRAMES = 25
_DOUBT = 1e-4
"""Chance of so much along the motion, against across it, where stamps don't jitter."""
_LEAST_RATIO = 2.0
"""Least of that: where stamps add less than the rows' own noise, their frames' times are not worth finding."""
_MOST_ROUNDS = 15
_SETTLED = 0.03
"""Change of the frames' times, against their jitter, at which they have settled."""
_REWEIGHTED = 4
_NEAR = 6.0  # sigma beyond which a row or a frame is a false detection
_LEAST_SIGMA = 0.05  # px
_ROBUST = 1.4826  # sigma of a Gaussian from its median absolute value
_WIDTH = 4.0  # Cauchy width in sigma of one row, as in the adjustment
_LARGEST = 0.1
"""s: a jitter beyond this is not believed."""


@dataclass(frozen=True, slots=True, eq=False)
class _Frames:
    """Rows of one camera by frame.

    frame: (n,) index of a row's frame. stamp: (m,) [s]. off: (n, 2) residuals [px] at the stamps' times. speed: (n, 2)
    of the point in the image [px/s].
    """

    frame: Ints
    stamp: Floats
    off: Floats
    speed: Floats

    def sums(self, values: Floats) -> Floats:
        """Sums (m,) of values (n,) over the rows of each frame."""
        return np.asarray(np.bincount(self.frame, values, len(self.stamp)), dtype=np.float64)


def settle(problem: Problem, state: State, progress: Callable[[str], None] | None = None) -> tuple[Problem, State]:
    """The frames' own times, and all else adjusted to them; both unchanged where no stamps are seen to jitter.

    problem, state: adjusted. Returns the problem with the rows' times moved, and the state with ``jitter`` (cameras,)
    [s]; 0 = the camera's stamps hold, as far as its frames tell.
    """
    if any(isinstance(path.basis, PointBasis) for path in state.trajectories) or not problem.freedom.clock:
        return problem, state
    cameras = range(len(state.cameras))
    found, fitted = problem, state
    jitter = np.zeros(len(cameras))
    for turn in range(_MOST_ROUNDS):
        parts = [_frames(problem, found, fitted, camera) for camera in cameras]
        jitter = np.array([_jitter(part, float(fitted.sigma[i])) for i, part in enumerate(parts)])
        if not jitter.any():
            return problem, state
        shifts = [_shifts(part, float(fitted.sigma[i]), float(jitter[i])) for i, part in enumerate(parts)]
        shifted = _shifted(problem, parts, shifts)
        steps = [after.time - before.time for after, before in zip(shifted.rows, found.rows, strict=True)]
        moved = float(np.sqrt(np.mean(np.concatenate(steps) ** 2)))
        found, fitted, _ = adjust(shifted, fitted, rounds=2, iterations=9)
        if progress is not None:
            progress(f"times of frames {turn + 1}: {float(np.median(fitted.sigma)):.2f} px")
        if moved < _SETTLED * float(jitter.max()):
            break
    return found, replace(fitted, jitter=jitter)


def _frames(given: Problem, now: Problem, state: State, camera: int) -> _Frames:
    """A camera's rows, less those that no other time brings near the path: they lie off across their motion too.

    given: with the stamps' times.
    """
    stamps, offs, speeds = [np.zeros(0)], [np.zeros((0, 2))], [np.zeros((0, 2))]
    for before, rows in zip(given.rows, now.rows, strict=True):
        if rows.camera != camera:
            continue
        every = np.ones(len(rows.time), dtype=np.bool_)
        line = linearise(rows.using(every), state.cameras[camera], state.trajectories[rows.label])
        speed = line.by_camera[:, :, OFFSET] * state.cameras[camera].rate
        off = line.residual - speed * (rows.time - before.time)[:, None]
        across = np.abs(_across(off, speed)) / np.maximum(np.linalg.norm(speed, axis=1), 1e-9)
        good = line.valid & np.isfinite(across)
        good &= across < _NEAR * max(_ROBUST * float(np.median(across[good])) if good.any() else 0.0, _LEAST_SIGMA)
        stamps.append(rows.stamps[good])
        offs.append(off[good])
        speeds.append(speed[good])
    stamp, frame = np.unique(np.concatenate(stamps), return_inverse=True)
    return _Frames(frame, stamp, np.concatenate(offs), np.concatenate(speeds))


def _across(off: Floats, speed: Floats) -> Floats:
    """Residuals (n,) across the motion, times its speed."""
    return np.asarray(off[:, 1] * speed[:, 0] - off[:, 0] * speed[:, 1])


def _alone(frames: _Frames, sigma: float) -> tuple[Floats, Floats, Floats]:
    """Each frame's time by itself (m,) [s], what it rests on (m,) [px²/s²], and the same across the motion (m,)."""
    across = _across(frames.off, frames.speed)
    along = (frames.off * frames.speed).sum(axis=1)
    square = (frames.speed**2).sum(axis=1)
    weight = np.ones(len(along))
    alone = side = told = np.zeros(len(frames.stamp))
    for _ in range(_REWEIGHTED):
        told = frames.sums(weight * square)
        over = 1.0 / np.where(told > 0.0, told, 1.0)
        alone, side = -frames.sums(weight * along) * over, frames.sums(weight * across) * over
        left = frames.off + frames.speed * alone[frames.frame, None]
        weight = 1.0 / (1.0 + (left**2).sum(axis=1) / (_WIDTH * sigma) ** 2)
    return alone, told, side


def _jitter(frames: _Frames, sigma: float) -> float:
    """Std [s] of the stamps of one camera; 0 where what lies along the motion is no more than what lies across it.

    From frame to frame only: what lasts is an error of the lens or of the path, not of stamps.
    """
    alone, told, side = _alone(frames, sigma)
    good = told > 0.0
    if np.count_nonzero(good) < _LEAST_FRAMES:
        return 0.0
    fast = told >= np.median(told[good])
    usual = _ROBUST * float(np.median(np.abs(np.diff(alone[fast])))) / np.sqrt(2.0)
    good &= _believed(alone, told, sigma, usual)
    if np.count_nonzero(good) < _LEAST_FRAMES:
        return 0.0
    weight = 2.0 / (1.0 / told[good][1:] + 1.0 / told[good][:-1])
    along = 0.5 * float((weight * np.diff(alone[good]) ** 2).sum())
    across = 0.5 * float((weight * np.diff(side[good]) ** 2).sum())
    enough = max(_LEAST_RATIO, float(fdtri(len(weight), len(weight), 1.0 - _DOUBT)))
    if along < enough * across:
        return 0.0
    return min(float(np.sqrt((along - across) / weight.sum())), _LARGEST)


def _believed(alone: Floats, told: Floats, sigma: float, jitter: float) -> Bools:
    """(m,) frames whose time by itself may be jitter and noise; any other is a false detection."""
    return np.asarray(np.abs(alone) < _NEAR * np.sqrt(jitter**2 + sigma**2 / np.maximum(told, 1e-9)))


def _shifts(frames: _Frames, sigma: float, jitter: float) -> Floats:
    """Each frame's time less its stamp (m,) [s]: its labels' word against the jitter's, mean and trend taken out."""
    alone, told, side = _alone(frames, sigma)
    good = (told > 0.0) & _believed(alone, told, sigma, jitter)
    if jitter == 0.0 or not good.any():
        return np.zeros(len(frames.stamp))
    # What labels of a frame have in common across their motion, they have along it too: no row is better than that.
    noise = max(sigma**2, float((told * side**2)[good].mean()))
    weight = np.where(good, told / (noise + told * jitter**2), 0.0)
    free = _without_trend(frames.stamp, alone, weight)
    return np.where(good, free * (told * jitter**2) / (noise + told * jitter**2), 0.0)


def _without_trend(time: Floats, values: Floats, weight: Floats) -> Floats:
    """Values (n,) less their weighted straight line: that is the clock's offset and rate."""
    about = time - np.average(time, weights=weight)
    line = np.column_stack([np.ones(len(time)), about]) * np.sqrt(weight)[:, None]
    fitted = np.linalg.lstsq(line, values * np.sqrt(weight), rcond=None)[0]
    return np.asarray(values - fitted[0] - fitted[1] * about)


def _shifted(given: Problem, parts: list[_Frames], shifts: list[Floats]) -> Problem:
    """The problem with every frame at its own time, and all rows asked again."""
    out = []
    for rows in given.rows:
        stamp = parts[rows.camera].stamp
        late = np.zeros(len(rows.time))
        if len(stamp):
            index = np.clip(np.searchsorted(stamp, rows.stamps), 0, len(stamp) - 1)
            late = np.where(stamp[index] == rows.stamps, shifts[rows.camera][index], 0.0)
        every = np.ones(len(rows.time), dtype=np.bool_)
        out.append(replace(rows, time=rows.time + late, stamp=rows.stamps, use=every))
    return replace(given, rows=tuple(out))
