"""Rotations: the group SO(3) and its tangent space, batched over leading axes.

Convention: ``exp(w)`` turns by |w| radians about w; perturbations are on the left,
``R(w) = exp(w) @ R``.
"""

from __future__ import annotations

import math

import numpy as np

from protocols.geometry.types import Floats

_SMALL = 1e-4  # below, Taylor series: the next term is < 1e-17


def hat(w: Floats) -> Floats:
    """Skew matrices (…, 3, 3) of vectors (…, 3): ``hat(a) @ b == cross(a, b)``."""
    w = np.asarray(w, dtype=np.float64)
    if w.ndim == 1:  # the commonest by far, in a fifth of the time
        x, y, z = w.tolist()
        return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def exp(w: Floats) -> Floats:
    """Rotation matrices (…, 3, 3) of rotation vectors (…, 3) [rad]; Rodrigues' formula."""
    w = np.asarray(w, dtype=np.float64)
    if w.ndim == 1:
        return _exp_of_one(*w.tolist())
    angle2 = np.sum(w * w, axis=-1)
    angle = np.sqrt(angle2)
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle2 / 6.0, np.sin(safe) / safe)[..., None, None]
    b = np.where(small, 0.5 - angle2 / 24.0, (1.0 - np.cos(safe)) / (safe * safe))[..., None, None]
    k = hat(w)
    return np.asarray(np.eye(3) + a * k + b * (k @ k))


def _exp_of_one(x: float, y: float, z: float) -> Floats:
    """The same of one vector, in a tenth of the time."""
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    small = angle < _SMALL
    a = 1.0 - angle2 / 6.0 if small else math.sin(angle) / angle
    b = 0.5 - angle2 / 24.0 if small else (1.0 - math.cos(angle)) / angle2
    ax, ay, az, xy, xz, yz = a * x, a * y, a * z, b * x * y, b * x * z, b * y * z
    return np.array(
        [
            [1.0 - b * (y * y + z * z), xy - az, xz + ay],
            [xy + az, 1.0 - b * (x * x + z * z), yz - ax],
            [xz - ay, yz + ax, 1.0 - b * (x * x + y * y)],
        ]
    )


def quaternion(rotation: Floats) -> Floats:
    """Unit quaternion (4,) w, x, y, z, w >= 0, of one rotation matrix (3, 3), accurate at every angle.

    Shepperd's method: of the four rows, each a multiple of the quaternion, the one with the largest component.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.asarray(rotation, dtype=np.float64).tolist()
    x, y, z = zy - yz, xz - zx, yx - xy
    xy, xz, yz = xy + yx, xz + zx, yz + zy
    rows = (
        (1.0 + xx + yy + zz, x, y, z),
        (x, 1.0 + xx - yy - zz, xy, xz),
        (y, xy, 1.0 - xx + yy - zz, yz),
        (z, xz, yz, 1.0 - xx - yy + zz),
    )
    q = max(enumerate(rows), key=lambda row: row[1][row[0]])[1]
    return np.array(q) / math.copysign(math.hypot(*q), q[0])


def from_quaternion(q: Floats) -> Floats:
    """Rotation matrix (3, 3) of a quaternion (4,) w, x, y, z of any length but zero."""
    w, vector = float(q[0]), np.asarray(q[1:], dtype=np.float64)
    size = float(np.linalg.norm(vector))
    return exp(2.0 * np.arctan2(size, w) / max(size, 1e-300) * vector)


def log(rotation: Floats) -> Floats:
    """Rotation vector (3,) [rad], |w| <= pi, of one rotation matrix (3, 3)."""
    q = quaternion(rotation)
    w, x, y, z = q.tolist()
    sine = math.hypot(x, y, z)
    return np.asarray((2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, w) / sine) * q[1:])


def nearest(matrix: Floats) -> Floats:
    """The rotation matrix nearest to ``matrix`` (3, 3) in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    d = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return np.asarray((u * d) @ vt)


def angle_between(a: Floats, b: Floats) -> float:
    """Geodesic distance [rad] between two rotations ``a`` and ``b``, both (3, 3)."""
    return float(np.linalg.norm(log(a @ b.T)))


def rotation_between(a: Floats, b: Floats) -> Floats:
    """The rotation (3, 3) of smallest angle that maps direction ``a`` (3,) to direction ``b`` (3,)."""
    a = a / np.linalg.norm(a)
    b = b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        other = np.eye(3)[int(np.argmin(np.abs(a)))]
        axis = np.cross(a, other)
        return exp(np.pi * axis / np.linalg.norm(axis))
    return exp(np.arctan2(sine, cosine) * axis / sine)
