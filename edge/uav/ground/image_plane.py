"""Camera model of the tracker: pixels to normalised coordinates and back, finite everywhere; homographies."""

from __future__ import annotations

import numpy as np

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

    def normalise(self, pixels: Floats) -> Floats:
        """Normalised coordinates (n, 2) of pixels (n, 2); NaN where the distortion model has no inverse."""
        if self.distorted and self.lens is not None:
            return self.lens.unproject(pixels)
        m = self._inverse
        return np.asarray(pixels @ m[:2, :2].T + m[:2, 2])

    def pixels(self, normalised: Floats) -> Floats:
        """Pixels (n, 2); far outside the image, where a distortion model folds over, pinhole projection."""
        m = self.matrix
        pinhole = np.asarray(normalised @ m[:2, :2].T + m[:2, 2])
        if not self.distorted or self.lens is None:
            return pinhole
        distorted = self.lens.project_normalised(normalised)
        # Beyond the corners the distortion polynomial is not calibrated: continue with the pinhole model there.
        outside = np.hypot(normalised[:, 0], normalised[:, 1]) > self._valid_radius
        return np.where(
            np.isfinite(distorted) & ~outside[:, None], distorted, pinhole + self._distortion_at_limit(normalised)
        )

    def inside(self, pixels: Floats, margin: float = 0.0) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Which pixels (n, 2) lie in the image, at least ``margin`` from its border."""
        x, y = pixels[:, 0], pixels[:, 1]
        with np.errstate(invalid="ignore"):
            return np.asarray(
                (x >= margin) & (y >= margin) & (x <= self.width - 1 - margin) & (y <= self.height - 1 - margin)
            )

    @property
    def _valid_radius(self) -> float:
        """Normalised radius up to which the distortion model is used: 1.3 times that of the corners."""
        cached: float | None = getattr(self, "_valid_radius_value", None)
        if cached is None:
            corners = np.array(
                [[0, 0], [self.width - 1, 0], [0, self.height - 1], [self.width - 1, self.height - 1]], dtype=np.float64
            )
            found = self.normalise(corners)
            radius = np.hypot(found[:, 0], found[:, 1])
            cached = 1.3 * float(np.nanmax(radius)) if np.isfinite(radius).any() else 1.0
            self._valid_radius_value = cached
        return cached

    def _distortion_at_limit(self, normalised: Floats) -> Floats:
        """The distortion at the valid radius in the same direction, which keeps the map continuous."""
        assert self.lens is not None
        radius = np.maximum(np.hypot(normalised[:, 0], normalised[:, 1]), 1e-9)
        at = normalised * (self._valid_radius / radius)[:, None]
        m = self.matrix
        shift = self.lens.project_normalised(at) - (at @ m[:2, :2].T + m[:2, 2])
        return np.asarray(np.where(np.isfinite(shift), shift, 0.0))


def inverse(matrix: Floats) -> Floats:
    """The inverse (3, 3). Raises numpy.linalg.LinAlgError."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def apply_homography(matrix: Floats, points: Floats) -> Floats:
    """Points (n, 2) mapped by a homography (3, 3); NaN where they are not in front (third coordinate <= 0)."""
    p = points @ matrix[:, :2].T + matrix[:, 2]
    z = np.where(p[:, 2] > 1e-9, p[:, 2], np.nan)
    return np.asarray(p[:, :2] / z[:, None])
