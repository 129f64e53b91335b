"""The motion of rigid bodies: poses on a cubic spline, or one pose an instant on a shared clock.

A control point is a position (3) and a quaternion (4) of any norm; both are interpolated linearly in the control
points, and the quaternion is normalised where it is used, so that rotations of any size have no singularity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.calibration.rigid_body.lag import rotations
from hub.trajectory.discrete import PointBasis
from hub.trajectory.splines import SplineBasis, fit_spline
from protocols.geometry.types import Bools, Floats, Ints

POSE = 7
"""Parameters of a control point: x, y, z, and the quaternion w, x, y, z."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyMotion:
    """One body's pose over the internal reference time. control: (size, 7), world from body."""

    basis: SplineBasis | PointBasis
    control: Floats

    def support(self, time: Floats) -> tuple[Ints, Floats, Floats, Bools]:
        """First control point (n,), weights of value and slope (n, 4), and whether the pose is defined (n,)."""
        return self.basis.weights_and_derivatives(time, 0.5)

    def at(self, time: Floats) -> tuple[Floats, Floats]:
        """Rotations (n, 3, 3), world from body, and positions (n, 3); NaN where not defined."""
        values = self.basis.evaluate(self.control, time)
        turn = np.where(np.isfinite(values[:, 3:]), values[:, 3:], [1.0, 0.0, 0.0, 0.0])
        return rotations(turn), values[:, :3]

    def points(self, time: Floats, point: Floats) -> Floats:
        """World positions (n, 3) of one point (3,) of the body; NaN where not defined."""
        turn, place = self.at(time)
        return np.asarray(place + turn @ point)


def fit_motion(basis: SplineBasis | PointBasis, time: Floats, turn: Floats, place: Floats) -> BodyMotion:
    """The motion nearest to poses at times (n,), robustly. turn: quaternions (n, 4) of consistent sign."""
    values = np.column_stack([place, turn])
    if isinstance(basis, PointBasis):
        index = basis.locate(time)[0]
        control = np.zeros((basis.size, POSE))
        for instant in range(len(basis.instants)):
            mine = values[index == instant]
            control[instant] = np.median(mine, axis=0) if len(mine) else values[0]
        control[len(basis.instants) :] = control[len(basis.instants) - 1]
        return BodyMotion(basis, control)
    weight, rows = np.ones(len(time)), basis.weights(time)
    control = fit_spline(basis, rows, values, weight, stiffness=1e-2)
    for _ in range(4):
        off = np.abs(basis.evaluate(control, time) - values)
        scale = np.maximum(1.4826 * np.median(off, axis=0), 1e-9)
        weight = 1.0 / (1.0 + ((off / (3.0 * scale)) ** 2).sum(axis=1))
        control = fit_spline(basis, rows, values, weight, stiffness=1e-2)
    return BodyMotion(basis, control)


def rotated(turn: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Points (n, 3) rotated by quaternions (n, 4) of any norm, and the derivative (n, 3, 4) by the quaternion."""
    norm = np.linalg.norm(turn, axis=1)
    unit = turn / norm[:, None]
    w, v = unit[:, :1], unit[:, 1:]
    cross = np.cross(v, points)
    out = points + 2.0 * w * cross + 2.0 * np.cross(v, cross)
    jacobian = np.empty((len(turn), 3, 4))
    jacobian[:, :, 0] = 2.0 * cross
    outer = points[:, :, None] * v[:, None, :]  # p vᵀ
    jacobian[:, :, 1:] = 2.0 * (
        (v * points).sum(axis=1)[:, None, None] * np.eye(3) + outer.transpose(0, 2, 1) - 2.0 * outer
    )
    jacobian[:, :, 1:] -= 2.0 * w[:, :, None] * cross_matrices(points)
    # A quaternion's length does not matter: only its part across it turns the body.
    along = np.einsum("nij,nj->ni", jacobian, unit)
    return out, (jacobian - along[:, :, None] * unit[:, None, :]) / norm[:, None, None]


def cross_matrices(v: Floats) -> Floats:
    """(n, 3, 3) matrices M with ``M w = v × w``."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - out.transpose(0, 2, 1)
