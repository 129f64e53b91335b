"""From a raw image track to a smooth one: false detections dropped, noise measured, gaps kept apart.

METHODS A, step 1: neighbour test, then a robust cubic spline whose knot spacing comes from the data by
generalised cross-validation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from hub.trajectory.discrete import SampledTrack
from hub.trajectory.splines import SplineBasis, fit_spline, stretches
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.observations import Track as RawTrack

LONGEST_PAUSE = 43_200.0
"""A longer gap [s] between two rows of a camera is a jump of its clock, not a pause."""
SHORTEST_GAP = 0.2
"""Gaps [s] up to this are bridged by the spline at any frame rate."""
GAP_INTERVALS = 3.2
"""… and so are gaps of up to this many median intervals (labels on every fourth frame)."""
_SPACINGS = (2.5, 4.0, 6.0, 9.0, 14.0)  # knot spacings tried, in median intervals
_FINE_SPACING = 0.5  # where the widest of those is the best: knots twice as dense as the points, held by
_FINE_STIFFNESS = (1e-2, 1e-1, 1.0)  # third differences, as strongly as cross-validation wants
_STIFFNESS = 1e-3  # only closes empty intervals
_SPACING_LIMITS = (0.06, 0.8)  # s
_BRIDGED_SPACINGS = 1.5  # a pause in which so smooth a track can't have gone anywhere else
_NEIGHBOURS = 4
_NEIGHBOUR_QUANTILE = 0.2
_JUMP_PASSES = 4
_JUMP = 3.0  # times the accelerations that a track's faster tenth shows
_CUT = 4.0  # residuals beyond this many sigma are false detections
_LEAST_POINTS = 4  # in a stretch
_NEVER_SUSPECT_PX = 1.5
_SUSPECT_PX = 3.0  # noise that is rather motion too fast for the knots
# Labels drawn between hand-set ones are exactly straight: without a floor the honest rest looks false.
_LEAST_SIGMA_PX = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class SmoothTrack:
    """One label of one camera as a function of the camera's time, in normalised coordinates.

    time: (n,) of the inliers [s], on the camera's clock less ``epoch``. points: (n, 2) inlier measurements.
    inlier: (m,) of the rows given. sigma: noise of one coordinate. focal: [px], to speak of pixels.
    """

    epoch: float
    time: Floats
    points: Floats
    inlier: Bools
    basis: SplineBasis
    control: Floats
    sigma: float
    focal: float
    jumps: Floats = field(default_factory=lambda: np.zeros(0))
    """(k,) times [s] at which the detector seems to have taken up another thing."""

    def at(self, time: Floats, derivative: int = 0) -> Floats:
        """Smoothed normalised coordinates (n, 2) (or their derivative); NaN in gaps."""
        return self.basis.evaluate(self.control, time, derivative)

    def point_and_speed(self, time: Floats) -> tuple[Floats, Floats]:
        """Smoothed normalised coordinates and their speeds [1/s], (n, 2) each; NaN in gaps."""
        return self.basis.evaluate_both(self.control, time)

    def scaled(self, factor: float) -> SmoothTrack:
        """The same track on a clock whose seconds are 1 / ``factor`` of these."""
        return replace(self, time=self.time * factor, basis=self.basis.scaled(factor), jumps=self.jumps * factor)

    @property
    def sigma_px(self) -> float:
        """Noise of one coordinate [px]."""
        return self.sigma * self.focal

    @property
    def span(self) -> float:
        """Seconds from the first to the last inlier."""
        return float(self.time[-1] - self.time[0])


Track: TypeAlias = SmoothTrack | SampledTrack
"""A track of either kind: smooth for independent clocks, sampled for a shared one."""


def smooth_track(time: Floats, normalised: Floats, focal: float, epoch: float | None = None) -> SmoothTrack | None:
    """Clean and smooth one track; None if fewer than a handful of points hang together.

    time: (n,) [s], increasing. normalised: (n, 2), undistorted; rows with NaN are left out.
    epoch: time that becomes 0; default the first row's.
    """
    origin = float(time[0]) if epoch is None and len(time) else float(epoch or 0.0)
    shifted = time - origin
    usable = np.isfinite(normalised).all(axis=1)
    if usable.sum() < 2 * _LEAST_POINTS:
        return None
    rows = np.flatnonzero(usable)
    t, x = shifted[rows], normalised[rows]
    good = neighbour_test(t, x, floor=_NEVER_SUSPECT_PX / focal)
    interval = float(np.median(np.diff(t)))
    gap = max(SHORTEST_GAP, GAP_INTERVALS * interval)
    jumps = _jumps(t, x, good)
    best: _Fit | None = None
    for factor in _SPACINGS:
        spacing = float(np.clip(factor * interval, *_SPACING_LIMITS))
        if best is not None and spacing == best.basis.spacing:
            continue
        fit = _robust_fit(t, x, good, jumps, spacing, _STIFFNESS, gap, focal)
        if fit is not None and (best is None or fit.score < best.score):
            best = fit
    if best is not None and (
        best.basis.spacing <= max(_SPACINGS[0] * interval, _SPACING_LIMITS[0]) or best.sigma * focal > _SUSPECT_PX
    ):
        for stiffness in _FINE_STIFFNESS:
            fit = _robust_fit(t, x, good, jumps, _FINE_SPACING * interval, stiffness, gap, focal)
            if fit is not None and fit.score < best.score:
                best = fit
    if best is None:
        return None
    basis, control, inlier, sigma = best.basis, best.control, best.inlier, best.sigma
    mask = np.zeros(len(time), dtype=np.bool_)
    mask[rows[inlier]] = True
    return SmoothTrack(origin, t[inlier], x[inlier], mask, basis, control, sigma, focal, jumps)


def without_jumps(tracks: list[RawTrack]) -> tuple[list[RawTrack], str]:
    """One camera's tracks without the rows before or after its clock jumped; and what was left out, or "".

    A board that learns the time while it records (1970 to now) has two clocks in one recording. Nobody films
    with a pause of half a day: a gap that long is a jump, and the part with most rows is kept.
    """
    if not tracks:
        return tracks, ""
    times = np.sort(np.concatenate([track.time for track in tracks]))
    cuts = np.flatnonzero(np.diff(times) > LONGEST_PAUSE)
    if len(cuts) == 0:
        return tracks, ""
    parts = np.split(times, cuts + 1)
    kept = max(parts, key=len)
    out = []
    for track in tracks:
        inside = (track.time >= kept[0]) & (track.time <= kept[-1])
        if inside.any():
            out.append(
                replace(
                    track,
                    frame=track.frame[inside],
                    time=track.time[inside],
                    pixels=track.pixels[inside],
                    size=track.size[inside],
                )
            )
    lost = len(times) - len(kept)
    jump = float(np.diff(times)[cuts].max())
    return out, f"its clock jumps by {jump:.0f} s; {lost} of {len(times)} rows on the other side are left out"


def neighbour_test(time: Floats, points: Floats, floor: float) -> Bools:
    """Which points (n,) agree with a line between some of their neighbours.

    Each point is compared with linear interpolation between each of its 4 predecessors and successors;
    the 20 % quantile of the residuals survives 40 % false neighbours, where the median breaks at 30 %.
    Then again with the neighbours that passed, of which few are false, and also with lines through two of one
    side, on which the last points before a jump lie. floor: residual below which a point is
    never suspected.
    """
    good = np.ones(len(time), dtype=np.bool_)
    for one_sided in (False, True):
        score = _neighbour_score(time, points, good, one_sided)
        # The 40 % quantile lies among the true points even where 40 % are false.
        limit = max(floor, 6.0 * float(np.quantile(score, 0.4)))
        again = np.asarray(score <= limit)
        if again.all() or again.sum() < 2 * _NEIGHBOURS:
            return again
        good = again
    return good


def _neighbour_score(time: Floats, points: Floats, good: Bools, one_sided: bool) -> Floats:
    """20 % quantile (n,) of the distances of each point from lines through two good neighbours."""
    rows = np.flatnonzero(good)
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
    with np.errstate(divide="ignore", invalid="ignore"):  # where one of the two is not there
        for k, (low, high) in enumerate(lines):
            share = (time - t_near[low]) / (t_near[high] - t_near[low])
            across = points[:, 0] - x_near[low] - share * (x_near[high] - x_near[low])
            down = points[:, 1] - y_near[low] - share * (y_near[high] - y_near[low])
            residuals[k] = np.where(there[low] & there[high], np.hypot(across, down), np.inf)
    residuals.sort(axis=0)
    known = np.isfinite(residuals).sum(axis=0)
    pick = np.maximum(0, np.ceil(_NEIGHBOUR_QUANTILE * known).astype(np.int64) - 1)
    score = residuals[pick, np.arange(len(time))]
    return np.where(known > 0, score, 0.0)  # the very ends have no neighbours on one side


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """One spline through a track. score: generalised cross-validation [normalised coordinates squared]."""

    score: float
    basis: SplineBasis
    control: Floats
    inlier: Bools
    sigma: float


def _jumps(t: Floats, x: Floats, good: Bools) -> Floats:
    """Times (k,) [s] between two points that no motion of this track joins: the detector took up another thing.

    Seen from both sides: what extrapolation misses, taken as an acceleration, is far beyond the track's own.
    """
    rows = np.flatnonzero(good)
    for turn in range(_JUMP_PASSES):
        if len(rows) < 2 * _LEAST_POINTS:
            break
        at, pos = t[rows], x[rows]
        dt = np.diff(at)
        speed = np.diff(pos, axis=0) / dt[:, None]
        # Between i and i + 1: from the speed before, and from the speed after.
        bend = np.linalg.norm(np.diff(speed, axis=0), axis=1) / (0.5 * (dt[1:] + dt[:-1]))
        limit = _JUMP * float(np.quantile(bend, 0.9))
        where = np.flatnonzero(np.minimum(bend[:-1], bend[1:]) > limit) + 1
        # A piece of a few points is no other thing but false points, and the rest is looked at without them.
        lengths = np.diff(np.r_[0, where + 1, len(rows)])
        short = np.repeat(lengths < _LEAST_POINTS, lengths)
        if not short.any() or turn == _JUMP_PASSES - 1:
            return np.asarray(0.5 * (at[where] + at[where + 1]))
        rows = rows[~short]
    return np.zeros(0)


def _robust_fit(
    t: Floats, x: Floats, good: Bools, jumps: Floats, spacing: float, stiffness: float, gap: float, focal: float
) -> _Fit | None:
    """Spline by reweighting, on stretches that neither long pauses nor jumps cut."""
    inlier = good.copy()
    basis, control, sigma = None, None, np.inf
    gap = max(gap, _BRIDGED_SPACINGS * spacing)
    piece = np.searchsorted(jumps, t)
    for step in range(6):
        inlier &= _in_stretches(t, inlier, gap, piece)
        count = int(inlier.sum())
        if count < 2 * _LEAST_POINTS:
            return None
        begins, ends = stretches(t[inlier], gap, piece[inlier])
        basis = SplineBasis.within(begins, ends, spacing)
        control = fit_spline(basis, t[inlier], x[inlier], np.ones(count), stiffness=stiffness)
        residual = np.linalg.norm(basis.evaluate(control, t) - x, axis=1)
        counts = np.diff(np.searchsorted(t[inlier], np.r_[begins, np.inf]))
        freedom = _freedom(counts, basis.intervals + 3, stiffness)
        n = float(count)
        left = max(n - freedom, 0.02 * n)
        # Median of a Rayleigh variable: 1.1774 sigma.
        sigma = max(_LEAST_SIGMA_PX / focal, float(np.median(residual[inlier])) / 1.1774 * np.sqrt(n / left))
        with np.errstate(invalid="ignore"):
            again = residual < max(_CUT * sigma * (2.0 if step == 0 else 1.0), _NEVER_SUSPECT_PX / focal)
        if np.array_equal(again, inlier):
            break
        inlier = again
    if basis is None or control is None:
        return None
    squared = np.minimum(residual[inlier], _CUT * sigma) ** 2
    kept = float(inlier.sum())
    score = float(squared.mean()) * (kept / max(kept - freedom, 0.02 * kept)) ** 2
    # A spacing that throws many points away is no better for fitting the rest.
    score *= (float(good.sum()) / kept) ** 2
    return _Fit(score, basis, control, inlier, sigma)


def _freedom(points: Ints, controls: Ints, stiffness: float) -> float:
    """Degrees of freedom of a fit: the trace of its smoother, by frequency as for evenly spaced points.

    points, controls: (s,) of each stretch.
    """
    # A third difference passes |2 sin(w / 2)|^6. Where there are fewer points than controls, a track has no
    # frequencies beyond the points' own; a control then shares in points / controls rows.
    rows = np.minimum(points / controls, 1.0)[:, None]
    phase = np.linspace(0.0, np.pi, 65)[1:] * rows
    share = 1.0 / (1.0 + stiffness * (2.0 * np.sin(0.5 * phase)) ** 6 / np.maximum(points / controls, 1e-9)[:, None])
    return float((np.minimum(points, controls) * share.mean(axis=1)).sum())


def _in_stretches(t: Floats, inlier: Bools, gap: float, piece: Ints) -> Bools:
    """Inliers that hang together with at least a handful of others."""
    out = np.zeros(len(t), dtype=np.bool_)
    rows = np.flatnonzero(inlier)
    if len(rows) == 0:
        return out
    cut = (np.diff(t[rows]) > gap) | (np.diff(piece[rows]) > 0)
    for part in np.split(rows, np.flatnonzero(cut) + 1):
        if len(part) >= _LEAST_POINTS:
            out[part] = True
    return out


def smooth_only(tracks: Mapping[str, Track]) -> dict[str, SmoothTrack]:
    """The smooth ones of a camera's tracks, by label."""
    return {label: track for label, track in tracks.items() if isinstance(track, SmoothTrack)}
