"""Acceptance tests of alignment hypotheses: limits, false-alarm probability, competing hypotheses, uniqueness."""

from __future__ import annotations

import numpy as np

from hub.sync.hypothesis import PairFit, PairSolution, evidence
from hub.sync.null_distribution import COST_FLOOR
from hub.sync.settings import PairSettings
from hub.two_view.relative_pose import RelativePose

_MIN_INLIERS = 0.9  # fraction of the common motion that counts as nearly all
_CHANCE_MISFIT = 9.0  # over the squared noise: upper bound for wrong alignments with nearly all rows as inliers


def accept_or_reject(
    names: tuple[str, str], fits: list[PairFit], independent_lags: float, s: PairSettings
) -> PairSolution:
    """The best hypothesis as solution of the cameras ``names``, or a refusal with the reason.

    fits: best first. independent_lags: approximate number of independent alignments that were searched.
    """
    best = fits[0]
    others = tuple(fits[1:4])
    competing = [fit for fit in fits[1:] if is_competing(fit, best, s)]
    credible = [fit for fit in competing if not is_chance_level(fit, best, independent_lags, s)]
    second = max((evidence(fit) / max(evidence(best), 1e-12) for fit in credible), default=0.0)
    log10_false_alarms = None if best.log10_false_alarm is None else best.log10_false_alarm + np.log10(independent_lags)
    # Periodic motion fits nearly as well one period later. With enough support the residual decides: nothing else
    # comes near the tracks' own noise.
    at_noise = (
        not competing
        and best.support >= s.min_support_without_null
        and best.residual_px <= s.max_noise_ratio * best.track_noise_px
    )
    rejection = rejection_reason(best, s)
    large_gap = not competing and best.log10_gap < s.max_log10_gap
    unique = is_unique_at_noise_floor(best, fits[1:], s)
    if rejection:
        reason = rejection
    elif best.inliers < min_inliers(best, s):
        reason = f"only {100 * best.inliers:.0f} % of the common motion agrees with one geometry"
    elif log10_false_alarms is None and best.support < s.min_support_without_null:
        reason = (
            f"the recordings overlap too little ({best.moving_overlap:.1f} s of motion) to distinguish one lag "
            "from another"
        )
    elif (
        log10_false_alarms is not None
        and log10_false_alarms > s.max_log10_false_alarm
        and not (at_noise or large_gap or unique)
    ):
        reason = (
            "other lags fit nearly as well (one of them would by chance in "
            f"{100 * min(1.0, 10.0**log10_false_alarms):.0f} % of cases): too little or too regular common motion, or "
            "two different objects"
        )
    elif second > s.max_evidence_ratio and not unique:
        other = max(credible, key=evidence)
        reason = f"two alignments are about as good ({best.offset:.2f} s and {other.offset:.2f} s)"
    else:
        return PairSolution(*names, "ok", best, others)
    return PairSolution(*names, reason, best, others)


def rejection_reason(fit: PairFit, s: PairSettings) -> str:
    """Why an alignment fails the absolute limits; "" if it passes them."""
    if rejection_reason_ignoring_planarity(fit, s) or not is_planar(fit, s):
        return rejection_reason_ignoring_planarity(fit, s)
    return "the motion lies in one plane (or the cameras stand in one place), which leaves the geometry undetermined"


def rejection_reason_ignoring_planarity(fit: PairFit, s: PairSettings) -> str:
    """Why an alignment fails the absolute limits other than planarity; "" if it passes them."""
    if fit.support < s.min_support:
        return f"only {fit.support:.1f} s of motion agree (of {fit.moving_overlap:.1f} s)"
    if fit.residual_px > s.max_residual_px:
        return f"the best alignment leaves a residual of {fit.residual_px:.1f} px"
    if abs(fit.rate - 1.0) > s.max_rate_error:
        return f"the best alignment needs a clock that is {1e6 * abs(fit.rate - 1.0):.0f} ppm off"
    if fit.in_front < s.min_in_front:
        return "the best geometry puts points behind a camera"
    return ""


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
    if fit.support > best.support and fit.inliers > _MIN_INLIERS and not rejection_reason(fit, s):
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
    some of the many other lags fit as well; if none does, the alignment is unique.
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
    next_best = max((strength(fit) for fit in others if fit.in_front > _MIN_INLIERS), default=0.0)
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
        or rejection_reason_ignoring_planarity(best, s)
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
        acceptable = not rejection_reason(fit, s) and fit.inliers >= min_inliers(fit, s)
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
