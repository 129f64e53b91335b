"""Refinement of two-view geometry, lag and rate on the Sampson distance: reweighted Levenberg-Marquardt.

METHODS A, step 3. The robust weight (Cauchy) begins wide, at the misfit of the start, and narrows to the
noise, so that a start from a coarse grid of lags is drawn in before outliers are let go.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hub.two_view.relative_pose import Geometry, RelativePose
from protocols.geometry.types import Floats

NARROW = 2.0
"""Width [sigma] of the robust weight at which a search ends."""
WIDE = 4.0
"""… and at which a final fit ends: 0.996 of the efficiency of least squares."""
_LEAST_ROWS = 12


@dataclass(frozen=True, slots=True, eq=False)
class PointPairs:
    """Corresponding normalised points. a, b: (n, 2). speed: (n, 2) of b by its time. lever: (n,) time of a
    less the samples' centre [s]."""

    a: Floats
    b: Floats
    speed: Floats
    lever: Floats


Sampler = Callable[[float, float], PointPairs]
"""Point pairs under ``t_b = slowness * (t_a - centre) + middle``, given (slowness, middle)."""


@dataclass(frozen=True, slots=True)
class Noise:
    """sigma_a, sigma_b: noise in normalised coordinates. rate_std: prior of the rate."""

    sigma_a: float
    sigma_b: float
    rate_std: float


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Mean robust cost a row, the time map ``t_b = slowness * (t_a - centre) + middle``, and the geometry.

    normal: (k + 2, k + 2) inverse covariance, for unit noise, of the geometry's steps, the middle and the slowness.
    """

    cost: float
    slowness: float
    middle: float
    geometry: Geometry
    normal: Floats


def refine(
    sampler: Sampler,
    geometry: Geometry,
    middle: float,
    scale: float,
    noise: Noise,
    *,
    slowness: float = 1.0,
    fixed_geometry: bool = False,
    iterations: int = 25,
    narrowest: float = NARROW,
) -> Refined | None:
    """Refine from a start; None where nothing overlaps or the rate runs away.

    scale: misfit over noise to begin with. fixed_geometry: only lag and rate move.
    """
    damping, width = 1e-3, max(3.0 * scale, narrowest)
    now = _system(sampler, geometry, slowness, middle, width, noise, fixed_geometry)
    if now is None:
        return None
    for _ in range(iterations):
        normal, gradient, cost = now
        damped = normal + np.diag(damping * np.diag(normal) + 1e-12)
        step: Floats = np.asarray(np.linalg.solve(damped, -gradient), dtype=np.float64)
        trial_geometry = geometry if fixed_geometry else geometry.moved(step[:-2])
        trial_at = slowness + float(step[-1]), middle + float(step[-2])
        trial = _system(sampler, trial_geometry, *trial_at, width, noise, fixed_geometry)
        if trial is not None and trial[2] < cost:
            geometry, (slowness, middle) = trial_geometry, trial_at
            damping = max(damping / 5.0, 1e-9)
            if width == narrowest:
                now = trial
                if cost - trial[2] < 1e-4 * cost:
                    break
                continue
        elif width == narrowest:
            damping *= 8.0
            if damping > 1e3:
                break
            continue
        width = max(narrowest, 0.5 * width)
        now = _system(sampler, geometry, slowness, middle, width, noise, fixed_geometry)
        if now is None:
            return None
    if not 0.5 < slowness < 2.0 or width > narrowest:
        return None
    return Refined(now[2], slowness, middle, geometry, now[0])


def _system(
    sampler: Sampler,
    geometry: Geometry,
    slowness: float,
    middle: float,
    width: float,
    noise: Noise,
    fixed_geometry: bool,
) -> tuple[Floats, Floats, float] | None:
    """Normal matrix, gradient and mean robust cost; None without overlap.

    Columns: the geometry's steps (none where it is fixed), lag, slowness.
    """
    pairs = sampler(slowness, middle)
    count = len(pairs.a)
    if count < _LEAST_ROWS:
        return None
    matrix = geometry.matrix
    line_b = pairs.a @ matrix[:, :2].T
    line_b += matrix[:, 2]
    line_a = pairs.b @ matrix[:2, :2]
    line_a += matrix[2, :2]
    variance = noise.sigma_b**2 * (line_b[:, 0] ** 2 + line_b[:, 1] ** 2)
    variance += noise.sigma_a**2 * (line_a[:, 0] ** 2 + line_a[:, 1] ** 2)
    over = 1.0 / np.sqrt(np.maximum(variance, 1e-30))
    residual = (pairs.b[:, 0] * line_b[:, 0] + pairs.b[:, 1] * line_b[:, 1] + line_b[:, 2]) * over
    ratio = (residual / width) ** 2
    free = 0 if fixed_geometry else 5 if isinstance(geometry, RelativePose) else 7
    jacobian = np.empty((count, free + 2))
    if free:
        products = np.empty((count, 3, 3))
        products[:, :2, :2] = pairs.b[:, :, None] * pairs.a[:, None, :]
        products[:, 2, :2] = pairs.a
        products[:, :2, 2] = pairs.b
        products[:, 2, 2] = 1.0
        jacobian[:, :free] = products.reshape(count, 9) @ geometry.tangents().reshape(free, 9).T
    jacobian[:, free] = line_b[:, 0] * pairs.speed[:, 0] + line_b[:, 1] * pairs.speed[:, 1]
    jacobian[:, free + 1] = jacobian[:, free] * pairs.lever
    jacobian *= over[:, None]
    weighted = jacobian / (1.0 + ratio)[:, None]
    normal = weighted.T @ jacobian
    gradient = weighted.T @ residual
    prior = 1.0 / noise.rate_std**2
    normal[-1, -1] += prior
    gradient[-1] += prior * (slowness - 1.0)
    cost = float((width**2 * np.log1p(ratio)).sum()) + prior * (slowness - 1.0) ** 2
    return normal, gradient, cost / count
