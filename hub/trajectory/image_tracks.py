"""Image tracks: outlier rejection, robust spline smoothing and noise estimate, split at gaps and discontinuities.

Asynchronous calibration paper, step 1: a neighbour test, then a robust cubic spline whose knot spacing is chosen by
generalised cross-validation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from hub.trajectory.discrete import SampledTrack
from hub.trajectory.splines import SplineBasis, fit_spline, weighted_sums
from protocols.geometry import kernels
from protocols.geometry.order_statistics import median, quantile
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.observations import Track as RawTrack

MAX_PAUSE_S = 43_200.0
"""A longer gap [s] between two rows of a camera is a step of its clock, not a pause."""
_COUNTED = 0.01  # of a gap: how nearly the frame numbers give it where it is a pause
BRIDGED_GAP_S = 0.2
"""Gaps [s] up to this are bridged by the spline at any frame rate."""
BRIDGED_INTERVALS = 3.2
"""… and so are gaps of up to this many median intervals (e.g. labels on every fourth frame)."""
_SPACINGS = (2.5, 4.0, 6.0, 9.0, 14.0)  # knot spacings tried, in median intervals
_FINE_SPACING = 0.5  # for fast motion or underfit: knots twice as dense as the points, regularised by
_FINE_STIFFNESS = (1e-2, 1e-1, 1.0)  # third differences; the strength is chosen by cross-validation
_STIFFNESS = 1e-3  # only bridges empty intervals
_SPACING_LIMITS = (0.06, 0.8)  # s
_BRIDGED_KNOTS = 1.5  # gaps of so many knot intervals are bridged: so smooth a track cannot leave its path in them
_NEIGHBOURS = 4  # on each side
_NEIGHBOUR_QUANTILE = 0.2  # of the residuals to lines through two of them: one good pair in five
_DISCONTINUITY_PASSES = 4  # each may split a stretch once more
_DISCONTINUITY_FACTOR = 3.0  # times the 90 % quantile of the track's accelerations
_OUTLIER_SIGMAS = 4.0  # residuals beyond this many sigma are false detections
_MIN_POINTS = 4  # per stretch
_MIN_OUTLIER_PX = 1.5  # three sigma of a good detector
_UNDERFIT_PX = 3.0  # more noise than this is rather motion too fast for the knots
# Interpolated labels are exactly straight: without a floor the hand-set ones would look like outliers.
_MIN_SIGMA_PX = 0.05
_PHASE = np.linspace(0.0, np.pi, 65)[1:]
_GAIN = (2.0 * np.sin(0.5 * _PHASE)) ** 6
"""Gain of the squared third difference at each phase from one control point to the next."""


@dataclass(frozen=True, slots=True, eq=False)
class SmoothTrack:
    """One label of one camera as a function of the camera's time, in normalised coordinates.

    time: (n,) of the inliers [s], on the camera's clock less ``time_origin``. points: (n, 2) of the inliers.
    inlier: (m,) of the given rows. sigma: noise of one coordinate. focal: [px], to convert to pixels.
    """

    time_origin: float
    time: Floats
    points: Floats
    inlier: Bools
    basis: SplineBasis
    control: Floats
    sigma: float
    focal: float
    discontinuities: Floats = field(default_factory=lambda: np.zeros(0))
    """(k,) times [s] at which the detector probably switched to another object."""
    polynomials: Floats = field(init=False)
    """(4, 2, size - 3) of the spline: refinements evaluate it hundreds of times."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "polynomials", self.basis.polynomials(self.control))

    def at(self, time: Floats, derivative: int = 0) -> Floats:
        """Smoothed normalised coordinates (n, 2) (or their derivative); NaN in gaps."""
        return self.basis.evaluate(self.control, time, derivative)

    def point_and_velocity(self, time: Floats) -> tuple[Floats, Floats]:
        """Smoothed normalised coordinates and their velocities [1/s], (n, 2) each; NaN in gaps."""
        return self.basis.evaluate_with_derivatives(self.polynomials, time)

    def scaled(self, factor: float) -> SmoothTrack:
        """The same track with its times multiplied by ``factor``."""
        return replace(
            self,
            time=self.time * factor,
            basis=self.basis.scaled(factor),
            discontinuities=self.discontinuities * factor,
        )

    @property
    def sigma_px(self) -> float:
        """Noise of one coordinate [px]."""
        return self.sigma * self.focal

    @property
    def span(self) -> float:
        """Seconds from the first to the last inlier."""
        return float(self.time[-1] - self.time[0])


ImageTrack: TypeAlias = SmoothTrack | SampledTrack
"""A track of either kind: smooth for independent clocks, sampled for a shared clock."""


def smooth_track(
    time: Floats, normalised: Floats, focal: float, time_origin: float | None = None, relative_std: Floats | None = None
) -> SmoothTrack | None:
    """Reject outliers of one track and smooth it; None with too few connected points.

    time: (n,) [s], increasing. normalised: (n, 2), undistorted; rows with NaN are left out.
    time_origin: time that becomes 0; default the first row's time. relative_std: (n,) of the rows' noise, relative to
    the typical row, by the detector; None = all alike.
    """
    origin = float(time[0]) if time_origin is None and len(time) else float(time_origin or 0.0)
    shifted = time - origin
    usable = np.isfinite(normalised).all(axis=1)
    if usable.sum() < 2 * _MIN_POINTS:
        return None
    rows = np.flatnonzero(usable)
    t, x = shifted[rows], normalised[rows]
    # Relative to the track's own typical row: what a fit absorbs is known for weights about 1.
    std = np.ones(len(rows)) if relative_std is None else relative_std[rows]
    typical = median(std)
    std = std / typical
    good = neighbour_test(t, x, floor=_MIN_OUTLIER_PX / focal)
    interval = median(np.diff(t))
    gap = max(BRIDGED_GAP_S, BRIDGED_INTERVALS * interval)
    discontinuities = _discontinuities(t, x, good)
    best: _SplineFit | None = None
    for factor in _SPACINGS:
        spacing = float(np.clip(factor * interval, *_SPACING_LIMITS))
        if best is not None and spacing == best.basis.spacing:
            continue
        fit = _robust_fit(t, x, std, good, discontinuities, spacing, _STIFFNESS, gap, focal)
        if fit is not None and (best is None or fit.score < best.score):
            best = fit
    if best is not None and (
        best.basis.spacing <= max(_SPACINGS[0] * interval, _SPACING_LIMITS[0]) or best.sigma * focal > _UNDERFIT_PX
    ):
        for stiffness in _FINE_STIFFNESS:
            fit = _robust_fit(t, x, std, good, discontinuities, _FINE_SPACING * interval, stiffness, gap, focal)
            if fit is not None and fit.score < best.score:
                best = fit
    if best is None:
        return None
    basis, control, inlier, sigma = best.basis, best.control, best.inlier, best.sigma / typical
    mask = np.zeros(len(time), dtype=np.bool_)
    mask[rows[inlier]] = True
    return SmoothTrack(origin, t[inlier], x[inlier], mask, basis, control, sigma, focal, discontinuities)


def without_clock_steps(tracks: list[RawTrack]) -> tuple[list[RawTrack], str]:
    """One camera's tracks without the rows before or after a step of its clock; and what was left out, or "".

    A board that receives the time while it records (1970 to now) has two clock segments in one recording. So long a gap
    is a clock step, unless the frame numbers say that it is a pause, and the part with most rows is kept.
    """
    if not tracks:
        return tracks, ""
    times = np.concatenate([track.time for track in tracks])
    order = np.argsort(times, kind="stable")
    times, frames = times[order], np.concatenate([track.frame for track in tracks])[order]
    gaps, numbers = np.diff(times), np.diff(frames)
    counted = numbers > 0
    interval = float(np.median(gaps[counted] / numbers[counted])) if counted.any() else 0.0
    cuts = np.flatnonzero(gaps > MAX_PAUSE_S)
    if len(cuts) == 0:
        return tracks, ""
    parts = np.split(times, cuts + 1)
    kept = max(parts, key=len)
    out = []
    for track in tracks:
        inside = (track.time >= kept[0]) & (track.time <= kept[-1])
        if inside.any():
            out.append(track.select(inside))
    dropped = len(times) - len(kept)
    is_pause = np.abs(numbers * interval - gaps)[cuts].max() <= _COUNTED * gaps[cuts].max()
    what = "by its frame numbers it pauses for" if is_pause else "its clock steps by"
    return out, f"{what} {gaps[cuts].max():.0f} s; {dropped} of {len(times)} rows on the other side are left out"


def neighbour_test(time: Floats, points: Floats, floor: float) -> Bools:
    """Inliers (n,): points that agree with lines through some of their neighbours.

    Each point is compared with linear interpolation between each of its 4 predecessors and successors; the 20 %
    quantile of the residuals tolerates 40 % outliers among the neighbours, where the median breaks down at 30 %. A
    second pass uses the neighbours that passed, few of which are outliers, and also lines through two neighbours of
    one side, which suit the last points before a discontinuity. floor: residual below which a point is always an
    inlier.
    """
    good = np.ones(len(time), dtype=np.bool_)
    for one_sided in (False, True):
        score = _neighbour_score(time, points, good, one_sided)
        # The 40 % quantile lies among the inliers even with 40 % outliers.
        limit = max(floor, 6.0 * quantile(score, 0.4))
        again = np.asarray(score <= limit)
        if again.all() or again.sum() < 2 * _NEIGHBOURS:
            return again
        good = again
    return good


def _neighbour_score(time: Floats, points: Floats, good: Bools, one_sided: bool) -> Floats:
    """20 % quantile (n,) of each point's distances from lines through two good neighbours."""
    rows = np.flatnonzero(good)
    if kernels.AVAILABLE:
        return kernels.neighbour_scores(time, points, rows, one_sided, _NEIGHBOUR_QUANTILE)
    t, x = time[rows], points[rows]
    before = np.searchsorted(rows, np.arange(len(time))) - 1
    after = before + 1 + good
    places = np.stack([before - i for i in range(_NEIGHBOURS)] + [after + j for j in range(_NEIGHBOURS)])
    there = (places >= 0) & (places < len(rows))
    t_near, x_near, y_near = (column.take(places, mode="clip") for column in (t, *np.ascontiguousarray(x.T)))
    lines = [(i, _NEIGHBOURS + j) for i in range(_NEIGHBOURS) for j in range(_NEIGHBOURS)]
    if one_sided:
        lines += [(j, i) for j in range(1, _NEIGHBOURS) for i in range(j)]
        lines += [(_NEIGHBOURS + i, _NEIGHBOURS + j) for j in range(1, _NEIGHBOURS) for i in range(j)]
    residuals = np.empty((len(lines), len(time)))
    with np.errstate(divide="ignore", invalid="ignore"):  # where one of the two does not exist
        for k, (low, high) in enumerate(lines):
            share = (time - t_near[low]) / (t_near[high] - t_near[low])
            across = points[:, 0] - x_near[low] - share * (x_near[high] - x_near[low])
            down = points[:, 1] - y_near[low] - share * (y_near[high] - y_near[low])
            residuals[k] = np.where(there[low] & there[high], np.hypot(across, down), np.inf)
    residuals.sort(axis=0)
    known = np.isfinite(residuals).sum(axis=0)
    pick = np.maximum(0, np.ceil(_NEIGHBOUR_QUANTILE * known).astype(np.int64) - 1)
    score = residuals[pick, np.arange(len(time))]
    return np.where(known > 0, score, 0.0)  # the ends have no neighbours on one side


@dataclass(frozen=True, slots=True, eq=False)
class _SplineFit:
    """A spline fit to a track. score: generalised cross-validation [normalised coordinates squared]."""

    score: float
    basis: SplineBasis
    control: Floats
    inlier: Bools
    sigma: float


def _discontinuities(t: Floats, x: Floats, good: Bools) -> Floats:
    """Times (k,) [s] of discontinuities, at which the detector switched to another object.

    Tested from both sides: the extrapolation error, expressed as an acceleration, is far above the track's own.
    """
    rows = np.flatnonzero(good)
    for iteration in range(_DISCONTINUITY_PASSES):
        if len(rows) < 2 * _MIN_POINTS:
            break
        at, pos = t[rows], x[rows]
        dt = np.diff(at)
        velocity = (pos[1:] - pos[:-1]).T / dt
        # Acceleration between i and i + 1, from the velocity before and from the velocity after.
        acceleration = np.hypot(*(velocity[:, 1:] - velocity[:, :-1])) / (0.5 * (dt[1:] + dt[:-1]))
        limit = _DISCONTINUITY_FACTOR * quantile(acceleration, 0.9)
        where = np.flatnonzero(np.minimum(acceleration[:-1], acceleration[1:]) > limit) + 1
        # A part of a few points is outliers rather than another object; the test is repeated without them.
        lengths = np.diff(np.r_[0, where + 1, len(rows)])
        short = np.repeat(lengths < _MIN_POINTS, lengths)
        if not short.any() or iteration == _DISCONTINUITY_PASSES - 1:
            return np.asarray(0.5 * (at[where] + at[where + 1]))
        rows = rows[~short]
    return np.zeros(0)


def _robust_fit(
    t: Floats,
    x: Floats,
    std: Floats,
    good: Bools,
    discontinuities: Floats,
    spacing: float,
    stiffness: float,
    gap: float,
    focal: float,
) -> _SplineFit | None:
    """Spline fit with iterative outlier rejection, on stretches split at long gaps and discontinuities."""
    inlier = good.copy()
    basis, control, sigma = None, None, np.inf
    gap, row_weight = max(gap, _BRIDGED_KNOTS * spacing), 1.0 / (std * std)
    part_index = np.searchsorted(discontinuities, t)
    for step in range(6):
        inlier, begins, ends, counts = _stretches(t, inlier, gap, part_index)
        count = int(counts.sum())
        if count < 2 * _MIN_POINTS:
            return None
        basis = SplineBasis.spanning(begins, ends, spacing)
        rows = basis.weights(t)  # once, for the fit and for its residuals
        control = fit_spline(basis, rows, x, np.where(inlier, row_weight, 0.0), stiffness)
        error = weighted_sums(control, *rows[:2]).T - x.T
        residual = np.hypot(error[0], error[1])
        residual /= std
        residual[~rows[2]] = np.inf
        degrees_of_freedom = _degrees_of_freedom(counts, basis.intervals + 3, stiffness)
        n = float(count)
        left = max(n - degrees_of_freedom, 0.02 * n)
        # Median of a Rayleigh variable: 1.1774 sigma.
        sigma = max(_MIN_SIGMA_PX / focal, median(residual[inlier]) / 1.1774 * np.sqrt(n / left))
        again = residual < max(_OUTLIER_SIGMAS * sigma * (2.0 if step == 0 else 1.0), _MIN_OUTLIER_PX / focal)
        if (again == inlier).all():
            break
        inlier = again
    if basis is None or control is None:
        return None
    squared = np.minimum(residual[inlier], _OUTLIER_SIGMAS * sigma) ** 2
    kept = float(len(squared))
    score = float(squared.sum()) / kept * (kept / max(kept - degrees_of_freedom, 0.02 * kept)) ** 2
    # A spacing that rejects many points must not win by fitting the rest well.
    score *= (float(np.count_nonzero(good)) / kept) ** 2
    return _SplineFit(score, basis, control, inlier, sigma)


def _degrees_of_freedom(points: Ints, control_counts: Ints, stiffness: float) -> float:
    """Effective degrees of freedom of a fit: the trace of its smoother matrix, by frequency for evenly spaced points.

    points, controls: (s,) of each stretch.
    """
    # With fewer points than control points a track has no frequencies above the points' own; a control point then has
    # points / controls rows.
    ratio = points / control_counts
    gain = _GAIN if ratio.min() >= 1.0 else (2.0 * np.sin(0.5 * _PHASE * np.minimum(ratio, 1.0)[:, None])) ** 6
    share = 1.0 / (1.0 + stiffness * gain / np.maximum(ratio, 1e-9)[:, None])
    return float((np.minimum(points, control_counts) * share.mean(axis=1)).sum())


def _stretches(t: Floats, inlier: Bools, gap: float, part_index: Ints) -> tuple[Bools, Floats, Floats, Ints]:
    """Inliers in stretches of at least _MIN_POINTS points; begins, ends and numbers of points of the stretches."""
    rows = np.flatnonzero(inlier)
    at, part = t[rows], part_index[rows]
    cuts = np.flatnonzero((at[1:] - at[:-1] > gap) | (part[1:] > part[:-1])) + 1
    edges = np.concatenate([[0], cuts, [len(rows)]])
    counts = edges[1:] - edges[:-1]
    long = counts >= _MIN_POINTS
    if not long.all():
        inlier = np.zeros(len(t), dtype=np.bool_)
        inlier[rows[np.repeat(long, counts)]] = True
    return inlier, at[edges[:-1][long]], at[edges[1:][long] - 1], counts[long]


def smooth_only(tracks: Mapping[str, ImageTrack]) -> dict[str, SmoothTrack]:
    """The smooth tracks among a camera's tracks, by label."""
    return {label: track for label, track in tracks.items() if isinstance(track, SmoothTrack)}
