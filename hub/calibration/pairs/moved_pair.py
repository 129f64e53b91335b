"""A move of one of two cameras during a recording, by their epipolar geometry, which does not show which of them.

One was moved where, at one and the same lag, the rows before and after some time each have a relative pose that
explains them, and both by far more than one relative pose does, also with a clock step at that time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from hub.bundle.clock_steps import STEP_SIZES
from hub.bundle.initialisation import CameraInput
from hub.bundle.preprocessing import PreparedSession, prepare
from hub.bundle.problem import CameraState
from hub.calibration.acceptance import MAX_ROTATION_STD
from hub.calibration.pairs.pair_network import solve_pairs
from hub.calibration.resection.moved_cameras import LEAST_ROWS, STARTS, Move, best_division
from hub.calibration.resection.scan import MIN_CANDIDATE_RATIO
from hub.sync.hypothesis import PairSolution
from hub.sync.samples import Samples, autocorrelation
from hub.sync.settings import PairSettings
from hub.trajectory.image_tracks import SmoothTrack, smooth_only
from hub.two_view.refinement import (
    FINAL_WIDTH,
    NoiseModel,
    PointPairs,
    RefinementResult,
    Sampler,
    refine,
    symmetric_inverse,
)
from hub.two_view.relative_pose import RelativePose, TwoViewGeometry, five_point, sampson
from protocols.geometry import so3
from protocols.geometry.order_statistics import median
from protocols.geometry.types import Bools, Floats
from protocols.session.observations import Observations
from protocols.session.rig import Rig

_MOST_ROWS, LEAST_SIDE_S = 500, 2.0
"""Rows that are used, and time [s] of each side of a move, without which a pose fits whatever there is."""
_NOISE_COST, _LEAST_PX, _LEAST_CHI2 = 0.5, 1.0, 100.0
"""Mean squared Sampson distance that rows have at least, over their noise: it had a median of 0.6 where two poses were
right; rms [px] that one pose leaves beyond two, and chi-squared of the second one, by effective rows: with correlated
errors of 0.5 to 2 px it came to 87. In 400 recordings of which nobody moved a camera, none had the ratio of costs; of
375 windows of two recorded rigs, 24 had it, and three had it all."""
_TRUNCATION_PX, _TRUNCATION_SIGMA, _INITIAL_SIGMA = 10.0, 5.0, 8.0
"""Distance from which a row counts as not explained: the larger one; and misfit at which a refinement starts."""
_RATE_STD, _WEAKER = 2e-4, 2.0  # of a clock; std of a rotation that shows a move, over that of one that is accepted
_SUBSET = 150  # rows of five-point hypotheses
_LAG_ITERATIONS, _STEP_STARTS = 2, 3  # the lag is off by a move at first; steps that are refined, best first


@dataclass(frozen=True, slots=True, eq=False)
class PairDivision:
    """Where the rows of cameras a and b divide: at times (2,) [s] of their tracks.

    poses: relative poses, b from a, before and after.
    """

    times: tuple[float, float]
    poses: tuple[RelativePose, RelativePose]

    def moves(
        self, prepared: PreparedSession, names: Iterable[str], observations: Observations, keeps_later: bool | None
    ) -> dict[str, Move]:
        """The move, as of either camera a and b of ``names``. keeps_later: None = the side with more rows."""
        turned = so3.angle_between(self.poses[0].rotation, self.poses[1].rotation)
        times = {
            name: at / prepared.time_scale(name) + prepared.time_origins[name]
            for name, at in zip(names, self.times, strict=True)
        }
        rows = {name: np.concatenate([track.time for track in observations.of_camera(name)]) for name in times}
        before, after = (sum(int((sign * (rows[k] - at) > 0.0).sum()) for k, at in times.items()) for sign in (-1, 1))
        later = after > before if keeps_later is None else keeps_later
        return {name: Move((at,), (turned,), int(later), before if later else after) for name, at in times.items()}


def time_map_between(a: CameraState, b: CameraState) -> tuple[float, float]:
    """Rate and offset [s] of ``t_a = rate t_b + offset``."""
    return b.rate / a.rate, a.centre + (b.offset - b.rate * b.centre - a.offset) / a.rate


def moves_of_two(
    prepared: PreparedSession, maps: Iterable[tuple[float, float]], observations: Observations, online: bool
) -> dict[str, Move]:
    """The move of one of a session's two cameras, as of either; empty where none was moved.

    maps: rates and offsets of ``t_a = rate t_b + offset`` of their tracks, of which one may be right. online: whether
    the newest side is kept, else that with more rows.
    """
    names = list(prepared.cameras)
    divisions = (find_division(prepared.cameras[names[0]], prepared.cameras[names[1]], one) for one in maps)
    found = next((one for one in divisions if one is not None), None)
    return {} if found is None else found.moves(prepared, names, observations, online or None)


def likely_maps(
    rig: Rig, observations: Observations, prepared: PreparedSession, pairs: Iterable[PairSolution]
) -> Iterator[tuple[float, float]]:
    """Rates and offsets at which two cameras' tracks, or one half of a's rows, agree best: a move leaves one untouched.

    pairs: of all their rows.
    """
    yield from ((fit.rate, fit.offset) for pair in pairs for fit in (pair.fit, *pair.alternatives) if fit is not None)
    a, b = prepared.cameras
    middle = median(np.concatenate([track.time for track in observations.of_camera(a)]))
    for later in (False, True):
        tracks = {
            key: half
            for key, track in observations.tracks.items()
            if len(half := track if key[0] != a else track.select((track.time >= middle) == later))
        }
        part = prepare(rig, replace(observations, tracks=tracks))
        if part.cameras.keys() == prepared.cameras.keys():
            start = {name: part.time_origins[name] - prepared.time_origins[name] for name in (a, b)}
            for pair in solve_pairs(part, lambda text, share: None)[1]:
                if pair.fit is not None:
                    yield pair.fit.rate, pair.fit.offset + start[a] - pair.fit.rate * start[b]


def find_division(a: CameraInput, b: CameraInput, time_map: tuple[float, float]) -> PairDivision | None:
    """Where one of two cameras was moved; None if nowhere.

    time_map: rate and offset of ``t_a = rate t_b + offset`` [s] of their tracks, the offset right to some 0.1 s.
    """
    rate, offset = time_map
    tracks_a, tracks_b = smooth_only(a.tracks), smooth_only(b.tracks)
    labels = [label for label in tracks_a if label in tracks_b]
    rows = _Rows([tracks_a[k] for k in labels], [tracks_b[k] for k in labels], rate, offset) if labels else None
    if rows is None or rows.count < 2 * LEAST_ROWS or (one := rows.free(rows.samples, offset)) is None:
        return None
    together = rows.costs(one.geometry, rows.samples.centre - one.intercept / one.inverse_rate, 1.0 / one.inverse_rate)
    if together.mean() < MIN_CANDIDATE_RATIO * _NOISE_COST:
        return None  # whatever two poses explain

    def costs(part: slice) -> Floats:
        begin, end, _ = part.indices(rows.count)
        found = rows.held(rows.part(begin, end), offset, [one.geometry])
        return np.full(rows.count, rows.most**2) if found is None else rows.costs(found.geometry, offset)

    for _ in range(_LAG_ITERATIONS):
        _, at = best_division(rows.count, LEAST_ROWS, costs, (0.1, *STARTS, 0.9))
        sides = rows.part(0, at), rows.part(at, rows.count)
        fits = [fit for side in sides if (fit := rows.free(side, offset, [one.geometry])) is not None]
        if len(fits) < 2:
            return None
        lags = [side.centre - rate * fit.intercept for side, fit in zip(sides, fits, strict=True)]
        covariances = [symmetric_inverse(fit.normal) for fit in fits]
        offset = float(np.average(lags, weights=[1.0 / max(float(one[-2, -2]), 1e-12) for one in covariances]))
    if min(rows.times[at - 1] - rows.times[0], rows.times[-1] - rows.times[at]) < LEAST_SIDE_S:
        return None
    held = [rows.held(side, offset, [fit.geometry]) for side, fit in zip(sides, fits, strict=True)]
    poses = [fit.geometry for fit in held if fit is not None and isinstance(fit.geometry, RelativePose)]
    if len(poses) < 2:
        return None
    later = np.arange(rows.count) >= at
    own = np.where(later, *(rows.distances(pose, offset) for pose in reversed(poses)))
    cost = float(np.minimum(own**2, rows.most**2).mean())
    least = min(float(together.mean()), _with_step(rows, offset, later, fits))
    gain = least / max(cost, _NOISE_COST)
    correlated = max(2.0 * float(autocorrelation(own).sum()) - 1.0, 1.0)
    spread = median(np.abs(own)) / 0.6745
    variance = spread**2 * correlated * max(float(np.linalg.eigvalsh(one[:3, :3])[-1]) for one in covariances)
    if (
        gain < MIN_CANDIDATE_RATIO
        or rows.px**2 * (least - cost) < _LEAST_PX**2
        or rows.count / correlated * np.log(gain) < _LEAST_CHI2
        or variance > (_WEAKER * MAX_ROTATION_STD) ** 2
    ):
        return None
    time = 0.5 * float(rows.times[at - 1] + rows.times[at])
    return PairDivision((time, (time - offset) / rate), (poses[0], poses[1]))


class _Rows:
    """Rows of camera a at their own times, and b's tracks there, at one rate.

    samples: the rows. order: (count,) theirs by time; times: in that order. px: noise [px] of a standard deviation of
    one; most: distance from which a row is not explained.
    """

    def __init__(self, a: list[SmoothTrack], b: list[SmoothTrack], rate: float, offset: float) -> None:
        every = Samples(a, b, offset, PairSettings(), _MOST_ROWS)
        self.samples = every.select(np.isfinite(every.points_at(rate, offset)[1][:, 0]))
        self.rate, self.count = rate, self.samples.count
        self.order = np.argsort(self.samples.time, kind="stable")
        self.times = self.samples.time[self.order]
        self.sigma = tuple(max(median(np.array([one.sigma for one in each])), 0.1 / each[0].focal) for each in (a, b))
        self.px = max(self.sigma[0] * a[0].focal, self.sigma[1] * b[0].focal)
        self.most = max(_TRUNCATION_SIGMA, _TRUNCATION_PX / self.px)

    def part(self, begin: int, end: int) -> Samples:
        """The rows from ``begin`` to ``end`` in the order of time."""
        return self.samples.select(np.sort(self.order[begin:end]))

    def distances(self, geometry: TwoViewGeometry, offset: float | Floats, rate: float | None = None) -> Floats:
        """Sampson distances (count,) over the noise, in the order of time, at most as not explained.

        offset: one, or (count,) of the samples. rate: another one.
        """
        b = self.samples.interpolate_b((self.samples.time - offset) / (rate or self.rate))[0]
        found = sampson(geometry.matrix, self.samples.points, b, *self.sigma)[self.order]
        return np.asarray(np.nan_to_num(np.clip(found, -self.most, self.most), nan=self.most))

    def costs(self, geometry: TwoViewGeometry, offset: float | Floats, rate: float | None = None) -> Floats:
        """Squared `distances`."""
        return self.distances(geometry, offset, rate) ** 2

    def free(self, samples: Samples, offset: float, starts: Iterable[TwoViewGeometry] = ()) -> RefinementResult | None:
        """Relative pose, lag and rate of some of the rows."""
        return self._fit(samples, samples, offset, starts)

    def held(self, samples: Samples, offset: float, starts: Iterable[TwoViewGeometry]) -> RefinementResult | None:
        """Their relative pose at a given lag."""
        pairs = samples(1.0 / self.rate, (samples.centre - offset) / self.rate)
        still = replace(pairs, velocity_b=np.zeros_like(pairs.velocity_b))
        return self._fit(samples, lambda inverse_rate, intercept: still, offset, starts)

    def refined(
        self, sampler: Sampler, start: TwoViewGeometry, intercept: float, other: float, std: float
    ) -> RefinementResult | None:
        """The fit of a relative pose and the two numbers of a sampler from one start. std: prior one of the second."""
        noise = NoiseModel(self.sigma[0], self.sigma[1], std)
        return refine(sampler, start, intercept, _INITIAL_SIGMA, noise, inverse_rate=other, final_width=FINAL_WIDTH)

    def _fit(
        self, samples: Samples, sampler: Sampler, offset: float, starts: Iterable[TwoViewGeometry]
    ) -> RefinementResult | None:
        """The best one from given starts and five-point hypotheses."""
        inverse_rate, intercept = 1.0 / self.rate, (samples.centre - offset) / self.rate
        pairs = sampler(inverse_rate, intercept)
        starts = [*starts, *five_point(pairs.a, pairs.b, 3.0 * min(self.sigma), 0, _SUBSET)]
        fits = (self.refined(sampler, start, intercept, inverse_rate, _RATE_STD) for start in starts)
        return min((fit for fit in fits if fit is not None), key=lambda fit: fit.cost, default=None)


def _with_step(rows: _Rows, offset: float, later: Bools, fits: list[RefinementResult]) -> float:
    """Mean cost of one relative pose with the best clock step before the ``later`` rows, from those of either side."""
    samples, inverse_rate, is_later = rows.samples, 1.0 / rows.rate, np.zeros(rows.count)
    is_later[rows.order] = later
    middle = (samples.centre - offset) / rows.rate

    def shifted(first: float, step: float) -> Floats:
        return np.asarray(offset - rows.rate * (first + step * is_later))

    def sampler(second: float, intercept: float) -> PointPairs:  # the step takes the place of the rate
        step = (second - 1.0) * is_later
        b, speed = samples.interpolate_b(inverse_rate * samples.centred_time + intercept + step)
        seen = np.isfinite(b).all(axis=1)
        return PointPairs(samples.points[seen], b[seen], speed[seen], is_later[seen])

    tried = [(0.0, float(size)) for size in STEP_SIZES] + [(float(size), -float(size)) for size in STEP_SIZES]
    costs = [
        (float(rows.costs(fit.geometry, shifted(*one)).mean()), *one, k) for one in tried for k, fit in enumerate(fits)
    ]
    best = min(costs)[0]
    for _, first, step, k in sorted(costs)[:_STEP_STARTS]:
        fit = rows.refined(sampler, fits[k].geometry, middle + first, 1.0 + step, 1.0)
        if fit is not None:
            found = shifted(fit.intercept - middle, fit.inverse_rate - 1.0)
            best = min(best, float(rows.costs(fit.geometry, found).mean()))
    return best
