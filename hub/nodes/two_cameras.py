"""What two cameras' shared observations say of their relative pose, every target point eliminated (METHODS C, step 3).

Relative pose of camera l as camera k sees it: ``X_l = rotation @ (X_k - centre)``; ``rotation`` (3, 3) is l from k,
``centre`` (3,) is l's centre in k's axes, in the unit in which the target's size is 1. A step (6,) is
``rotation <- exp(step[:3]) @ rotation, centre <- centre + step[3:]``.

Observations are rows (n, 6): x, y, log size in k, then in l. x, y are normalised and undistorted; the size is
normalised too (pixels over focal length), so that ``size = 1 / depth`` (eqs. 13 and 14). Weights are rows (n, 4):
1/std of x and y, 1/std of the log size, in k, then in l; 0 where there is no size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from protocols.geometry import so3
from protocols.geometry.types import Bools, Floats

_NEAREST = 1e-3
"""Least depth of a triangulated point, as a share of its distance."""
_POINT_STEPS = 2


def small_log(rotation: Floats) -> Floats:
    """Rotation vector (3,) [rad] of a matrix (3, 3), fast for turns below a radian."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    if a + e + i < 2.0:
        return so3.log(rotation)
    x, y, z = 0.5 * (h - f), 0.5 * (c - g), 0.5 * (d - b)
    sine = math.sqrt(x * x + y * y + z * z)
    factor = math.asin(min(sine, 1.0)) / sine if sine > 1e-9 else 1.0
    return np.array([x * factor, y * factor, z * factor])


@dataclass(frozen=True, slots=True, eq=False)
class Relative:
    """Camera l from camera k. rotation: (3, 3). centre: (3,). `linearise` also takes one a row."""

    rotation: Floats
    centre: Floats

    def moved(self, step: Floats) -> Relative:
        """After a step (6,)."""
        return Relative(so3.exp(step[:3]) @ self.rotation, self.centre + step[3:])

    def step_to(self, other: Relative) -> Floats:
        """The step (6,) that leads to ``other``."""
        return np.concatenate([small_log(other.rotation @ self.rotation.T), other.centre - self.centre])

    def inverse(self) -> Relative:
        """Camera k from camera l."""
        return Relative(self.rotation.T, -self.rotation @ self.centre)

    def scaled(self, factor: float) -> Relative:
        """With lengths in another unit."""
        return Relative(self.rotation, self.centre * factor)


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """Second-order model of the negative log-likelihood of each observation about one relative pose.

    hessian: (n, 6, 6). gradient: (n, 6). chi2: (n,) at that pose. ahead: (n,) the point lies before both cameras.
    """

    hessian: Floats
    gradient: Floats
    chi2: Floats
    ahead: Bools


def triangulate(pose: Relative, rows: Floats, weights: Floats) -> Floats:
    """Points (n, 3) in k's axes nearest to both rays, and to the depths that the sizes tell."""
    n = len(rows)
    ray_k = np.ones((n, 3))
    ray_k[:, :2] = rows[:, 0:2]
    ray_l = np.ones((n, 3))
    ray_l[:, :2] = rows[:, 3:5]
    ray_l = _turned(ray_l, pose.rotation)
    # depth_k ray_k - depth_l ray_l = centre, least squares in angle; a depth of 0 is told by the size with weight.
    long_k, long_l = (ray_k * ray_k).sum(axis=1), (ray_l * ray_l).sum(axis=1)
    across = (ray_k * ray_l).sum(axis=1)
    size_k, size_l = np.exp(-rows[:, 2]), np.exp(-rows[:, 5])
    # A size with relative std s leaves depth * s along the ray; the rays leave depth / weight across it.
    pull_k = (weights[:, 1] / np.maximum(weights[:, 0], 1e-12)) ** 2 * long_k
    pull_l = (weights[:, 3] / np.maximum(weights[:, 2], 1e-12)) ** 2 * long_l
    a, b = long_k + pull_k, long_l + pull_l
    u = (ray_k * pose.centre).sum(axis=1) + pull_k * size_k
    v = -(ray_l * pose.centre).sum(axis=1) + pull_l * size_l
    determinant = np.maximum(a * b - across * across, 1e-12 * a * b)
    depth = (b * u + across * v) / determinant
    return np.asarray(ray_k * depth[:, None])


def _turned(vectors: Floats, rotation: Floats) -> Floats:
    """``vector @ rotation`` of each (n, 3), by one rotation or by its own."""
    if rotation.ndim == 2:
        return np.asarray(vectors @ rotation)
    return np.asarray((vectors[:, None, :] @ rotation)[:, 0])


def stacked(poses: list[Relative], counts: list[int]) -> Relative:
    """One relative pose a row: the first ``counts[0]`` times, and so on."""
    which = np.repeat(np.arange(len(poses)), counts)
    return Relative(np.array([p.rotation for p in poses])[which], np.array([p.centre for p in poses])[which])


def linearise(pose: Relative, rows: Floats, weights: Floats) -> Terms:
    """Residuals of both cameras, the point eliminated by its Schur complement (METHODS C, step 3).

    A point that would lie behind a camera has ``ahead`` False and no meaning.
    """
    point = triangulate(pose, rows, weights)
    for _ in range(_POINT_STEPS):
        by_k, by_l, residual_k, residual_l, ahead, _ = _residuals(pose, point, rows, weights)
        normal = by_k.transpose(0, 2, 1) @ by_k + by_l.transpose(0, 2, 1) @ by_l
        pull = (by_k * residual_k[:, :, None]).sum(axis=1) + (by_l * residual_l[:, :, None]).sum(axis=1)
        inverse = _inverse(normal)
        step = -(inverse * pull[:, None, :]).sum(axis=2)
        # A far point may leap behind the camera; half its depth a step is enough.
        limit = 0.5 * np.abs(point[:, 2]) / np.maximum(np.abs(step[:, 2]), 1e-300)
        point = point + step * np.minimum(1.0, limit)[:, None]
    by_k, by_l, residual_k, residual_l, ahead, local = _residuals(pose, point, rows, weights)
    inverse = _inverse(by_k.transpose(0, 2, 1) @ by_k + by_l.transpose(0, 2, 1) @ by_l)
    in_l = by_l @ np.swapaxes(pose.rotation, -1, -2)  # derivative by the point in l's axes
    by_pose = np.concatenate([-in_l @ so3.hat(local), -by_l], axis=2)
    turned = by_pose.transpose(0, 2, 1)
    cross = turned @ by_l
    hessian = turned @ by_pose - cross @ inverse @ cross.transpose(0, 2, 1)
    pull = (by_k * residual_k[:, :, None]).sum(axis=1) + (by_l * residual_l[:, :, None]).sum(axis=1)
    gradient = (turned * residual_l[:, None, :]).sum(axis=2)
    gradient = gradient - ((cross @ inverse) * pull[:, None, :]).sum(axis=2)
    chi2 = (residual_k * residual_k).sum(axis=1) + (residual_l * residual_l).sum(axis=1)
    return Terms(hessian, gradient, chi2, ahead)


def _residuals(
    pose: Relative, point: Floats, rows: Floats, weights: Floats
) -> tuple[Floats, Floats, Floats, Floats, Bools, Floats]:
    """Derivatives by the point in k's axes (n, 3, 3) and residuals (n, 3) in sigma, of k and of l."""
    local = _turned(point - pose.centre, np.swapaxes(pose.rotation, -1, -2))
    by_k, residual_k, ahead_k = _one_camera(point, rows[:, 0:3], weights[:, 0:2])
    in_l, residual_l, ahead_l = _one_camera(local, rows[:, 3:6], weights[:, 2:4])
    return by_k, in_l @ pose.rotation, residual_k, residual_l, ahead_k & ahead_l, local


def _one_camera(local: Floats, seen: Floats, weights: Floats) -> tuple[Floats, Floats, Bools]:
    depth = local[:, 2]
    floor = _NEAREST * np.abs(local).max(axis=1) + 1e-12
    ahead = np.asarray(depth > floor)
    safe = np.maximum(depth, floor)
    over = 1.0 / safe
    flat = local[:, :2] * over[:, None]
    scaled = over * weights[:, 0]
    by = np.zeros((len(local), 3, 3))
    by[:, 0, 0] = by[:, 1, 1] = scaled
    by[:, 0, 2] = -flat[:, 0] * scaled
    by[:, 1, 2] = -flat[:, 1] * scaled
    by[:, 2, 2] = -over * weights[:, 1]
    residual = np.empty((len(local), 3))
    residual[:, :2] = (flat - seen[:, :2]) * weights[:, :1]
    residual[:, 2] = (-np.log(safe) - seen[:, 2]) * weights[:, 1]
    return by, residual, ahead


def _inverse(m: Floats) -> Floats:
    """Inverses (n, 3, 3) of symmetric matrices (n, 3, 3) by cofactors; a floor keeps singular ones finite."""
    a, b, c = m[:, 0, 0], m[:, 0, 1], m[:, 0, 2]
    d, e, f = m[:, 1, 1], m[:, 1, 2], m[:, 2, 2]
    out = np.empty_like(m)
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = np.maximum(a * p + b * q + c * r, 1e-15 * a * d * f + 1e-300)
    over = 1.0 / determinant
    out[:, 0, 0] = p * over
    out[:, 0, 1] = out[:, 1, 0] = q * over
    out[:, 0, 2] = out[:, 2, 0] = r * over
    out[:, 1, 1] = (a * f - c * c) * over
    out[:, 1, 2] = out[:, 2, 1] = (b * c - a * e) * over
    out[:, 2, 2] = (a * d - b * b) * over
    return out
