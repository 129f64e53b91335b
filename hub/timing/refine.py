"""Refinement of relative pose, lag and rate on the Sampson distance: reweighted Levenberg-Marquardt.

METHODS A, step 3. The robust weight (Cauchy) begins wide, at the misfit of the start, and narrows to the
noise, so that a start from a coarse grid of lags is drawn in before outliers are let go.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hub.timing import two_view
from hub.timing.two_view import RelativePose
from protocols.geometry import so3
from protocols.geometry.types import Floats

_NARROWEST = 2.0  # sigma
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
    """Mean robust cost a row, the time map ``t_b = slowness * (t_a - centre) + middle``, and the pose."""

    cost: float
    slowness: float
    middle: float
    pose: RelativePose


def refine(
    sampler: Sampler,
    pose: RelativePose,
    middle: float,
    scale: float,
    noise: Noise,
    *,
    fixed_pose: bool = False,
    iterations: int = 25,
) -> Refined | None:
    """Refine from a start; None where nothing overlaps or the rate runs away.

    scale: misfit over noise to begin with. fixed_pose: only lag and rate move.
    """
    slowness = 1.0
    damping, width = 1e-3, max(3.0 * scale, _NARROWEST)
    free = np.arange(5, 7) if fixed_pose else np.arange(7)
    now = _system(sampler, pose, slowness, middle, width, noise)
    if now is None:
        return None
    for _ in range(iterations):
        normal, gradient, cost = now
        part = normal[np.ix_(free, free)]
        step = np.zeros(7)
        step[free] = np.linalg.solve(part + np.diag(damping * np.diag(part) + 1e-12), -gradient[free])
        trial_pose = _moved(pose, step)
        trial = _system(sampler, trial_pose, slowness + step[6], middle + step[5], width, noise)
        if trial is not None and trial[2] < cost:
            pose, slowness, middle = trial_pose, slowness + float(step[6]), middle + float(step[5])
            damping = max(damping / 5.0, 1e-9)
            if width > _NARROWEST:
                width = max(_NARROWEST, 0.5 * width)
                now = _system(sampler, pose, slowness, middle, width, noise)
                if now is None:
                    return None
                continue
            now = trial
            if cost - trial[2] < 1e-4 * cost:
                break
        elif width > _NARROWEST:
            width = max(_NARROWEST, 0.5 * width)
            now = _system(sampler, pose, slowness, middle, width, noise)
            if now is None:
                return None
        else:
            damping *= 8.0
            if damping > 1e3:
                break
    if not 0.5 < slowness < 2.0 or width > _NARROWEST:
        return None
    return Refined(now[2], slowness, middle, pose)


def _moved(pose: RelativePose, step: Floats) -> RelativePose:
    direction = pose.direction + two_view.tangent_basis(pose.direction) @ step[3:5]
    return RelativePose(so3.exp(step[:3]) @ pose.rotation, direction / np.linalg.norm(direction))


def _cross(a: Floats, b: Floats) -> Floats:
    """Row-wise cross product; numpy's own costs several times as much on short arrays."""
    out = np.empty((len(a), 3))
    b = np.broadcast_to(b, a.shape)
    out[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    out[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    out[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return out


def _system(
    sampler: Sampler, pose: RelativePose, slowness: float, middle: float, width: float, noise: Noise
) -> tuple[Floats, Floats, float] | None:
    """Normal matrix (7, 7), gradient (7,) and mean robust cost; None without overlap.

    Columns: rotation 0..2, direction 3..4, lag 5, slowness 6.
    """
    pairs = sampler(slowness, middle)
    count = len(pairs.a)
    if count < _LEAST_ROWS:
        return None
    essential = pose.essential
    ha, hb = two_view.homogeneous(pairs.a), two_view.homogeneous(pairs.b)
    turned = ha @ pose.rotation.T
    line_b, line_a = ha @ essential.T, hb @ essential
    variance = noise.sigma_b**2 * (line_b[:, :2] ** 2).sum(1) + noise.sigma_a**2 * (line_a[:, :2] ** 2).sum(1)
    over = 1.0 / np.sqrt(np.maximum(variance, 1e-30))
    residual = (hb * line_b).sum(1) * over
    jacobian = np.empty((count, 7))
    jacobian[:, :3] = _cross(turned, _cross(hb, pose.direction))
    jacobian[:, 3:5] = _cross(turned, hb) @ two_view.tangent_basis(pose.direction)
    jacobian[:, 5] = (line_b[:, :2] * pairs.speed).sum(1)
    jacobian[:, 6] = jacobian[:, 5] * pairs.lever
    jacobian *= over[:, None]
    ratio = (residual / width) ** 2
    weighted = jacobian / (1.0 + ratio)[:, None]
    normal = weighted.T @ jacobian
    gradient = weighted.T @ residual
    prior = 1.0 / noise.rate_std**2
    normal[6, 6] += prior
    gradient[6] += prior * (slowness - 1.0)
    cost = float((width**2 * np.log1p(ratio)).sum()) + prior * (slowness - 1.0) ** 2
    return normal, gradient, cost / count
