"""Two-view measurement model with eliminated target points, linearised about a relative pose.

Distributed pose paper, step 3. Camera l relative to camera k: ``X_l = rotation @ (X_k - centre)``; ``rotation`` (3, 3)
is l from k, ``centre`` (3,) is l's centre in k's axes, in the unit in which the target's size is 1. A step (6,) is
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

_MIN_DEPTH_SHARE = 1e-3
"""Least depth of a triangulated point, as a share of its distance."""
_POINT_STEPS = 1  # Gauss-Newton steps: the linear point is near
_EYE = np.eye(3)


def small_log(rotation: Floats) -> Floats:
    """Rotation vector (3,) [rad] of a matrix (3, 3), fast for angles below one radian."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    if a + e + i < 2.0:
        return so3.log(rotation)
    x, y, z = 0.5 * (h - f), 0.5 * (c - g), 0.5 * (d - b)
    sine = math.sqrt(x * x + y * y + z * z)
    factor = math.asin(min(sine, 1.0)) / sine if sine > 1e-9 else 1.0
    return np.array([x * factor, y * factor, z * factor])


@dataclass(frozen=True, slots=True, eq=False)
class RelativeTransform:
    """Camera l from camera k. rotation: (3, 3). centre: (3,). `linearise_observations` also takes one per row."""

    rotation: Floats
    centre: Floats

    def retract(self, step: Floats) -> RelativeTransform:
        """The pose after a step (6,)."""
        return RelativeTransform(so3.exp(step[:3]) @ self.rotation, self.centre + step[3:])

    def local_coordinates(self, other: RelativeTransform) -> Floats:
        """The step (6,) from this pose to ``other``."""
        return np.concatenate([small_log(other.rotation @ self.rotation.T), other.centre - self.centre])

    def inverse(self) -> RelativeTransform:
        """Camera k from camera l."""
        return RelativeTransform(self.rotation.T, -self.rotation @ self.centre)

    def scaled(self, factor: float) -> RelativeTransform:
        """The same with lengths times ``factor``."""
        return RelativeTransform(self.rotation, self.centre * factor)


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedObservations:
    """Second-order model of the negative log-likelihood of each observation about one relative pose.

    hessian: (n, 6, 6). gradient: (n, 6). chi2: (n,) at that pose. in_front: (n,) the point is in front of both cameras.
    """

    hessian: Floats
    gradient: Floats
    chi2: Floats
    in_front: Bools


def triangulate(pose: RelativeTransform, rows: Floats, weights: Floats) -> Floats:
    """Points (n, 3) in k's axes by least squares from both rays and the depths given by the sizes."""
    rays = np.ones((2, 3, len(rows)))
    rays[:, :2] = rows.T.reshape(2, 3, -1)[:, :2]
    ray_k, ray_l = rays[0], _rotate_rows(rays[1].T, pose.rotation).T
    centre = np.atleast_2d(pose.centre).T
    # depth_k ray_k - depth_l ray_l = centre, least squares in angle; the sizes add weighted depth terms.
    long_k, long_l = (ray_k * ray_k).sum(axis=0), (ray_l * ray_l).sum(axis=0)
    across = (ray_k * ray_l).sum(axis=0)
    # A size with relative std s has std depth * s along the ray; the rays have std depth / weight across it.
    pull = (weights.T[1::2] / weights.T[0::2]) ** 2
    pull_k, pull_l = pull[0] * long_k, pull[1] * long_l
    size = np.exp(-rows.T[2::3])
    a, b = long_k + pull_k, long_l + pull_l
    u = (ray_k * centre).sum(axis=0) + pull_k * size[0]
    v = pull_l * size[1] - (ray_l * centre).sum(axis=0)
    ab = a * b
    depth = (b * u + across * v) / np.maximum(ab - across * across, 1e-12 * ab)
    return np.asarray((ray_k * depth).T)


def _rotate_rows(vectors: Floats, rotation: Floats) -> Floats:
    """``vector @ rotation`` for each row (n, 3), by one common rotation or one per row."""
    if rotation.ndim == 2:
        return np.asarray(vectors @ rotation)
    return np.asarray((vectors[:, None, :] @ rotation)[:, 0])


def stack_transforms(poses: list[RelativeTransform], counts: list[int]) -> RelativeTransform:
    """One relative pose per row: the first one ``counts[0]`` times, and so on."""
    which = np.repeat(np.arange(len(poses)), counts)
    return RelativeTransform(np.array([p.rotation for p in poses])[which], np.array([p.centre for p in poses])[which])


def linearise_observations(pose: RelativeTransform, rows: Floats, weights: Floats) -> LinearisedObservations:
    """Quadratic model of each observation with its point eliminated (Schur complement; distributed pose paper, step 3).

    Where the point is behind a camera ``in_front`` is False and the other values are meaningless. All in k's axes: with
    N = K + L the point's information from both cameras, that of the relative pose is M = L - L N⁻¹ L.
    """
    turn = pose.rotation
    rotation_t = np.swapaxes(turn, -1, -2)
    point = triangulate(pose, rows, weights)
    # Components first: numpy's inner loops are then over the observations, not over two cameras or three components.
    seen = np.ascontiguousarray(rows.reshape(-1, 2, 3).T)
    pixel, size = np.ascontiguousarray(weights[:, 0::2].T), np.ascontiguousarray(weights[:, 1::2].T)
    for _ in range(_POINT_STEPS):
        by_l, normal, pull, _, _, _ = _point_information(pose, rotation_t, point, seen, pixel, size)
        step = -(_inverse_symmetric(normal) @ pull[:, :, None])[:, :, 0]
        # A far point could step behind the camera: limit the step to half its depth.
        limit = 0.5 * np.abs(point[:, 2]) / np.maximum(np.abs(step[:, 2]), 1e-300)
        point = point + step * np.minimum(1.0, limit)[:, None]
    by_l, normal, pull, pull_l, chi2, in_front = _point_information(pose, rotation_t, point, seen, pixel, size)
    gain = by_l @ _inverse_symmetric(normal)
    information = by_l - gain @ by_l
    gradient = pull_l - (gain @ pull[:, :, None])[:, :, 0]
    # A step moves the point relative to l, in k's axes, by -hat(point - centre) rotationᵀ turn - shift.
    by_pose = np.empty((len(rows), 3, 6))
    by_pose[:, :, :3] = so3.hat(pose.centre - point) @ rotation_t
    by_pose[:, :, 3:] = -_EYE
    turned = by_pose.transpose(0, 2, 1)
    return LinearisedObservations(
        turned @ information @ by_pose, (turned @ gradient[:, :, None])[:, :, 0], chi2, in_front
    )


def _point_information(
    pose: RelativeTransform, rotation_t: Floats, point: Floats, seen: Floats, pixel: Floats, size: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats, Bools]:
    """Information (n, 3, 3) of the points from l and from both, gradients (n, 3) from both and from l, chi2, in_front.

    All in k's axes. seen: (3, 2, n); pixel, size: weights (2, n).
    """
    n = len(point)
    local = np.empty((3, 2, n))
    local[:, 0] = point.T
    local[:, 1] = _rotate_rows(point - pose.centre, rotation_t).T
    floor = _MIN_DEPTH_SHARE * np.abs(local).max(axis=0) + 1e-12
    in_front = (local[2] > floor).all(axis=0)
    safe = np.maximum(local[2], floor)
    over = 1.0 / safe
    normalised = local[:2] * over
    a, b = over * pixel, over * size
    off = (normalised - seen[:2]) * pixel
    far = (np.log(safe) + seen[2]) * -size
    pull = np.empty((3, 2, n))
    pull[:2] = off * a
    pull[2] = -(pull[:2] * normalised).sum(axis=0) - b * far
    information = np.zeros((2, n, 3, 3))
    square = a * a
    information[:, :, 0, 0] = information[:, :, 1, 1] = square
    aslant = normalised * -square
    information[:, :, 0, 2] = information[:, :, 2, 0] = aslant[0]
    information[:, :, 1, 2] = information[:, :, 2, 1] = aslant[1]
    information[:, :, 2, 2] = b * b - (aslant * normalised).sum(axis=0)
    by_l = rotation_t @ information[1] @ pose.rotation
    pull_l = _rotate_rows(pull[:, 1].T, pose.rotation)
    chi2 = (off * off).sum(axis=(0, 1)) + (far * far).sum(axis=0)
    return by_l, information[0] + by_l, pull[:, 0].T + pull_l, pull_l, chi2, np.asarray(in_front)


def _inverse_symmetric(m: Floats) -> Floats:
    """Inverses (n, 3, 3) of symmetric matrices (n, 3, 3) by cofactors; the determinant is bounded from below."""
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
