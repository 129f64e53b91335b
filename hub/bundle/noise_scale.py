"""The noise that the covariances go by: the median residual, corrected for what it hides.

A path with many knots follows part of the noise, so that residuals are smaller than the noise was. And errors of
lenses and clocks last from frame to frame, so that n residuals tell less than n separate ones would.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hub.bundle.bordered_system import BAND
from hub.bundle.covariance import Covariance, covariance
from hub.bundle.problem import CAMERA_PARAMETERS, Problem, Rows, State
from hub.bundle.residuals import linearise, predict
from hub.trajectory.discrete import PointBasis
from hub.trajectory.smoothness_prior import MotionPrior
from hub.trajectory.splines import SUPPORT
from protocols.geometry.types import Floats

_MOST_ROWS = 2000
"""Rows of a camera of which the absorbed share is taken; evenly spread."""
_LEAST_LEFT = 0.2
"""Least share of the numbers that a camera must have left after what the path absorbed."""
_LONGEST_S = 2.0
"""Time [s] over which residuals are looked at for erring together."""
_MOST_TOGETHER = 1000.0
_LEAST_PAIRS = 200
"""Pairs of residuals at one lag from which their correlation is told."""
_TOLD = 3.0
"""Sigma by which a correlation must stand out before it is believed."""


def honest(problem: Problem, state: State, prior: MotionPrior) -> State:
    """The state with ``sigma`` (cameras,) as a covariance must have it; nothing else changes.

    Separate points (a shared clock) come with their own correction (`adjust.noise`) and stay.
    """
    if any(isinstance(path.basis, PointBasis) for path in state.trajectories):
        return state
    found = covariance(problem, state, prior)
    absorbed, alike = np.zeros(len(state.cameras)), np.ones(len(state.cameras))
    numbers = np.zeros(len(state.cameras))
    for rows in problem.rows:
        numbers[rows.camera] += 2.0 * float(np.count_nonzero(rows.use))
        absorbed[rows.camera] += _absorbed(problem, state, found, rows)
    for camera in range(len(state.cameras)):
        alike[camera] = max(together(problem, state, camera), modelled(problem, state, camera))
    left = np.maximum(1.0 - absorbed / np.maximum(numbers, 1.0), _LEAST_LEFT)
    return replace(state, sigma=state.sigma * np.sqrt(alike / left))


def _absorbed(problem: Problem, state: State, found: Covariance, rows: Rows) -> float:
    """How many of the rows' numbers the fit follows: the trace of the hat matrix over them."""
    used = np.flatnonzero(rows.use)
    if not len(used):
        return 0.0
    pick = used[np.unique(np.linspace(0, len(used) - 1, min(len(used), _MOST_ROWS)).astype(np.int64))]
    use = np.zeros_like(rows.use)
    use[pick] = True
    line = linearise(rows.using(use), state.cameras[rows.camera], state.trajectories[rows.label], CAMERA_PARAMETERS)
    base = 3 * sum(path.basis.size for path in state.trajectories[: rows.label])
    first = base + 3 * line.index
    inside = (first % BAND)[:, None] + np.arange(BAND)
    blocks = found.blocks[(first // BAND)[:, None, None], inside[:, :, None], inside[:, None, :]]
    w, n = line.weights, len(line.index)
    point = np.einsum("na,naibj,nb->nij", w, blocks.reshape(n, SUPPORT, 3, SUPPORT, 3), w, optimize=True)
    trace = float(np.einsum("npi,nij,npj->", line.by_point, point, line.by_point, optimize=True))
    if found.free.size:
        around = found.carried[first[:, None] + np.arange(BAND)].reshape(n, SUPPORT, 3, -1)
        shift = -line.by_point @ np.einsum("na,naip->nip", w, around)
        columns = problem.free_columns()
        mine = np.flatnonzero(columns // CAMERA_PARAMETERS == rows.camera)
        shift[:, :, mine] += line.by_camera[:, :, columns[mine] % CAMERA_PARAMETERS]
        trace += float(np.einsum("npi,ij,npj->", shift, found.free, shift, optimize=True))
    return trace / float(state.sigma[rows.camera]) ** 2 * len(used) / len(pick)


def modelled(problem: Problem, state: State, camera: int) -> float:
    """How many residuals count as one by the noise that was found; 1 where none was."""
    if state.coloured is None:
        return 1.0
    times = [np.unique(rows.time[rows.use]) for rows in problem.rows if rows.camera == camera]
    if not any(len(time) > 1 for time in times):
        return 1.0
    white, lasting = float(state.coloured.white[camera]) ** 2, float(state.coloured.lasting[camera]) ** 2
    step = float(np.median(np.concatenate([np.diff(time) for time in times])))
    kept = float(np.exp(-step / state.coloured.seconds[camera]))
    return 1.0 + 2.0 * lasting / (white + lasting) * kept / max(1.0 - kept, 1e-6)


def together(problem: Problem, state: State, camera: int) -> float:
    """How many of a camera's residuals count as one: those in a row of a label, times those of a frame's labels.

    1 + 2 sum of the correlations from frame to frame, and 1 + (labels - 1) times that within a frame, as far as these
    stand out.
    """
    parts: list[tuple[Floats, Floats]] = []
    for rows in problem.rows:
        if rows.camera != camera or np.count_nonzero(rows.use) < 8:
            continue
        off = (predict(rows, state.cameras[camera], state.trajectories[rows.label]) - rows.pixels)[rows.use]
        good = np.isfinite(off).all(axis=1)
        parts.append((rows.stamps[rows.use][good], off[good]))
    frames = _in_a_frame(parts)
    return frames * _in_a_row(parts, frames)


def _in_a_frame(parts: list[tuple[Floats, Floats]]) -> float:
    """parts: stamps (n,) and residuals (n, 2), one entry a label."""
    if len(parts) < 2:
        return 1.0
    off = np.concatenate([part[1] for part in parts])
    stamps, frame = np.unique(np.concatenate([part[0] for part in parts]), return_inverse=True)
    shown = np.bincount(frame, minlength=len(stamps))
    others = shown - 1.0
    pairs = float((shown * others).sum()) / 2.0
    variance = float(np.mean(off**2))
    if pairs < _LEAST_PAIRS or variance <= 0.0:
        return 1.0
    sums = np.stack([np.bincount(frame, column, len(stamps)) for column in off.T])
    correlation = (float((sums**2).sum()) - float((off**2).sum())) / (4.0 * pairs * variance)
    if correlation < _TOLD / np.sqrt(2.0 * pairs):
        return 1.0
    return 1.0 + float((shown * others).sum() / shown.sum()) * correlation


def _in_a_row(parts: list[tuple[Floats, Floats]], frames: float = 1.0) -> float:
    """parts: as above, in any order. frames: how many labels of a frame count as one: so few are their pairs."""
    parts = [(time[order], off[order].T.copy()) for time, off in parts for order in [np.argsort(time, kind="stable")]]
    steps = np.concatenate([np.diff(time) for time, _ in parts]) if parts else np.zeros(0)
    step = float(np.median(steps)) if len(steps) else 0.0
    variance = float(np.mean(np.concatenate([off for _, off in parts], axis=1) ** 2)) if parts else 0.0
    if step <= 0.0 or variance <= 0.0:
        return 1.0
    total = 1.0
    for lag in range(1, round(_LONGEST_S / step) + 1):
        product, pairs = 0.0, 0
        for time, off in parts:
            if lag < len(time):
                near = np.abs(time[lag:] - time[:-lag] - lag * step) < 0.5 * step
                product += float(((off[:, lag:] * off[:, :-lag]) @ near).sum())
                pairs += int(np.count_nonzero(near))
        if pairs < _LEAST_PAIRS:
            break
        correlation = 0.5 * product / pairs / variance
        if correlation < _TOLD * np.sqrt(frames / (2.0 * pairs)):
            break
        total += 2.0 * correlation
    return min(total, _MOST_TOGETHER)
