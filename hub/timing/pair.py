"""Two calibrated cameras that share no clock: lag, rate and relative pose, with no guess given.

METHODS A, steps 2 to 5: scan of all lags, candidates, refinement of (E, lag, rate) on the Sampson distance
by reweighted Levenberg-Marquardt from several essential matrices, and an absolute test of the answer.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hub.timing import two_view
from hub.timing.refine import Noise, PointPairs, Refined, refine
from hub.timing.scan import PairMoments, candidates, grid_track, scan_lags
from hub.timing.tracks import SmoothTrack
from hub.timing.two_view import RelativePose
from protocols.geometry.types import Bools, Floats

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
    accept_support: float = 2.0
    accept_inliers: float = 0.6
    """Of the common motion, where there is plenty of it."""
    strict_inliers: float = 0.95
    """… and where there is hardly any: seven parameters and a search over all lags fit a few seconds of anything."""
    plenty: float = 12.0
    hardly: float = 4.0
    """Seconds of agreeing motion that count as plenty and as hardly any."""
    largest_rate: float = 5e-3
    accept_in_front: float = 0.95
    accept_ratio: float = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class PairFit:
    """One refined alignment: ``t_a = rate * t_b + offset`` on the tracks' own (shifted) times.

    cost: mean robust squared distance over the noise. sigma_px: robust residual [px].
    support: seconds of agreeing motion. inliers, front: fractions of the moving samples.
    moving_overlap: seconds in which both tracks exist and move. middle: time of a in the middle of them.
    parallax: median angle [rad] between the two rays of a point.
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
    # The label that moves most leads the scan; the refinement uses it too.
    label = max(labels, key=lambda name: min(_moving(tracks_a[name], s), _moving(tracks_b[name], s)))
    a, b = tracks_a[label], tracks_b[label]
    span = max(a.span, b.span)
    step = s.step if span > 60 else s.step / 1.5
    moments = PairMoments(grid_track(a, step, s.sigma_px), grid_track(b, step, s.sigma_px))
    if float(moments.support.max(initial=0.0)) < s.least_support:
        return PairSolution(*names, "the point hardly moves while both could have seen it")
    scan = scan_lags(moments, s.least_support, None if known is None else known.essential.T)
    chosen = candidates(scan, s.per_stratum, s.at_most)
    fits: list[PairFit] = []
    for index in chosen:
        offset, cost = float(scan.offset[index]), float(scan.cost[index])
        start = moments.fundamental(int(index)).T if known is None else None  # s_b' E s_a
        fit = _refine_candidate(a, b, offset, cost, start, known, s)
        if fit is not None:
            fits.append(fit)
    if not fits:
        return PairSolution(*names, "no alignment of the two tracks agrees with any geometry")
    return _judge(names, _distinct(fits), s)


def _moving(track: SmoothTrack, s: PairSettings) -> float:
    """Seconds in which the track moves."""
    speed = np.linalg.norm(track.at(track.time, 1), axis=1) * track.focal
    interval = float(np.median(np.diff(track.time)))
    return float((speed > s.moving_px).sum()) * interval


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


def _judge(names: tuple[str, str], fits: list[PairFit], s: PairSettings) -> PairSolution:
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
    elif second > s.accept_ratio:
        reason = f"two alignments are about as good ({best.offset:.2f} s and {others[0].offset:.2f} s)"
    else:
        return PairSolution(*names, "ok", best, others)
    return PairSolution(*names, reason, best, others)


def _refine_candidate(
    a: SmoothTrack,
    b: SmoothTrack,
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
        threshold = 3.0 * s.sigma_px * scale / min(a.focal, b.focal)
        starts = [two_view.decompose(start, here_a, here_b)]
        for seed in range(2):
            starts += two_view.five_point(here_a, here_b, threshold, seed)
    noise = Noise(s.sigma_px / a.focal, s.sigma_px / b.focal, s.rate_std)
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
    return _Samples(a, b, offset, settings or PairSettings()).judge(0.0, 1.0, offset, pose)


class _Samples:
    """Samples of one alignment: the inliers of a at their own times, b by its spline."""

    def __init__(self, a: SmoothTrack, b: SmoothTrack, offset: float, s: PairSettings) -> None:
        self.a, self.b, self.s = a, b, s
        margin = 0.5
        b_end = float(b.basis.starts[-1] + b.basis.intervals[-1] * b.basis.spacing)
        inside = (a.time - offset > b.basis.starts[0] - margin) & (a.time - offset < b_end + margin)
        speed = np.linalg.norm(a.at(a.time, 1), axis=1) * a.focal
        rows = np.flatnonzero(inside & (speed > 0.5 * s.moving_px))
        if len(rows) > s.samples:
            rows = rows[np.linspace(0, len(rows) - 1, s.samples).round().astype(np.int64)]
        self.time = a.time[rows]
        self.points = a.points[rows]
        self.count = len(rows)
        self.centre = float(np.median(self.time)) if len(rows) else 0.0

    def at(self, rate: float, offset: float) -> tuple[Floats, Floats]:
        """Points of a (n, 2) and of b (n, 2; NaN in its gaps) under ``t_a = rate t_b + offset``."""
        return self.points, self.b.at((self.time - offset) / rate)

    def __call__(self, slowness: float, middle: float) -> PointPairs:
        lever = self.time - self.centre
        time_b = slowness * lever + middle
        b = self.b.at(time_b)
        there = np.isfinite(b[:, 0])
        return PointPairs(self.points[there], b[there], self.b.at(time_b[there], 1), lever[there])

    def judge(self, cost: float, rate: float, offset: float, pose: RelativePose) -> PairFit:
        """Absolute figures of an alignment, over the samples where both move."""
        a, b = self.at(rate, offset)
        there = np.isfinite(b).all(axis=1)
        speed_b = np.linalg.norm(self.b.at((self.time - offset) / rate, 1), axis=1) * self.b.focal
        speed_a = np.linalg.norm(self.a.at(self.time, 1), axis=1) * self.a.focal
        with np.errstate(invalid="ignore"):
            moving: Bools = there & (speed_a > self.s.moving_px) & (speed_b > self.s.moving_px)
        count = int(moving.sum())
        if count < 8:
            return PairFit(rate, offset, pose, cost, np.inf, 0.0, 0.0, 0.0, 0.0, self.centre, 0.0)
        sigma_a, sigma_b = self.s.sigma_px / self.a.focal, self.s.sigma_px / self.b.focal
        distance = np.abs(two_view.sampson(pose.essential, a[moving], b[moving], sigma_a, sigma_b))
        sigma_px = float(np.median(distance)) / 0.6745 * self.s.sigma_px
        # A track's own noise counts for what it is; a wrong geometry must not hide behind it.
        limit = max(3.0 * max(self.a.sigma_px, self.b.sigma_px, self.s.sigma_px), 3.0) / self.s.sigma_px
        close = distance < limit
        front = two_view.in_front(pose, a[moving][close], b[moving][close])
        interval = self._seconds_a_sample()
        seconds = float(count) * interval
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
        )

    def _seconds_a_sample(self) -> float:
        gaps = np.diff(self.time)
        return float(np.median(gaps)) if len(gaps) else 0.0
