"""Corresponding points of two tracks under a time map, and the quality figures of an alignment of them."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np

from hub.sync.hypothesis import PairFit
from hub.sync.settings import PairSettings
from hub.trajectory.image_tracks import SmoothTrack
from hub.two_view import relative_pose
from hub.two_view.refinement import PointPairs, RefinementResult
from hub.two_view.relative_pose import TwoViewGeometry
from protocols.geometry import kernels
from protocols.geometry.order_statistics import median
from protocols.geometry.types import Bools, Floats, Ints

_MAX_INTERVAL_RATIO = 5.0  # times the median interval: longer ones are pauses
_CLIP = 3.0  # robust sigma at which residuals are clipped: outliers carry no correlation
_MIN_SIGNIFICANCE = 2.0  # sigma from which a correlation coefficient is significant


class Samples:
    """Samples of one alignment, all labels together: a's detections at their own times, b interpolated by its splines.

    a, b: tracks of the same labels in the same order. offset: approximate one [s], ``t_a = t_b + offset``. max_count:
    largest number of samples. label, time [s], points: (n,), (n,), (n, 2) of a. centre: median time [s].
    seconds_per_sample: support that a sample stands for; several labels count as the root of their number.
    A callable (`refinement.Sampler`): point pairs at a time map.
    """

    def __init__(
        self, a: Sequence[SmoothTrack], b: Sequence[SmoothTrack], offset: float, settings: PairSettings, max_count: int
    ) -> None:
        self.a, self.b, self.settings = a, b, settings
        rows_per_label = [self._moving_rows(one, other, offset) for one, other in zip(a, b, strict=True)]
        fraction = min(1.0, max_count / max(sum(len(rows) for rows in rows_per_label), 1))
        # The same fraction of every label, spread over its time.
        thinned = [
            rows[np.linspace(0, len(rows) - 1, round(fraction * len(rows))).round().astype(np.int64)]
            if fraction < 1.0
            else rows
            for rows in rows_per_label
        ]
        self.label = np.concatenate([np.full(len(rows), k) for k, rows in enumerate(thinned)])
        self.time = np.concatenate([one.time[rows] for one, rows in zip(a, thinned, strict=True)])
        self.points = np.concatenate([one.points[rows] for one, rows in zip(a, thinned, strict=True)])
        intervals = [_mean_interval(one.time) for one in a]
        seconds = sum(len(rows) * t for rows, t in zip(rows_per_label, intervals, strict=True))
        self.seconds_per_sample = len(a) ** -0.5 * seconds / max(len(self.time), 1)
        self._recount()

    def keep_inliers(self, matrix: Floats, rate: float, offset: float, pixels: float) -> None:
        """Drop samples whose Sampson distance to ``s_bᵀ M s_a = 0`` (3, 3) exceeds ``pixels`` at this time map."""
        a, b = self.points_at(rate, offset)
        sigma_a, sigma_b = 1.0 / self.a[0].focal, 1.0 / self.b[0].focal
        with np.errstate(invalid="ignore"):
            inlier = np.abs(relative_pose.sampson(matrix, a, b, sigma_a, sigma_b)) < pixels
        self.label, self.time, self.points = self.label[inlier], self.time[inlier], self.points[inlier]
        self._recount()

    def thinned(self, max_count: int) -> Samples:
        """A copy with at most ``max_count`` of these samples, spread evenly."""
        rows = np.linspace(0, self.count - 1, min(max_count, self.count))
        out = self.select(np.unique(rows.round().astype(np.int64)))
        out.seconds_per_sample *= self.count / max(out.count, 1)
        return out

    def select(self, rows: Ints | Bools) -> Samples:
        """A copy with some of these samples."""
        out = copy(self)
        out.label, out.time, out.points = self.label[rows], self.time[rows], self.points[rows]
        out._recount()
        return out

    def _recount(self) -> None:
        self.count = len(self.time)
        self.centre = median(self.time) if self.count else 0.0
        self.centred_time = self.time - self.centre
        self.points = np.asfortranarray(self.points)  # numpy is slow along axes of length two
        self._compiled: kernels.SampledTracks | None = None

    @property
    def compiled(self) -> kernels.SampledTracks | None:
        """The samples for the compiled kernels."""
        if self._compiled is None and kernels.AVAILABLE and self.count:
            rows = np.bincount(self.label, minlength=len(self.b)).tolist()
            splines = [(track.basis.table, track.polynomials) for track in self.b]
            self._compiled = kernels.SampledTracks(self.points, self.centred_time, rows, splines)
        return self._compiled

    def _moving_rows(self, a: SmoothTrack, b: SmoothTrack, offset: float) -> Ints:
        margin = 0.5
        inside = (a.time - offset > b.basis.begin - margin) & (a.time - offset < b.basis.end + margin)
        speed = np.hypot(*a.point_and_velocity(a.time)[1].T) * a.focal
        return np.flatnonzero(inside & (speed > 0.5 * self.settings.min_speed_px))

    def interpolate_b(self, time: Floats) -> tuple[Floats, Floats]:
        """Points and velocities [1/s] of b, (n, 2) each, at b's times (n,) of the samples; NaN in gaps."""
        return self._interpolate(self.b, time)

    def _interpolate(self, tracks: Sequence[SmoothTrack], time: Floats) -> tuple[Floats, Floats]:
        if len(tracks) == 1:
            return tracks[0].point_and_velocity(time)
        points, velocities = np.full((2, len(time)), np.nan).T, np.full((2, len(time)), np.nan).T
        for k, track in enumerate(tracks):
            mine = self.label == k
            points[mine], velocities[mine] = track.point_and_velocity(time[mine])
        return points, velocities

    def points_at(self, rate: float, offset: float) -> tuple[Floats, Floats]:
        """Points of a (n, 2) and of b (n, 2; NaN in its gaps) under ``t_a = rate t_b + offset``."""
        return self.points, self.interpolate_b((self.time - offset) / rate)[0]

    def __call__(self, inverse_rate: float, intercept: float) -> PointPairs:
        b, speed = self.interpolate_b(inverse_rate * self.centred_time + intercept)
        present = np.isfinite(b[:, 0])
        if present.all():
            return PointPairs(self.points, b, speed, self.centred_time)
        a, b, speed = (one.T.compress(present, axis=1).T for one in (self.points, b, speed))
        return PointPairs(a, b, speed, self.centred_time[present])

    def autocorrelation_time(self, result: RefinementResult) -> float:
        """Integrated autocorrelation time of the residuals [samples]: the number of samples per effective sample."""
        pairs, sigma = self(result.inverse_rate, result.intercept), (1.0 / self.a[0].focal, 1.0 / self.b[0].focal)
        residual = relative_pose.sampson(result.geometry.matrix, pairs.a, pairs.b, *sigma)
        return 2.0 * float(autocorrelation(residual).sum()) - 1.0

    def evaluate(self, rate: float, offset: float, geometry: TwoViewGeometry) -> PairFit:
        """The alignment ``t_a = rate * t_b + offset`` with quality figures, over the samples where both tracks move."""
        b, velocity_b = self.interpolate_b((self.time - offset) / rate)
        smooth, velocity_a = self._interpolate(self.a, self.time)
        focal_a, focal_b = self.a[0].focal, self.b[0].focal
        least = self.settings.min_speed_px
        with np.errstate(invalid="ignore"):  # where b is not present
            moving: Bools = np.hypot(*velocity_a.T) * focal_a > least
            moving &= np.hypot(*velocity_b.T) * focal_b > least
        a, smooth, b = (one.T.compress(moving, axis=1).T for one in (self.points, smooth, b))
        count = len(a)
        if count < 8:
            return PairFit(rate, offset, geometry, np.inf, 0.0, 0.0, 0.0, 0.0, self.centre, 0.0)
        sigma_a, sigma_b = self.settings.sigma_px / focal_a, self.settings.sigma_px / focal_b
        distance = np.abs(relative_pose.sampson(geometry.matrix, a, b, sigma_a, sigma_b))
        smoothed = relative_pose.sampson(geometry.matrix, smooth, b, sigma_a, sigma_b)
        # The inlier limit follows the tracks' noise, not the fit's residual: a wrong geometry must not widen it.
        track_noise = max(median(np.array([track.sigma_px for track in tracks])) for tracks in (self.a, self.b))
        limit = max(3.0 * track_noise, 3.0) / self.settings.sigma_px
        inlier = distance < limit
        inlier_a, inlier_b = (one.T.compress(inlier, axis=1).T for one in (a, b))
        front = relative_pose.in_front(geometry, inlier_a, inlier_b)
        seconds = float(count) * self.seconds_per_sample
        inliers = float(inlier.mean())
        ends = inlier_a * focal_a, inlier_b * focal_b
        # From a to b and back, of which the less counts: edge-on planes magnify noise.
        planar = [relative_pose.homography_residual(*both) for both in (ends, ends[::-1])]
        return PairFit(
            rate=rate,
            offset=offset,
            geometry=geometry,
            residual_px=median(distance) / 0.6745 * self.settings.sigma_px,
            inliers=inliers,
            in_front=float(front.mean()) if len(front) else 0.0,
            support=seconds * inliers,
            moving_overlap=seconds,
            mid_time=median(self.time[moving]),
            parallax=relative_pose.parallax(geometry, a, b),
            track_noise_px=track_noise,
            misfit=float((smoothed[inlier] ** 2).mean()) if inlier.any() else np.inf,
            planar_residual_px=min(planar),
        )


def autocorrelation(residual: Floats) -> Floats:
    """Autocorrelation (k,) of residuals (n,) by lag in samples, from lag 0 up to the last significant one."""
    limit = _CLIP * median(np.abs(residual)) / 0.6745
    residual = np.clip(residual, -limit, limit)
    variance = max(float(np.mean(residual**2)), 1e-300)
    out = [1.0]
    for lag in range(1, len(residual) // 4):
        correlation = float(np.mean(residual[lag:] * residual[:-lag])) / variance
        if correlation < _MIN_SIGNIFICANCE / np.sqrt(len(residual)):
            break
        out.append(correlation)
    return np.array(out)


def _mean_interval(time: Floats) -> float:
    """Mean interval [s] of a track's times (n,) without pauses; dropped frames lengthen it."""
    steps = time[1:] - time[:-1]
    short = steps[steps <= _MAX_INTERVAL_RATIO * median(steps)]
    return float(short.sum()) / len(short)
