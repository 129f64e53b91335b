"""Camera pose over the ground plane: with 6 degrees of freedom (calibrated), or as a homography (uncalibrated).

Both give ``matrix`` H (3, 3), normalised image from ground: m ~ H [X, Y, 1], third coordinate > 0 in front.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np

from protocols.geometry import so3
from protocols.geometry.types import Floats


class PlaneCamera(Protocol):
    """A camera over the plane whose parameters Gauss-Newton optimises."""

    @property
    def matrix(self) -> Floats:
        """(3, 3), normalised image from ground."""

    def jacobian(self, ground: Floats, normalised: Floats, depth: Floats) -> Floats:
        """Derivative (n, 2, k) of normalised coordinates by the parameters.

        ground: (n, 2) points; normalised: (n, 2) their normalised coordinates; depth: (n,) third coordinates.
        """

    def retract(self, step: Floats) -> Self:
        """The camera changed by k local parameters."""

    def extrapolated(self, previous: Self, ratio: float) -> Self:
        """The camera if the motion since ``previous`` continues, times ``ratio``."""

    def prediction_std(self, seconds: float, scale: float) -> Floats:
        """(k,) std of the extrapolation. scale: typical distance to the ground [ground units]."""


@dataclass(frozen=True, slots=True, eq=False)
class PlanePose:
    """A calibrated camera: rotation (3, 3) camera from ground axes (X, Y, down), centre (3,).

    Parameters: rotation vector in camera axes [rad], centre [ground units].
    """

    rotation: Floats
    centre: Floats

    @property
    def matrix(self) -> Floats:
        """H = R [e1 e2 -C], without the camera matrix."""
        out = self.rotation.copy()
        out[:, 2] = -(self.rotation @ self.centre)
        return out

    def jacobian(self, ground: Floats, normalised: Floats, depth: Floats) -> Floats:
        """Derivative by a rotation vector, delta x p, and by a shift of the centre, -R delta."""
        x, y = normalised[:, 0], normalised[:, 1]
        out = np.empty((len(normalised), 2, 6))
        out[:, 0, 0], out[:, 1, 0] = -x * y, -1.0 - y * y
        out[:, 0, 1], out[:, 1, 1] = 1.0 + x * x, x * y
        out[:, 0, 2], out[:, 1, 2] = -y, x
        a = -self.rotation
        out[:, 0, 3:] = (a[0] - x[:, None] * a[2]) / depth[:, None]
        out[:, 1, 3:] = (a[1] - y[:, None] * a[2]) / depth[:, None]
        return out

    def retract(self, step: Floats) -> PlanePose:
        """exp(step[:3]) on the left of the rotation, step[3:] added to the centre."""
        return PlanePose(so3.exp(step[:3]) @ self.rotation, self.centre + step[3:])

    def extrapolated(self, previous: PlanePose, ratio: float) -> PlanePose:
        """Constant angular and linear velocity."""
        rotation_step = so3.log(self.rotation @ previous.rotation.T)
        return PlanePose(
            so3.exp(ratio * rotation_step) @ self.rotation, self.centre + ratio * (self.centre - previous.centre)
        )

    def prediction_std(self, seconds: float, scale: float) -> Floats:
        """Angular acceleration of a few rad/s², speed changing by 1/20 of the height a frame of 1/30 s."""
        steps = max(seconds * 30.0, 0.3)
        return steps * np.array(3 * [0.02] + 3 * [0.01 * scale])


_GENERATORS = np.array(
    [
        [[0, 0, 1], [0, 0, 0], [0, 0, 0]],  # translation
        [[0, 0, 0], [0, 0, 1], [0, 0, 0]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],  # rotation
        [[1, 0, 0], [0, 1, 0], [0, 0, 0]],  # scale
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],  # shear
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 0, 0], [1, 0, 0]],  # perspective
        [[0, 0, 0], [0, 0, 0], [0, 1, 0]],
    ],
    dtype=np.float64,
)


@dataclass(frozen=True, slots=True, eq=False)
class PlaneHomography:
    """An uncalibrated camera: a homography with 8 parameters, the generators of SL(3) applied on its left."""

    matrix: Floats

    def jacobian(self, ground: Floats, normalised: Floats, depth: Floats) -> Floats:
        """d m = (G m)_xy - m (G m)_z for each generator G."""
        homogeneous = np.column_stack([normalised, np.ones(len(normalised))])
        moved = np.einsum("kij,nj->nik", _GENERATORS, homogeneous)
        return np.asarray(moved[:, :2] - normalised[:, :, None] * moved[:, 2:3])

    def retract(self, step: Floats) -> PlaneHomography:
        """(I + sum step_k G_k) H, with the third coordinate kept positive and of unit size."""
        matrix = (np.eye(3) + np.tensordot(step, _GENERATORS, 1)) @ self.matrix
        return PlaneHomography(_unit_determinant(matrix))

    def extrapolated(self, previous: PlaneHomography, ratio: float) -> PlaneHomography:
        """The last frame-to-frame homography repeated, to first order times ``ratio``."""
        try:
            last = self.matrix @ np.linalg.inv(previous.matrix)
        except np.linalg.LinAlgError:
            return self
        last = last / np.cbrt(np.linalg.det(last))
        step = np.eye(3) + ratio * (last - np.eye(3))
        return PlaneHomography(_unit_determinant(step @ self.matrix))

    def prediction_std(self, seconds: float, scale: float) -> Floats:
        """Wide for translation and rotation; shear and perspective of a flying camera change slowly."""
        steps = max(seconds * 30.0, 0.3)
        return steps * np.array([0.03, 0.03, 0.02, 0.02, 0.004, 0.004, 0.004, 0.004])


def _unit_determinant(matrix: Floats) -> Floats:
    """The same homography with determinant 1: m ~ H g; the sign of the depth is kept."""
    return np.asarray(matrix / np.cbrt(np.linalg.det(matrix)))
