"""Offset between the camera's clock and the telemetry's, by correlating visual rotation with the attitude.

telemetry time = camera time + offset. Both integrated rotations are resampled on one time grid and high-pass filtered,
which removes slow errors (a bias, or the camera's own motion over the ground). The offset maximises a likelihood ratio
that is evaluated at every offset of the search window by FFT; the maximum must be unique.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.uav.base import Telemetry
from edge.uav.timing.ground_motion import GroundMotion, RelativeRotations, compare_ways
from protocols.geometry.types import Bools, Floats

_STEP_S = 1.0 / 60.0  # of the grid: half a frame at 30 fps, refined afterwards
_HIGH_PASS_WINDOW_S = 2.0  # of the weighted moving average that is subtracted
_MIN_COVERAGE = 0.95  # of that window: the mean of half a window would be biased
MAX_FRAME_GAP_S = 0.25  # of two images: the rotation in between is unknown
_MAX_TELEMETRY_GAP_S = 2.5  # of two samples, as of interpolation: slow links send attitudes once a second or two
_SPARSE_SPACING_S = 0.08  # attitude sampled less often is interpolated by a rotation spline
_MIN_LOG_RATIO = 12.0  # of the maximum to other offsets, and (plus log of their number) to no correlation
_PEAK_HALF_WIDTH_S = 0.35  # offsets closer to the maximum belong to the same peak
_MIN_OVERLAP_S = 2.0  # of images and telemetry
_FINE_STEP_S = 0.002  # of the refinement, a tenth of _MAX_STD_S; a parabola does the rest
_GAP_FACTOR = 2.5  # times the median spacing: a longer one is a gap
_MAX_SPAN_S = 6 * 3600.0  # of images or telemetry: the grids of six hours take 50 MB, and no battery lasts longer
_MAX_SPACING_S = 0.25 * _HIGH_PASS_WINDOW_S  # of attitudes, for a contradiction: in between it may turn at will
_MIN_TURN_RMS = float(np.radians(1.0))  # of attitudes about their mean of 2 s: 0.4 degrees of noise do not reach it
_FROZEN_RMS = 1e-6  # rad, likewise: rounding of one attitude that is repeated; no sensor is as calm
CONTRADICTION = "attitudes turn otherwise than the images"
"""Begins the reason where telemetry is of another mounting, camera, gimbal or convention."""
OUTSIDE = "the offset lies outside the search window"
_MAX_STD_S = 0.02  # of an accepted offset: at 30 degrees a second it is half a degree


@dataclass(frozen=True, slots=True)
class OffsetEstimate:
    """offset, std [s]. agreement: share of the visual rotation that the telemetry explains, 0 … 1.

    motion: the positions' way against the images'; None where there is none.
    """

    offset: float
    std: float
    agreement: float
    motion: GroundMotion | None = None


def find_offset(
    visual: RelativeRotations,
    telemetry: Sequence[Telemetry],
    body_from_camera: Floats,
    search: tuple[float, float] | None = None,
) -> OffsetEstimate | str:
    """The offset, or the reason why it is not observable.

    visual: rotation seen by the camera. telemetry: by increasing time. body_from_camera: (3, 3). search: lowest and
    highest offset [s]; None: all offsets at which the two overlap by 2 s.
    """
    found = search_offset(visual, telemetry, body_from_camera, search)
    if isinstance(found, str):
        return found
    for turns in (1, 2, 3):
        other = search_offset(visual, telemetry, turned_about_axis(body_from_camera, turns), search)
        if not isinstance(other, str) and other.evidence > found.evidence + other.threshold:
            return f"{CONTRADICTION}, but as of a camera turned by {90 * turns} degrees: check body_from_camera"
    if found.contradicts:
        return f"{CONTRADICTION}: check body_from_camera, and whether they come late"
    correlated = found.evidence >= found.threshold
    motion = None
    if correlated or search is not None:  # else nothing is known of the offset
        motion = compare_ways(visual, telemetry, body_from_camera, found.offset if correlated else 0.0)
        if motion is not None and motion.contradiction:
            return motion.contradiction
    return accepted_offset(found, motion)


def accepted_offset(
    found: OffsetSearch, motion: GroundMotion | None = None, most_std_s: float = _MAX_STD_S
) -> OffsetEstimate | str:
    """The offset at the maximum of a search, or the reason why it is not observable.

    motion: to put into the answer. most_std_s: largest std that is accepted.
    """
    if found.evidence < found.threshold:
        return "the camera rotated too little, or its rotation does not match the telemetry"
    if found.evidence - found.second < _MIN_LOG_RATIO:
        return "the offset is ambiguous: the rotation varies too little"
    if found.at_end:
        return OUTSIDE
    offset, std, agreement = _refine(found)
    if std > most_std_s:
        return f"its std would be {1e3 * std:.0f} ms: the camera rotated too little, or attitudes are too sparse"
    return OffsetEstimate(offset, std, agreement, motion)


def turned_about_axis(body_from_camera: Floats, turns: int) -> Floats:
    """The mounting (3, 3) of a camera that is turned about its optical axis by quarter turns."""
    x, y, z = np.asarray(body_from_camera).T
    return np.column_stack([(x, y, -x, -y)[turns], (y, -x, -y, x)[turns], z])


@dataclass(frozen=True, slots=True, eq=False)
class OffsetSearch:
    """The maximum over all offsets searched, on the grid.

    evidence, second, threshold: log-likelihood ratio to "uncorrelated" at the maximum, at the best offset elsewhere,
    and that which noise alone does not reach. telemetry_rms: of its rotation [rad], high-pass filtered, where images
    are; spacing: of its samples [s]. at_end: whether it lies at an end of the window. Further: for _refine.
    """

    evidence: float
    second: float
    threshold: float
    telemetry_rms: float
    spacing: float
    at_end: bool
    offset: float
    base: float
    correlation_time: float
    visual: tuple[Floats, Floats]
    telemetry: _IntegratedAngles

    @property
    def contradicts(self) -> bool:
        """Whether the telemetry turns by so much that the images would have to show it, and they do not; or the images
        do, and it is the same in every digit."""
        rms, (seen, known) = self.telemetry_rms, self.visual
        if rms < _FROZEN_RMS:
            rms = float(np.sqrt(np.square(seen[known > 0]).sum() / max(known.sum(), 1.0)))
        return self.evidence < self.threshold and rms >= _MIN_TURN_RMS and self.spacing <= _MAX_SPACING_S


def search_offset(
    visual: RelativeRotations,
    telemetry: Sequence[Telemetry],
    body_from_camera: Floats,
    search: tuple[float, float] | None = None,
) -> OffsetSearch | str:
    """Search all offsets, arguments as of ``find_offset``; a text says why none can be searched."""
    if len(visual.vectors) < 10:
        return "no camera rotation could be measured in the images"
    if len(telemetry) < 5:
        return "the telemetry has too few attitudes"
    spans = (float(visual.ends[-1] - visual.starts[0]), telemetry[-1].time - telemetry[0].time)
    if not max(spans) < _MAX_SPAN_S:  # before any array is sized by it
        return f"time stamps span {max(spans):.0f} s, more than {_MAX_SPAN_S:.0f} s: a clock jumped"
    from_telemetry = _telemetry_angles(telemetry, body_from_camera)
    if from_telemetry is None:
        return "the telemetry has too few attitudes"
    start = float(visual.starts[0])
    from_images = _visual_angles(visual, start)
    telemetry_start = float(telemetry[0].time)
    low = telemetry_start - float(visual.ends[-1]) + _MIN_OVERLAP_S
    high = float(telemetry[-1].time) - start - _MIN_OVERLAP_S
    if search is not None:
        low, high = max(low, search[0]), min(high, search[1])
    if low > high:
        return "images and telemetry do not overlap anywhere in the search window"
    a, a_known = _high_pass(from_images)
    b, b_known = _high_pass(from_telemetry)
    # Row i of a is at start + i step, row j of b at telemetry_start + j step:
    # offset = telemetry_start − start + (j − i) step.
    shifts = np.arange(
        int(np.ceil((low - telemetry_start + start) / _STEP_S)),
        int(np.floor((high - telemetry_start + start) / _STEP_S)) + 1,
    )
    if len(shifts) < 3:
        return "the search window is too narrow"
    score = _log_likelihood_ratios(a, a_known, b, b_known, shifts)
    if not np.isfinite(score).any():
        return "images and telemetry do not overlap anywhere in the search window"
    best = int(np.argmax(score))
    correlation_time = _correlation_time(a, a_known, b, b_known, int(shifts[best]))
    score = score * (_STEP_S / correlation_time)
    peak = float(score[best])
    others = np.abs(shifts - shifts[best]) * _STEP_S > _PEAK_HALF_WIDTH_S
    second = float(np.max(score[others], initial=-np.inf))
    # The maximum over noise alone grows with the number of independent offsets.
    threshold = _MIN_LOG_RATIO + np.log(max(1.0, len(shifts) * _STEP_S / _PEAK_HALF_WIDTH_S))
    rows = np.flatnonzero(a_known) + int(shifts[best])
    rows = rows[(rows >= 0) & (rows < len(b))]
    rms = float(np.sqrt(np.square(b[rows]).sum() / max(b_known[rows].sum(), 1.0)))
    base = telemetry_start - start
    coarse, at_end = base + float(shifts[best]) * _STEP_S, best in (0, len(shifts) - 1)
    spacing = float(np.median(np.diff([sample.time for sample in telemetry])))
    return OffsetSearch(
        peak, second, threshold, rms, spacing, at_end, coarse, base, correlation_time, (a, a_known), from_telemetry
    )


@dataclass(frozen=True, slots=True, eq=False)
class _IntegratedAngles:
    """Integrated rotation (n, 3) [rad] in camera axes at grid times first + k step [s]; NaN where unknown.

    Angles and not rates: the noise of an attitude is white; that of its rate is not, and masks the motion.
    """

    first: float
    values: Floats


def _visual_angles(visual: RelativeRotations, start: float) -> _IntegratedAngles:
    spans = visual.ends - visual.starts
    valid = (spans > 0.0) & (spans < MAX_FRAME_GAP_S)
    starts, ends = visual.starts[valid] - start, visual.ends[valid] - start
    integrated = np.cumsum(visual.vectors[valid], axis=0)
    grid = np.arange(0.0, float(ends[-1]), _STEP_S)
    index = np.clip(np.searchsorted(starts, grid, side="right") - 1, 0, len(starts) - 1)
    inside = (grid >= starts[index] - 1e-9) & (grid <= ends[index] + 1e-9)
    nodes = np.r_[starts[0], ends]
    values = _interpolate(nodes, np.vstack([np.zeros(3), integrated]), grid)
    values[~inside] = np.nan
    return _IntegratedAngles(0.0, values)


def _telemetry_angles(telemetry: Sequence[Telemetry], body_from_camera: Floats) -> _IntegratedAngles | None:
    """Integrated rotation of the telemetry attitudes; None with too few of them."""
    times = np.array([sample.time for sample in telemetry])
    if len(times) < 5:
        return None
    increasing = np.r_[True, np.diff(times) > 1e-6]
    times = times[increasing]
    if len(times) < 5:
        return None
    attitudes = np.array([sample.ned_from_body for sample in telemetry])[increasing]
    camera_from_ned = np.asarray(body_from_camera).T @ np.swapaxes(attitudes, 1, 2)
    gaps = np.diff(times)
    at = times[0] + np.arange(0.0, times[-1] - times[0], _STEP_S)
    index = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(gaps) - 1)
    if np.median(gaps) > _SPARSE_SPACING_S:
        times, camera_from_ned = _upsample(times, camera_from_ned)
    steps = _rotation_vectors(camera_from_ned[1:] @ np.swapaxes(camera_from_ned[:-1], 1, 2))
    integrated = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    values = _interpolate(times, integrated, at)
    values[gaps[index] > _MAX_TELEMETRY_GAP_S] = np.nan
    return _IntegratedAngles(float(at[0]), values)


def _interpolate(times: Floats, values: Floats, at: Floats) -> Floats:
    """Values (n, 3) at ``times`` resampled at the times ``at`` by cubic splines; linearly across gaps.

    Linear interpolation has its knots as corners: two such series agree best with corner on corner, and an offset from
    images and attitudes of similar rates would be biased by up to 4 ms towards aligned samples.
    """
    from scipy.interpolate import CubicSpline

    out = np.column_stack([np.interp(at, times, values[:, axis]) for axis in range(3)])
    gaps = np.diff(times)
    breaks = np.flatnonzero(gaps > _GAP_FACTOR * np.median(gaps))
    for first, last in zip(np.r_[0, breaks + 1], np.r_[breaks, len(times) - 1], strict=True):
        inside = (at >= times[first]) & (at <= times[last])
        if last - first >= 3 and inside.any():
            out[inside] = CubicSpline(times[first : last + 1], values[first : last + 1])(at[inside])
    return out


def _rotation_vectors(rotations: Floats) -> Floats:
    """Rotation vectors (n, 3) of rotation matrices (n, 3, 3) well below half a turn."""
    m = rotations
    twice = np.column_stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]])
    sine = 0.5 * np.linalg.norm(twice, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(m, axis1=1, axis2=2) - 1.0))
    factor = np.where(sine > 1e-9, 0.5 * angle / np.maximum(sine, 1e-9), 0.5)
    return np.asarray(factor[:, None] * twice)


def _upsample(times: Floats, camera_from_ned: Floats) -> tuple[Floats, Floats]:
    """Sparse attitudes resampled densely by a cubic rotation spline."""
    from scipy.spatial.transform import Rotation, RotationSpline

    spline = RotationSpline(times, Rotation.from_matrix(np.swapaxes(camera_from_ned, 1, 2)))
    dense = np.arange(times[0], times[-1], 0.5 * _SPARSE_SPACING_S)
    return dense, np.swapaxes(np.asarray(spline(dense).as_matrix()), 1, 2)


def _high_pass(angles: _IntegratedAngles) -> tuple[Floats, Floats]:
    """Angles without their low-frequency part (n, 3), zero where unknown, and (n,) 1 where known."""
    known: Bools = np.asarray(np.isfinite(angles.values).all(axis=1), dtype=np.bool_)
    filled: Floats = np.where(known[:, None], angles.values, 0.0)
    half = round(0.5 * _HIGH_PASS_WINDOW_S / _STEP_S)
    window = np.hanning(2 * half + 3)[1:-1]

    def smoothed(row: Floats) -> Floats:
        return np.convolve(row, window, "full")[half : half + len(row)]

    weight = smoothed(known.astype(np.float64))
    low_pass = (
        np.column_stack([smoothed(np.asarray(filled[:, k])) for k in range(3)]) / np.maximum(weight, 1e-9)[:, None]
    )
    # Close to a gap the low-frequency part is not defined.
    known = np.asarray(known & (weight > _MIN_COVERAGE * window.sum()), dtype=np.bool_)
    return np.where(known[:, None], filled - low_pass, 0.0), known.astype(np.float64)


def _log_likelihood_ratios(
    a: Floats, a_known: Floats, b: Floats, b_known: Floats, shifts: np.ndarray[tuple[int], np.dtype[np.int64]]
) -> Floats:
    """Log-likelihood ratio against "uncorrelated" for every shift (n,), as if all grid points were independent.

    Per axis: half the number of points times log(energy / residual), by FFT; -inf where the overlap is too short.
    """
    size = 1
    while size < len(a) + len(b):
        size *= 2

    def correlate(x: Floats, y: Floats) -> Floats:
        """Sum over i of x[i] y[i + shift]."""
        spectrum = np.conj(np.fft.rfft(x, size)) * np.fft.rfft(y, size)
        return np.asarray(np.fft.irfft(spectrum, size)[shifts % size])

    count = correlate(a_known, b_known)
    enough = count * _STEP_S >= _MIN_OVERLAP_S - 2 * _STEP_S
    score = np.zeros(len(shifts))
    for axis in range(3):
        energy = correlate(np.square(a[:, axis]), b_known)
        other_energy = correlate(a_known, np.square(b[:, axis]))
        cross = correlate(a[:, axis], b[:, axis])
        residual = np.maximum(energy + other_energy - 2.0 * cross, 1e-9)
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = 0.5 * count * np.log(np.maximum(energy + other_energy, 1e-9) / residual)
        # An axis that disagrees (the camera's own translation) is uninformative, not contrary evidence.
        score += np.maximum(gain, 0.0)
    return np.where(enough, score, -np.inf)


def _correlation_time(a: Floats, a_known: Floats, b: Floats, b_known: Floats, shift: int) -> float:
    """Correlation time [s] of the residual at a shift: its autocorrelation, integrated up to its first zero."""
    first, last = max(0, -shift), min(len(a), len(b) - shift)
    known = (a_known[first:last] * b_known[first + shift : last + shift]) > 0
    residual = np.where(known[:, None], a[first:last] - b[first + shift : last + shift], 0.0)
    size = 2 * len(residual)
    spectrum = np.abs(np.fft.rfft(residual, size, axis=0)) ** 2
    autocorrelation = np.fft.irfft(spectrum, size, axis=0)[: len(residual)]
    longest = _STEP_S
    for row in (autocorrelation / np.maximum(autocorrelation[0], 1e-12)).T:
        ends = np.flatnonzero(row <= 0.0)
        longest = max(longest, _STEP_S * (2.0 * float(row[: ends[0] if len(ends) else len(row)].sum()) - 1.0))
    return longest


def _refine(found: OffsetSearch) -> tuple[float, float, float]:
    """The offset refined below the grid step; its std, and the share of the visual rotation that is explained."""
    from scipy.interpolate import CubicSpline

    (a, a_known), base, coarse, correlation_time = found.visual, found.base, found.offset, found.correlation_time
    grid = np.arange(len(found.telemetry.values)) * _STEP_S
    b, b_known = _high_pass(found.telemetry)
    frame_times = np.arange(len(a)) * _STEP_S
    candidates = coarse + np.arange(-3.0 * _STEP_S, 3.0 * _STEP_S, _FINE_STEP_S)
    cross, visual_energy, telemetry_energy = (
        np.zeros((len(candidates), 3)),
        np.zeros((len(candidates), 3)),
        np.zeros((len(candidates), 3)),
    )
    # Linear interpolation would attenuate between grid points and bias the offset towards them.
    spline = CubicSpline(grid, b)
    # The same image times at every offset: samples entering or leaving at a gap would change the agreement.
    known = a_known > 0
    for offset in (candidates[0], candidates[-1]):
        known &= np.interp(frame_times + offset - base, grid, b_known, left=0.0, right=0.0) > 0.99
    total = 0.0
    for k, offset in enumerate(candidates):
        times = frame_times + offset - base
        shifted = np.asarray(spline(np.clip(times, grid[0], grid[-1])))
        total = float(max(int(known.sum()), 1))
        cross[k] = (a * shifted)[known].sum(axis=0) / total
        visual_energy[k] = np.square(a)[known].sum(axis=0) / total
        telemetry_energy[k] = np.square(shifted)[known].sum(axis=0) / total
    # The energy of the interpolated attitude is smaller between samples, where noise is averaged: used as it is at each
    # offset, it would bias the offset. Its trend must stay: a manoeuvre that enters the window is worth milliseconds.
    energy = visual_energy.max(axis=0)
    cost = visual_energy - cross * np.abs(cross) / np.maximum(_fit_parabolas(candidates, telemetry_energy), 1e-12)
    noise = np.maximum(cost.min(axis=0), 1e-3 * energy)
    # Axes without correlation get no weight.
    useful = noise < 0.8 * energy
    weight = np.where(useful, 1.0 / np.maximum(noise, 1e-9), 0.0)
    score = 0.5 * (cost @ weight) * total * _STEP_S / correlation_time
    k = int(np.clip(np.argmin(score), 2, len(candidates) - 3))
    curvature, slope, _ = np.polyfit(candidates[k - 2 : k + 3] - candidates[k], score[k - 2 : k + 3], 2)
    shift = float(np.clip(-slope / (2.0 * curvature), -2 * _FINE_STEP_S, 2 * _FINE_STEP_S)) if curvature > 0 else 0.0
    wide_curvature = np.polyfit(candidates - candidates[k], score, 2)[0]
    # From the curvature of the log-likelihood, scaled by the correlation time: the noise is not white.
    std = 1.0 / float(np.sqrt(max(2.0 * wide_curvature, 1.0)))
    agreement = 1.0 - float((cost[k] * weight).sum() / max((energy * weight).sum(), 1e-12))
    return float(candidates[k]) + shift, std, float(np.clip(agreement, 0.0, 1.0))


def _fit_parabolas(at: Floats, values: Floats) -> Floats:
    """Values (n, 3) of least-squares parabolas fitted to values (n, 3) at (n,)."""
    return np.column_stack([np.polyval(np.polyfit(at - at.mean(), row, 2), at - at.mean()) for row in values.T])
