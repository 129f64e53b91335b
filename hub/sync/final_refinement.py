"""The last refinement of a pair's answer, and whether the motion tells its lag and rotation well enough to give it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hub.sync.alignment import PairFit, PairSettings, PairSolution, Samples
from hub.sync.lag_uncertainty import at_centre, leaning
from hub.trajectory.image_tracks import SmoothTrack
from hub.two_view.refinement import WIDE, Noise, Refined, refine
from hub.two_view.relative_pose import Geometry, RelativePose, five_point, in_front
from protocols.geometry import so3
from protocols.geometry.types import Floats

NEAR_PX = 10.0
"""What may belong to the geometry of a scan in pieces [px]."""
_SEEDS = 8  # of five-point hypotheses, each followed to its end
_STARTS_SAMPLES, _STARTS_STEPS = 300, 60
_SUBSET = 150
_IN_FRONT = 0.95
_SAME_LAG = 0.1  # s
_AS_LIKELY = 6.0  # squared stds between geometries that are told apart, residuals that are alike counted as one
_RATE_TOLD = 5.0  # std, residuals that are alike counted as one
_USUAL_RATE = 2e-4  # std of a clock's rate, where the motion does not tell it


def finish(
    answer: PairSolution,
    fit: PairFit,
    a: Sequence[SmoothTrack],
    b: Sequence[SmoothTrack],
    s: PairSettings,
    *,
    fixed: bool = False,
    pieces: bool = False,
) -> PairSolution:
    """The answer with all samples, the tracks' own noise and hardly any robustness left, and its stds; or a refusal.

    a, b: tracks of the same labels. fixed: the geometry is given. pieces: only what is near the geometry counts.
    """
    samples = Samples(a, b, fit.offset, s, s.all_samples)
    if pieces:
        samples.keep_near(fit.geometry.matrix, fit.rate, fit.offset, NEAR_PX)
    own = [max(float(np.median([t.sigma for t in one])), 0.1 / one[0].focal) for one in (a, b)]
    misfit = max(1.0, fit.sigma_px / (0.5 * (own[0] * a[0].focal + own[1] * b[0].focal)))
    noise = Noise(own[0] * misfit, own[1] * misfit, s.rate_std)
    slowness = 1.0 / fit.rate
    posed = isinstance(fit.geometry, RelativePose) and not fixed
    if posed and s.firm and not pieces:
        likeliest, apart = _likeliest(samples, fit, noise)
        if apart > s.largest_turn_apart:
            reason = f"rotations {np.rad2deg(apart):.0f}° apart fit the motion alike"
            return replace(answer, status=reason, fit=fit)
        fit = replace(fit, geometry=likeliest)
    found = refine(
        samples,
        fit.geometry,
        slowness * (samples.centre - fit.offset),
        1.0,
        noise,
        slowness=slowness,
        fixed_geometry=fixed,
        narrowest=WIDE,
    )
    if found is None:
        return answer
    found, covariance, rate_std = _usual_rate(samples, found, noise, fixed)
    rate = 1.0 / found.slowness
    last = samples.judge(found.cost, rate, samples.centre - rate * found.middle, found.geometry)
    last = replace(
        last,
        log10_chance=fit.log10_chance,
        lag_std=float(np.sqrt(max(covariance[-2, -2], 0.0))),
        turn_std=float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0))) if posed else 0.0,
        rate_std=rate_std,
    )
    speed = float(np.nanmedian(np.linalg.norm(samples.of_b((samples.time - last.offset) / rate)[1], axis=1)))
    a_pixel = 1.0 / max(speed * b[0].focal, 1e-9)
    if last.lag_std > min(max(s.largest_lag_std, a_pixel), s.largest_slow_lag_std):
        return replace(answer, status=f"the motion tells the lag only to {1e3 * last.lag_std:.0f} ms (std)", fit=last)
    sure = fit.log10_chance is not None and fit.log10_chance < s.sure_log10_chance
    if last.turn_std > (s.sure_turn_std if sure else s.largest_turn_std):
        reason = f"the motion tells the relative rotation only to {np.rad2deg(last.turn_std):.1f}° (std)"
        return replace(answer, status=reason, fit=last)
    answer = replace(answer, fit=last)
    return _firm(answer, last, samples, found, noise, rate_std, s) if posed and s.firm else answer


def _likeliest(samples: Samples, fit: PairFit, noise: Noise) -> tuple[Geometry, float]:
    """The likeliest geometry of many starts at about the fit's lag, and how far others as likely are turned [rad].

    Seen from far away, rotation and direction hardly show by themselves: from one start a search ends somewhere in a
    valley of tens of degrees, at a cost that looks like the noise.
    """
    few = samples.thinned(_STARTS_SAMPLES)
    middle = (few.centre - fit.offset) / fit.rate
    a, b = few.at(fit.rate, fit.offset)
    both = np.isfinite(b).all(axis=1)
    a, b = a[both], b[both]
    usual = replace(noise, rate_std=_USUAL_RATE)
    threshold = 3.0 * min(noise.sigma_a, noise.sigma_b)
    starts = [fit.geometry]
    for seed in range(_SEEDS):
        starts += five_point(a, b, threshold, seed, _SUBSET)
    ends = []
    for start in starts:
        end = refine(few, start, middle, 1.0, usual, slowness=1.0 / fit.rate, iterations=_STARTS_STEPS, narrowest=WIDE)
        if end is not None and in_front(end.geometry, a, b).mean() > _IN_FRONT and abs(end.middle - middle) < _SAME_LAG:
            ends.append(end)
    if not ends:
        return fit.geometry, 0.0
    best = min(ends, key=lambda end: end.cost)
    worst = best.cost + _AS_LIKELY * few.together(best) / max(len(a), 1)
    turns = [so3.angle_between(_turn(end), _turn(best)) for end in ends if end.cost < worst]
    return best.geometry, max(turns)


def _turn(found: Refined) -> Floats:
    if not isinstance(found.geometry, RelativePose):
        raise TypeError("a fundamental matrix has no rotation")
    return found.geometry.rotation


def _usual_rate(samples: Samples, found: Refined, noise: Noise, fixed: bool) -> tuple[Refined, Floats, float]:
    """The fit with the rate that clocks usually have, where the motion does not tell it; its covariance and prior."""
    covariance: Floats = np.asarray(np.linalg.pinv(found.normal, hermitian=True))
    together = samples.together(found)
    if abs(found.slowness - 1.0) >= _RATE_TOLD * np.sqrt(together * covariance[-1, -1]):
        return found, covariance, noise.rate_std
    wide = np.sqrt(together)
    usual = refine(
        samples,
        found.geometry,
        found.middle,
        1.0,
        Noise(noise.sigma_a * wide, noise.sigma_b * wide, _USUAL_RATE),
        fixed_geometry=fixed,
        narrowest=WIDE,
    )
    if usual is None:
        return found, covariance, noise.rate_std
    return usual, np.asarray(np.linalg.pinv(usual.normal, hermitian=True) / together), _USUAL_RATE


def _firm(
    answer: PairSolution,
    fit: PairFit,
    samples: Samples,
    found: Refined,
    noise: Noise,
    rate_std: float,
    s: PairSettings,
) -> PairSolution:
    """The answer, at the lag that lenses not exactly as told leave likeliest where they could move it far."""
    few = samples.thinned(s.samples)
    sigma = noise.sigma_a, noise.sigma_b
    lean = leaning(few, at_centre(found, samples.centre, few), sigma, rate_std, s.largest_lag_std)
    rate = 1.0 / lean.slowness
    fit = replace(fit, rate=rate, offset=few.centre - rate * lean.middle, lag_doubt=lean.std)
    if lean.std > s.largest_doubt:
        told = f"{1e3 * lean.std:.0f} ms (std)"
        reason = f"the motion tells the lag only to {told}, with lenses and shutters not exactly as told"
        return replace(answer, status=reason, fit=fit)
    if lean.swing > s.largest_swing:
        told = f"{1e3 * lean.swing:.0f} ms"
        reason = f"the motion tells the lag only to {told}: that far it moves without a fifth of what was seen"
        return replace(answer, status=reason, fit=fit)
    return replace(answer, fit=fit)


__all__ = ["NEAR_PX", "finish"]
