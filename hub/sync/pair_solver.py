"""Two cameras that share no clock: lag, rate and geometry, with no guess given.

METHODS A, steps 2 to 5: scan of all lags, candidates, refinement of (E or F, lag, rate) on the Sampson
distance from several starts, and absolute tests of the answer. Where the plain scan finds nothing, it is
made again for clock rates further from 1 and, where a track jumps, on the pieces between the jumps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from hub.sync.acceptance import (
    at_noise,
    distinct,
    doubts,
    flat,
    hopeless,
    judge,
    needed_inliers,
    sound,
    stands_apart,
    strength,
)
from hub.sync.alignment import PairFit, PairSettings, PairSolution, Samples, evidence, grid_step, turned_round
from hub.sync.final_refinement import NEAR_PX, finish
from hub.sync.lag_scan import PairMoments, Scan, busiest, candidates, grid_tracks, scan_lags
from hub.sync.lts_scan import scan_pieces
from hub.sync.null_distribution import OWN_LAGS, Chance, chance
from hub.sync.track_cache import Kept
from hub.trajectory.image_tracks import SmoothTrack
from hub.two_view import relative_pose
from hub.two_view.refinement import Noise, Refined, refine
from hub.two_view.relative_pose import Geometry, RelativePose, Uncalibrated
from protocols.geometry.types import Floats

_LEAST_SAMPLES = 12
_AT_NOISE = 0.8  # mean robust cost of an alignment whose rows are as noisy as the settings say: about 0.75
_NEAR_CANDIDATES = 3
_NO_FIT = "no alignment of the two tracks agrees with any geometry"
_NO_FIT_NEAR = "at the lag that the other cameras tell no geometry agrees; other lags were not looked at"
_STARTS = 4
_SEEDS = 8  # of five-point hypotheses; the later ones only …
_PROMISING = 12.0  # … for what comes this near the noise: a wrong minimum of E at the right lag
_MOST_DRIFTS = 8  # of either sign
_MOST_PIECES = 45.0  # s of a that the scan in pieces looks at
_PIECES_STEP = 0.033  # s: the scan in pieces is rough, and dear
_MOSTLY_ONE = 0.85  # of a track's rows: with fewer on one path there may be another
_OTHER_LAGS = 0.5  # s from the best: what is no part of it
_LEAST_OTHER_LAGS = 3.0  # s
_NO_BETTER = (
    1.1  # times what the fundamental matrix leaves: an essential one that comes so near is not in a wrong minimum
)
_MUCH_WORSE = 4.0  # times the same: so much a wrong minimum leaves at the right lag
_SAME_COST, _OFTEN = 0.01, 3  # starts that end in the same minimum
_SHARPLY_SEEN = 50.0  # s: over longer recordings a rate 0.1 % off (29.97 for 30) slips by more than the scan bears
_HARDLY_BETTER = 0.2  # of what lags with as much in common usually leave
_SAME_LAG = 0.1  # s
_REPEATS = 4  # lags at which the answer's own geometry is tried
_FRAME_RATES = (24.0, 25.0, 30.0, 50.0, 60.0)
_LABELLED_RATES = tuple(
    sorted(
        {round(a / b, 9) for a in _FRAME_RATES for b in _FRAME_RATES if 0.4 < a / b < 2.5 and a != b},
        key=lambda rate: abs(np.log(rate)),
    )
)
"""Ratios between the frame rates that cameras have: times made of frame numbers with a wrong one are off by these."""


def solve_pair(
    tracks_a: dict[str, SmoothTrack],
    tracks_b: dict[str, SmoothTrack],
    names: tuple[str, str],
    settings: PairSettings | None = None,
    known: RelativePose | None = None,
    *,
    calibrated: bool = True,
    thorough: bool = False,
    near: float | None = None,
    plain: PairSolution | None = None,
    kept: Kept | None = None,
) -> PairSolution:
    """Find lag, rate and geometry of two cameras from the labels that both saw.

    tracks_a, tracks_b: by label; all tracks of one camera share one epoch. known: the relative pose, where
    it is given: then only lag and rate are sought. calibrated: whether both lenses are known; if not, the
    tracks' normalised coordinates are those of any nominal lens and the answer is a fundamental matrix.
    thorough: whether to go on where that finds nothing: clocks up to 5000 ppm off, those of wrongly told
    frame rates, and tracks that follow something else now and then; tens of times as dear. near: ``t_a - t_b``
    in the middle of the common time, where other cameras tell it: then only lags about it are looked at. plain: the
    refusal of the same tracks without ``thorough`` and ``near``, if it is at hand: then it is not sought again. kept:
    what other pairs of these cameras asked already.
    """
    s = settings or PairSettings()
    labels = [label for label in tracks_a if label in tracks_b]
    if not labels:
        return PairSolution(*names, "no label that both cameras saw")
    search = _Search([tracks_a[k] for k in labels], [tracks_b[k] for k in labels], s, known, calibrated, kept)
    first = search.again(plain) or search.at_rate(names, 1.0, None if near is None else (near, s.near_window))
    if first.solved and near is None and first.fit is not None and first.fit.support < s.hardly and search.jumps():
        # A few seconds of a torn track agree with much; the lag at which its pieces agree for longer is likelier.
        pieces = search.in_pieces(names)
        if pieces.solved and pieces.fit is not None and pieces.fit.support > 2.0 * first.fit.support:
            return pieces
    if first.solved or not thorough or near is not None or (first.fit is not None and at_noise(first.fit, s)):
        return first  # what fits to the noise for long is refused for what no other rate would mend
    if search.jumps():
        first = search.in_pieces(names)
        if first.solved:
            return first
    for rate in search.rates():
        answer = search.at_rate(names, rate)
        if answer.solved:
            return answer
    return first


class _Search:
    """One pair's tracks, and what is the same for every rate that is tried."""

    def __init__(
        self,
        a: Sequence[SmoothTrack],
        b: Sequence[SmoothTrack],
        s: PairSettings,
        known: RelativePose | None,
        calibrated: bool,
        kept: Kept | None = None,
    ) -> None:
        self.a, self.b, self.s, self.known, self.calibrated = a, b, s, known, calibrated
        self.kept = kept = kept or Kept()
        self.step = grid_step(max(kept.fast_motion(track) for track in (*a, *b)), s)
        self.tried = 0
        self.bandwidth = min(max(kept.bandwidth(track) for track in one) for one in (a, b))
        self.span = min(max(t.basis.end for t in one) - min(t.basis.begin for t in one) for one in (a, b))

    def rates(self) -> Iterator[float]:
        """Clock rates worth another scan: what a drift does to a long recording, and wrongly told frame rates."""
        # A scan at rate 1 sees a pair as long as the ends don't slip by more than a few steps.
        slip = 0.15 / max(self.span, 1e-9)
        if slip < 5e-3:
            count = min(int(np.ceil(5e-3 / slip)), _MOST_DRIFTS)
            for k in range(1, count + 1):
                yield 1.0 + k * slip
                yield 1.0 - k * slip
        yield from _LABELLED_RATES

    def again(self, plain: PairSolution | None) -> PairSolution | None:
        """The refusal of the search at rate 1 that was made before, as if it were made now."""
        if plain is None or plain.solved:
            return None
        self.tried += 1
        return plain

    def at_rate(self, names: tuple[str, str], rate: float, near: tuple[float, float] | None = None) -> PairSolution:
        """Answer with b's clock taken to run ``rate`` times as fast: one scan, its candidates, the verdict.

        near: offset and window [s] where it is about known.
        """
        s, self.tried = self.s, self.tried + 1
        b = list(self.b) if rate == 1.0 else [track.scaled(rate) for track in self.b]
        grid_a = self.kept.grid(self.a, self.step, s.sigma_px)
        grid_b = self.kept.grid(b, self.step, s.sigma_px) if rate == 1.0 else grid_tracks(b, self.step, s.sigma_px)
        moments = PairMoments(grid_a, grid_b)
        if float(moments.support.max(initial=0.0)) < s.least_support:
            return PairSolution(*names, "the point hardly moves while both could have seen it")
        if near is not None and float(moments.support[moments.near(*near)].max(initial=0.0)) < s.least_support:
            return PairSolution(*names, _NO_FIT_NEAR)
        scan = scan_lags(moments, s.least_support, None if self.known is None else self.known.essential.T, near)
        chances = _Chances(moments, scan, self.known, self.bandwidth)
        fits: list[PairFit] = []
        told_rate = rate in _LABELLED_RATES and self.span < _SHARPLY_SEEN
        good: tuple[float, float] | None = None  # evidence and scan cost of the best trustworthy fit so far
        for index in candidates(scan, s.per_stratum, s.at_most if near is None else _NEAR_CANDIDATES, near):
            offset, cost = float(scan.offset[index]), float(scan.cost[index])
            if good is not None and hopeless(float(scan.support[index]), cost, *good, s):
                continue
            if told_rate and not chances.promises(int(index), self._searched(scan, offset)):
                continue
            start = moments.fundamental(int(index)).T if self.known is None else None  # s_b' M s_a
            fit = self._refine_candidate(b, offset, cost, start)
            if fit is None:
                continue
            fit = chances.of(fit)
            fits.append(fit)
            if sound(fit, s) and (good is None or evidence(fit) > good[0]):
                good = (evidence(fit), cost)
        if not fits:
            return PairSolution(*names, _NO_FIT if near is None else _NO_FIT_NEAR)
        answer = self._judged(names, fits, b, None if near is not None else scan)
        if answer.solved and answer.fit is not None and near is None:
            again = [chances.of(fit) for fit in self._repeats(b, moments, scan, answer.fit)]
            if again:
                answer = self._judged(names, fits + again, b, scan)
        if answer.solved and answer.fit is not None:
            answer = finish(answer, answer.fit, self.a, b, s, fixed=self.known is not None)
        if rate != 1.0 and answer.fit is not None:
            answer = replace(answer, fit=replace(answer.fit, rate=answer.fit.rate * rate))
        return answer

    def _judged(
        self, names: tuple[str, str], fits: list[PairFit], b: Sequence[SmoothTrack], scan: Scan | None
    ) -> PairSolution:
        """What is said of the best of ``fits``. scan: of all lags, None where they were not looked at."""
        s = self.s
        ordered = distinct(fits, s)
        answer = judge(names, ordered, 1.0 if scan is None else self._searched(scan, ordered[0].lag), s)
        if answer.solved or scan is None or self.tried > 1 or self.known is not None:
            return answer
        best = max(ordered, key=strength)
        if not stands_apart(best, ordered, s):
            return answer
        apart = PairSolution(*names, "ok", best, tuple(fit for fit in ordered if fit is not best)[:3])
        return apart if self._told_firmly(apart, best, b) else answer

    def _told_firmly(self, apart: PairSolution, best: PairFit, b: Sequence[SmoothTrack]) -> bool:
        """Whether the motion tells lag and rotation of ``best`` firmly, from either camera's side.

        Where nothing corresponds, what fits all the same bends to the lag.
        """
        s = self.s
        most = s.largest_doubt
        if flat(best, s):
            most = s.largest_flat_doubt
        if best.support < s.plenty_apart:
            most = min(most, s.largest_short_doubt)
        wanted = replace(s, firm=True, largest_doubt=most, largest_turn_std=s.firm_turn_std)
        there = finish(apart, best, self.a, b, wanted)
        if not there.solved or there.fit is None:
            return False
        back = turned_round(best)
        other = finish(replace(apart, fit=back), back, b, self.a, wanted)
        return other.solved and other.fit is not None and abs(there.fit.lag + other.fit.lag) < s.largest_swing

    def jumps(self) -> bool:
        """Whether a track jumps, so that it may be made of several things; geometry that is given needs no pieces."""
        torn = any(len(track.jumps) or track.inlier.mean() < _MOSTLY_ONE for track in (*self.a, *self.b))
        return self.known is None and torn

    def in_pieces(self, names: tuple[str, str]) -> PairSolution:
        """Answer for tracks that follow something else now and then: the lag with most time that agrees."""
        s, step = self.s, max(self.step, _PIECES_STEP)
        grid_a = busiest(grid_tracks(self.a, step, s.sigma_px), _MOST_PIECES)
        moments = PairMoments(grid_a, grid_tracks(self.b, step, s.sigma_px))
        scan = scan_pieces(moments, s.sigma_px, seed=0)
        tried = scan.agreeing > 0
        if not tried.any():
            return PairSolution(*names, "the tracks jump, and no lag leaves enough of them in common")
        best = int(np.argmax(scan.agreeing))
        other = tried & (np.abs(moments.offset - moments.offset[best]) > _OTHER_LAGS)
        if other.sum() * step < _LEAST_OTHER_LAGS:
            return PairSolution(*names, "the tracks jump, and overlap too little to tell one lag from another")
        usual, spread = float(scan.agreeing[other].mean()), float(scan.agreeing[other].std())
        stands_out = (float(scan.agreeing[best]) - usual) / max(spread, 1e-6)
        fits = []
        for index in _peaks(moments.offset, scan.agreeing, s.at_most):
            start = scan.matrix[index].T
            fit = self._refine_candidate(
                self.b, float(moments.offset[index]), float(scan.misfit[index]), start, pieces=True
            )
            if fit is not None:
                fits.append(fit)
        if not fits:
            return PairSolution(*names, "no alignment of the pieces of the two tracks agrees with any geometry")
        fits.sort(key=lambda fit: -fit.support * fit.front)
        fit = fits[0]
        second = max((rival.support for rival in fits[1:] if abs(rival.offset - fit.offset) > 0.1), default=0.0)
        reason = doubts(fit, s)
        if reason:
            pass
        elif fit.support < s.accept_pieces_support:
            reason = f"the tracks jump, and only {fit.support:.1f} s of them agree"
        elif stands_out < s.accept_pieces or second > s.accept_ratio * fit.support:
            reason = (
                f"the tracks jump, and other lags fit nearly as well (the best agrees for {fit.support:.1f} s, the "
                f"next for {second:.1f} s; the scan's best stands out by {stands_out:.1f} sigma)"
            )
        if reason:
            return PairSolution(*names, reason, fit)
        return finish(PairSolution(*names, "ok", fit), fit, self.a, self.b, s, pieces=True)

    def _repeats(self, b: Sequence[SmoothTrack], moments: PairMoments, scan: Scan, best: PairFit) -> Iterator[PairFit]:
        """Alignments at other lags that begin with the best one's own geometry.

        A motion that repeats itself fits the same geometry a period later. The scan's own start there may end in a
        minimum beside it, and would then speak for the wrong one of the two.
        """
        here = int(np.argmin(np.abs(scan.offset - best.lag)))
        which = np.flatnonzero(scan.support > self.s.accept_ratio * scan.support[here])
        cost = np.full(len(scan.offset), np.inf)
        cost[which] = moments.costs_of(which, best.geometry.matrix.T)
        own = float(cost[max(0, here - 1) : here + 2].min())
        # As with any candidate: a lag between two steps of the grid costs no more than that.
        hopeful = (np.abs(scan.offset - best.lag) > _SAME_LAG) & (cost < 25.0 * max(own, 4.0))
        for index in _peaks(scan.offset, np.where(hopeful, 1.0 / (cost + 1.0), 0.0), _REPEATS):
            fit = self._refine_candidate(b, float(scan.offset[index]), float(cost[index]), best.geometry)
            if fit is not None:
                yield fit

    def _searched(self, scan: Scan, lag: float) -> float:
        """About how many independent alignments with as much common motion were looked at, rates included.

        Those with much more of it could hardly fit as well by chance.
        """
        support = scan.support[int(np.argmin(np.abs(scan.offset - lag)))]
        alike = (scan.support > 0.7 * support) & (scan.support < 1.4 * support)
        return max(1.0, self.tried * float(alike.sum()) * self.step / self.s.distinct_alignments)

    def _refine_candidate(
        self,
        b: Sequence[SmoothTrack],
        offset: float,
        cost: float,
        start: Floats | Geometry | None,
        *,
        pieces: bool = False,
    ) -> PairFit | None:
        """Refine one lag from the moments' matrix and, with known lenses, from five-point hypotheses; the best wins.

        start: that matrix (3, 3), ``s_bᵀ M s_a = 0``, or the one geometry to begin with.

        One start is not enough: one clean session in ten ends in a wrong minimum of the essential matrix,
        with the time right and the rotation tens of degrees off.
        """
        s, a = self.s, self.a
        few = Samples(a, b, offset, s, s.samples if pieces else s.few)
        if pieces and isinstance(start, np.ndarray):
            few.keep_near(start, 1.0, offset, NEAR_PX)
        if few.count < _LEAST_SAMPLES:
            return None
        scale = float(np.sqrt(max(cost, 1.0)))
        noise = Noise(s.sigma_px / a[0].focal, s.sigma_px / b[0].focal, s.rate_std)
        fixed = self.known is not None
        own = min(1.0, min(float(np.median([t.sigma_px for t in one])) for one in (a, b)) / s.sigma_px) ** 2
        best: Refined | None = None
        reached = 0
        for count, (geometry, floor) in enumerate(self._starts(few, b, offset, scale, start)):
            floor = 0.0 if pieces else floor  # its rows were chosen to suit that very matrix
            if floor > _PROMISING * own or (best is not None and best.cost < _NO_BETTER * floor):
                break
            if count >= _STARTS and (best is None or best.cost > _PROMISING * own):
                break
            found = refine(few, geometry, few.centre - offset, scale, noise, fixed_geometry=fixed, iterations=14)
            if found is None:
                continue
            if best is None or found.cost < (1.0 - _SAME_COST) * best.cost:
                reached = 0
            if best is None or found.cost < (1.0 + _SAME_COST) * best.cost:
                reached += 1
            if best is None or found.cost < best.cost:
                best = found
            if best.cost < _AT_NOISE * own:
                break  # nothing fits better than the noise allows
            if reached >= _OFTEN and best.cost < _MUCH_WORSE * floor:
                break  # all starts lead here, and it is no minimum with the geometry far off
        if best is None:
            return None
        rate = 1.0 / best.slowness
        offset = few.centre - rate * best.middle
        samples = Samples(a, b, offset, s, s.samples)
        if pieces:
            samples.keep_near(best.geometry.matrix, rate, offset, NEAR_PX)
        if samples.count < _LEAST_SAMPLES:
            return None
        if samples.count > few.count:
            middle = best.middle + best.slowness * (samples.centre - few.centre)
            again = refine(
                samples, best.geometry, middle, np.sqrt(best.cost), noise, slowness=best.slowness, fixed_geometry=fixed
            )
            if again is None:
                return None
            best, rate = again, 1.0 / again.slowness
            offset = samples.centre - rate * best.middle
        return samples.judge(best.cost, rate, offset, best.geometry)

    def _starts(
        self, few: Samples, b: Sequence[SmoothTrack], offset: float, scale: float, start: Floats | Geometry | None
    ) -> Iterator[tuple[Geometry, float]]:
        """Geometries to refine, and a cost that none of them will come below (0 = not known).

        Every essential matrix is a fundamental one, so that none leaves less than the best of these.
        """
        if self.known is not None:
            yield self.known, 0.0
            return
        if isinstance(start, RelativePose | Uncalibrated):
            yield start, 0.0
            return
        here_a, here_b = few.at(1.0, offset)
        both = np.isfinite(here_b).all(axis=1)
        if both.sum() < _LEAST_SAMPLES or start is None:
            return
        if not self.calibrated:
            yield Uncalibrated.of(start), 0.0
            return
        here_a, here_b = here_a[both], here_b[both]
        threshold = 3.0 * self.s.sigma_px * scale / min(self.a[0].focal, b[0].focal)
        yield relative_pose.decompose(start, here_a, here_b), 0.0
        noise = Noise(self.s.sigma_px / self.a[0].focal, self.s.sigma_px / b[0].focal, self.s.rate_std)
        loose = refine(few, Uncalibrated.of(start), few.centre - offset, scale, noise, iterations=14)
        floor = 0.0 if loose is None else loose.cost
        if loose is not None:
            yield relative_pose.decompose(loose.geometry.matrix, here_a, here_b), floor
        for seed in range(_SEEDS):
            for geometry in relative_pose.five_point(here_a, here_b, threshold, seed):
                yield geometry, floor


class _Chances:
    """How well unrelated stretches fit, for the lengths that are asked for."""

    def __init__(self, moments: PairMoments, scan: Scan, known: RelativePose | None, bandwidth: float) -> None:
        self.moments, self.scan, self.known = moments, scan, None if known is None else known.essential.T
        self.bandwidth = bandwidth
        self.found: list[tuple[float, float, Chance | None]] = []

    def promises(self, index: int, searched: float) -> bool:
        """Whether a lag of the scan, as it is, fits better than the best of ``searched`` unrelated ones would."""
        seconds = float(self.scan.support[index])
        alike = (self.scan.support > 0.7 * seconds) & (self.scan.support < 1.4 * seconds) & np.isfinite(self.scan.cost)
        if self.scan.cost[index] > _HARDLY_BETTER * np.median(self.scan.cost[alike]):
            return False
        chosen = self._chance(seconds, float(self.scan.offset[index]))
        if chosen is None:
            return True
        one = chosen.log10_probability(float(self.scan.cost[index]), 1.0, self.bandwidth * seconds)
        return bool(one + np.log10(searched) < 0.0)

    def _chance(self, seconds: float, at: float) -> Chance | None:
        chosen = next(
            (c for long, lag, c in self.found if 0.8 * long < seconds < 1.25 * long and abs(lag - at) < 0.5), None
        )
        if chosen is None and seconds > 0:
            chosen = chance(self.moments, self.scan, seconds, at, self.known)
            self.found.append((seconds, at, chosen))
        return chosen

    def of(self, fit: PairFit) -> PairFit:
        """The fit with the chance that unrelated stretches as long as its common motion leave no more than it does."""
        seconds, cycles = fit.moving_overlap, self.bandwidth * fit.moving_overlap
        chosen = self._chance(seconds, fit.lag)
        if chosen is None:
            return replace(fit, cycles=self.bandwidth * fit.support)
        # The next best: any lag that leaves at least half as much in common.
        index = int(np.argmin(np.abs(self.scan.offset - fit.lag)))
        others = (self.scan.support > 0.5 * self.scan.support[index]) & (np.abs(self.scan.offset - fit.lag) > OWN_LAGS)
        following = float(self.scan.cost[others].min(initial=np.inf))
        return replace(
            fit,
            cycles=self.bandwidth * fit.support,
            log10_chance=chosen.log10_probability(fit.misfit, fit.inliers, cycles),
            log10_gap=chosen.log10_gap(fit.misfit / max(fit.inliers, 1e-9), following, cycles)
            if np.isfinite(following)
            else 0.0,
        )


def _peaks(offset: Floats, value: Floats, at_most: int) -> list[int]:
    """Indices of the highest values, none within 0.15 s of a higher one."""
    out: list[int] = []
    for index in np.argsort(-value, kind="stable"):
        if value[index] <= 0 or len(out) >= at_most:
            break
        if all(abs(offset[index] - offset[other]) > 0.15 for other in out):
            out.append(int(index))
    return out


def judge_alignment(
    a: SmoothTrack, b: SmoothTrack, offset: float, pose: RelativePose, settings: PairSettings | None = None
) -> PairFit:
    """The absolute figures of an alignment ``t_a = t_b + offset`` that another method found."""
    s = settings or PairSettings()
    return Samples([a], [b], offset, s, s.samples).judge(0.0, 1.0, offset, pose)


__all__ = ["PairFit", "PairSettings", "PairSolution", "evidence", "judge_alignment", "needed_inliers", "solve_pair"]
