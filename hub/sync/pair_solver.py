"""Lag, clock rate and two-view geometry of two unsynchronised cameras, without an initial guess.

Extends the asynchronous calibration paper: scan of all lags, candidate lags, refinement of (E or F, lag, rate) on the
Sampson distance from several starts, acceptance tests in absolute terms. Where the scan finds no solution, it is
repeated at clock rates further from 1 and, where a track has discontinuities, with least trimmed squares.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from hub.sync.acceptance import (
    absolute_tests,
    accept_or_reject,
    acceptance_test,
    cannot_compete,
    is_at_noise_floor,
    is_planar,
    is_reliable,
    is_unique_maximum,
    rank_distinct,
    strength,
    with_tests,
)
from hub.sync.final_refinement import LTS_INLIER_PX, refine_and_test
from hub.sync.hypothesis import PairFit, PairSolution, evidence, swap_cameras
from hub.sync.lag_scan import (
    LagScan,
    PairMoments,
    candidate_lags,
    grid_tracks,
    most_active_window,
    scan_lags,
    scan_step,
)
from hub.sync.lts_scan import scan_lags_lts
from hub.sync.null_distribution import EXCLUSION_WINDOW, NullDistribution, fit_null_distribution
from hub.sync.samples import Samples
from hub.sync.settings import PairSettings
from hub.sync.track_cache import TrackCache
from hub.trajectory.image_tracks import SmoothTrack
from hub.two_view import relative_pose
from hub.two_view.refinement import NoiseModel, RefinementResult, refine
from hub.two_view.relative_pose import FundamentalMatrix, RelativePose, TwoViewGeometry
from protocols.geometry.order_statistics import median
from protocols.geometry.types import Floats

_MIN_SAMPLES = 12  # more than the seven unknowns
_NOISE_COST = 0.8  # mean robust cost at which a fit is at the noise: it is about 0.75 with the noise of the settings
_PREDICTED_LAG_CANDIDATES = 3  # the window holds one or two minima
_NO_FIT = "no alignment of the two tracks agrees with any geometry"
_HARDLY_MOVES = "the point hardly moves while both could have seen it"
_HARDLY_MOVES_AT_PREDICTED_LAG = (
    "the point hardly moves at the lag that the other cameras imply; other lags were not searched"
)
_NO_FIT_AT_PREDICTED_LAG = "no geometry agrees at the lag that the other cameras imply; other lags were not searched"
_NONE_RELIABLE = "none of the most promising lags fits; further ones were not searched"
_MAX_STARTS = 4  # hypotheses that are refined whatever they cost, best first
_FIVE_POINT_SEEDS = 8  # random seeds of five-point hypotheses; more than _MAX_STARTS hypotheses are tried only …
_PROMISING = 12.0  # … while the cost is at most this many times the noise: a local minimum of E at the right lag
_MAX_RATE_STEPS = 8  # drift rates tried on either side of 1
_MAX_LTS_SECONDS = 45.0  # s of a's tracks that the LTS scan uses
_LTS_STEP = 0.033  # s: the LTS scan is coarse and expensive
_MIN_TRACK_INLIERS = 0.85  # fraction of a track's rows: with fewer the track may follow several objects
_LTS_EXCLUSION = 0.5  # s about the best lag that do not count as other lags
_MIN_OTHER_LAGS = 3.0  # s of other lags
_CLOSE_TO_FUNDAMENTAL = 1.1  # times the fundamental matrix's cost: an E this close is not in a local minimum
_SAME_MINIMUM, _MIN_REPEATS = 0.01, 3
"""Relative cost difference, number of starts that end in the same minimum: in 2,500 searches of 220 simulated rigs no
later start ended lower. With a wrong lens all end in it, far from the fundamental matrix's cost."""
_MAX_RATE_BLIND_SPAN = (
    50.0  # s: over longer recordings a rate error of 0.1 % (29.97 for 30) exceeds the scan's tolerance
)
_MAX_COST_RATIO = 0.2  # of the median cost of lags with similar support
_SAME_LAG = 0.1  # s
_MAX_REPETITIONS = 4  # other lags at which the solution's own geometry is tried
FRAME_RATES = (24.0, 25.0, 30.0, 50.0, 60.0)  # common ones [1/s]
FRAME_RATE_RATIOS = tuple(
    sorted(
        {round(a / b, 9) for a in FRAME_RATES for b in FRAME_RATES if 0.4 < a / b < 2.5 and a != b},
        key=lambda rate: abs(np.log(rate)),
    )
)
"""Ratios of common frame rates: timestamps made from frame numbers with a wrong frame rate are off by these."""
SLOW_MOTION_RATES, _SHOWN_RATES = (60.0, 100.0, 120.0, 200.0, 240.0), (24.0, 25.0, 30.0)
"""Frames a second of slow motion as phones and action cameras film it, and as their files show it."""
_SLOW_MOTION = sorted({round(a / b, 9) for a in SLOW_MOTION_RATES for b in _SHOWN_RATES if a / b >= 2.5})
_SAME_BANDWIDTH = 2.0
"""Ratio of the bandwidths of two views of one motion: at most 1.7 of waved markers and drones."""


def slow_motion_ratios(bandwidth: float, other: float) -> list[float]:
    """Factors of the times of a slow-motion file, or of one beside slow-motion files, that explain two bandwidths.

    bandwidth, other: of the motion [Hz] in it and in the other file.
    """
    ratio = bandwidth / max(other, 1e-9)
    every = (factor for one in _SLOW_MOTION for factor in (1.0 / one, one))
    return [factor for factor in every if 1.0 / _SAME_BANDWIDTH < ratio / factor < _SAME_BANDWIDTH]


def solve_pair(
    tracks_a: dict[str, SmoothTrack],
    tracks_b: dict[str, SmoothTrack],
    names: tuple[str, str],
    settings: PairSettings | None = None,
    known_pose: RelativePose | None = None,
    *,
    calibrated: bool = True,
    thorough: bool = False,
    predicted_lag: float | None = None,
    previous_refusal: PairSolution | None = None,
    cache: TrackCache | None = None,
) -> PairSolution:
    """Estimate lag, clock rate and two-view geometry of two cameras from the labels that both saw.

    tracks_a, tracks_b: by label; all tracks of one camera share one time origin. names: of the two cameras.
    known_pose: the given relative pose; then only lag and rate are estimated. calibrated: whether both cameras have
    intrinsics; if not, the tracks' normalised coordinates are those of any nominal intrinsics and the geometry is a
    fundamental matrix. thorough: whether to continue where that finds no solution: clock rates up to 5000 ppm off,
    those of wrong frame rates, and tracks that follow several objects; tens of times as expensive.
    predicted_lag: ``t_a - t_b`` [s] at the middle of the common time, implied by other cameras: then only lags within
    ``settings.predicted_lag_window`` of it are searched. previous_refusal: result for the same tracks without
    ``thorough`` and ``predicted_lag``, if known: that search is not repeated. cache: grids of the cameras' tracks that
    other pairs have computed. A pair without an acceptable alignment is returned unsolved, with the reason.
    """
    s = settings or PairSettings()
    labels = [label for label in tracks_a if label in tracks_b]
    if not labels:
        return PairSolution(*names, "no label that both cameras saw")
    search = _PairSearch([tracks_a[k] for k in labels], [tracks_b[k] for k in labels], s, known_pose, calibrated, cache)
    window = None if predicted_lag is None else (predicted_lag, s.predicted_lag_window)
    first = search.reuse_refusal(previous_refusal) or search.search_at_rate(names, 1.0, window)
    short = first.fit is not None and first.fit.support < s.short_support
    if first.solved and window is None and short and search.has_discontinuities():
        # A few seconds of a discontinuous track fit many lags; one with longer trimmed agreement is more likely.
        lts = search.search_lts(names)
        if lts.solved and lts.fit is not None and first.fit is not None and lts.fit.support > 2.0 * first.fit.support:
            return lts
    if (
        first.solved
        or not thorough
        or window is not None
        or (first.fit is not None and is_at_noise_floor(first.fit, s))
    ):
        return first  # a long fit at the noise floor was refused for a reason that no other rate would cure
    if search.has_discontinuities():
        first = search.search_lts(names)
        if first.solved:
            return first
    for rate in search.candidate_rates():
        solution = search.search_at_rate(names, rate)
        if solution.solved:
            return solution
    return first


class _PairSearch:
    """Tracks of one pair and what is common to the searches at all clock rates.

    tried: number of rates searched so far. bandwidths: of either camera's motion [Hz]. span: of the shorter recording
    [s]. step: of the lag scan [s].
    """

    def __init__(
        self,
        a: Sequence[SmoothTrack],
        b: Sequence[SmoothTrack],
        s: PairSettings,
        known_pose: RelativePose | None,
        calibrated: bool,
        cache: TrackCache | None = None,
    ) -> None:
        self.a, self.b, self.s, self.known_pose, self.calibrated = a, b, s, known_pose, calibrated
        self.cache = cache = cache or TrackCache()
        self.step = scan_step(max(cache.fast_image_speed(track) for track in (*a, *b)), s)
        self.tried = 0
        self.bandwidths = [max(cache.bandwidth(track) for track in one) for one in (a, b)]
        self.span = min(max(t.basis.end for t in one) - min(t.basis.begin for t in one) for one in (a, b))

    def candidate_rates(self) -> Iterator[float]:
        """Clock rates worth another scan: drift over a long recording, and wrong frame rates."""
        # A scan at rate 1 finds a pair as long as the time error at the ends is within a few grid steps.
        slip = 0.15 / max(self.span, 1e-9)
        if slip < 5e-3:
            count = min(int(np.ceil(5e-3 / slip)), _MAX_RATE_STEPS)
            for k in range(1, count + 1):
                yield 1.0 + k * slip
                yield 1.0 - k * slip
        yield from FRAME_RATE_RATIOS
        yield from slow_motion_ratios(self.bandwidths[1], self.bandwidths[0])

    def reuse_refusal(self, previous_refusal: PairSolution | None) -> PairSolution | None:
        """The known refusal of the search at rate 1, counted as if it were repeated; None if there is none."""
        if previous_refusal is None or previous_refusal.solved:
            return None
        self.tried += 1
        return previous_refusal

    def search_at_rate(
        self, names: tuple[str, str], rate: float, lag_window: tuple[float, float] | None = None
    ) -> PairSolution:
        """Solution with b's times multiplied by ``rate``: one lag scan, refined candidates, acceptance tests.

        lag_window: offset and half-width [s] to search, None for all lags.
        """
        s, self.tried = self.s, self.tried + 1
        b = list(self.b) if rate == 1.0 else [track.scaled(rate) for track in self.b]
        grid_a = self.cache.grid(self.a, self.step, s.sigma_px)
        grid_b = self.cache.grid(b, self.step, s.sigma_px) if rate == 1.0 else grid_tracks(b, self.step, s.sigma_px)
        moments = PairMoments(grid_a, grid_b)
        if float(moments.support.max(initial=0.0)) < s.min_scan_support:
            return PairSolution(*names, _HARDLY_MOVES)
        if lag_window is not None:
            near = moments.support[moments.within(*lag_window)]
            if float(near.max(initial=0.0)) < s.min_scan_support:
                return PairSolution(*names, _HARDLY_MOVES_AT_PREDICTED_LAG)
        known_fundamental = None if self.known_pose is None else self.known_pose.essential.T
        scan = scan_lags(moments, s.min_scan_support, known_fundamental, lag_window)
        bandwidth = min(self.bandwidths[0], self.bandwidths[1] / rate)
        null_distributions = _NullDistributions(moments, scan, known_fundamental, bandwidth)
        fits: list[PairFit] = []
        frame_rate_ratio = rate in FRAME_RATE_RATIOS and self.span < _MAX_RATE_BLIND_SPAN
        reliable: tuple[float, float] | None = None  # evidence and scan cost of the best reliable fit so far
        count = s.max_candidates if lag_window is None else _PREDICTED_LAG_CANDIDATES
        for index in candidate_lags(scan, s.candidates_per_octave, count, lag_window):
            if reliable is None and len(fits) >= s.max_unreliable_candidates:
                return PairSolution(*names, _NONE_RELIABLE, rank_distinct(fits, s)[0], incomplete=True)
            offset, cost = float(scan.offset[index]), float(scan.cost[index])
            if reliable is not None and cannot_compete(float(scan.support[index]), cost, *reliable, s):
                continue
            if frame_rate_ratio and not null_distributions.is_promising(
                int(index), self._independent_lags(scan, offset)
            ):
                continue
            start = moments.fundamental(int(index)).T if self.known_pose is None else None  # s_b' M s_a
            fit = self._refine_candidate(b, offset, cost, start)
            if fit is None:
                continue
            fit = null_distributions.with_false_alarm(fit)
            fits.append(fit)
            if is_reliable(fit, s) and (reliable is None or evidence(fit) > reliable[0]):
                reliable = (evidence(fit), cost)
        if not fits:
            reason = _NO_FIT if lag_window is None else _NO_FIT_AT_PREDICTED_LAG
            return PairSolution(*names, reason, refuted=lag_window is not None)
        solution = self._accept(names, fits, b, None if lag_window is not None else scan)
        if solution.solved and solution.fit is not None and lag_window is None:
            again = [
                null_distributions.with_false_alarm(fit) for fit in self._repetitions(b, moments, scan, solution.fit)
            ]
            if again:
                solution = self._accept(names, fits + again, b, scan)
        if solution.solved and solution.fit is not None:
            solution = refine_and_test(solution, solution.fit, self.a, b, s, fixed_geometry=self.known_pose is not None)
        if rate != 1.0 and solution.fit is not None:
            solution = replace(solution, fit=replace(solution.fit, rate=solution.fit.rate * rate))
        return solution

    def _accept(
        self, names: tuple[str, str], fits: list[PairFit], b: Sequence[SmoothTrack], scan: LagScan | None
    ) -> PairSolution:
        """The best of ``fits`` if it is accepted, else a refusal. scan: of all lags, None if not made."""
        s = self.s
        ordered = rank_distinct(fits, s)
        independent_lags = 1.0 if scan is None else self._independent_lags(scan, ordered[0].lag)
        solution = accept_or_reject(names, ordered, independent_lags, s)
        if solution.solved or scan is None or self.tried > 1 or self.known_pose is not None:
            return solution
        best = max(ordered, key=strength)
        if not is_unique_maximum(best, ordered, s):
            return solution
        tests = solution.acceptance if best is solution.fit else absolute_tests(best, s)
        instead = "unique maximum with a precise lag"
        tests = tuple(test if test.passed else replace(test, alternative=instead) for test in tests)
        others = tuple(fit for fit in ordered if fit is not best)[:3]
        unique = PairSolution(*names, "ok", best, others, acceptance=tests)
        return unique if self._is_precise(unique, best, b) else solution

    def _is_precise(self, unique: PairSolution, best: PairFit, b: Sequence[SmoothTrack]) -> bool:
        """Whether lag and rotation of ``best`` pass the sensitivity test, with either camera as the first.

        A spurious alignment of unrelated tracks seldom has a precise lag: its geometry adapts to the lag.
        """
        s = self.s
        limit = s.max_total_lag_std
        if is_planar(best, s):
            limit = s.max_total_lag_std_planar
        if best.support < s.unique_long_support:
            limit = min(limit, s.max_total_lag_std_short)
        strict = replace(s, standalone=True, max_total_lag_std=limit, max_rotation_std=s.unique_max_rotation_std)
        forward = refine_and_test(unique, best, self.a, b, strict)
        if not forward.solved or forward.fit is None:
            return False
        swapped = swap_cameras(best)
        reverse = refine_and_test(replace(unique, fit=swapped), swapped, b, self.a, strict)
        if not reverse.solved or reverse.fit is None:
            return False
        return abs(forward.fit.lag + reverse.fit.lag) < s.max_leave_out_change

    def has_discontinuities(self) -> bool:
        """Whether a track may follow several objects by turns; never so with a known pose, which needs no LTS."""
        discontinuous = any(
            len(track.discontinuities) or track.inlier.mean() < _MIN_TRACK_INLIERS for track in (*self.a, *self.b)
        )
        return self.known_pose is None and discontinuous

    def search_lts(self, names: tuple[str, str]) -> PairSolution:
        """Solution for tracks that follow several objects by turns: the lag with most seconds of inlier motion."""
        s, step = self.s, max(self.step, _LTS_STEP)
        grid_a = most_active_window(grid_tracks(self.a, step, s.sigma_px), _MAX_LTS_SECONDS)
        moments = PairMoments(grid_a, grid_tracks(self.b, step, s.sigma_px))
        scan = scan_lags_lts(moments, s.sigma_px)
        tried = scan.inlier_seconds > 0
        if not tried.any():
            return PairSolution(*names, "the tracks are discontinuous, and no lag leaves enough common motion")
        best = int(np.argmax(scan.inlier_seconds))
        other = tried & (np.abs(moments.offset - moments.offset[best]) > _LTS_EXCLUSION)
        if other.sum() * step < _MIN_OTHER_LAGS:
            return PairSolution(
                *names, "the tracks are discontinuous, and overlap too little to distinguish one lag from another"
            )
        mean, std = float(scan.inlier_seconds[other].mean()), float(scan.inlier_seconds[other].std())
        zscore = (float(scan.inlier_seconds[best]) - mean) / max(std, 1e-6)
        fits = []
        for index in _peaks(moments.offset, scan.inlier_seconds, s.max_candidates):
            start = scan.matrix[index].T
            fit = self._refine_candidate(
                self.b, float(moments.offset[index]), float(scan.misfit[index]), start, lts=True
            )
            if fit is not None:
                fits.append(fit)
        if not fits:
            return PairSolution(
                *names, "the tracks are discontinuous, and no alignment of parts of them agrees with any geometry"
            )
        fits.sort(key=lambda fit: -fit.support * fit.in_front)
        fit = fits[0]
        second = max((one.support for one in fits[1:] if abs(one.offset - fit.offset) > 0.1), default=0.0)
        little = f"the tracks are discontinuous, and only {fit.support:.1f} s of motion agree"
        rivals = (
            "the tracks are discontinuous, and other lags fit nearly as well (the best agrees for "
            f"{fit.support:.1f} s, the next for {second:.1f} s; the best is {zscore:.1f} sigma above the others)"
        )
        share = second / max(fit.support, 1e-9)
        tests = (
            *absolute_tests(fit, s),
            acceptance_test("inlier support of discontinuous tracks", fit.support, s.min_lts_support, little),
            acceptance_test("inlier seconds above other lags", zscore, s.min_lts_zscore, rivals),
            acceptance_test("next lag's inlier support", share, s.max_evidence_ratio, rivals),
        )
        solution = with_tests(PairSolution(*names, "ok"), tests, fit)
        return refine_and_test(solution, fit, self.a, self.b, s, lts=True) if solution.solved else solution

    def _repetitions(
        self, b: Sequence[SmoothTrack], moments: PairMoments, scan: LagScan, best: PairFit
    ) -> Iterator[PairFit]:
        """Alignments at other lags, refined from the best one's own geometry.

        A periodic motion fits the same geometry one period later. Refinement from the scan's geometry may end there in
        another local minimum, and the wrong one of the two lags would then look unique.
        """
        here = int(np.argmin(np.abs(scan.offset - best.lag)))
        which = np.flatnonzero(scan.support > self.s.max_evidence_ratio * scan.support[here])
        cost = np.full(len(scan.offset), np.inf)
        cost[which] = moments.costs_given(which, best.geometry.matrix.T)
        own = float(cost[max(0, here - 1) : here + 2].min())
        # The same limits as in `cannot_compete`: a lag between two grid steps costs no more than that.
        plausible = (np.abs(scan.offset - best.lag) > _SAME_LAG) & (cost < 25.0 * max(own, 4.0))
        for index in _peaks(scan.offset, np.where(plausible, 1.0 / (cost + 1.0), 0.0), _MAX_REPETITIONS):
            fit = self._refine_candidate(b, float(scan.offset[index]), float(cost[index]), best.geometry)
            if fit is not None:
                yield fit

    def _independent_lags(self, scan: LagScan, lag: float) -> float:
        """Approximate number of independent alignments with similar support that were searched, at all rates.

        Those with much more support could hardly fit as well by chance.
        """
        support = scan.support[int(np.argmin(np.abs(scan.offset - lag)))]
        similar = (scan.support > 0.7 * support) & (scan.support < 1.4 * support)
        return max(1.0, self.tried * float(similar.sum()) * self.step / self.s.independent_lag_spacing)

    def _refine_candidate(
        self,
        b: Sequence[SmoothTrack],
        offset: float,
        cost: float,
        start: Floats | TwoViewGeometry | None,
        *,
        lts: bool = False,
    ) -> PairFit | None:
        """Refine one lag from the scan's matrix and, with intrinsics, from five-point hypotheses; the best of all.

        start: that matrix (3, 3), ``s_bᵀ M s_a = 0``, or the only geometry to start from. lts: use only the inliers
        of the start.

        One start is not enough: one clean session in ten ends in a local minimum of the essential matrix,
        with the lag right and the rotation tens of degrees off.
        """
        s, a = self.s, self.a
        coarse = Samples(a, b, offset, s, s.refinement_samples if lts else s.start_samples)
        if lts and isinstance(start, np.ndarray):
            coarse.keep_inliers(start, 1.0, offset, LTS_INLIER_PX)
        if coarse.count < _MIN_SAMPLES:
            return None
        noise = NoiseModel(s.sigma_px / a[0].focal, s.sigma_px / b[0].focal, s.rate_prior_std)
        best = self._best_start(coarse, b, offset, float(np.sqrt(max(cost, 1.0))), start, noise, lts)
        if best is None:
            return None
        rate = 1.0 / best.inverse_rate
        offset = coarse.centre - rate * best.intercept
        samples = Samples(a, b, offset, s, s.refinement_samples)
        if lts:
            samples.keep_inliers(best.geometry.matrix, rate, offset, LTS_INLIER_PX)
        if samples.count < _MIN_SAMPLES:
            return None
        if samples.count > coarse.count:
            intercept = best.intercept + best.inverse_rate * (samples.centre - coarse.centre)
            again = refine(
                samples,
                best.geometry,
                intercept,
                np.sqrt(best.cost),
                noise,
                inverse_rate=best.inverse_rate,
                fixed_geometry=self.known_pose is not None,
            )
            if again is None:
                return None
            best, rate = again, 1.0 / again.inverse_rate
            offset = samples.centre - rate * best.intercept
        return samples.evaluate(rate, offset, best.geometry)

    def _best_start(
        self,
        coarse: Samples,
        b: Sequence[SmoothTrack],
        offset: float,
        initial_misfit: float,
        start: Floats | TwoViewGeometry | None,
        noise: NoiseModel,
        lts: bool,
    ) -> RefinementResult | None:
        """The best of the refined initial geometries of `_refine_candidate`; None if none can be refined."""
        s, a = self.s, self.a
        own = min(1.0, min(median(np.array([t.sigma_px for t in one])) for one in (a, b)) / s.sigma_px) ** 2
        best: RefinementResult | None = None
        ends: list[float] = []
        for count, (geometry, lower_bound) in enumerate(
            self._initial_geometries(coarse, b, offset, initial_misfit, start)
        ):
            lower_bound = 0.0 if lts else lower_bound  # the samples were selected as inliers of that very matrix
            lowest = np.inf if best is None else best.cost
            if lower_bound > _PROMISING * own or lowest < _CLOSE_TO_FUNDAMENTAL * lower_bound:
                break
            if count >= _MAX_STARTS and lowest > _PROMISING * own:
                break
            fixed = self.known_pose is not None
            found = refine(
                coarse, geometry, coarse.centre - offset, initial_misfit, noise, fixed_geometry=fixed, iterations=14
            )
            if found is None:
                continue
            ends.append(found.cost)
            if found.cost < lowest:
                best, lowest = found, found.cost
            if lowest < _NOISE_COST * own:
                break  # at the noise: no other start can fit better
            if sum(abs(cost - found.cost) < _SAME_MINIMUM * found.cost for cost in ends) >= _MIN_REPEATS:
                break  # no other start would end elsewhere
        return best

    def _initial_geometries(
        self,
        coarse: Samples,
        b: Sequence[SmoothTrack],
        offset: float,
        initial_misfit: float,
        start: Floats | TwoViewGeometry | None,
    ) -> Iterator[tuple[TwoViewGeometry, float]]:
        """Geometries to refine, each with a lower bound of its refined cost (0 = unknown).

        Every essential matrix is a fundamental matrix, so none costs less than the best fundamental matrix.
        """
        if self.known_pose is not None:
            yield self.known_pose, 0.0
            return
        if isinstance(start, RelativePose | FundamentalMatrix):
            yield start, 0.0
            return
        pairs = coarse(1.0, coarse.centre - offset)
        if len(pairs.a) < _MIN_SAMPLES or start is None:
            return
        if not self.calibrated:
            yield FundamentalMatrix.of(start), 0.0
            return
        threshold = 3.0 * self.s.sigma_px * initial_misfit / min(self.a[0].focal, b[0].focal)
        yield relative_pose.decompose_essential(start, pairs.a, pairs.b), 0.0
        noise = NoiseModel(self.s.sigma_px / self.a[0].focal, self.s.sigma_px / b[0].focal, self.s.rate_prior_std)
        uncalibrated = refine(
            coarse, FundamentalMatrix.of(start), coarse.centre - offset, initial_misfit, noise, iterations=14
        )
        lower_bound = 0.0 if uncalibrated is None else uncalibrated.cost
        if uncalibrated is not None:
            yield relative_pose.decompose_essential(uncalibrated.geometry.matrix, pairs.a, pairs.b), lower_bound
        for seed in range(_FIVE_POINT_SEEDS):
            for geometry in relative_pose.five_point(pairs.a, pairs.b, threshold, seed):
                yield geometry, lower_bound


class _NullDistributions:
    """Null distributions of one lag scan by support and lag, each fitted once. bandwidth: of the motion [Hz]."""

    def __init__(self, moments: PairMoments, scan: LagScan, known_fundamental: Floats | None, bandwidth: float) -> None:
        self.moments, self.scan, self.known_fundamental = moments, scan, known_fundamental
        self.bandwidth = bandwidth
        self.fitted: list[tuple[float, float, NullDistribution | None]] = []

    def is_promising(self, index: int, independent_lags: float) -> bool:
        """Whether a lag of the unrefined scan fits better than the best of ``independent_lags`` wrong ones would."""
        seconds = float(self.scan.support[index])
        similar = (
            (self.scan.support > 0.7 * seconds) & (self.scan.support < 1.4 * seconds) & np.isfinite(self.scan.cost)
        )
        if self.scan.cost[index] > _MAX_COST_RATIO * np.median(self.scan.cost[similar]):
            return False
        null = self._null_distribution(seconds, float(self.scan.offset[index]))
        if null is None:
            return True
        one = null.log10_false_alarm(float(self.scan.cost[index]), 1.0, self.bandwidth * seconds)
        return bool(one + np.log10(independent_lags) < 0.0)

    def _null_distribution(self, seconds: float, at: float) -> NullDistribution | None:
        null = next(
            (c for long, lag, c in self.fitted if 0.8 * long < seconds < 1.25 * long and abs(lag - at) < 0.5), None
        )
        if null is None and seconds > 0:
            null = fit_null_distribution(self.moments, self.scan, seconds, at, self.known_fundamental)
            self.fitted.append((seconds, at, null))
        return null

    def with_false_alarm(self, fit: PairFit) -> PairFit:
        """The fit with its false-alarm probabilities: that unrelated motion of the same length fits as well."""
        seconds, cycles = fit.moving_overlap, self.bandwidth * fit.moving_overlap
        null = self._null_distribution(seconds, fit.lag)
        if null is None:
            return replace(fit, cycles=self.bandwidth * fit.support)
        # The next best: of all lags with at least half the support.
        index = int(np.argmin(np.abs(self.scan.offset - fit.lag)))
        others = (self.scan.support > 0.5 * self.scan.support[index]) & (
            np.abs(self.scan.offset - fit.lag) > EXCLUSION_WINDOW
        )
        next_cost = float(self.scan.cost[others].min(initial=np.inf))
        return replace(
            fit,
            cycles=self.bandwidth * fit.support,
            log10_false_alarm=null.log10_false_alarm(fit.misfit, fit.inliers, cycles),
            log10_gap=null.log10_gap(fit.misfit / max(fit.inliers, 1e-9), next_cost, cycles)
            if np.isfinite(next_cost)
            else 0.0,
        )


def _peaks(offset: Floats, value: Floats, max_candidates: int) -> list[int]:
    """Indices of the highest positive values, none within 0.15 s of a higher one."""
    out: list[int] = []
    for index in np.argsort(-value, kind="stable"):
        if value[index] <= 0 or len(out) >= max_candidates:
            break
        if all(abs(offset[index] - offset[other]) > 0.15 for other in out):
            out.append(int(index))
    return out


def evaluate_alignment(a: SmoothTrack, b: SmoothTrack, offset: float, pose: RelativePose) -> PairFit:
    """Quality figures of an alignment ``t_a = t_b + offset`` [s] that another method estimated."""
    s = PairSettings()
    return Samples([a], [b], offset, s, s.refinement_samples).evaluate(1.0, offset, pose)
