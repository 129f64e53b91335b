"""Where the camera is over the ground plane: as a pose of 6 degrees of freedom, or as a bare homography.

Both give ``matrix`` H (3, 3), normalised image from ground: m ~ H [X, Y, 1], third coordinate > 0 in front.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np

from protocols.geometry import so3
from protocols.geometry.types import Floats


class PlaneMotion(Protocol):
    """A camera over the plane that Gauss-Newton can move."""

    @property
    def matrix(self) -> Floats:
        """(3, 3), normalised image from ground."""
        ...

    def jacobian(self, ground: Floats, seen: Floats, depth: Floats) -> Floats:
        """Derivative (n, 2, k) of normalised coordinates by the parameters.

        ground: (n, 2) points; seen: (n, 2) their normalised coordinates; depth: (n,) third coordinates.
        """
        ...

    def moved(self, step: Floats) -> Self:
        """Moved by k parameters."""
        ...

    def continued(self, before: Self, ratio: float) -> Self:
        """What follows if the motion since ``before`` goes on, times ``ratio``."""
        ...

    def prior_std(self, seconds: float, scale: float) -> Floats:
        """(k,) std of the prediction. scale: typical distance to the ground [ground units]."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class PosePlane:
    """A calibrated camera: rotation (3, 3) camera from ground axes (X, Y, down), centre (3,).

    Parameters: rotation vector in camera axes [rad], centre [ground units].
    """

    rotation: Floats
    centre: Floats

    @property
    def matrix(self) -> Floats:
        """H = R [e1 e2 -C], with the camera matrix taken off."""
        out = self.rotation.copy()
        out[:, 2] = -(self.rotation @ self.centre)
        return out

    def jacobian(self, ground: Floats, seen: Floats, depth: Floats) -> Floats:
        """Rotation acts as delta x p, a shift of the centre as -R delta."""
        x, y = seen[:, 0], seen[:, 1]
        out = np.empty((len(seen), 2, 6))
        out[:, 0, 0], out[:, 1, 0] = -x * y, -1.0 - y * y
        out[:, 0, 1], out[:, 1, 1] = 1.0 + x * x, x * y
        out[:, 0, 2], out[:, 1, 2] = -y, x
        a = -self.rotation
        out[:, 0, 3:] = (a[0] - x[:, None] * a[2]) / depth[:, None]
        out[:, 1, 3:] = (a[1] - y[:, None] * a[2]) / depth[:, None]
        return out

    def moved(self, step: Floats) -> PosePlane:
        """exp(step[:3]) on the left of the rotation, step[3:] added to the centre."""
        return PosePlane(so3.exp(step[:3]) @ self.rotation, self.centre + step[3:])

    def continued(self, before: PosePlane, ratio: float) -> PosePlane:
        """Constant angular and linear velocity."""
        turn = so3.log(self.rotation @ before.rotation.T)
        return PosePlane(so3.exp(ratio * turn) @ self.rotation, self.centre + ratio * (self.centre - before.centre))

    def prior_std(self, seconds: float, scale: float) -> Floats:
        """Angular acceleration of a few rad/s², speed changing by 1/20 of the height a frame of 1/30 s."""
        steps = max(seconds * 30.0, 0.3)
        return np.asarray(steps * np.r_[np.full(3, 0.02), np.full(3, 0.01 * scale)])


_GENERATORS = np.array(
    [
        [[0, 0, 1], [0, 0, 0], [0, 0, 0]],  # shift
        [[0, 0, 0], [0, 0, 1], [0, 0, 0]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],  # turn
        [[1, 0, 0], [0, 1, 0], [0, 0, 0]],  # scale
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],  # shear
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 0, 0], [1, 0, 0]],  # perspective
        [[0, 0, 0], [0, 0, 0], [0, 1, 0]],
    ],
    dtype=np.float64,
)


@dataclass(frozen=True, slots=True, eq=False)
class ChainPlane:
    """An uncalibrated camera: the homography itself, 8 parameters on its left."""

    matrix: Floats

    def jacobian(self, ground: Floats, seen: Floats, depth: Floats) -> Floats:
        """d m = (G m)_xy - m (G m)_z for each generator G."""
        homogeneous = np.column_stack([seen, np.ones(len(seen))])
        moved = np.einsum("kij,nj->nik", _GENERATORS, homogeneous)
        return np.asarray(moved[:, :2] - seen[:, :, None] * moved[:, 2:3])

    def moved(self, step: Floats) -> ChainPlane:
        """(I + sum step_k G_k) H, with the third coordinate kept positive and of unit size."""
        matrix = (np.eye(3) + np.tensordot(step, _GENERATORS, 1)) @ self.matrix
        return ChainPlane(_unit(matrix))

    def continued(self, before: ChainPlane, ratio: float) -> ChainPlane:
        """The last frame-to-frame homography again, to first order times ``ratio``."""
        try:
            last = self.matrix @ np.linalg.inv(before.matrix)
        except np.linalg.LinAlgError:
            return self
        last = last / np.cbrt(np.linalg.det(last))
        step = np.eye(3) + ratio * (last - np.eye(3))
        return ChainPlane(_unit(step @ self.matrix))

    def prior_std(self, seconds: float, scale: float) -> Floats:
        """Shift and turn wide; shear and perspective of a flying camera change slowly."""
        steps = max(seconds * 30.0, 0.3)
        return steps * np.array([0.03, 0.03, 0.02, 0.02, 0.004, 0.004, 0.004, 0.004])


def _unit(matrix: Floats) -> Floats:
    """The same homography with determinant 1: m ~ H g, the sign of the depth kept."""
    return np.asarray(matrix / np.cbrt(np.linalg.det(matrix)))
