"""Camera model of the tracker: pixels to normalised coordinates and back, finite everywhere; homographies."""

from __future__ import annotations

import cv2
import numpy as np

from protocols.geometry import kernels
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats


class ImagePlane:
    """Maps pixels (n, 2) to normalised coordinates (n, 2).

    With intrinsics these are the undistorted x/z, y/z. Without them they are pixels from the image centre in units
    of the longer side.
    """

    def __init__(self, size: tuple[int, int], lens: Intrinsics | None) -> None:
        self.width, self.height = size
        self.lens = lens
        if lens is None:
            longer = float(max(size))
            centre = [(self.width - 1) / 2.0, (self.height - 1) / 2.0]
            self.matrix: Floats = np.array([[longer, 0.0, centre[0]], [0.0, longer, centre[1]], [0.0, 0.0, 1.0]])
        else:
            self.matrix = np.asarray(lens.matrix, dtype=np.float64)
        self.distorted = lens is not None and (lens.fisheye or bool(np.any(lens.distortions)))
        self.focal = float(0.5 * (self.matrix[0, 0] + self.matrix[1, 1]))
        self._inverse = np.linalg.inv(self.matrix)
        x, y = self.width - 1.0, self.height - 1.0
        self.corners: Floats = np.array([[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]])
        """Pixels (4, 2), clockwise."""
        self._valid_radius = np.inf  # of the distortion model, normalised: 1.3 times that of the corners
        if self.distorted:
            radius = np.hypot(*self.normalise(self.corners).T)
            self._valid_radius = 1.3 * float(np.nanmax(radius)) if np.isfinite(radius).any() else 1.0

    def normalise(self, pixels: Floats) -> Floats:
        """Normalised coordinates (n, 2) of pixels (n, 2); NaN where the distortion model has no inverse."""
        if self.distorted and self.lens is not None:
            return self.lens.unproject(pixels)
        m = self._inverse
        return np.asarray(pixels @ m[:2, :2].T + m[:2, 2])

    @property
    def compiled(self) -> bool:
        """Whether the kernels project as this lens does."""
        return kernels.AVAILABLE and not (self.lens is not None and self.lens.fisheye)

    def kernel_arguments(self, matrix: Floats) -> tuple[Floats, Floats, Floats | None, float, float]:
        """What the kernels take of a camera with homography ``matrix`` (3, 3), normalised from ground."""
        coefficients, fold = (None, np.inf) if self.lens is None else (self.lens.distortions, self.lens.fold)
        return np.ascontiguousarray(matrix), self.matrix, coefficients, fold, self._valid_radius

    def project(self, matrix: Floats, ground: Floats) -> Floats:
        """Pixels (n, 2) of ground points (n, 2) by a homography (3, 3), normalised from ground; NaN behind the camera.

        Beyond the valid radius the distortion polynomial is not calibrated: there it stays what it is at that radius,
        which keeps the map continuous.
        """
        if self.compiled:
            out, ground = np.empty((len(ground), 2)), np.ascontiguousarray(ground, dtype=np.float64)
            kernels.call("ground_pixels", *self.kernel_arguments(matrix), len(out), ground, out)
            return out
        normalised = apply_homography(matrix, ground)
        pinhole = self._pinhole(normalised)
        if not self.distorted or self.lens is None:
            return pinhole
        distorted = self.lens.project_normalised(normalised)
        radius = np.maximum(np.hypot(normalised[:, 0], normalised[:, 1]), 1e-9)
        at = normalised * (self._valid_radius / radius)[:, None]
        shift = self.lens.project_normalised(at) - self._pinhole(at)
        valid = np.isfinite(distorted) & (radius <= self._valid_radius)[:, None]
        return np.where(valid, distorted, pinhole + np.where(np.isfinite(shift), shift, 0.0))

    def _pinhole(self, normalised: Floats) -> Floats:
        return np.asarray(normalised @ self.matrix[:2, :2].T + self.matrix[:2, 2])

    def inside(self, pixels: Floats, margin: float = 0.0) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Which pixels (n, 2) lie in the image, at least ``margin`` from its border."""
        half = 0.5 * np.array([self.width - 1.0, self.height - 1.0])
        distance = np.abs(pixels - half)
        return np.asarray((distance[:, 0] <= half[0] - margin) & (distance[:, 1] <= half[1] - margin))


def inverse(matrix: Floats) -> Floats:
    """The inverse (3, 3). Raises numpy.linalg.LinAlgError."""
    determinant, found = cv2.invert(matrix)  # in a seventh of numpy's time
    if not determinant:
        raise np.linalg.LinAlgError("a singular matrix has no inverse")
    return np.asarray(found, dtype=np.float64)


def apply_homography(matrix: Floats, points: Floats) -> Floats:
    """Points (n, 2) mapped by a homography (3, 3); NaN where they are not in front (third coordinate <= 0)."""
    p = points @ matrix[:, :2].T + matrix[:, 2]
    z = np.where(p[:, 2] > 1e-9, p[:, 2], np.nan)
    return np.asarray(p[:, :2] / z[:, None])
