"""Robust refinement of two-view geometry, lag and clock rate on the Sampson distance.

Levenberg-Marquardt with Cauchy weights (iteratively reweighted least squares), in place of the alternation of the
asynchronous calibration paper. The width of the Cauchy weight starts at the misfit of the initial guess and is halved
down to the noise (graduated non-convexity), so that starts from a coarse grid of lags converge before outliers lose
their weight. Sampson distance: Hartley and Zisserman, Multiple View Geometry, sec. 11.4.3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
from scipy.linalg.lapack import dgesv

from hub.two_view.relative_pose import FundamentalMatrix, RelativePose, TwoViewGeometry
from protocols.geometry import kernels
from protocols.geometry.types import Floats

SEARCH_WIDTH = 2.0
"""Final width [sigma] of the Cauchy weight in a search."""
FINAL_WIDTH = 4.0
"""Final width [sigma] of the Cauchy weight in a final fit: 0.996 of the efficiency of least squares."""
_TOLERANCE = 1e-4
"""Relative decrease of the cost at which it has converged."""
_NO_INFORMATION = 1e-15  # relative size of eigenvalues that are rounding errors
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


def symmetric_inverse(matrix: Floats) -> Floats:
    """Pseudoinverse of a symmetric matrix (n, n)."""
    values, vectors = np.linalg.eigh(matrix)
    known = np.abs(values) > _NO_INFORMATION * np.abs(values).max()
    return np.asarray((vectors * np.where(known, 1.0 / np.where(known, values, 1.0), 0.0)) @ vectors.T)


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
    compiled: kernels.SampledTracks | None = getattr(sampler, "compiled", None)
    if compiled is not None:
        is_pose, free, numbers = _packed(geometry)
        state = np.concatenate([*numbers, [inverse_rate, intercept]])
        noises, limits = (noise.sigma_a, noise.sigma_b, noise.rate_prior_std), (_MIN_ROWS, iterations, _TOLERANCE)
        kind, widths = (is_pose, 0 if fixed_geometry else free), (width, final_width)
        cost, normal = kernels.refine_alignment(compiled, state, kind, noises, widths, limits)
        left, right, (inverse_rate, intercept) = state[:9].reshape(3, 3), state[9:18].reshape(3, 3), state[21:].tolist()
        moved = RelativePose(left, state[18:21]) if is_pose else FundamentalMatrix(left, right, float(state[18]))
        return RefinementResult(cost, inverse_rate, intercept, moved, normal) if np.isfinite(cost) else None
    system_at = partial(_linearise, sampler, noise=noise, fixed_geometry=fixed_geometry)
    rows, last_gain = system_at(geometry, inverse_rate, intercept), 0.0
    system = rows(width)
    if not np.isfinite(system[2]):
        return None
    for _ in range(iterations):
        normal, gradient, cost = system
        damped = normal.copy()
        damped.reshape(-1)[:: len(normal) + 1] += damping * normal.diagonal() + 1e-12
        step: Floats = np.asarray(dgesv(damped, -gradient)[2])  # numpy's solution, without its checks
        trial_geometry = geometry if fixed_geometry else geometry.retract(step[:-2])
        trial_map = inverse_rate + float(step[-1]), intercept + float(step[-2])
        trial_rows = system_at(trial_geometry, *trial_map)
        trial = trial_rows(width)
        if trial[2] < cost:
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
        system = rows(width)  # another width changes the weights only
    if not 0.5 < inverse_rate < 2.0 or width > final_width:
        return None
    return RefinementResult(system[2], inverse_rate, intercept, geometry, system[0])


_System: TypeAlias = tuple[Floats, Floats, float]
"""Normal matrix and gradient by local geometry, intercept, inverse rate; mean robust cost, infinite without overlap."""


def _linearise(
    sampler: Sampler,
    geometry: TwoViewGeometry,
    inverse_rate: float,
    intercept: float,
    *,
    noise: NoiseModel,
    fixed_geometry: bool,
) -> Callable[[float], _System]:
    """The system at a state, by the width of the Cauchy weights."""
    tangents = np.zeros((0, 3, 3)) if fixed_geometry else geometry.tangents()
    rows = _residuals(sampler(inverse_rate, intercept), geometry.matrix, tangents, noise)
    prior, count = 1.0 / noise.rate_prior_std**2, len(rows[0])

    def system(width: float) -> _System:
        if count < _MIN_ROWS:
            return np.zeros((0, 0)), np.zeros(0), np.inf
        normal, gradient, cost = _normal_equations(rows, width)
        normal[-1, -1] += prior
        gradient[-1] += prior * (inverse_rate - 1.0)
        return normal, gradient, (cost + prior * (inverse_rate - 1.0) ** 2) / count

    return system


def _packed(geometry: TwoViewGeometry) -> tuple[bool, int, list[Floats]]:
    """Whether a geometry is a pose, its degrees of freedom, and its numbers as `kernels.refine_alignment` has them."""
    if isinstance(geometry, RelativePose):
        return True, 5, [geometry.rotation.ravel(), np.zeros(9), geometry.direction]
    return False, 7, [geometry.left.ravel(), geometry.right.ravel(), np.array([geometry.angle, 0.0, 0.0])]


def _residuals(pairs: PointPairs, matrix: Floats, tangents: Floats, noise: NoiseModel) -> tuple[Floats, Floats]:
    """Sampson distances (n,) in units of the noise and their Jacobian (k + 2, n)."""
    a, b = pairs.a.T, pairs.b.T
    line_b = matrix[:, :2] @ a
    line_b += matrix[:, 2:]
    line_a = matrix[:2, :2].T @ b
    line_a += matrix[2, :2, None]
    variance = noise.sigma_b**2 * np.einsum("in,in->n", line_b[:2], line_b[:2])
    variance += noise.sigma_a**2 * np.einsum("in,in->n", line_a, line_a)
    over = 1.0 / np.sqrt(np.maximum(variance, 1e-30))
    residual = (np.einsum("in,in->n", b, line_b[:2]) + line_b[2]) * over
    count, free = len(residual), len(tangents)
    jacobian, products = np.empty((free + 2, count)), np.empty((3, 3, count))
    np.multiply(b[:, None], a, out=products[:2, :2])
    products[2, :2], products[:2, 2], products[2, 2] = a, b, 1.0
    np.matmul(tangents.reshape(free, 9), products.reshape(9, count), out=jacobian[:free])
    np.einsum("in,in->n", line_b[:2], pairs.velocity_b.T, out=jacobian[free])
    np.multiply(jacobian[free], pairs.centred_time, out=jacobian[free + 1])
    jacobian *= over
    return residual, jacobian


def _normal_equations(rows: tuple[Floats, Floats], width: float) -> _System:
    """Normal matrix, gradient and robust cost of `_residuals`, with Cauchy weights of a width."""
    residual, jacobian = rows
    ratio = np.square(residual / width)
    weighted = jacobian / (1.0 + ratio)
    return weighted @ jacobian.T, weighted @ residual, float((width**2 * np.log1p(ratio)).sum())
