"""The adjustment of cameras around rigid bodies: its fixed quantities and its estimated ones.

Bodies move on a cubic spline, or have one pose an instant on a shared clock. A control point is a position (3) and a
quaternion (4) of any norm; both are interpolated linearly in the control points, and the quaternion is normalised
where it is used, so that rotations of any size have no singularity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.bundle.problem import CameraState, Column
from hub.calibration.rigid_body.lag import rotations
from hub.calibration.rigid_body.views import CameraViews
from hub.trajectory.discrete import PointBasis
from hub.trajectory.splines import SplineBasis, fit_spline
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.calibration import AdjustmentStep

_SHAPE_START = 2e-3  # of the distance of neighbouring points: of a print on paper
_JITTER_START = 0.1  # of a frame interval

POSE = 7
"""Parameters of a control point: x, y, z, and the quaternion w, x, y, z."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyProblem:
    """Fixed quantities of the adjustment, by camera.

    views: what was seen. nominal: prior means of the lenses. free_lens: whether it is estimated. fixed: whether the
    camera's pose is given. reference: the camera that fixes clock and, where no pose is given, the world. clock:
    whether clocks are estimated. free_readout: whether the readout of its rows is estimated. use: rows that fit.
    free_shape: whether the body's points are estimated, with the described ones as prior means.
    """

    views: tuple[CameraViews, ...]
    nominal: tuple[Intrinsics, ...]
    free_lens: tuple[bool, ...]
    fixed: tuple[bool, ...]
    reference: int
    clock: bool
    free_readout: tuple[bool, ...]
    use: tuple[Bools, ...]
    free_shape: bool = False

    def columns(self, camera: int) -> list[int]:
        """The free parameters of a camera, as in ``hub.bundle.problem``."""
        out: list[int] = []
        if not self.fixed[camera] and (camera != self.reference or any(self.fixed)):
            out += range(6)
        if self.clock and camera != self.reference:
            out += [Column.OFFSET, Column.RATE]
        if self.clock and self.free_readout[camera]:
            out.append(Column.READOUT)
        if self.free_lens[camera]:
            out += Column.LENS[: 7 if self.nominal[camera].fisheye else None]
        return out


@dataclass(frozen=True, slots=True, eq=False)
class BodyState:
    """All estimated quantities. shift: by camera, time error (V,) of each view [s]. sigma: (cameras,) noise [px].
    jitter: (cameras,) std of the time errors [s], 0 = none. shape: (labels, 3) true points of the bodies less the
    described ones; shape_std: (3,) their prior stds by axis. scatter: by body, stds (7,) of the path's third
    differences; None on a shared clock."""

    cameras: tuple[CameraState, ...]
    bodies: tuple[BodyMotion, ...]
    shift: tuple[Floats, ...]
    sigma: Floats
    jitter: Floats
    shape: Floats
    shape_std: Floats
    scatter: tuple[Floats | None, ...] = ()
    steps: tuple[AdjustmentStep, ...] = ()


def initial_jitter(problem: BodyProblem) -> Floats:
    """Prior stds (cameras,) of the time errors [s] before they are estimated."""
    return np.array(
        [_JITTER_START * frame_interval(views) if problem.clock else 0.0 for views in problem.views], dtype=np.float64
    )


def frame_interval(views: CameraViews) -> float:
    """Median time between the views of a body [s]."""
    steps = np.diff(views.time)[np.diff(views.body) == 0]
    return float(np.median(steps)) if len(steps) else 1.0


def pitch(problem: BodyProblem) -> float:
    """Median distance of a body's described points from the nearest other one."""
    points = np.unique(np.concatenate([views.points for views in problem.views]), axis=0)
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(axis=1)))


def initial_shape(problem: BodyProblem, labels: int) -> tuple[Floats, Floats]:
    """No errors (labels, 3) of the points, and their prior stds (3,) before they are estimated."""
    return np.zeros((labels, 3)), np.full(3, _SHAPE_START * pitch(problem))


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
