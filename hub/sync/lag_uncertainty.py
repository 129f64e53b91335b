"""Uncertainty of a pair's lag: std with lens and readout errors as consider parameters, and leave-out change.

Where a path is nearly planar or slow, a focal length that is 1 % off or a rolling shutter shifts the lag by more than
noise does, and residuals do not show it. So the errors of both lenses and the readout times are parameters with priors
of their usual size: consider parameters (Schmidt: not estimated, but added to the covariance), which is cheap, and
estimated where the std of the lag is then too large. Autocorrelated residuals count by their effective sample size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hub.sync.samples import Samples, autocorrelation
from hub.two_view.refinement import FINAL_WIDTH, RefinementResult, symmetric_inverse
from hub.two_view.relative_pose import RelativePose
from protocols.geometry.order_statistics import median
from protocols.geometry.types import Bools, Floats

_LENS_STD = (0.015, 0.012, 0.012, 0.02)
"""Std of given intrinsics: log focal length, principal point (normalised), k1."""
_READOUT_STD = 0.02
"""Std of the rolling-shutter readout time [s] per unit of normalised height: about 15 ms for most images."""
_CONSIDER_STD = np.array([*_LENS_STD, *_LENS_STD, _READOUT_STD, _READOUT_STD])
_POSE_DOF = 5  # rotation and direction
_INTERCEPT, _INVERSE_RATE = _POSE_DOF, _POSE_DOF + 1
_LEAVE_OUT_PARTS = 5  # contiguous folds of the samples
_ITERATIONS = 20  # a bound: it stops where the cost hardly decreases
_MIN_RELATIVE_DECREASE = 1e-5  # of the cost, at which the iteration has converged
_MAX_DAMPING = 1e6  # no step decreases the cost any more


@dataclass(frozen=True, slots=True, eq=False)
class LagUncertainty:
    """Time map ``t_b = inverse_rate * (t_a - centre) + intercept``, centre of the samples, and its uncertainty.

    std: of the intercept [s], lens and readout uncertainty included. leave_out_change: greatest change of the intercept
    [s] when a contiguous fifth of the samples is left out (jackknife); 0 where not computed.
    """

    inverse_rate: float
    intercept: float
    std: float
    leave_out_change: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Parameters:
    """Pose, time map and lens errors.

    lens_errors: (10,) log focal length, principal point (2) and k1 of a, then of b, then both readout times [s per
    unit of normalised height].
    """

    pose: RelativePose
    intercept: float
    inverse_rate: float
    lens_errors: Floats

    def retract(self, step: Floats) -> _Parameters:
        return _Parameters(
            self.pose.retract(step[:_POSE_DOF]),
            self.intercept + float(step[_INTERCEPT]),
            self.inverse_rate + float(step[_INVERSE_RATE]),
            self.lens_errors + step[_INVERSE_RATE + 1 :],
        )


def estimate_lag_uncertainty(
    samples: Samples, found: RefinementResult, sigma: tuple[float, float], rate_prior_std: float, std_limit: float
) -> LagUncertainty:
    """Std of the lag of ``found``; where it exceeds ``std_limit`` [s], the lenses are estimated too.

    Then time map, std and leave-out change are of the fit with lenses. found: with a relative pose, its intercept at
    the samples' centre. sigma: noise std of normalised points of a and of b. rate_prior_std: of the rate about 1.
    Raises TypeError for a fundamental matrix.
    """
    if not isinstance(found.geometry, RelativePose):
        raise TypeError("a fundamental matrix has no lenses to estimate")
    parameters = _Parameters(found.geometry, found.intercept, found.inverse_rate, np.zeros(len(_CONSIDER_STD)))
    all_samples = np.ones(samples.count, dtype=np.bool_)
    residual, jacobian = _residuals(samples, parameters, sigma, all_samples)
    scale = max(median(np.abs(residual)) / 0.6745, 1e-9)
    prior = np.concatenate([np.zeros(_INTERCEPT + 1), [rate_prior_std**-2], _CONSIDER_STD**-2])
    weight = _cauchy_weight(residual, FINAL_WIDTH * scale)
    inflation = _autocorrelation_inflation(
        residual, jacobian[:, : _INVERSE_RATE + 1], weight, scale, prior[: _INVERSE_RATE + 1]
    )
    std = _consider_std(jacobian / (scale * inflation), weight, prior)
    if std <= std_limit:
        return LagUncertainty(found.inverse_rate, found.intercept, std)
    noise, width = (sigma[0] * scale * inflation, sigma[1] * scale * inflation), FINAL_WIDTH / inflation
    refined, std = _estimate_with_lenses(samples, parameters, noise, width, prior, all_samples)
    fold = np.argsort(np.argsort(samples.time)) * _LEAVE_OUT_PARTS // samples.count
    left_out = [
        _estimate_with_lenses(samples, refined, noise, width, prior, fold != k)[0] for k in range(_LEAVE_OUT_PARTS)
    ]
    leave_out_change = max(abs(one.intercept - refined.intercept) for one in left_out)
    return LagUncertainty(refined.inverse_rate, refined.intercept, std, leave_out_change)


def _autocorrelation_inflation(
    residual: Floats, jacobian: Floats, weight: Floats, scale: float, prior: Floats
) -> float:
    """Factor by which autocorrelation of the residuals (n,) inflates the std of the lag.

    Sandwich covariance with the residuals' autocorrelation: slowly varying errors are mostly absorbed by the geometry
    and affect the lag less.
    """
    rho = autocorrelation(residual)
    inflated_scale = scale * np.sqrt(max(2.0 * float(rho.sum()) - 1.0, 1.0))
    weighted = jacobian * weight[:, None]
    covariance = symmetric_inverse(weighted.T @ jacobian / inflated_scale**2 + np.diag(prior))[_INTERCEPT]
    influence = weighted @ covariance * (scale / inflated_scale**2)  # change of the lag per residual
    variance = influence @ influence + 2.0 * sum(
        float(one) * float(influence[lag:] @ influence[:-lag]) for lag, one in enumerate(rho[1:], start=1)
    )
    return float(max(inflated_scale / scale * np.sqrt(max(variance, 0.0) / covariance[_INTERCEPT]), 1.0))


def _consider_std(jacobian: Floats, weight: Floats, prior: Floats) -> float:
    """Std of the lag with given lenses: noise covariance plus consider covariance of the lens errors."""
    estimated = _INVERSE_RATE + 1
    weighted = jacobian * weight[:, None]
    normal = weighted.T @ jacobian
    covariance = symmetric_inverse(normal[:estimated, :estimated] + np.diag(prior[:estimated]))
    systematic = covariance[_INTERCEPT] @ normal[:estimated, estimated:] * _CONSIDER_STD
    return float(np.sqrt(covariance[_INTERCEPT, _INTERCEPT] + systematic @ systematic))


def _estimate_with_lenses(
    samples: Samples, parameters: _Parameters, noise: tuple[float, float], width: float, prior: Floats, use: Bools
) -> tuple[_Parameters, float]:
    """Levenberg-Marquardt over all 17 parameters, and the std of the lag. use: (n,) mask of the samples."""

    def system(at: _Parameters) -> tuple[Floats, Floats, float]:
        residual, jacobian = _residuals(samples, at, noise, use)
        weighted = jacobian * _cauchy_weight(residual, width)[:, None]
        deviation = np.concatenate([np.zeros(_INTERCEPT + 1), [at.inverse_rate - 1.0], at.lens_errors])
        cost = width**2 * float(np.log1p((residual / width) ** 2).sum()) + float((prior * deviation * deviation).sum())
        return weighted.T @ jacobian + np.diag(prior), weighted.T @ residual + prior * deviation, cost

    damping = 1e-3
    normal, gradient, cost = system(parameters)
    for _ in range(_ITERATIONS):
        step = np.linalg.solve(normal + np.diag(damping * np.diag(normal) + 1e-12), -gradient)
        trial = parameters.retract(np.asarray(step, dtype=np.float64))
        trial_system = system(trial)
        if trial_system[2] < cost:
            done = cost - trial_system[2] < _MIN_RELATIVE_DECREASE * cost
            parameters, (normal, gradient, cost) = trial, trial_system
            damping = max(damping / 5.0, 1e-9)
            if done:
                break
        else:
            damping *= 8.0
            if damping > _MAX_DAMPING:
                break
    return parameters, float(np.sqrt(symmetric_inverse(normal)[_INTERCEPT, _INTERCEPT]))


def _residuals(
    samples: Samples, parameters: _Parameters, noise: tuple[float, float], use: Bools
) -> tuple[Floats, Floats]:
    """Sampson distances over the noise (n,), and their Jacobian (n, 17): pose, intercept, inverse rate, lens errors."""
    centred_time = samples.time - samples.centre
    time = parameters.inverse_rate * centred_time + parameters.intercept
    readout_a, readout_b = parameters.lens_errors[-2:]
    # Rows below the middle are read later; b's height is accurate enough without its own readout correction.
    height_b = np.nan_to_num(samples.interpolate_b(time)[0][:, 1])
    b, speed = samples.interpolate_b(time + readout_a * samples.points[:, 1] - readout_b * height_b)
    present = np.isfinite(b[:, 0]) & use
    # Coordinates first, rows last: numpy is slow along axes of length two or three.
    a, b, speed = (one.T.compress(present, axis=1) for one in (samples.points, b, speed))
    true_a, true_b = _with_lens_errors(a, parameters.lens_errors[:4]), _with_lens_errors(b, parameters.lens_errors[4:8])
    matrix = parameters.pose.matrix
    line_a, line_b = matrix.T @ true_b, matrix @ true_a
    variance = noise[0] ** 2 * np.square(line_a[:2]).sum(axis=0) + noise[1] ** 2 * np.square(line_b[:2]).sum(axis=0)
    inverse_noise = 1.0 / np.sqrt(np.maximum(variance, 1e-30))
    jacobian = np.empty((_INVERSE_RATE + 1 + len(_CONSIDER_STD), a.shape[1]))
    products = (true_b[:, None] * true_a).reshape(9, -1)
    jacobian[:_POSE_DOF] = parameters.pose.tangents().reshape(_POSE_DOF, 9) @ products
    jacobian[_INTERCEPT] = (line_b[:2] * speed).sum(axis=0)
    jacobian[_INVERSE_RATE] = jacobian[_INTERCEPT] * centred_time[present]
    jacobian[7:11] = _lens_jacobian(a, line_a)
    jacobian[11:15] = _lens_jacobian(b, line_b)
    jacobian[15] = jacobian[_INTERCEPT] * a[1]
    jacobian[16] = -jacobian[_INTERCEPT] * b[1]
    return (true_b * line_b).sum(axis=0) * inverse_noise, (jacobian * inverse_noise).T


def _with_lens_errors(points: Floats, lens_errors: Floats) -> Floats:
    """Homogeneous points (3, n) of normalised ones (2, n), corrected for the ``lens_errors`` (4,) of their lens."""
    corrected = (points - lens_errors[1:3, None]) * np.exp(-lens_errors[0])
    out = np.ones((3, points.shape[1]))
    out[:2] = corrected * (1.0 - lens_errors[3] * np.square(corrected).sum(axis=0))
    return out


def _lens_jacobian(points: Floats, line: Floats) -> Floats:
    """Derivatives (4, n) of the distances of points (2, n) from lines (3, n) by the lens errors, to first order."""
    variance = (points * line[:2]).sum(axis=0)
    return -np.stack([variance, line[0], line[1], variance * np.square(points).sum(axis=0)])


def _cauchy_weight(residual: Floats, width: float) -> Floats:
    return np.asarray(1.0 / (1.0 + (residual / width) ** 2))


def recentred(found: RefinementResult, centre: float, samples: Samples) -> RefinementResult:
    """``found`` of samples centred at ``centre`` [s], with its intercept at the centre of ``samples``."""
    return replace(found, intercept=found.intercept + found.inverse_rate * (samples.centre - centre))
