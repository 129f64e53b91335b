"""Perspective bias of a sphere's contour: its centroid is not the projection of the sphere's centre."""

from __future__ import annotations

import numpy as np

from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

_MAX_TAN_HALF_ANGLE = 0.3  # tan of half the sphere's angular diameter; beyond it the camera is next to the sphere
_CONTOUR_ANGLES = 2.0 * np.pi * np.arange(24) / 24


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
