"""Two calibrated cameras that share no clock: lag, rate and relative pose, with no guess given.

METHODS A, steps 2 to 5: scan of all lags, candidates, refinement of (E, lag, rate) on the Sampson distance
by reweighted Levenberg-Marquardt from several essential matrices, and an absolute test of the answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hub.timing import two_view
from hub.timing.refine import Noise, PointPairs, Refined, refine
from hub.timing.scan import PairMoments, Scan, candidates, grid_tracks, scan_lags, significance
from hub.timing.tracks import SmoothTrack
from hub.timing.two_view import RelativePose
from protocols.geometry.types import Bools, Floats, Ints

_LEAST_SAMPLES = 12


@dataclass(frozen=True, slots=True)
class PairSettings:
    """What the pair solver reckons with; the defaults hold on every rig."""

    step: float = 0.05
    """Grid of the scan [s]."""
    least_support: float = 1.0
    """Seconds in which both must move for a lag to be looked at."""
    sigma_px: float = 0.5
    """Noise that a good track has; scales the scan's costs."""
    per_stratum: int = 3
    at_most: int = 10
    samples: int = 500
    """Point pairs in the refinement of a candidate."""
    largest_sigma_px: float = 6.0
    """Lens errors included: beyond this an epipolar fit is no fit."""
    rate_std: float = 2e-3
    """Prior on how far a clock's rate is from its nominal one."""
    moving_px: float = 20.0
    """Image speed [px/s] from which a sample counts as moving."""
    accept_support: float = 4.0
    """Seconds of agreeing motion below which nothing is answered: what fits there was up to 7 degrees off."""
    unchecked_support: float = 8.0
    """… and where too few other lags overlap alike to compare with."""
    accept_inliers: float = 0.6
    """Of the common motion, where there is plenty of it."""
    strict_inliers: float = 0.95
    """… and where there is hardly any: seven parameters and a search over all lags fit a few seconds of anything."""
    plenty: float = 12.0
    hardly: float = 4.0
    """Seconds of agreeing motion that count as plenty and as hardly any."""
    largest_rate: float = 1e-2
    accept_significance: float = 3.0
    """Sigma by which the alignment's misfit must stand out from that of other lags with like support."""
    flat_ratio: float = 3.0
    """A plane that leaves less than this many times the epipolar residual explains the motion as well."""
    accept_in_front: float = 0.95
    accept_ratio: float = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class PairFit:
    """One refined alignment: ``t_a = rate * t_b + offset`` on the tracks' own (shifted) times.

    cost: mean robust squared distance over the noise. sigma_px: robust residual [px].
    support: seconds of agreeing motion. inliers, front: fractions of the moving samples.
    moving_overlap: seconds in which both tracks exist and move. middle: time of a in the middle of them.
    parallax: median angle [rad] between the two rays of a point. flat_px: what one plane would leave [px].
    """

    rate: float
    offset: float
    pose: RelativePose
    cost: float
    sigma_px: float
    inliers: float
    front: float
    support: float
    moving_overlap: float
    middle: float
    parallax: float
    flat_px: float = float("nan")


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


def solve_pair(
    tracks_a: dict[str, SmoothTrack],
    tracks_b: dict[str, SmoothTrack],
    names: tuple[str, str],
    settings: PairSettings | None = None,
    known: RelativePose | None = None,
) -> PairSolution:
    """Find lag, rate and relative pose of two cameras from the labels that both saw.

    tracks_a, tracks_b: by label; all tracks of one camera share one epoch. known: the relative pose, where
    it is given: then only lag and rate are sought.
    """
    s = settings or PairSettings()
    labels = [label for label in tracks_a if label in tracks_b]
    if not labels:
        return PairSolution(*names, "no label that both cameras saw")
    a, b = [tracks_a[label] for label in labels], [tracks_b[label] for label in labels]
    span = max(max(track.basis.end for track in one) - min(track.basis.begin for track in one) for one in (a, b))
    step = s.step if span > 60 else s.step / 1.5
    moments = PairMoments(grid_tracks(a, step, s.sigma_px), grid_tracks(b, step, s.sigma_px))
    if float(moments.support.max(initial=0.0)) < s.least_support:
        return PairSolution(*names, "the point hardly moves while both could have seen it")
    scan = scan_lags(moments, s.least_support, None if known is None else known.essential.T)
    chosen = candidates(scan, s.per_stratum, s.at_most)
    fits: list[PairFit] = []
    good: tuple[float, float] | None = None  # evidence and scan cost of the best trustworthy fit so far
    for index in chosen:
        offset, cost = float(scan.offset[index]), float(scan.cost[index])
        if good is not None and _hopeless(float(scan.support[index]), cost, *good, s):
            continue
        start = moments.fundamental(int(index)).T if known is None else None  # s_b' E s_a
        fit = _refine_candidate(a, b, offset, cost, start, known, s)
        if fit is None:
            continue
        fits.append(fit)
        if _sound(fit, s) and (good is None or evidence(fit) > good[0]):
            good = (evidence(fit), cost)
    if not fits:
        return PairSolution(*names, "no alignment of the two tracks agrees with any geometry")
    ordered = _distinct(fits)
    return _judge(names, ordered, _significance(scan, ordered[0], s), s)


def _sound(fit: PairFit, s: PairSettings) -> bool:
    return fit.inliers > 0.8 and fit.front > s.accept_in_front and fit.sigma_px < 4.0 * s.sigma_px


def _hopeless(support: float, cost: float, best_evidence: float, best_cost: float, s: PairSettings) -> bool:
    """Whether a candidate can neither win over a sound fit nor make it doubtful, so that refining it is idle.

    Its evidence is at most the seconds in which both move; and what leaves tens of times the misfit of the
    sound one is not brought down to it by a lag between two steps of the grid.
    """
    return 1.5 * support < s.accept_ratio * best_evidence or cost > 25.0 * max(best_cost, 4.0)


def _significance(scan: Scan, fit: PairFit, s: PairSettings) -> float | None:
    lag = fit.middle - (fit.middle - fit.offset) / fit.rate  # of the middle of the motion
    return significance(scan, lag, (fit.sigma_px / s.sigma_px) ** 2)


def _distinct(fits: list[PairFit]) -> list[PairFit]:
    """Best first, alignments that are the same within 0.1 s once."""
    ordered = sorted(fits, key=lambda fit: -evidence(fit))
    out: list[PairFit] = []
    for fit in ordered:
        if all(abs(fit.offset - other.offset) > 0.1 for other in out):
            out.append(fit)
    return out


def evidence(fit: PairFit) -> float:
    """What speaks for an alignment: seconds of agreeing motion, less where little of the overlap agrees."""
    return float(fit.support * fit.inliers * fit.front / np.sqrt(1.0 + fit.sigma_px))


def needed_inliers(fit: PairFit, s: PairSettings) -> float:
    """The share of the common motion that must agree: the less motion there is, the more of it."""
    short = float(np.clip((s.plenty - fit.support) / (s.plenty - s.hardly), 0.0, 1.0))
    return s.accept_inliers + short * (s.strict_inliers - s.accept_inliers)


def _judge(names: tuple[str, str], fits: list[PairFit], stands_out: float | None, s: PairSettings) -> PairSolution:
    best = fits[0]
    others = tuple(fits[1:4])
    second = evidence(others[0]) / max(evidence(best), 1e-12) if others else 0.0
    if best.support < s.accept_support:
        reason = f"only {best.support:.1f} s of motion agree (of {best.moving_overlap:.1f} s)"
    elif best.sigma_px > s.largest_sigma_px:
        reason = f"the best alignment leaves {best.sigma_px:.1f} px"
    elif abs(best.rate - 1.0) > s.largest_rate:
        reason = f"the best alignment needs a clock that is {1e6 * abs(best.rate - 1.0):.0f} ppm off"
    elif best.inliers < needed_inliers(best, s):
        reason = f"only {100 * best.inliers:.0f} % of the common motion agrees with one geometry"
    elif best.front < s.accept_in_front:
        reason = "the best geometry puts points behind a camera"
    elif best.flat_px < s.flat_ratio * max(best.sigma_px, s.sigma_px):
        reason = "the motion lies in one plane (or the cameras stand in one place), which leaves the geometry open"
    elif stands_out is None and best.support < s.unchecked_support:
        reason = (
            f"the recordings overlap too little ({best.moving_overlap:.1f} s of motion) to tell one lag from another"
        )
    elif stands_out is not None and stands_out < s.accept_significance:
        reason = (
            f"other lags fit nearly as well (the best stands out by {stands_out:.1f} sigma, needed are "
            f"{s.accept_significance:.1f}): too little or too regular common motion, or two different things"
        )
    elif second > s.accept_ratio:
        reason = f"two alignments are about as good ({best.offset:.2f} s and {others[0].offset:.2f} s)"
    else:
        return PairSolution(*names, "ok", best, others)
    return PairSolution(*names, reason, best, others)


def _refine_candidate(
    a: Sequence[SmoothTrack],
    b: Sequence[SmoothTrack],
    offset: float,
    cost: float,
    start: Floats | None,
    known: RelativePose | None,
    s: PairSettings,
) -> PairFit | None:
    """Refine one lag from the moments' matrix and from five-point hypotheses; the best wins.

    One start is not enough: one clean session in ten ends in a wrong minimum of the essential matrix,
    with the time right and the rotation tens of degrees off.
    """
    sample = _Samples(a, b, offset, s)
    if sample.count < _LEAST_SAMPLES:
        return None
    scale = float(np.sqrt(max(cost, 1.0)))
    if known is not None:
        starts = [known]
    else:
        here_a, here_b = sample.at(1.0, offset)
        both = np.isfinite(here_b).all(axis=1)
        if both.sum() < _LEAST_SAMPLES or start is None:
            return None
        here_a, here_b = here_a[both], here_b[both]
        threshold = 3.0 * s.sigma_px * scale / min(a[0].focal, b[0].focal)
        starts = [two_view.decompose(start, here_a, here_b)]
        for seed in range(2):
            starts += two_view.five_point(here_a, here_b, threshold, seed)
    noise = Noise(s.sigma_px / a[0].focal, s.sigma_px / b[0].focal, s.rate_std)
    best: Refined | None = None
    for pose in starts:
        fit = refine(sample, pose, sample.centre - offset, scale, noise, fixed_pose=known is not None)
        if fit is not None and (best is None or fit.cost < best.cost):
            best = fit
    if best is None:
        return None
    rate = 1.0 / best.slowness
    return sample.judge(best.cost, rate, sample.centre - rate * best.middle, best.pose)


def judge_alignment(
    a: SmoothTrack, b: SmoothTrack, offset: float, pose: RelativePose, settings: PairSettings | None = None
) -> PairFit:
    """The absolute figures of an alignment ``t_a = t_b + offset`` that another method found."""
    return _Samples([a], [b], offset, settings or PairSettings()).judge(0.0, 1.0, offset, pose)


def _flat_px(a: Floats, b: Floats) -> float:
    """What the best plane leaves [px], in the direction in which it leaves less: seen edge-on, it magnifies noise."""
    return min(two_view.homography_residual(a, b), two_view.homography_residual(b, a))


class _Samples:
    """Samples of one alignment, all labels together: the inliers of a at their own times, b by its splines.

    a, b: tracks of the same labels in the same order.
    """

    def __init__(self, a: Sequence[SmoothTrack], b: Sequence[SmoothTrack], offset: float, s: PairSettings) -> None:
        self.a, self.b, self.s = a, b, s
        parts = [self._rows(one, other, offset) for one, other in zip(a, b, strict=True)]
        share = min(1.0, s.samples / max(sum(len(rows) for rows in parts), 1))
        # The same share of every label, spread over its time.
        thinned = [
            rows[np.linspace(0, len(rows) - 1, round(share * len(rows))).round().astype(np.int64)] for rows in parts
        ]
        self.label = np.concatenate([np.full(len(rows), k) for k, rows in enumerate(thinned)])
        self.time = np.concatenate([one.time[rows] for one, rows in zip(a, thinned, strict=True)])
        self.points = np.concatenate([one.points[rows] for one, rows in zip(a, thinned, strict=True)])
        self.speed = np.concatenate(
            [np.linalg.norm(one.at(one.time[rows], 1), axis=1) for one, rows in zip(a, thinned, strict=True)]
        )
        self.count = len(self.time)
        self.centre = float(np.median(self.time)) if self.count else 0.0
        intervals = [float(np.median(np.diff(one.time))) for one in a]
        rows_a_second = self.count / max(sum(len(rows) * t for rows, t in zip(parts, intervals, strict=True)), 1e-9)
        self.seconds_a_sample = len(a) ** -0.5 / max(rows_a_second, 1e-9)

    def _rows(self, a: SmoothTrack, b: SmoothTrack, offset: float) -> Ints:
        margin = 0.5
        inside = (a.time - offset > b.basis.begin - margin) & (a.time - offset < b.basis.end + margin)
        speed = np.linalg.norm(a.at(a.time, 1), axis=1) * a.focal
        return np.flatnonzero(inside & (speed > 0.5 * self.s.moving_px))

    def of_b(self, time: Floats, derivative: int = 0) -> Floats:
        """Points of b (n, 2), or their derivative, at b's times (n,) of the samples; NaN in gaps."""
        if len(self.b) == 1:
            return self.b[0].at(time, derivative)
        out = np.full((len(time), 2), np.nan)
        for k, track in enumerate(self.b):
            mine = self.label == k
            out[mine] = track.at(time[mine], derivative)
        return out

    def at(self, rate: float, offset: float) -> tuple[Floats, Floats]:
        """Points of a (n, 2) and of b (n, 2; NaN in its gaps) under ``t_a = rate t_b + offset``."""
        return self.points, self.of_b((self.time - offset) / rate)

    def __call__(self, slowness: float, middle: float) -> PointPairs:
        lever = self.time - self.centre
        time_b = slowness * lever + middle
        b = self.of_b(time_b)
        there = np.isfinite(b[:, 0])
        speed = self.of_b(time_b, 1)
        return PointPairs(self.points[there], b[there], speed[there], lever[there])

    def judge(self, cost: float, rate: float, offset: float, pose: RelativePose) -> PairFit:
        """Absolute figures of an alignment, over the samples where both move."""
        a, b = self.at(rate, offset)
        there = np.isfinite(b).all(axis=1)
        focal_a, focal_b = self.a[0].focal, self.b[0].focal
        speed_b = np.linalg.norm(self.of_b((self.time - offset) / rate, 1), axis=1) * focal_b
        speed_a = self.speed * focal_a
        with np.errstate(invalid="ignore"):
            moving: Bools = there & (speed_a > self.s.moving_px) & (speed_b > self.s.moving_px)
        count = int(moving.sum())
        if count < 8:
            return PairFit(rate, offset, pose, cost, np.inf, 0.0, 0.0, 0.0, 0.0, self.centre, 0.0)
        sigma_a, sigma_b = self.s.sigma_px / focal_a, self.s.sigma_px / focal_b
        distance = np.abs(two_view.sampson(pose.essential, a[moving], b[moving], sigma_a, sigma_b))
        sigma_px = float(np.median(distance)) / 0.6745 * self.s.sigma_px
        # A track's own noise counts for what it is; a wrong geometry must not hide behind it.
        own = max(float(np.median([track.sigma_px for track in tracks])) for tracks in (self.a, self.b))
        limit = max(3.0 * own, 3.0) / self.s.sigma_px
        close = distance < limit
        front = two_view.in_front(pose, a[moving][close], b[moving][close])
        seconds = float(count) * self.seconds_a_sample
        inliers = float(close.mean())
        share = float(front.mean()) if len(front) else 0.0
        rays_a, rays_b = two_view.homogeneous(a[moving]) @ pose.rotation.T, two_view.homogeneous(b[moving])
        cosine = (rays_a * rays_b).sum(1) / np.linalg.norm(rays_a, axis=1) / np.linalg.norm(rays_b, axis=1)
        return PairFit(
            rate=rate,
            offset=offset,
            pose=pose,
            cost=cost,
            sigma_px=sigma_px,
            inliers=inliers,
            front=share,
            support=seconds * inliers,
            moving_overlap=seconds,
            middle=float(np.median(self.time[moving])),
            parallax=float(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))),
            flat_px=_flat_px(a[moving][close] * focal_a, b[moving][close] * focal_b),
        )
