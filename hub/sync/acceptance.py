"""What is said of an alignment, alone and beside the others: accepted, or refused and why."""

from __future__ import annotations

import numpy as np

from hub.sync.alignment import PairFit, PairSettings, PairSolution, evidence
from hub.sync.null_distribution import COST_FLOOR
from hub.two_view.relative_pose import RelativePose

_NEARLY_ALL = 0.9
_LOOSE = 9.0  # of squared noise: wrong alignments in which nearly all rows agree leave less


def judge(names: tuple[str, str], fits: list[PairFit], searched: float, s: PairSettings) -> PairSolution:
    """The first of ``fits``, best first, as answer of the cameras ``names``, or the reason why it is none.

    searched: about how many independent alignments were looked at.
    """
    best = fits[0]
    others = tuple(fits[1:4])
    rivals = [fit for fit in fits[1:] if rival_of(fit, best, s)]
    grave = [fit for fit in rivals if not made_by_chance(fit, best, searched, s)]
    second = max((evidence(fit) / max(evidence(best), 1e-12) for fit in grave), default=0.0)
    by_chance = None if best.log10_chance is None else best.log10_chance + np.log10(searched)
    # Regular motion fits nearly as well a period later. That is settled by the noise where there is enough of
    # it and nothing else comes near what the tracks' own noise leaves.
    settled = not rivals and best.support >= s.unchecked_support and best.sigma_px <= s.exact * best.own_px
    doubt = doubts(best, s)
    apart = not rivals and best.log10_gap < s.accept_log10_gap
    alone = stands_alone(best, fits[1:], s)
    if doubt:
        reason = doubt
    elif best.inliers < needed_inliers(best, s):
        reason = f"only {100 * best.inliers:.0f} % of the common motion agrees with one geometry"
    elif by_chance is None and best.support < s.unchecked_support:
        reason = (
            f"the recordings overlap too little ({best.moving_overlap:.1f} s of motion) to tell one lag from another"
        )
    elif by_chance is not None and by_chance > s.accept_log10_chance and not (settled or apart or alone):
        reason = (
            f"other lags fit nearly as well (one of them would by chance in {100 * min(1.0, 10.0**by_chance):.0f} % "
            "of cases): too little or too regular common motion, or two different things"
        )
    elif second > s.accept_ratio and not alone:
        rival = max(grave, key=evidence)
        reason = f"two alignments are about as good ({best.offset:.2f} s and {rival.offset:.2f} s)"
    else:
        return PairSolution(*names, "ok", best, others)
    return PairSolution(*names, reason, best, others)


def doubts(fit: PairFit, s: PairSettings) -> str:
    """What speaks against an alignment taken by itself; "" for nothing."""
    if faults(fit, s) or not flat(fit, s):
        return faults(fit, s)
    return "the motion lies in one plane (or the cameras stand in one place), which leaves the geometry open"


def faults(fit: PairFit, s: PairSettings) -> str:
    """What speaks against an alignment taken by itself, flatness left aside; "" for nothing."""
    if fit.support < s.accept_support:
        return f"only {fit.support:.1f} s of motion agree (of {fit.moving_overlap:.1f} s)"
    if fit.sigma_px > s.largest_sigma_px:
        return f"the best alignment leaves {fit.sigma_px:.1f} px"
    if abs(fit.rate - 1.0) > s.largest_rate:
        return f"the best alignment needs a clock that is {1e6 * abs(fit.rate - 1.0):.0f} ppm off"
    if fit.front < s.accept_in_front:
        return "the best geometry puts points behind a camera"
    return ""


def flat(fit: PairFit, s: PairSettings) -> bool:
    """Whether a plane explains the motion nearly as well, so that several geometries may."""
    return fit.flat_px < s.flat_ratio * max(fit.sigma_px, s.sigma_px)


def rival_of(fit: PairFit, best: PairFit, s: PairSettings) -> bool:
    """Whether another alignment comes near the best one: in what it leaves, and in how unlikely that is."""
    if best.sigma_px <= s.exact * best.own_px and best.support >= s.unchecked_support:
        # What is left is the tracks' own noise, row for row: then a little more is a lot less likely.
        limit = s.worse_than_noise * best.sigma_px
    else:
        limit = s.clearly_worse * max(best.sigma_px, s.sigma_px)
    if fit.sigma_px > limit:
        return False
    if fit.log10_chance is None or best.log10_chance is None:
        return True
    if fit.support > best.support and fit.inliers > _NEARLY_ALL and not doubts(fit, s):
        return True  # as good for longer: chance, told from stretches of a motion that repeats itself, does not decide
    return fit.log10_chance < best.log10_chance + s.clearly_likelier


def made_by_chance(fit: PairFit, best: PairFit, searched: float, s: PairSettings) -> bool:
    """Whether chance makes one like this rival in any search, and the best one far more rarely.

    Where nothing corresponds, as many alignments as were looked at hold one or more like that: it speaks for nothing.
    One as good as the best for longer is none of these: chance, told from parts of a motion that repeats itself, does
    not decide there.
    """
    if fit.log10_chance is None or best.log10_chance is None or fit.support > best.support:
        return False
    usual = fit.log10_chance + np.log10(searched) >= 0.0
    return bool(usual and fit.log10_chance > best.log10_chance + s.likelier_than_usual)


def stands_alone(best: PairFit, others: list[PairFit], s: PairSettings) -> bool:
    """Whether an alignment leaves no more than the noise, over cycles enough, and no other comes near it.

    How unlikely that is by chance cannot be told from unrelated stretches where the motion is slow: any seven numbers
    fit few cycles of it. But then some of the many other lags fit as well, and here none does.
    """
    if best.inliers < _NEARLY_ALL or best.support < s.alone_support or best.sigma_px > s.exact * best.own_px:
        return False
    if not isinstance(best.geometry, RelativePose):
        return False  # without lenses two numbers more fit more of anything
    own = strength(best)
    next_best = max((strength(fit) for fit in others if fit.front > _NEARLY_ALL), default=0.0)
    apart = own - next_best >= s.alone_margin and next_best <= s.accept_ratio * own
    return own >= s.alone_strength and apart


def stands_apart(best: PairFit, fits: list[PairFit], s: PairSettings) -> bool:
    """Whether nothing speaks against an alignment by itself, and no other comes near its strength.

    fits: with or without it. What lenses that are not exactly as told leave over the tracks' noise is no matter here,
    and neither is a plane that leaves more than it does. By itself that proves nothing: unrelated tracks have a
    strongest alignment too. But it hardly ever tells its lag firmly.
    """
    if not isinstance(best.geometry, RelativePose) or best.support < s.alone_support:
        return False
    if best.inliers < _NEARLY_ALL or faults(best, s) or best.flat_px < s.flat_ratio * best.sigma_px:
        return False
    own = strength(best)
    next_best = max((strength(fit) for fit in fits if fit is not best), default=0.0)
    return own >= s.alone_strength and own - next_best >= s.alone_margin and next_best <= s.apart_ratio * own


def strength(fit: PairFit) -> float:
    """Cycles of agreeing motion, times the logarithm of how much less they leave than wrong ones that agree do."""
    share = (fit.misfit + COST_FLOOR) / _LOOSE
    return fit.cycles * fit.inliers * fit.front * -float(np.log(min(share, 1.0)))


def needed_inliers(fit: PairFit, s: PairSettings) -> float:
    """The share of the common motion that must agree: the less motion there is, the more of it."""
    short = float(np.clip((s.plenty - fit.support) / (s.plenty - s.hardly), 0.0, 1.0))
    return s.accept_inliers + short * (s.strict_inliers - s.accept_inliers)


def distinct(fits: list[PairFit], s: PairSettings) -> list[PairFit]:
    """Best first, alignments that are the same within 0.1 s once.

    The best is the strongest of those against which nothing speaks by itself, and in which enough agrees: most lags
    with much in common fit some of it, and would come before the right one of a short overlap.
    """

    def merit(fit: PairFit) -> tuple[bool, float, float]:
        fair = not doubts(fit, s) and fit.inliers >= needed_inliers(fit, s)
        return (fair, strength(fit), evidence(fit))

    ordered = sorted(fits, key=merit, reverse=True)
    out: list[PairFit] = []
    for fit in ordered:
        if all(abs(fit.lag - other.lag) > 0.1 for other in out):
            out.append(fit)
    return out


def sound(fit: PairFit, s: PairSettings) -> bool:
    """Whether an alignment is good enough to measure others by."""
    return fit.inliers > 0.8 and fit.front > s.accept_in_front and fit.sigma_px < 4.0 * s.sigma_px


def at_noise(fit: PairFit, s: PairSettings) -> bool:
    """Whether long common motion leaves no more than the tracks' own noise: then lag and rate are what they are.

    Not at a rate that no clock has: there a frame rate was told wrongly, and is to be tried by itself.
    """
    return (
        abs(fit.rate - 1.0) <= s.largest_rate
        and fit.support >= s.unchecked_support
        and fit.inliers > _NEARLY_ALL
        and fit.sigma_px <= s.exact * max(fit.own_px, s.sigma_px)
    )


def hopeless(support: float, cost: float, best_evidence: float, best_cost: float, s: PairSettings) -> bool:
    """Whether a candidate can neither win over a sound fit nor make it doubtful, so that refining it is idle.

    Its evidence is at most the seconds in which both move; and what leaves tens of times the misfit of the
    sound one is not brought down to it by a lag between two steps of the grid.
    """
    return 1.5 * support < s.accept_ratio * best_evidence or cost > 25.0 * max(best_cost, 4.0)
