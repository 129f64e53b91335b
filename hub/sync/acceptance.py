"""Acceptance tests of alignment hypotheses: limits, false-alarm probability, competing hypotheses, uniqueness."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from hub.sync.hypothesis import PairFit, PairSolution, evidence
from hub.sync.null_distribution import COST_FLOOR
from hub.sync.settings import PairSettings
from hub.two_view.relative_pose import RelativePose
from protocols.core.acceptance import AcceptanceTest, first_failure

_MIN_INLIERS = 0.9  # fraction of the common motion that counts as nearly all
_CHANCE_MISFIT = 9.0  # over the squared noise: upper bound for wrong alignments with nearly all rows as inliers


_BENCH = "measured: python -m tests.bench.pair_timing"
LIMITS = {
    "inlier support": ("s", ">=", _BENCH),
    "residual": ("px", "<=", "largest residual that a lens of a few per cent error leaves"),
    "clock rate error": ("", "<=", "crystals stay within 1e-4; beyond 1e-2 the frame rate is wrong"),
    "points in front of both cameras": ("", ">=", "cheirality, less an outlier in twenty"),
    "plane's residual over the residual": ("", ">=", _BENCH),
    "inliers": ("", ">=", _BENCH),
    "inlier support without a null distribution": ("s", ">=", _BENCH),
    "log10 of the false-alarm probability": ("", "<=", "quantile: 5 % of the null distribution"),
    "evidence of the next alignment": ("", "<=", _BENCH),
    "inlier support of discontinuous tracks": ("s", ">=", _BENCH),
    "inlier seconds above other lags": ("std", ">=", "quantile: three standard deviations of other lags"),
    "next lag's inlier support": ("", "<=", _BENCH),
    "angle between equally likely rotations": ("rad", "<=", "half a radian: another minimum, no longer noise"),
    "std of the lag by noise": ("s", "<=", "a tenth of a frame at 25 fps; where slow, the time of a pixel's motion"),
    "std of the relative rotation": ("rad", "<=", _BENCH),
    "std of the lag with lens and readout": ("s", "<=", _BENCH),
    "change of the lag without a fifth of the samples": ("s", "<=", _BENCH),
}
"""By name: unit, sense, and where the limit comes from (the limits themselves are `PairSettings`)."""


def acceptance_test(name: str, value: float, limit: float, reason: str, alternative: str = "") -> AcceptanceTest:
    """One of the pair's acceptance tests. alternative: the test that decides in its stead where it passed, or ""."""
    unit, sense, source = LIMITS[name]
    test = AcceptanceTest(name, float(value), float(limit), unit, source, reason, sense)
    return test if test.passed else replace(test, alternative=alternative)


def with_tests(solution: PairSolution, tests: Iterable[AcceptanceTest], fit: PairFit) -> PairSolution:
    """The solution with further tests, refused where one of them fails."""
    tests = tuple(tests)
    failed = first_failure(tests)
    status = solution.status if failed is None else failed.reason
    return replace(solution, status=status, fit=fit, acceptance=solution.acceptance + tests)


def accept_or_reject(
    names: tuple[str, str], fits: list[PairFit], independent_lags: float, s: PairSettings
) -> PairSolution:
    """The best hypothesis as solution of the cameras ``names``, or a refusal with the reason.

    fits: best first. independent_lags: approximate number of independent alignments that were searched.
    """
    best = fits[0]
    competing = [fit for fit in fits[1:] if is_competing(fit, best, s)]
    credible = [fit for fit in competing if not is_chance_level(fit, best, independent_lags, s)]
    other = max(credible, key=evidence, default=None)
    unique = "unique at the noise floor" if is_unique_at_noise_floor(best, fits[1:], s) else ""
    limit = min_inliers(best, s)
    share = f"only {100 * best.inliers:.0f} % of the common motion agrees with one geometry"
    tests = [*absolute_tests(best, s), acceptance_test("inliers", best.inliers, limit, share)]
    if best.log10_false_alarm is None:
        too_short = (
            f"the recordings overlap too little ({best.moving_overlap:.1f} s of motion) to distinguish one lag "
            "from another"
        )
        name = "inlier support without a null distribution"
        tests.append(acceptance_test(name, best.support, s.min_support_without_null, too_short))
    else:
        tests.append(_false_alarm_test(best, bool(competing), independent_lags, unique, s))
    if other is not None:
        ratio = evidence(other) / max(evidence(best), 1e-12)
        two = f"two alignments are about as good ({best.offset:.2f} s and {other.offset:.2f} s)"
        tests.append(acceptance_test("evidence of the next alignment", ratio, s.max_evidence_ratio, two, unique))
    return with_tests(PairSolution(*names, "ok", alternatives=tuple(fits[1:4])), tests, best)


def _false_alarm_test(
    best: PairFit, has_competition: bool, independent_lags: float, unique: str, s: PairSettings
) -> AcceptanceTest:
    """Whether unrelated motion would hardly ever fit as well at one of the lags that were searched."""
    found = float(best.log10_false_alarm or 0.0) + float(np.log10(independent_lags))
    alternative = unique
    # Periodic motion fits nearly as well one period later. With enough support the residual decides: nothing else
    # comes near the tracks' own noise.
    at_noise = best.residual_px <= s.max_noise_ratio * best.track_noise_px
    if not has_competition and best.support >= s.min_support_without_null and at_noise:
        alternative = "residual at the noise floor"
    elif not has_competition and best.log10_gap < s.max_log10_gap:
        alternative = "gap to the next lag"
    chance = f"{100 * min(1.0, 10.0**found):.0f} %"
    reason = (
        f"other lags fit nearly as well (one of them would by chance in {chance} of cases): too little or too regular "
        "common motion, or two different objects"
    )
    name, limit = "log10 of the false-alarm probability", s.max_log10_false_alarm
    return acceptance_test(name, found, limit, reason, alternative)


def absolute_tests(fit: PairFit, s: PairSettings) -> tuple[AcceptanceTest, ...]:
    """The absolute limits of an alignment; that of planarity comes last."""
    support = f"only {fit.support:.1f} s of motion agree (of {fit.moving_overlap:.1f} s)"
    residual = f"the best alignment leaves a residual of {fit.residual_px:.1f} px"
    rate = abs(fit.rate - 1.0)
    behind = "the best geometry puts points behind a camera"
    clock = f"the best alignment needs a clock that is {1e6 * rate:.0f} ppm off"
    return (
        acceptance_test("inlier support", fit.support, s.min_support, support),
        acceptance_test("residual", fit.residual_px, s.max_residual_px, residual),
        acceptance_test("clock rate error", rate, s.max_rate_error, clock),
        acceptance_test("points in front of both cameras", fit.in_front, s.min_in_front, behind),
        acceptance_test(
            "plane's residual over the residual",
            # Where no plane was fitted (few points), none explains the motion.
            np.nan_to_num(fit.planar_residual_px, nan=np.inf) / np.nan_to_num(max(fit.residual_px, s.sigma_px)),
            s.min_planar_ratio,
            "the motion lies in one plane (or the cameras stand in one place), which leaves the geometry undetermined",
        ),
    )


def passes_absolute_tests(fit: PairFit, s: PairSettings, *, ignore_planarity: bool = False) -> bool:
    """Whether an alignment is within the absolute limits."""
    tests = absolute_tests(fit, s)
    return first_failure(tests[:-1] if ignore_planarity else tests) is None


def is_planar(fit: PairFit, s: PairSettings) -> bool:
    """Whether a plane explains the motion nearly as well: then the two-view geometry is degenerate."""
    return fit.planar_residual_px < s.min_planar_ratio * max(fit.residual_px, s.sigma_px)


def is_competing(fit: PairFit, best: PairFit, s: PairSettings) -> bool:
    """Whether another alignment is a competing hypothesis: similar in residual and in false-alarm probability."""
    if best.residual_px <= s.max_noise_ratio * best.track_noise_px and best.support >= s.min_support_without_null:
        # The best residual is the tracks' own noise: then a slightly larger one is much less likely.
        limit = s.competing_residual_ratio_at_noise * best.residual_px
    else:
        limit = s.competing_residual_ratio * max(best.residual_px, s.sigma_px)
    if fit.residual_px > limit:
        return False
    if fit.log10_false_alarm is None or best.log10_false_alarm is None:
        return True
    if fit.support > best.support and fit.inliers > _MIN_INLIERS and passes_absolute_tests(fit, s):
        return True  # as good for longer: the null distribution of a periodic motion cannot decide
    return fit.log10_false_alarm < best.log10_false_alarm + s.competing_log10_margin


def is_chance_level(fit: PairFit, best: PairFit, independent_lags: float, s: PairSettings) -> bool:
    """Whether a competing hypothesis is expected by chance in every search, and the best one far more rarely.

    Without any correspondence, ``independent_lags`` alignments contain at least one as good as ``fit``, so it is no
    evidence. An alignment with more support than the best never counts as chance: the null distribution of a periodic
    motion cannot decide there.
    """
    if fit.log10_false_alarm is None or best.log10_false_alarm is None or fit.support > best.support:
        return False
    expected = fit.log10_false_alarm + np.log10(independent_lags) >= 0.0
    return bool(expected and fit.log10_false_alarm > best.log10_false_alarm + s.chance_log10_margin)


def is_unique_at_noise_floor(best: PairFit, others: list[PairFit], s: PairSettings) -> bool:
    """Ambiguity test for slow motion: residual at the noise floor, strong, and no other alignment nearly as strong.

    For slow motion a null distribution cannot decide, because seven parameters fit a few cycles of any motion. But then
    some of the many other lags fit as well; if none does, the alignment is unique. Of others with points behind a
    camera only those of motion in a plane count: there the geometry, and with it what is behind, is not determined.
    """
    if (
        best.inliers < _MIN_INLIERS
        or best.support < s.unique_min_support
        or best.residual_px > s.max_noise_ratio * best.track_noise_px
    ):
        return False
    if not isinstance(best.geometry, RelativePose):
        return False  # without intrinsics two more parameters fit more of any motion
    own = strength(best)
    possible = (fit for fit in others if fit.in_front > _MIN_INLIERS or is_planar(fit, s))
    next_best = max((strength(fit) for fit in possible), default=0.0)
    large_gap = own - next_best >= s.unique_min_margin and next_best <= s.max_evidence_ratio * own
    return own >= s.unique_min_strength and large_gap


def is_unique_maximum(best: PairFit, fits: list[PairFit], s: PairSettings) -> bool:
    """Ambiguity test with lens errors: within the absolute limits, and no other alignment is nearly as strong.

    fits: with or without ``best``. A residual above the tracks' noise, as inaccurate intrinsics leave it, is allowed,
    and so is near-planar motion if a plane leaves clearly more than the alignment does. Not sufficient alone: unrelated
    tracks have a strongest alignment too, but its lag is hardly ever precise, so the sensitivity test must follow.
    """
    if not isinstance(best.geometry, RelativePose) or best.support < s.unique_min_support:
        return False
    if (
        best.inliers < _MIN_INLIERS
        or not passes_absolute_tests(best, s, ignore_planarity=True)
        or best.planar_residual_px < s.min_planar_ratio * best.residual_px
    ):
        return False
    own = strength(best)
    next_best = max((strength(fit) for fit in fits if fit is not best), default=0.0)
    return (
        own >= s.unique_min_strength
        and own - next_best >= s.unique_min_margin
        and next_best <= s.unique_max_strength_ratio * own
    )


def strength(fit: PairFit) -> float:
    """Cycles of inlier motion times the log ratio of the misfit of wrong alignments to this one's."""
    ratio = (fit.misfit + COST_FLOOR) / _CHANCE_MISFIT
    return fit.cycles * fit.inliers * fit.in_front * -float(np.log(min(ratio, 1.0)))


def min_inliers(fit: PairFit, s: PairSettings) -> float:
    """Required inlier fraction of the common motion: higher for less support."""
    short = float(np.clip((s.long_support - fit.support) / (s.long_support - s.short_support), 0.0, 1.0))
    return s.min_inliers_long + short * (s.min_inliers_short - s.min_inliers_long)


def rank_distinct(fits: list[PairFit], s: PairSettings) -> list[PairFit]:
    """Alignments best first, of those with lags within 0.1 s only the best.

    Alignments within the absolute limits and with enough inliers come first, by strength: most lags with a long overlap
    fit some of it, and would otherwise come before the right one with a short overlap.
    """

    def merit(fit: PairFit) -> tuple[bool, float, float]:
        acceptable = passes_absolute_tests(fit, s) and fit.inliers >= min_inliers(fit, s)
        return (acceptable, strength(fit), evidence(fit))

    ordered = sorted(fits, key=merit, reverse=True)
    out: list[PairFit] = []
    for fit in ordered:
        if all(abs(fit.lag - other.lag) > 0.1 for other in out):
            out.append(fit)
    return out


def is_reliable(fit: PairFit, s: PairSettings) -> bool:
    """Whether an alignment is good enough to exclude other candidates by `cannot_compete`."""
    return fit.inliers > 0.8 and fit.in_front > s.min_in_front and fit.residual_px < 4.0 * s.sigma_px


def is_at_noise_floor(fit: PairFit, s: PairSettings) -> bool:
    """Whether a long common motion has a residual at the tracks' own noise: then no other rate can improve it.

    Never at a rate beyond ``max_rate_error``: there the frame rate is wrong and is searched separately.
    """
    return (
        abs(fit.rate - 1.0) <= s.max_rate_error
        and fit.support >= s.min_support_without_null
        and fit.inliers > _MIN_INLIERS
        and fit.residual_px <= s.max_noise_ratio * max(fit.track_noise_px, s.sigma_px)
    )


def cannot_compete(support: float, cost: float, best_evidence: float, best_cost: float, s: PairSettings) -> bool:
    """Whether a candidate lag can neither beat a reliable fit nor compete with it, so that refining it is useless.

    support [s] and cost: of the candidate in the scan. Its evidence is at most its support; and a scan cost of tens of
    times the reliable fit's cannot come from the grid step of the lag alone.
    """
    return 1.5 * support < s.max_evidence_ratio * best_evidence or cost > 25.0 * max(best_cost, 4.0)
