"""Final maximum-likelihood refinement of an accepted alignment, and tests of its precision and sensitivity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from hub.sync.acceptance import acceptance_test, with_tests
from hub.sync.hypothesis import PairFit, PairSolution
from hub.sync.lag_uncertainty import estimate_lag_uncertainty, recentred
from hub.sync.samples import Samples, autocorrelation
from hub.sync.settings import PairSettings
from hub.trajectory.image_tracks import SmoothTrack
from hub.two_view.refinement import FINAL_WIDTH, NoiseModel, PointPairs, RefinementResult, refine, symmetric_inverse
from hub.two_view.relative_pose import RelativePose, TwoViewGeometry, five_point, homogeneous, in_front, sampson
from protocols.geometry import so3
from protocols.geometry.order_statistics import median
from protocols.geometry.types import Floats

LTS_INLIER_PX = 10.0
"""Distance [px] up to which a sample is an inlier of the geometry of an LTS scan."""
_FIVE_POINT_SEEDS = 8  # random seeds of five-point hypotheses, each refined to convergence
_START_SAMPLES, _START_ITERATIONS = 300, 60  # enough to rank the minima, which are then refined with all samples
_FIVE_POINT_SUBSET = 150  # pairs among which inliers are counted
_CLEAR_SHARE = 0.5  # of the largest ambiguity: a bound below it is clear, whatever the robust weights may change
_MIN_IN_FRONT = 0.95  # cheirality, less an outlier in twenty
_MAX_LAG_CHANGE = 0.1  # s from the fit's lag
LIKELIHOOD_MARGIN = 6.0  # chi-square between distinguishable geometries, by effective sample size
_MIN_RATE_SIGNIFICANCE = 5.0  # std, by effective sample size: above it the motion determines the rate
_TYPICAL_RATE_STD = 2e-4  # prior std of a clock's rate, where the motion does not determine it
_refine_finally = partial(refine, final_width=FINAL_WIDTH)


def refine_and_test(
    solution: PairSolution,
    fit: PairFit,
    a: Sequence[SmoothTrack],
    b: Sequence[SmoothTrack],
    s: PairSettings,
    *,
    fixed_geometry: bool = False,
    lts: bool = False,
) -> PairSolution:
    """Refine an alignment with all samples, the tracks' own noise and a wide robust kernel; refuse it if imprecise.

    a, b: tracks of the same labels in the same order. fixed_geometry: the geometry is given. lts: use only inliers of
    the fit's geometry. With intrinsics and ``s.standalone``, rotation ambiguity and lag sensitivity are tested too.
    Returns the solution with the refined fit and its stds, or unsolved with the reason.
    """
    samples = Samples(a, b, fit.offset, s, s.final_samples)
    if lts:
        samples.keep_inliers(fit.geometry.matrix, fit.rate, fit.offset, LTS_INLIER_PX)
    sigma = [max(median(np.array([t.sigma for t in one])), 0.1 / one[0].focal) for one in (a, b)]
    misfit = max(1.0, fit.residual_px / (0.5 * (sigma[0] * a[0].focal + sigma[1] * b[0].focal)))
    noise = NoiseModel(sigma[0] * misfit, sigma[1] * misfit, s.rate_prior_std)
    inverse_rate = 1.0 / fit.rate
    has_pose = isinstance(fit.geometry, RelativePose) and not fixed_geometry
    if has_pose and s.standalone and not lts:
        most_likely, ambiguity = _most_likely_geometry(samples, fit, noise, _CLEAR_SHARE * s.max_rotation_ambiguity)
        reason = f"rotations {np.rad2deg(ambiguity):.0f}° apart fit the motion equally well"
        name = "angle between equally likely rotations"
        solution = with_tests(solution, [acceptance_test(name, ambiguity, s.max_rotation_ambiguity, reason)], fit)
        if not solution.solved:
            return solution
        fit = replace(fit, geometry=most_likely)
    intercept = inverse_rate * (samples.centre - fit.offset)
    found = _refine_finally(
        samples, fit.geometry, intercept, 1.0, noise, inverse_rate=inverse_rate, fixed_geometry=fixed_geometry
    )
    if found is None:
        return solution
    found, covariance, rate_prior_std = _with_rate_prior(samples, found, noise, fixed_geometry)
    rate = 1.0 / found.inverse_rate
    last = samples.evaluate(rate, samples.centre - rate * found.intercept, found.geometry)
    last = replace(
        last,
        log10_false_alarm=fit.log10_false_alarm,
        lag_std=float(np.sqrt(max(covariance[-2, -2], 0.0))),
        rotation_std=float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0))) if has_pose else 0.0,
        rate_prior_std=rate_prior_std,
    )
    speeds = np.hypot(*samples.interpolate_b((samples.time - last.offset) / rate)[1].T)
    speed = median(speeds[np.isfinite(speeds)])
    a_pixel = 1.0 / max(speed * b[0].focal, 1e-9)
    lag_limit = min(max(s.max_lag_std, a_pixel), s.max_slow_lag_std)
    certain_lag = fit.log10_false_alarm is not None and fit.log10_false_alarm < s.certain_lag_log10_false_alarm
    rotation_limit = s.max_rotation_std_certain_lag if certain_lag else s.max_rotation_std
    lag_reason = f"the motion determines the lag only to {1e3 * last.lag_std:.0f} ms (std)"
    tests = [acceptance_test("std of the lag by noise", last.lag_std, lag_limit, lag_reason)]
    if has_pose:
        std = np.rad2deg(last.rotation_std)
        reason = f"the motion determines the relative rotation only to {std:.1f}° (std)"
        name = "std of the relative rotation"
        tests.append(acceptance_test(name, last.rotation_std, rotation_limit, reason))
    solution = with_tests(solution, tests, last)
    if not (solution.solved and has_pose and s.standalone):
        return solution
    return _test_sensitivity(solution, last, samples, found, noise, rate_prior_std, s)


def _most_likely_geometry(
    samples: Samples, fit: PairFit, noise: NoiseModel, clear: float
) -> tuple[TwoViewGeometry, float]:
    """Most likely geometry of many starts near the fit's lag, and the largest angle [rad] to equally likely rotations.

    Distant motion hardly separates rotation and direction (bas-relief ambiguity): from one start the search ends
    anywhere in a valley of tens of degrees, at a cost near the noise. Where a bound of that angle is below ``clear``
    [rad], no other start is tried: the fit's geometry and the bound.
    """
    coarse = samples.thinned(_START_SAMPLES)
    intercept = (coarse.centre - fit.offset) / fit.rate
    pairs = coarse(1.0 / fit.rate, intercept)
    a, b, bound = pairs.a, pairs.b, rotation_bound(pairs, fit.geometry.matrix, noise)
    if bound < clear:
        return fit.geometry, bound
    typical = replace(noise, rate_prior_std=_TYPICAL_RATE_STD)
    threshold = 3.0 * min(noise.sigma_a, noise.sigma_b)
    starts = [fit.geometry]
    for seed in range(_FIVE_POINT_SEEDS):
        starts += five_point(a, b, threshold, seed, _FIVE_POINT_SUBSET)
    minima = []
    for start in starts:
        minimum = _refine_finally(
            coarse, start, intercept, 1.0, typical, inverse_rate=1.0 / fit.rate, iterations=_START_ITERATIONS
        )
        if (
            minimum is not None
            and isinstance(minimum.geometry, RelativePose)
            and in_front(minimum.geometry, a, b).mean() > _MIN_IN_FRONT
            and abs(minimum.intercept - intercept) < _MAX_LAG_CHANGE
        ):
            minima.append((minimum, minimum.geometry.rotation))
    if not minima:
        return fit.geometry, 0.0
    best, likeliest = min(minima, key=lambda one: one[0].cost)
    cost_limit = best.cost + LIKELIHOOD_MARGIN * coarse.autocorrelation_time(best) / max(len(a), 1)
    angles = [so3.angle_between(rotation, likeliest) for minimum, rotation in minima if minimum.cost < cost_limit]
    return best.geometry, max(angles)


def rotation_bound(pairs: PointPairs, matrix: Floats, noise: NoiseModel) -> float:
    """Bound [rad] of the angle from the rotation of ``matrix`` (3, 3) to any other that is equally likely; may be inf.

    With Taubin's distance M / N of moments and gradients, all matrices (9,) that cost no more than a limit are a cone
    ``m^T (M - limit N) m <= 0``, whatever their starts; M is what is left when the change of the lag is free. To turn a
    rotation by w turns the essential matrix by w / 2 at least, however the direction follows.
    """
    a, b = homogeneous(pairs.a).T, homogeneous(pairs.b).T
    residual = sampson(matrix, pairs.a, pairs.b, noise.sigma_a, noise.sigma_b)
    weight = 1.0 / (1.0 + (residual / FINAL_WIDTH) ** 2)
    rows = (np.concatenate([b, pairs.velocity_b.T])[:, None] * a).reshape(-1, len(residual))
    moments, blocks = (weight * rows) @ rows.T, np.zeros((3, 3, 3, 3))
    of_a, of_b = noise.sigma_b**2 * ((weight * a) @ a.T), noise.sigma_a**2 * ((weight * b) @ b.T)
    for k in range(2):  # the coordinates in the image are noisy, the third is not
        blocks[k, :, k] += of_a
        blocks[:, k, :, k] += of_b
    norm = blocks.reshape(9, 9)
    start = matrix.ravel() / np.linalg.norm(matrix)
    cost = start @ moments[:9, :9] @ start / (start @ norm @ start)
    limit = cost + LIKELIHOOD_MARGIN * (2.0 * float(autocorrelation(residual).sum()) - 1.0) / len(residual)
    free = moments[:9, 9:] @ symmetric_inverse(moments[9:, 9:]) @ moments[9:, :9]
    value, vector = np.linalg.eigh(moments[:9, :9] - free - limit * norm)
    if value[1] <= 0.0:
        return np.inf
    off_axis = np.arccos(min(abs(float(start @ vector[:, 0])), 1.0))
    return 2.0 * float(off_axis + np.arctan(np.sqrt(max(-value[0], 0.0) / value[1])))


def _with_rate_prior(
    samples: Samples, found: RefinementResult, noise: NoiseModel, fixed_geometry: bool
) -> tuple[RefinementResult, Floats, float]:
    """The fit, with a typical rate prior if the motion does not determine the rate; its covariance and prior std."""
    covariance = symmetric_inverse(found.normal)
    autocorrelation_time = samples.autocorrelation_time(found)
    if abs(found.inverse_rate - 1.0) >= _MIN_RATE_SIGNIFICANCE * np.sqrt(autocorrelation_time * covariance[-1, -1]):
        return found, covariance, noise.rate_prior_std
    inflation = np.sqrt(autocorrelation_time)
    inflated = NoiseModel(noise.sigma_a * inflation, noise.sigma_b * inflation, _TYPICAL_RATE_STD)
    typical = _refine_finally(samples, found.geometry, found.intercept, 1.0, inflated, fixed_geometry=fixed_geometry)
    if typical is None:
        return found, covariance, noise.rate_prior_std
    return typical, symmetric_inverse(typical.normal) / autocorrelation_time, _TYPICAL_RATE_STD


def _test_sensitivity(
    solution: PairSolution,
    fit: PairFit,
    samples: Samples,
    found: RefinementResult,
    noise: NoiseModel,
    rate_prior_std: float,
    s: PairSettings,
) -> PairSolution:
    """Test of the lag's sensitivity to lens errors and left-out samples; the solution with the lag so estimated."""
    coarse = samples.thinned(s.refinement_samples)
    sigma = noise.sigma_a, noise.sigma_b
    uncertainty = estimate_lag_uncertainty(
        coarse, recentred(found, samples.centre, coarse), sigma, rate_prior_std, s.max_lag_std
    )
    rate = 1.0 / uncertainty.inverse_rate
    fit = replace(fit, rate=rate, offset=coarse.centre - rate * uncertainty.intercept, total_lag_std=uncertainty.std)
    std, change = f"{1e3 * uncertainty.std:.0f} ms (std)", f"{1e3 * uncertainty.leave_out_change:.0f} ms"
    only = "the motion determines the lag only to"
    total = f"{only} {std}, with lens and readout uncertainty included"
    leave_out = f"{only} {change}: it changes by that much without a fifth of the samples"
    tests = (
        acceptance_test("std of the lag with lens and readout", uncertainty.std, s.max_total_lag_std, total),
        acceptance_test(
            "change of the lag without a fifth of the samples",
            uncertainty.leave_out_change,
            s.max_leave_out_change,
            leave_out,
        ),
    )
    return with_tests(solution, tests, fit)
