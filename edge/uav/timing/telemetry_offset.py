"""The offset between a camera's clock and its telemetry's: the turning seen in the pictures against the attitude's.

telemetry time = camera time + offset. Both turned angles are laid on one time grid and freed of what changes slowly
(a bias, or the camera's own motion over the ground); the offset is where they agree best. Every offset of the search
window is looked at, by one correlation, and an answer must beat all others that are not beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.uav.tracker import Telemetry
from protocols.geometry.types import Bools, Floats

_STEP_S = 1.0 / 60.0
_SLOW_S = 2.0  # width of the window whose mean is taken away
_WHOLE = 0.95  # of that window that must be known: half a window has another mean
_LONGEST_FRAME_S = 0.25
_LONGEST_GAP_S = 2.5
_SLOW_SAMPLES_S = 0.08  # sampled more seldom, attitude is interpolated by a spline
_SURE = 12.0  # by how much the log-likelihood of the answer must beat the others', beside the number of others
_BESIDE_S = 0.35  # offsets that near to the answer are no others
_LEAST_S = 2.0  # seconds of pictures that overlap
_FINE_S = 0.002
_MISSING = 2.5  # usual distances between samples, after which some are missing
_USELESS_S = 0.02  # std of an answer that is none: at a turn of 30 degrees a second it is half a degree


@dataclass(frozen=True, slots=True)
class Offset:
    """offset, std [s]. agreement: share of the pictures' turning that the telemetry explains, 0 … 1."""

    offset: float
    std: float
    agreement: float


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """Rotation vectors (n, 3) [rad] of the camera from ``begins`` to ``ends`` (n,) [s], camera axes."""

    begins: Floats
    ends: Floats
    turns: Floats


def find_offset(
    seen: Turning,
    telemetry: Sequence[Telemetry],
    body_from_camera: Floats,
    search: tuple[float, float] | None = None,
) -> Offset | str:
    """The offset, or why it can't be told.

    telemetry: by time. body_from_camera: (3, 3). search: lowest and highest offset [s]; None: all at which the two
    overlap by 2 s.
    """
    told = _told_angles(telemetry, body_from_camera)
    if len(seen.turns) < 10:
        return "the pictures show no turning that can be measured"
    if told is None:
        return "the telemetry holds too few attitudes"
    origin = float(seen.begins[0])
    pictures = _picture_angles(seen, origin)
    epoch = float(telemetry[0].time)
    low = epoch - float(seen.ends[-1]) + _LEAST_S
    high = float(telemetry[-1].time) - origin - _LEAST_S
    if search is not None:
        low, high = max(low, search[0]), min(high, search[1])
    if low > high:
        return "pictures and telemetry overlap nowhere in the search window"
    a, a_known = _quick(pictures)
    b, b_known = _quick(told)
    # Row i of a is at origin + i step, row j of b at epoch + j step: offset = epoch − origin + (j − i) step.
    shifts = np.arange(
        int(np.ceil((low - epoch + origin) / _STEP_S)), int(np.floor((high - epoch + origin) / _STEP_S)) + 1
    )
    if len(shifts) < 3:
        return "the search window is too narrow"
    score = _likelihood(a, a_known, b, b_known, shifts)
    if not np.isfinite(score).any():
        return "pictures and telemetry overlap nowhere in the search window"
    best = int(np.argmax(score))
    piece = _piece(a, a_known, b, b_known, int(shifts[best]))
    score = score * (_STEP_S / piece)
    lead = float(score[best])
    others = np.abs(shifts - shifts[best]) * _STEP_S > _BESIDE_S
    rival = float(np.max(score[others], initial=-np.inf))
    # Nothing but noise reaches the better a likelihood the more offsets there are to choose from.
    chance = _SURE + np.log(max(1.0, len(shifts) * _STEP_S / _BESIDE_S))
    if lead < chance:
        return "the camera turned too little, or otherwise than the telemetry says"
    if lead - rival < _SURE:
        return "several offsets fit alike: the flight is too even"
    if best in (0, len(shifts) - 1):
        return "the offset lies outside the search window"
    near = epoch - origin + float(shifts[best]) * _STEP_S
    offset, std, agreement = _refine(a, a_known, told, near, epoch - origin, piece)
    if std > _USELESS_S:
        return f"it would be known to {1e3 * std:.0f} ms only: the camera turned too little, or is told too seldom"
    return Offset(offset, std, agreement)


@dataclass(frozen=True, slots=True, eq=False)
class _Angles:
    """Turned angles (n, 3) [rad], summed up in camera axes, at grid times first + k step [s]; NaN where unknown.

    Angles and not rates: the noise of an attitude is white, that of its rate is not and drowns the motion.
    """

    first: float
    values: Floats


def _picture_angles(seen: Turning, origin: float) -> _Angles:
    spans = seen.ends - seen.begins
    good = (spans > 0.0) & (spans < _LONGEST_FRAME_S)
    begins, ends = seen.begins[good] - origin, seen.ends[good] - origin
    summed = np.cumsum(seen.turns[good], axis=0)
    grid = np.arange(0.0, float(ends[-1]), _STEP_S)
    index = np.clip(np.searchsorted(begins, grid, side="right") - 1, 0, len(begins) - 1)
    inside = (grid >= begins[index] - 1e-9) & (grid <= ends[index] + 1e-9)
    nodes = np.r_[begins[0], ends]
    values = _between(nodes, np.vstack([np.zeros(3), summed]), grid)
    values[~inside] = np.nan
    return _Angles(0.0, values)


def _told_angles(telemetry: Sequence[Telemetry], body_from_camera: Floats) -> _Angles | None:
    """The same of the attitudes."""
    times = np.array([sample.time for sample in telemetry])
    if len(times) < 5:
        return None
    fresh = np.r_[True, np.diff(times) > 1e-6]
    times = times[fresh]
    if len(times) < 5:
        return None
    turned = np.array([sample.ned_from_body for sample in telemetry])[fresh]
    camera_from_ned = np.asarray(body_from_camera).T @ np.swapaxes(turned, 1, 2)
    gaps = np.diff(times)
    at = times[0] + np.arange(0.0, times[-1] - times[0], _STEP_S)
    index = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(gaps) - 1)
    if np.median(gaps) > _SLOW_SAMPLES_S:
        times, camera_from_ned = _smooth(times, camera_from_ned)
    steps = _logs(camera_from_ned[1:] @ np.swapaxes(camera_from_ned[:-1], 1, 2))
    summed = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    values = _between(times, summed, at)
    values[gaps[index] > _LONGEST_GAP_S] = np.nan
    return _Angles(float(at[0]), values)


def _between(times: Floats, values: Floats, at: Floats) -> Floats:
    """Values (n, 3) at ``times``, by cubic splines at the moments ``at`` between them; straight across what is missing.

    Straight lines are flattest half-way: two such rows agree best with corner on corner, and an offset found from
    pictures and attitudes of like rates would be drawn by up to 4 ms to where they fall together.
    """
    from scipy.interpolate import CubicSpline

    out = np.column_stack([np.interp(at, times, values[:, axis]) for axis in range(3)])
    gaps = np.diff(times)
    breaks = np.flatnonzero(gaps > _MISSING * np.median(gaps))
    for first, last in zip(np.r_[0, breaks + 1], np.r_[breaks, len(times) - 1], strict=True):
        inside = (at >= times[first]) & (at <= times[last])
        if last - first >= 3 and inside.any():
            out[inside] = CubicSpline(times[first : last + 1], values[first : last + 1])(at[inside])
    return out


def _logs(rotations: Floats) -> Floats:
    """Rotation vectors (n, 3) of rotations (n, 3, 3) well below half a turn."""
    m = rotations
    twice = np.column_stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]])
    sine = 0.5 * np.linalg.norm(twice, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(m, axis1=1, axis2=2) - 1.0))
    factor = np.where(sine > 1e-9, 0.5 * angle / np.maximum(sine, 1e-9), 0.5)
    return np.asarray(factor[:, None] * twice)


def _smooth(times: Floats, camera_from_ned: Floats) -> tuple[Floats, Floats]:
    """Seldom samples, filled up by a cubic spline of rotations."""
    from scipy.spatial.transform import Rotation, RotationSpline

    spline = RotationSpline(times, Rotation.from_matrix(np.swapaxes(camera_from_ned, 1, 2)))
    dense = np.arange(times[0], times[-1], 0.5 * _SLOW_SAMPLES_S)
    return dense, np.swapaxes(np.asarray(spline(dense).as_matrix()), 1, 2)


def _quick(angles: _Angles) -> tuple[Floats, Floats]:
    """Angles without their slow part (n, 3), zero where unknown, and (n,) 1 where known."""
    known: Bools = np.asarray(np.isfinite(angles.values).all(axis=1), dtype=np.bool_)
    filled: Floats = np.where(known[:, None], angles.values, 0.0)
    half = round(0.5 * _SLOW_S / _STEP_S)
    window = np.hanning(2 * half + 3)[1:-1]

    def smoothed(row: Floats) -> Floats:
        return np.convolve(row, window, "full")[half : half + len(row)]

    weight = smoothed(known.astype(np.float64))
    slow = np.column_stack([smoothed(np.asarray(filled[:, k])) for k in range(3)]) / np.maximum(weight, 1e-9)[:, None]
    # Beside a gap there is no slow part to take away.
    known = np.asarray(known & (weight > _WHOLE * window.sum()), dtype=np.bool_)
    return np.where(known[:, None], filled - slow, 0.0), known.astype(np.float64)


def _likelihood(
    a: Floats, a_known: Floats, b: Floats, b_known: Floats, shifts: np.ndarray[tuple[int], np.dtype[np.int64]]
) -> Floats:
    """Log-likelihood ratio against "nothing in common" for every shift (n,), as if all grid points were independent.

    Per axis: half the number of points times log(energy / residual), by FFT; -inf where too little overlaps.
    """
    size = 1
    while size < len(a) + len(b):
        size *= 2

    def correlate(x: Floats, y: Floats) -> Floats:
        """Sum over i of x[i] y[i + shift]."""
        spectrum = np.conj(np.fft.rfft(x, size)) * np.fft.rfft(y, size)
        return np.asarray(np.fft.irfft(spectrum, size)[shifts % size])

    count = correlate(a_known, b_known)
    enough = count * _STEP_S >= _LEAST_S - 2 * _STEP_S
    score = np.zeros(len(shifts))
    for axis in range(3):
        energy = correlate(np.square(a[:, axis]), b_known)
        theirs = correlate(a_known, np.square(b[:, axis]))
        cross = correlate(a[:, axis], b[:, axis])
        residual = np.maximum(energy + theirs - 2.0 * cross, 1e-9)
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = 0.5 * count * np.log(np.maximum(energy + theirs, 1e-9) / residual)
        # An axis that disagrees (the camera's own motion) says nothing rather than against.
        score += np.maximum(gain, 0.0)
    return np.where(enough, score, -np.inf)


def _piece(a: Floats, a_known: Floats, b: Floats, b_known: Floats, shift: int) -> float:
    """Seconds over which the residual at a shift is of one piece: its autocorrelation, summed up to its first zero."""
    first, last = max(0, -shift), min(len(a), len(b) - shift)
    known = (a_known[first:last] * b_known[first + shift : last + shift]) > 0
    gap = np.where(known[:, None], a[first:last] - b[first + shift : last + shift], 0.0)
    size = 2 * len(gap)
    spectrum = np.abs(np.fft.rfft(gap, size, axis=0)) ** 2
    together = np.fft.irfft(spectrum, size, axis=0)[: len(gap)]
    longest = _STEP_S
    for row in (together / np.maximum(together[0], 1e-12)).T:
        ends = np.flatnonzero(row <= 0.0)
        longest = max(longest, _STEP_S * (2.0 * float(row[: ends[0] if len(ends) else len(row)].sum()) - 1.0))
    return longest


def _refine(
    a: Floats, a_known: Floats, told: _Angles, near: float, zero: float, piece: float
) -> tuple[float, float, float]:
    """The offset to a fraction of the grid; its std, and the share that is explained."""
    from scipy.interpolate import CubicSpline

    grid = np.arange(len(told.values)) * _STEP_S
    b, b_known = _quick(told)
    here = np.arange(len(a)) * _STEP_S
    tries = near + np.arange(-3.0 * _STEP_S, 3.0 * _STEP_S, _FINE_S)
    common, ours, theirs_all = np.zeros((len(tries), 3)), np.zeros((len(tries), 3)), np.zeros((len(tries), 3))
    # Straight lines would weaken what lies between grid points, and draw the answer onto them.
    between = CubicSpline(grid, b)
    # The same moments of the pictures at every offset: what comes and goes at a gap's edge is no agreement.
    known = a_known > 0
    for offset in (tries[0], tries[-1]):
        known &= np.interp(here + offset - zero, grid, b_known, left=0.0, right=0.0) > 0.99
    total = 0.0
    for k, offset in enumerate(tries):
        moments = here + offset - zero
        theirs = np.asarray(between(np.clip(moments, grid[0], grid[-1])))
        total = float(max(int(known.sum()), 1))
        common[k] = (a * theirs)[known].sum(axis=0) / total
        ours[k] = np.square(a)[known].sum(axis=0) / total
        theirs_all[k] = np.square(theirs)[known].sum(axis=0) / total
    # The energy of the interpolated attitude is smaller between samples, where noise is averaged: taken at each offset,
    # it would draw the answer there. Its trend must stay: a manoeuvre that enters the window is worth milliseconds.
    energy = ours.max(axis=0)
    cost = ours - common * np.abs(common) / np.maximum(_trend(tries, theirs_all), 1e-12)
    noise = np.maximum(cost.min(axis=0), 1e-3 * energy)
    # Axes in which nothing agrees carry no weight.
    useful = noise < 0.8 * energy
    weight = np.where(useful, 1.0 / np.maximum(noise, 1e-9), 0.0)
    score = 0.5 * (cost @ weight) * total * _STEP_S / piece
    k = int(np.clip(np.argmin(score), 2, len(tries) - 3))
    bend, slope, _ = np.polyfit(tries[k - 2 : k + 3] - tries[k], score[k - 2 : k + 3], 2)
    shift = float(np.clip(-slope / (2.0 * bend), -2 * _FINE_S, 2 * _FINE_S)) if bend > 0 else 0.0
    wide_bend = np.polyfit(tries - tries[k], score, 2)[0]
    # The curvature of the log-likelihood, whose seconds count as pieces of ``piece`` each: the noise is not white.
    std = 1.0 / float(np.sqrt(max(2.0 * wide_bend, 1.0)))
    agreement = 1.0 - float((cost[k] * weight).sum() / max((energy * weight).sum(), 1e-12))
    return float(tries[k]) + shift, std, float(np.clip(agreement, 0.0, 1.0))


def _trend(at: Floats, values: Floats) -> Floats:
    """Parabolas (n, 3) through values (n, 3) at (n,)."""
    return np.column_stack([np.polyval(np.polyfit(at - at.mean(), row, 2), at - at.mean()) for row in values.T])
