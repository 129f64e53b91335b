"""A ball's picture: the centre of its outline is not the projection of its centre."""

from __future__ import annotations

import numpy as np

from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

_WIDEST = 0.3  # tan of half a ball's angle: beyond, a camera stands next to it
_TURN = 2.0 * np.pi * np.arange(24) / 24


def outline_to_centre(outlines: Floats, sizes: Floats, lens: Intrinsics) -> Floats:
    """From centres (n, 2) [px] of balls' outlines to the projections (n, 2) of the balls' centres.

    The cone around a ball goes through the whole lens, not through its slope alone: a pinhole's picture of it is an
    ellipse whose centre lies farther out than the ball's, barrel distortion takes some of that back, and a fisheye
    nearly all of it. sizes: (n,) diameters of the discs of equal area [px]. What has no size, is beyond the lens or
    fills the picture stays where it is.
    """
    outlines = np.asarray(outlines, dtype=np.float64)
    flat = lens.unproject(outlines)
    known = np.isfinite(flat).all(axis=1) & np.isfinite(sizes)
    flat = np.where(known[:, None], flat, 0.0)
    towards = np.column_stack([flat, np.ones(len(flat))])
    secant = np.linalg.norm(towards, axis=1)
    slope = np.abs(np.linalg.det(lens.pixel_jacobian(flat)))
    # A small solid angle w is sec³ w in normalised coordinates.
    spread = 0.5 * np.where(known, sizes, 0.0) / np.sqrt(np.maximum(slope, 1e-12) * secant**3)  # tan of half the angle
    known &= spread < _WIDEST
    towards /= secant[:, None]
    across = np.column_stack([np.ones(len(flat)), np.zeros(len(flat)), -flat[:, 0]])
    across /= np.hypot(1.0, flat[:, 0])[:, None]
    along = np.cross(towards, across)
    rim = towards[:, None] + spread[:, None, None] * (
        np.cos(_TURN)[:, None] * across[:, None] + np.sin(_TURN)[:, None] * along[:, None]
    )
    rim = lens.project(rim.reshape(-1, 3)).reshape(len(flat), len(_TURN), 2) - outlines[:, None]
    known &= np.isfinite(rim).all(axis=(1, 2))
    following = np.roll(rim, -1, axis=1)
    area = rim[:, :, 0] * following[:, :, 1] - rim[:, :, 1] * following[:, :, 0]
    known &= area.sum(axis=1) > 0.0
    weight = area / np.where(known, 3.0 * area.sum(axis=1), 1.0)[:, None]
    moved = outlines - (weight[:, :, None] * (rim + following)).sum(axis=1)
    return np.asarray(np.where(known[:, None], moved, outlines))
