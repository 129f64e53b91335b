"""An alignment of two tracks: its samples, its absolute figures, and what a solved or refused pair says."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from hub.trajectory.image_tracks import SmoothTrack
from hub.two_view import relative_pose
from hub.two_view.refinement import PointPairs, Refined
from hub.two_view.relative_pose import Geometry, RelativePose
from protocols.geometry.types import Bools, Floats, Ints

_PAUSE_INTERVALS = 5.0
_GROSS = 3.0  # sigma beyond which a residual tells no correlation
_TOLD = 2.0  # sigma by which a correlation must stand out
_STEPS = (0.01, 0.0125, 0.016, 0.02, 0.025, 0.033, 0.05)


@dataclass(frozen=True, slots=True)
class PairSettings:
    """What the pair solver reckons with; the defaults hold on every rig."""

    finest_step: float = 0.01
    coarsest_step: float = 0.05
    """Grid of the scan [s], between these; …"""
    step_px: float = 8.0
    """… chosen so that the faster tenth of the motion goes about this far in a step [px]."""
    least_support: float = 1.0
    """Seconds in which both must move for a lag to be looked at."""
    sigma_px: float = 0.5
    """Noise that a good track has; scales the scan's costs."""
    per_stratum: int = 6
    at_most: int = 18
    few: int = 160
    """Point pairs in the choice among the starts of a candidate."""
    samples: int = 500
    """Point pairs in the refinement of a candidate, and in the look at how firm the answer's lag is."""
    all_samples: int = 6000
    """Point pairs in the last refinement of the alignment that is answered."""
    largest_sigma_px: float = 6.0
    """Lens errors included: beyond this an epipolar fit is no fit."""
    rate_std: float = 2e-3
    """Prior on how far a clock's rate is from its nominal one."""
    moving_px: float = 20.0
    """Image speed [px/s] from which a sample counts as moving."""
    accept_support: float = 1.5
    """Seconds of agreeing motion below which nothing is answered."""
    unchecked_support: float = 8.0
    """… and where the recordings are too short to tell how well unrelated stretches fit."""
    accept_inliers: float = 0.6
    """Of the common motion, where there is plenty of it."""
    strict_inliers: float = 0.95
    """… and where there is hardly any: seven parameters and a search over all lags fit a few seconds of anything."""
    plenty: float = 12.0
    hardly: float = 4.0
    """Seconds of agreeing motion that count as plenty and as hardly any."""
    largest_rate: float = 1e-2
    accept_log10_chance: float = -1.3
    """log10 of the chance that the best of all wrong lags fits as well."""
    accept_pieces: float = 3.0
    """Standard deviations by which a lag's agreeing seconds must stand out where the tracks jump, …"""
    accept_pieces_support: float = 4.0
    """… and how many of them there must be."""
    accept_log10_gap: float = -2.0
    """log10 of the chance that the next best lag is so much worse; either of the two will do."""
    alone_support: float = 5.0
    """Seconds of agreeing motion from which an alignment at the noise is believed that stands alone: …"""
    alone_strength: float = 3.0
    """… its strength (`verdict.strength`), and …"""
    alone_margin: float = 2.3
    """… by how much it exceeds the next best one's: half the logarithm of the odds, 100 to 1. (That one must not come
    near it in evidence either: a motion that repeats itself makes two that are strong alike.)"""
    apart_ratio: float = 0.6
    """Strength of the next best alignment over that of one whose lag is told firmly, beyond which it is in doubt."""
    distinct_alignments: float = 0.3
    """Seconds between lags whose misfits are independent."""
    flat_ratio: float = 3.0
    """A plane that leaves less than this many times the epipolar residual explains the motion as well."""
    accept_in_front: float = 0.95
    accept_ratio: float = 0.5
    """Evidence of the second best alignment over that of the best; …"""
    clearly_worse: float = 1.6
    """… which doesn't count if it leaves this many times the residual, …"""
    worse_than_noise: float = 1.4
    """… this many times where the best one leaves no more than the noise, …"""
    clearly_likelier: float = 3.0
    """… or if chance makes it this many powers of ten more often; …"""
    likelier_than_usual: float = 2.0
    """… so many are enough where chance makes one like it in every search."""
    near_window: float = 0.3
    """How far the lag may be from what other cameras tell, where they do [s]."""
    exact: float = 1.3
    """What an alignment may leave over the tracks' own noise for the noise to explain it."""
    largest_lag_std: float = 4e-3
    """Least certainty [s] of the lag, …"""
    largest_slow_lag_std: float = 10e-3
    """… up to this where the point moves by less than a pixel in that time, and …"""
    firm: bool = True
    """Whether the answer must stand by itself, and not only begin an adjustment of more cameras, which judges it: …"""
    largest_doubt: float = 10e-3
    """… largest std [s] of the lag, lenses and shutters included: the path, which tells it again, must then agree; …"""
    largest_flat_doubt: float = 7e-3
    """… where a plane explains the motion nearly as well, so much; …"""
    largest_short_doubt: float = 7e-3
    """… where an alignment that stands apart has less motion than …"""
    plenty_apart: float = 10.0
    """… these seconds, so much; …"""
    largest_swing: float = 30e-3
    """… seconds by which it may move when a fifth of what it rests on is left out."""
    largest_turn_apart: float = 0.5
    """Angle [rad] between rotations that fit alike, beyond which a pair by itself has none; …"""
    largest_turn_std: float = 0.1
    """… of the relative rotation [rad] that is worth an answer; …"""
    firm_turn_std: float = 0.04
    """… where an alignment is believed for standing apart, so little; …"""
    sure_turn_std: float = 0.25
    """… where the lag is beyond doubt, so much: epipolar lines can be right to a pixel with the pose open."""
    sure_log10_chance: float = -3.0
    """log10 of the chance of one unrelated stretch from which the lag is beyond doubt."""


@dataclass(frozen=True, slots=True, eq=False)
class PairFit:
    """One refined alignment: ``t_a = rate * t_b + offset`` on the tracks' own (shifted) times.

    cost: mean robust squared distance over the noise. sigma_px: robust residual [px].
    support: seconds of agreeing motion. inliers, front: fractions of the moving samples.
    moving_overlap: seconds in which both tracks exist and move. middle: time of a in the middle of them.
    parallax: median angle [rad] between the two rays of a point (0 without lenses).
    flat_px: what one plane would leave [px]. misfit: mean squared distance over the settings' noise of the
    smoothed samples that agree. own_px: noise of the noisier camera's tracks. log10_chance: of one unrelated
    stretch of such length fitting as well, None where the recordings are too short to tell. log10_gap: of the
    next best lag leaving so much more by chance. cycles: bandwidth times seconds of agreeing motion. lag_std [s],
    turn_std [rad]: of the last refinement, by noise alone. lag_doubt [s]: std of the lag with lenses and shutters not
    exactly as told. rate_std: of what the rate was taken for beforehand, narrow where the motion does not tell it.
    """

    rate: float
    offset: float
    geometry: Geometry
    cost: float
    sigma_px: float
    inliers: float
    front: float
    support: float
    moving_overlap: float
    middle: float
    parallax: float
    flat_px: float = float("nan")
    misfit: float = float("inf")
    own_px: float = float("nan")
    log10_chance: float | None = None
    log10_gap: float = 0.0
    cycles: float = 0.0
    lag_std: float = float("nan")
    turn_std: float = float("nan")
    lag_doubt: float = float("nan")
    rate_std: float = float("nan")

    @property
    def pose(self) -> RelativePose:
        """The relative pose. Raises ValueError for a fit of cameras without known lenses."""
        if not isinstance(self.geometry, RelativePose):
            raise ValueError("cameras without intrinsics have no relative pose")
        return self.geometry

    @property
    def lag(self) -> float:
        """``t_a - t_b`` [s] at the middle of the common motion."""
        return self.middle - (self.middle - self.offset) / self.rate


@dataclass(frozen=True, slots=True, eq=False)
class PairSolution:
    """What is known of a pair of cameras. ``status`` is "ok" or the reason of the refusal."""

    a: str
    b: str
    status: str
    fit: PairFit | None = None
    others: tuple[PairFit, ...] = field(default=())
    fundamental: Floats | None = None
    """(3, 3) of undistorted pixels, ``m_aᵀ F m_b = 0``, where the method found it directly."""

    @property
    def solved(self) -> bool:
        """Whether the fit can be relied on."""
        return self.status == "ok"


class Samples:
    """Samples of one alignment, all labels together: the inliers of a at their own times, b by its splines.

    a, b: tracks of the same labels in the same order. offset: about where they meet, ``t_a = t_b + offset``.
    most: samples at most.
    """

    def __init__(
        self, a: Sequence[SmoothTrack], b: Sequence[SmoothTrack], offset: float, settings: PairSettings, most: int
    ) -> None:
        self.a, self.b, self.s = a, b, settings
        parts = [self._rows(one, other, offset) for one, other in zip(a, b, strict=True)]
        share = min(1.0, most / max(sum(len(rows) for rows in parts), 1))
        # The same share of every label, spread over its time.
        thinned = [
            rows[np.linspace(0, len(rows) - 1, round(share * len(rows))).round().astype(np.int64)] for rows in parts
        ]
        self.label = np.concatenate([np.full(len(rows), k) for k, rows in enumerate(thinned)])
        self.time = np.concatenate([one.time[rows] for one, rows in zip(a, thinned, strict=True)])
        self.points = np.concatenate([one.points[rows] for one, rows in zip(a, thinned, strict=True)])
        intervals = [_interval(one.time) for one in a]
        seconds = sum(len(rows) * t for rows, t in zip(parts, intervals, strict=True))
        self.seconds_a_sample = len(a) ** -0.5 * seconds / max(len(self.time), 1)
        self._count()

    def keep_near(self, matrix: Floats, rate: float, offset: float, pixels: float) -> None:
        """Leave out what is further than ``pixels`` from ``s_bᵀ M s_a = 0`` (3, 3) under this time map."""
        a, b = self.at(rate, offset)
        sigma_a, sigma_b = 1.0 / self.a[0].focal, 1.0 / self.b[0].focal
        with np.errstate(invalid="ignore"):
            near = np.abs(relative_pose.sampson(matrix, a, b, sigma_a, sigma_b)) < pixels
        self.label, self.time, self.points = self.label[near], self.time[near], self.points[near]
        self._count()

    def thinned(self, most: int) -> Samples:
        """At most so many of these samples, spread over their rows."""
        out = copy(self)
        rows = np.unique(np.linspace(0, self.count - 1, min(most, self.count)).round().astype(np.int64))
        out.label, out.time, out.points = self.label[rows], self.time[rows], self.points[rows]
        out.seconds_a_sample = self.seconds_a_sample * self.count / max(len(rows), 1)
        out._count()
        return out

    def _count(self) -> None:
        self.count = len(self.time)
        self.centre = float(np.median(self.time)) if self.count else 0.0

    def _rows(self, a: SmoothTrack, b: SmoothTrack, offset: float) -> Ints:
        margin = 0.5
        inside = (a.time - offset > b.basis.begin - margin) & (a.time - offset < b.basis.end + margin)
        speed = np.linalg.norm(a.at(a.time, 1), axis=1) * a.focal
        return np.flatnonzero(inside & (speed > 0.5 * self.s.moving_px))

    def of_b(self, time: Floats) -> tuple[Floats, Floats]:
        """Points and speeds of b, (n, 2) each, at b's times (n,) of the samples; NaN in gaps."""
        if len(self.b) == 1:
            return self.b[0].point_and_speed(time)
        points, speeds = np.full((len(time), 2), np.nan), np.full((len(time), 2), np.nan)
        for k, track in enumerate(self.b):
            mine = self.label == k
            points[mine], speeds[mine] = track.point_and_speed(time[mine])
        return points, speeds

    def at(self, rate: float, offset: float) -> tuple[Floats, Floats]:
        """Points of a (n, 2) and of b (n, 2; NaN in its gaps) under ``t_a = rate t_b + offset``."""
        return self.points, self.of_b((self.time - offset) / rate)[0]

    def __call__(self, slowness: float, middle: float) -> PointPairs:
        lever = self.time - self.centre
        b, speed = self.of_b(slowness * lever + middle)
        there = np.isfinite(b[:, 0])
        if there.all():
            return PointPairs(self.points, b, speed, lever)
        return PointPairs(self.points[there], b[there], speed[there], lever[there])

    def together(self, found: Refined) -> float:
        """How many residuals in a row count as one."""
        rate = 1.0 / found.slowness
        a, b = self.at(rate, self.centre - rate * found.middle)
        there = np.isfinite(b[:, 0])
        off = relative_pose.sampson(
            found.geometry.matrix, a[there], b[there], 1.0 / self.a[0].focal, 1.0 / self.b[0].focal
        )
        return 2.0 * float(correlated(off).sum()) - 1.0

    def judge(self, cost: float, rate: float, offset: float, geometry: Geometry) -> PairFit:
        """Absolute figures of an alignment, over the samples where both move."""
        a = self.points
        b, speed = self.of_b((self.time - offset) / rate)
        there = np.isfinite(b).all(axis=1)
        focal_a, focal_b = self.a[0].focal, self.b[0].focal
        speed_b = np.linalg.norm(speed, axis=1) * focal_b
        speed_a = np.concatenate(
            [
                np.linalg.norm(track.at(self.time[self.label == k], 1), axis=1) * focal_a
                for k, track in enumerate(self.a)
            ]
        )
        with np.errstate(invalid="ignore"):
            moving: Bools = there & (speed_a > self.s.moving_px) & (speed_b > self.s.moving_px)
        count = int(moving.sum())
        if count < 8:
            return PairFit(rate, offset, geometry, cost, np.inf, 0.0, 0.0, 0.0, 0.0, self.centre, 0.0)
        sigma_a, sigma_b = self.s.sigma_px / focal_a, self.s.sigma_px / focal_b
        distance = np.abs(relative_pose.sampson(geometry.matrix, a[moving], b[moving], sigma_a, sigma_b))
        smooth = np.concatenate([track.at(self.time[self.label == k]) for k, track in enumerate(self.a)])
        smoothed = np.abs(relative_pose.sampson(geometry.matrix, smooth[moving], b[moving], sigma_a, sigma_b))
        # A track's own noise counts for what it is; a wrong geometry must not hide behind it.
        own = max(float(np.median([track.sigma_px for track in tracks])) for tracks in (self.a, self.b))
        limit = max(3.0 * own, 3.0) / self.s.sigma_px
        close = distance < limit
        front = relative_pose.in_front(geometry, a[moving][close], b[moving][close])
        seconds = float(count) * self.seconds_a_sample
        inliers = float(close.mean())
        return PairFit(
            rate=rate,
            offset=offset,
            geometry=geometry,
            cost=cost,
            sigma_px=float(np.median(distance)) / 0.6745 * self.s.sigma_px,
            inliers=inliers,
            front=float(front.mean()) if len(front) else 0.0,
            support=seconds * inliers,
            moving_overlap=seconds,
            middle=float(np.median(self.time[moving])),
            parallax=relative_pose.parallax(geometry, a[moving], b[moving]),
            own_px=own,
            misfit=float((smoothed[close] ** 2).mean()) if close.any() else np.inf,
            flat_px=_flat_px(a[moving][close] * focal_a, b[moving][close] * focal_b),
        )


def correlated(off: Floats) -> Floats:
    """Correlations (k,) of residuals (n,) so many rows apart, 0 first, as far as they stand out."""
    limit = _GROSS * float(np.median(np.abs(off))) / 0.6745
    off = np.clip(off, -limit, limit)
    variance = max(float(np.mean(off**2)), 1e-300)
    out = [1.0]
    for lag in range(1, len(off) // 4):
        correlation = float(np.mean(off[lag:] * off[:-lag])) / variance
        if correlation < _TOLD / np.sqrt(len(off)):
            break
        out.append(correlation)
    return np.array(out)


def _interval(time: Floats) -> float:
    """Mean interval [s] of a track's rows (n,), pauses left out: rows that were dropped leave longer ones."""
    steps = np.diff(time)
    return float(steps[steps <= _PAUSE_INTERVALS * np.median(steps)].mean())


def fast_motion(track: SmoothTrack) -> float:
    """Speed in the image [px/s] that a tenth of a track's rows exceed."""
    speed = track.at(track.time, 1)
    return float(np.quantile(np.sqrt(speed[:, 0] ** 2 + speed[:, 1] ** 2), 0.9)) * track.focal


def grid_step(fast: float, s: PairSettings) -> float:
    """Step of the scan [s] in which the faster motion of the two, of ``fast`` px/s, goes a few pixels."""
    wanted = s.step_px / max(fast, 1e-9)
    fitting = [step for step in _STEPS if s.finest_step <= step <= min(s.coarsest_step, wanted)]
    return max(fitting, default=s.finest_step)


def turned_round(fit: PairFit) -> PairFit:
    """The same alignment with the two cameras in the other order. Raises ValueError without lenses."""
    turn = fit.pose.rotation.T
    pose = RelativePose(turn, -turn @ fit.pose.direction)
    middle = (fit.middle - fit.offset) / fit.rate
    return replace(fit, rate=1.0 / fit.rate, offset=-fit.offset / fit.rate, geometry=pose, middle=middle)


def evidence(fit: PairFit) -> float:
    """What speaks for an alignment: seconds of agreeing motion, less where little of the overlap agrees."""
    return float(fit.support * fit.inliers * fit.front / np.sqrt(1.0 + fit.sigma_px))


def _flat_px(a: Floats, b: Floats) -> float:
    """What the best plane leaves [px], in the direction in which it leaves less: seen edge-on, it magnifies noise."""
    return min(relative_pose.homography_residual(a, b), relative_pose.homography_residual(b, a))
