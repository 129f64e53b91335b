"""Robust refinement of two-view geometry, lag and clock rate on the Sampson distance.

Levenberg-Marquardt with Cauchy weights (iteratively reweighted least squares), in place of the alternation of the
asynchronous calibration paper. The width of the Cauchy weight starts at the misfit of the initial guess and is halved
down to the noise (graduated non-convexity), so that starts from a coarse grid of lags converge before outliers lose
their weight. Sampson distance: Hartley and Zisserman, Multiple View Geometry, sec. 11.4.3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hub.two_view.relative_pose import RelativePose, TwoViewGeometry
from protocols.geometry.types import Floats

SEARCH_WIDTH = 2.0
"""Final width [sigma] of the Cauchy weight in a search."""
FINAL_WIDTH = 4.0
"""Final width [sigma] of the Cauchy weight in a final fit: 0.996 of the efficiency of least squares."""
_TOLERANCE = 1e-4
"""Relative decrease of the cost at which it has converged."""
_MIN_ROWS = 12  # twice the six unknowns of a relative pose and a lag


@dataclass(frozen=True, slots=True, eq=False)
class PointPairs:
    """Corresponding normalised points.

    a, b: (n, 2), fastest where a coordinate lies together. velocity_b: (n, 2) derivative of b by b's time [1/s].
    centred_time: (n,) time of a minus the samples' centre [s].
    """

    a: Floats
    b: Floats
    velocity_b: Floats
    centred_time: Floats


Sampler = Callable[[float, float], PointPairs]
"""Point pairs under the time map ``t_b = inverse_rate * (t_a - centre) + intercept``: f(inverse_rate, intercept)."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Image noise and clock-rate prior.

    sigma_a, sigma_b: noise std of normalised points of a and of b. rate_prior_std: prior std of the rate about 1.
    """

    sigma_a: float
    sigma_b: float
    rate_prior_std: float


@dataclass(frozen=True, slots=True, eq=False)
class RefinementResult:
    """Estimate of two-view geometry and time map ``t_b = inverse_rate * (t_a - centre) + intercept``.

    cost: mean robust cost of a point pair, in units of the squared noise. intercept: b's time [s] at the samples'
    centre. normal: (k + 2, k + 2) normal matrix, the inverse covariance for unit noise, of the geometry's k local
    parameters, intercept and inverse rate.
    """

    cost: float
    inverse_rate: float
    intercept: float
    geometry: TwoViewGeometry
    normal: Floats


def refine(
    sampler: Sampler,
    geometry: TwoViewGeometry,
    intercept: float,
    initial_misfit: float,
    noise: NoiseModel,
    *,
    inverse_rate: float = 1.0,
    fixed_geometry: bool = False,
    iterations: int = 25,
    final_width: float = SEARCH_WIDTH,
) -> RefinementResult | None:
    """Refine geometry, lag and rate from an initial guess; None without overlap or if the rate diverges.

    sampler: point pairs at a time map. geometry, intercept [s], inverse_rate: initial guess. initial_misfit: its
    residual over the noise, from which the Cauchy width starts. fixed_geometry: estimate lag and rate only.
    final_width: of the Cauchy weight [sigma].
    """
    damping, width = 1e-3, max(3.0 * initial_misfit, final_width)
    rows = _linearise(sampler, geometry, inverse_rate, intercept, noise, fixed_geometry)
    if rows is None:
        return None
    system, last_gain = _normal_equations(rows, inverse_rate, width, noise), 0.0
    for _ in range(iterations):
        normal, gradient, cost = system
        damped = normal + np.diag(damping * np.diag(normal) + 1e-12)
        step: Floats = np.asarray(np.linalg.solve(damped, -gradient), dtype=np.float64)
        trial_geometry = geometry if fixed_geometry else geometry.retract(step[:-2])
        trial_map = inverse_rate + float(step[-1]), intercept + float(step[-2])
        trial_rows = _linearise(sampler, trial_geometry, *trial_map, noise, fixed_geometry)
        trial = None if trial_rows is None else _normal_equations(trial_rows, trial_map[0], width, noise)
        if trial_rows is not None and trial is not None and trial[2] < cost:
            geometry, (inverse_rate, intercept), rows = trial_geometry, trial_map, trial_rows
            damping = max(damping / 5.0, 1e-9)
            if width == final_width:
                system, gain = trial, cost - trial[2]
                # Near the minimum each step gains the same share of the last one's gain: what the next would.
                if gain * gain / max(gain, last_gain) < _TOLERANCE * cost:
                    break
                last_gain = gain
                continue
        elif width == final_width:
            damping *= 8.0
            if damping > 1e3:
                break
            continue
        width = max(final_width, 0.5 * width)
        system = _normal_equations(rows, inverse_rate, width, noise)  # another width changes the weights only
    if not 0.5 < inverse_rate < 2.0 or width > final_width:
        return None
    return RefinementResult(system[2], inverse_rate, intercept, geometry, system[0])


def _linearise(
    sampler: Sampler,
    geometry: TwoViewGeometry,
    inverse_rate: float,
    intercept: float,
    noise: NoiseModel,
    fixed_geometry: bool,
) -> tuple[Floats, Floats] | None:
    """Residuals (n,) in units of the noise and their Jacobian (k + 2, n); None without overlap.

    Parameters: the geometry's local ones (none if it is fixed), intercept, inverse rate.
    """
    pairs = sampler(inverse_rate, intercept)
    count = len(pairs.a)
    if count < _MIN_ROWS:
        return None
    matrix, a, b = geometry.matrix, pairs.a.T, pairs.b.T
    line_b = matrix[:, :2] @ a
    line_b += matrix[:, 2:]
    line_a = matrix[:2, :2].T @ b
    line_a += matrix[2, :2, None]
    variance = np.einsum("in,in->n", line_b[:2], line_b[:2])
    variance *= noise.sigma_b**2
    variance += noise.sigma_a**2 * np.einsum("in,in->n", line_a, line_a)
    over = 1.0 / np.sqrt(np.maximum(variance, 1e-30))
    residual = np.einsum("in,in->n", b, line_b[:2])
    residual += line_b[2]
    residual *= over
    free = 0 if fixed_geometry else 5 if isinstance(geometry, RelativePose) else 7
    jacobian = np.empty((free + 2, count))
    if free:
        products = np.empty((3, 3, count))
        np.multiply(b[:, None], a, out=products[:2, :2])
        products[2, :2], products[:2, 2], products[2, 2] = a, b, 1.0
        np.matmul(geometry.tangents().reshape(free, 9), products.reshape(9, count), out=jacobian[:free])
    np.einsum("in,in->n", line_b[:2], pairs.velocity_b.T, out=jacobian[free])
    np.multiply(jacobian[free], pairs.centred_time, out=jacobian[free + 1])
    jacobian *= over
    return residual, jacobian


def _normal_equations(
    rows: tuple[Floats, Floats], inverse_rate: float, width: float, noise: NoiseModel
) -> tuple[Floats, Floats, float]:
    """Normal matrix, gradient and mean robust cost of `_linearise`'s rows, with Cauchy weights of a width."""
    residual, jacobian = rows
    ratio = residual / width
    ratio *= ratio
    weighted = jacobian / (1.0 + ratio)
    normal = weighted @ jacobian.T
    gradient = weighted @ residual
    prior = 1.0 / noise.rate_prior_std**2
    normal[-1, -1] += prior
    gradient[-1] += prior * (inverse_rate - 1.0)
    cost = float((width**2 * np.log1p(ratio)).sum()) + prior * (inverse_rate - 1.0) ** 2
    return normal, gradient, cost / len(residual)
