"""From a raw image track to a smooth one: false detections dropped, noise measured, gaps kept apart.

METHODS A, step 1: neighbour test, then a robust cubic spline whose knot spacing comes from the data by
generalised cross-validation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from hub.points import SampledTrack
from hub.splines import SplineBasis, fit_spline, stretches
from protocols.geometry.types import Bools, Floats
from protocols.session.observations import Track as RawTrack

LONGEST_PAUSE = 43_200.0
"""A longer gap [s] between two rows of a camera is a jump of its clock, not a pause."""
SHORTEST_GAP = 0.2
"""Gaps [s] up to this are bridged by the spline at any frame rate."""
GAP_INTERVALS = 3.2
"""… and so are gaps of up to this many median intervals (labels on every fourth frame)."""
_SPACINGS = (2.5, 4.0, 6.0, 9.0, 14.0)  # knot spacings tried, in median intervals
_SPACING_LIMITS = (0.06, 0.8)  # s
_NEIGHBOURS = 4
_CUT = 4.0  # residuals beyond this many sigma are false detections
_LEAST_POINTS = 4  # in a stretch
_NEVER_SUSPECT_PX = 1.5
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

    def at(self, time: Floats, derivative: int = 0) -> Floats:
        """Smoothed normalised coordinates (n, 2) (or their derivative); NaN in gaps."""
        return self.basis.evaluate(self.control, time, derivative)

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
    best: tuple[float, SplineBasis, Floats, Bools, float] | None = None
    for factor in _SPACINGS:
        spacing = float(np.clip(factor * interval, *_SPACING_LIMITS))
        if best is not None and spacing == best[1].spacing:
            continue
        fit = _robust_fit(t, x, good, spacing, gap, focal)
        if fit is not None and (best is None or fit[0] < best[0]):
            best = fit
    if best is None:
        return None
    _, basis, control, inlier, sigma = best
    mask = np.zeros(len(time), dtype=np.bool_)
    mask[rows[inlier]] = True
    return SmoothTrack(origin, t[inlier], x[inlier], mask, basis, control, sigma, focal)


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
    floor: residual below which a point is never suspected.
    """
    n = len(time)
    residuals = np.full((_NEIGHBOURS * _NEIGHBOURS, n), np.nan)
    row = 0
    for a in range(1, _NEIGHBOURS + 1):
        for b in range(1, _NEIGHBOURS + 1):
            middle = np.arange(a, n - b)
            if len(middle):
                before, after = middle - a, middle + b
                share = (time[middle] - time[before]) / (time[after] - time[before])
                line = points[before] + share[:, None] * (points[after] - points[before])
                residuals[row, middle] = np.linalg.norm(points[middle] - line, axis=1)
            row += 1
    known = np.isfinite(residuals).sum(axis=0)
    ordered = np.sort(residuals, axis=0)  # NaN last
    pick = np.maximum(0, np.ceil(0.2 * known).astype(np.int64) - 1)
    score = ordered[pick, np.arange(n)]
    score = np.where(known > 0, score, 0.0)  # the very ends have no neighbours on one side
    # The 40 % quantile lies among the true points even where 40 % are false.
    limit = max(floor, 6.0 * float(np.quantile(score, 0.4)))
    return np.asarray(score <= limit)


def _robust_fit(
    t: Floats, x: Floats, good: Bools, spacing: float, gap: float, focal: float
) -> tuple[float, SplineBasis, Floats, Bools, float] | None:
    """Spline by reweighting: (GCV score, basis, control, inliers, sigma)."""
    inlier = good.copy()
    basis, control, sigma = None, None, np.inf
    for step in range(6):
        inlier &= _in_stretches(t, inlier, gap)
        if inlier.sum() < 2 * _LEAST_POINTS:
            return None
        begins, ends = stretches(t[inlier], gap)
        basis = SplineBasis.over(begins, ends, spacing)
        control = fit_spline(basis, t[inlier], x[inlier], np.ones(int(inlier.sum())), stiffness=1e-3)
        residual = np.linalg.norm(basis.evaluate(control, t) - x, axis=1)
        counts = np.diff(np.searchsorted(t[inlier], np.r_[begins, np.inf]))
        freedom = float(np.minimum(counts, basis.intervals + 3).sum())
        n = float(inlier.sum())
        left = max(n - freedom, 0.1 * n)
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
    score = float(squared.mean()) * (kept / max(kept - freedom, 0.05 * kept)) ** 2
    # A spacing that throws many points away is no better for fitting the rest.
    score *= (float(good.sum()) / kept) ** 2
    return score, basis, control, inlier, sigma


def _in_stretches(t: Floats, inlier: Bools, gap: float) -> Bools:
    """Inliers that hang together with at least a handful of others."""
    out = np.zeros(len(t), dtype=np.bool_)
    rows = np.flatnonzero(inlier)
    if len(rows) == 0:
        return out
    for part in np.split(rows, np.flatnonzero(np.diff(t[rows]) > gap) + 1):
        if len(part) >= _LEAST_POINTS:
            out[part] = True
    return out


def smooth_only(tracks: Mapping[str, Track]) -> dict[str, SmoothTrack]:
    """The smooth ones of a camera's tracks, by label."""
    return {label: track for label, track in tracks.items() if isinstance(track, SmoothTrack)}
