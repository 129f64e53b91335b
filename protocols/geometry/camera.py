"""Camera intrinsics: pinhole with OpenCV's distortion, and OpenCV's fisheye model; the bias of a sphere's contour.

Camera axes: x right, y down, z forward. Pixels are OpenCV's: (0, 0) is the centre of the top-left
pixel. ``normalised`` coordinates are (x/z, y/z) without distortion.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from protocols.geometry import kernels
from protocols.geometry.types import Floats

_MAX_TAN_HALF_ANGLE = 0.3  # tan of half the sphere's angular diameter; beyond it the camera is next to the sphere
_CONTOUR_ANGLES = 2.0 * np.pi * np.arange(24) / 24
_IN_CAMERA_AXES = np.eye(3), np.zeros(3)
_NEWTON_STEPS = 20  # a bound: it converges quadratically
_NEWTON_TOLERANCE = 1e-12  # normalised: 1e-9 px
_MAX_NORMALISED = 100.0  # in normalised coordinates: 89.4 degrees off the axis


@dataclass(frozen=True, slots=True, eq=False)
class Intrinsics:
    """Lens and sensor of one camera.

    width, height: image size [px].
    matrix: (3, 3) camera matrix [px].
    distortions: (5,) k1, k2, p1, p2, k3 of the pinhole model, or (4,) k1..k4 of the fisheye model.
    """

    width: int
    height: int
    matrix: Floats
    distortions: Floats = field(default_factory=lambda: np.zeros(5))
    fisheye: bool = False
    fold: float = field(init=False, default=float("inf"))
    """Radius up to which the radial distortion is monotonic: normalised radius, for fisheye the angle [rad].

    Points beyond it are not projected."""

    def __post_init__(self) -> None:
        if not self.fisheye and len(self.distortions) == 4:  # OpenCV's short form: k3 = 0
            object.__setattr__(self, "distortions", np.r_[self.distortions, 0.0])
        radial = self.distortions if self.fisheye else self.distortions[[0, 1, 4]]
        slope = np.r_[1.0, radial * (3.0 + 2.0 * np.arange(len(radial)))]
        object.__setattr__(self, "fold", _first_fold(slope))

    def table(self) -> dict[str, Any]:
        """Its keys in rig.toml."""
        fisheye = {"fisheye": True} if self.fisheye else {}
        size = [self.width, self.height]
        return {"size": size, "matrix": self.matrix.tolist(), "distortions": self.distortions.tolist(), **fisheye}

    def message_fields(self) -> dict[str, Any]:
        """Its fields in bus messages, besides the image size."""
        return {
            "matrix": self.matrix.ravel().tolist(),
            "distortions": self.distortions.tolist(),
            "fisheye": self.fisheye,
        }

    @classmethod
    def of_message(cls, message: Any, size: tuple[int, int] | None = None) -> Intrinsics | None:
        """Those in a bus message with matrix, distortions and fisheye; None where it has none.

        size: (width, height) of the images [px], where the message does not hold it.
        """
        if len(message.matrix) != 9:
            return None
        width, height = (message.width, message.height) if size is None else size
        zeros = np.zeros(4 if message.fisheye else 5)
        distortions = np.array(message.distortions) if message.distortions else zeros
        return cls(width, height, np.array(message.matrix).reshape(3, 3), distortions, message.fisheye)

    @property
    def focal(self) -> float:
        """Mean focal length [px]: pixels per radian on the optical axis."""
        return float(0.5 * (self.matrix[0, 0] + self.matrix[1, 1]))

    @property
    def is_portrait(self) -> bool:
        """Whether the image is higher than wide: turned by 90°, as sensors have long rows."""
        return self.height > self.width

    def row_offset(self, pixels: Floats) -> Floats:
        """The sensor's row (n,) of pixels (n, 2) relative to its middle: -0.5 in the first one, 0.5 in the last.

        Of a portrait image the sensor's rows are the columns.
        """
        last = max(min(self.width, self.height) - 1, 1)
        return np.asarray(np.clip(pixels[:, 0 if self.is_portrait else 1], 0, last) / last - 0.5)

    def project(self, points: Floats) -> Floats:
        """Distorted pixels (n, 2) of points (n, 3) in camera axes; NaN where z <= 0 (pinhole) or beyond the fold."""
        points = np.asarray(points, dtype=np.float64)
        if self.fisheye:
            return self._to_pixels(self._distort_fisheye(points))
        if kernels.AVAILABLE:
            lens, every = (self.matrix, self.distortions, self.fold), np.ones(len(points), dtype=np.bool_)
            _, _, pixels, _, seen = kernels.project_points(points, _IN_CAMERA_AXES, lens, every)
            pixels[:, ~seen] = np.nan
            return pixels.T
        z = points[:, 2]
        safe = np.where(z > 0, z, np.nan)
        normalised = points[:, :2] / safe[:, None]
        with np.errstate(invalid="ignore"):
            inside = np.hypot(normalised[:, 0], normalised[:, 1]) < self.fold
        return self._to_pixels(np.where(inside[:, None], self.distort(normalised)[0], np.nan))

    def project_normalised(self, normalised: Floats) -> Floats:
        """Distorted pixels (n, 2) of undistorted normalised coordinates (n, 2)."""
        return self.project(np.column_stack([normalised, np.ones(len(normalised))]))

    def unproject(self, pixels: Floats) -> Floats:
        """Undistorted normalised coordinates (n, 2) of distorted pixels (n, 2).

        NaN where the lens model has no inverse (far outside the image, where it folds over).
        """
        pixels = np.asarray(pixels, dtype=np.float64)
        a = self.matrix
        y = (pixels[:, 1] - a[1, 2]) / a[1, 1]
        x = (pixels[:, 0] - a[0, 2] - a[0, 1] * y) / a[0, 0]
        distorted = np.column_stack([x, y])
        # Points that far off the axis are outside every image and would only overflow.
        distorted[~(np.abs(distorted).max(axis=1) < _MAX_NORMALISED)] = np.nan
        if self.fisheye:
            return self._undistort_fisheye(distorted)
        return self._undistort(distorted)

    def distort(self, normalised: Floats) -> tuple[Floats, Floats]:
        """Brown's distortion of the pinhole model.

        normalised: (n, 2). Returns the distorted coordinates (n, 2) and their Jacobian (n, 2, 2).
        """
        if kernels.AVAILABLE:
            out, jacobian = kernels.brown_distortion(normalised, self.distortions)
            return out.T, jacobian.transpose(2, 0, 1)
        k1, k2, p1, p2, k3 = self.distortions
        x, y = normalised[:, 0], normalised[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)  # d radial / d r2
        # Stored coordinate by coordinate: numpy is slow along axes of two.
        out, jacobian = np.empty((2, len(normalised))), np.empty((2, 2, len(normalised)))
        out[0] = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        out[1] = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        jacobian[0, 1] = jacobian[1, 0] = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        jacobian[0, 0] = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        jacobian[1, 1] = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        return out.T, jacobian.transpose(2, 0, 1)

    def pixel_jacobian(self, normalised: Floats) -> Floats:
        """Derivative (n, 2, 2) of distorted pixels by undistorted normalised coordinates (n, 2)."""
        if self.fisheye:
            step = 1e-6
            columns = []
            for axis in np.eye(2):
                ahead = self.project_normalised(normalised + step * axis)
                behind = self.project_normalised(normalised - step * axis)
                columns.append((ahead - behind) / (2 * step))
            return np.stack(columns, axis=-1)
        return np.asarray(self.matrix[:2, :2] @ self.distort(normalised)[1])

    def _to_pixels(self, distorted: Floats) -> Floats:
        return np.asarray(distorted @ self.matrix[:2, :2].T + self.matrix[:2, 2])

    def _undistort(self, distorted: Floats) -> Floats:
        """Newton's method on ``distort``; converges in a few steps inside the image."""
        estimate = distorted.copy()
        if not np.any(self.distortions):
            return estimate
        for _ in range(_NEWTON_STEPS):
            value, jacobian = self.distort(estimate)
            error = value - distorted
            determinant = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
            determinant = np.where(np.abs(determinant) > 1e-9, determinant, np.nan)
            step_x = (jacobian[:, 1, 1] * error[:, 0] - jacobian[:, 0, 1] * error[:, 1]) / determinant
            step_y = (jacobian[:, 0, 0] * error[:, 1] - jacobian[:, 1, 0] * error[:, 0]) / determinant
            step = np.column_stack([step_x, step_y])
            estimate = estimate - step
            if not np.nanmax(np.abs(step), initial=0.0) > _NEWTON_TOLERANCE:
                break
        value, _ = self.distort(estimate)
        # A root beyond the monotonic range of the polynomial is not the inverse.
        with np.errstate(invalid="ignore"):
            good = (np.abs(value - distorted).max(axis=1) < 1e-9) & (np.hypot(*estimate.T) < self.fold)
        return np.where(good[:, None], estimate, np.nan)

    def _distort_fisheye(self, points: Floats) -> Floats:
        radius = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(radius, points[:, 2])
        t2 = theta * theta
        k1, k2, k3, k4 = self.distortions
        bent = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        bent = np.where(theta < self.fold, bent, np.nan)
        on_axis = 1.0 / np.where(points[:, 2] > 0, points[:, 2], np.nan)
        scale = np.where(radius > 1e-12, bent / np.where(radius > 1e-12, radius, 1.0), on_axis)
        return np.asarray(points[:, :2] * scale[:, None])

    def _undistort_fisheye(self, distorted: Floats) -> Floats:
        bent = np.hypot(distorted[:, 0], distorted[:, 1])
        k1, k2, k3, k4 = self.distortions
        theta = bent.copy()
        for _ in range(_NEWTON_STEPS):
            t2 = theta * theta
            value = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - bent
            slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
            theta = theta - value / np.where(slope > 1e-6, slope, np.nan)
        with np.errstate(invalid="ignore"):
            again = theta * (1.0 + theta**2 * (k1 + theta**2 * (k2 + theta**2 * (k3 + theta**2 * k4))))
            good = (theta >= 0) & (theta < min(np.pi / 2 - 1e-3, self.fold)) & (np.abs(again - bent) < 1e-9)
        scale = np.where(bent > 1e-12, np.tan(theta) / np.where(bent > 1e-12, bent, 1.0), 1.0)
        return np.where(good[:, None], distorted * scale[:, None], np.nan)


def _first_fold(slope: Floats) -> float:
    """Radius up to which a radial distortion is monotonic: the first positive zero of its derivative.

    slope: coefficients of 1, r², r⁴, … of the derivative. inf where it is always monotonic.
    """
    slope = np.where(np.abs(slope) > 1e-12, slope, 0.0)
    roots = np.roots(np.trim_zeros(slope[::-1], "f"))
    real = roots[(np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1.0)) & (roots.real > 0)].real
    return float(np.sqrt(real.min())) if len(real) else float("inf")


def outline_to_centre(outlines: Floats, sizes: Floats, lens: Intrinsics) -> Floats:
    """Projections (n, 2) of spheres' centres from the centroids (n, 2) [px] of their contours.

    The viewing cone tangent to the sphere is projected through the whole lens model, not its linearisation: a pinhole
    camera sees an ellipse whose centre lies farther from the principal point than the sphere's centre; barrel
    distortion reduces this bias, and a fisheye removes nearly all of it. sizes: (n,) diameters of the discs of equal
    area [px]. Points without a size, outside the lens model's range or with a very large sphere are not changed.
    """
    outlines = np.asarray(outlines, dtype=np.float64)
    flat = lens.unproject(outlines)
    known = np.isfinite(flat).all(axis=1) & np.isfinite(sizes)
    flat = np.where(known[:, None], flat, 0.0)
    towards = np.column_stack([flat, np.ones(len(flat))])
    secant = np.linalg.norm(towards, axis=1)
    slope = np.abs(np.linalg.det(lens.pixel_jacobian(flat)))
    # A small solid angle w has the area sec³ w in normalised coordinates.
    spread = 0.5 * np.where(known, sizes, 0.0) / np.sqrt(np.maximum(slope, 1e-12) * secant**3)  # tan of half the angle
    known &= spread < _MAX_TAN_HALF_ANGLE
    towards /= secant[:, None]
    across = np.column_stack([np.ones(len(flat)), np.zeros(len(flat)), -flat[:, 0]])
    across /= np.hypot(1.0, flat[:, 0])[:, None]
    along = np.cross(towards, across)
    rim = towards[:, None] + spread[:, None, None] * (
        np.cos(_CONTOUR_ANGLES)[:, None] * across[:, None] + np.sin(_CONTOUR_ANGLES)[:, None] * along[:, None]
    )
    rim = lens.project(rim.reshape(-1, 3)).reshape(len(flat), len(_CONTOUR_ANGLES), 2) - outlines[:, None]
    known &= np.isfinite(rim).all(axis=(1, 2))
    following = np.roll(rim, -1, axis=1)
    area = rim[:, :, 0] * following[:, :, 1] - rim[:, :, 1] * following[:, :, 0]
    known &= area.sum(axis=1) > 0.0
    weight = area / np.where(known, 3.0 * area.sum(axis=1), 1.0)[:, None]
    moved = outlines - (weight[:, :, None] * (rim + following)).sum(axis=1)
    return np.asarray(np.where(known[:, None], moved, outlines))
