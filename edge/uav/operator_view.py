"""The operator's video overlay: same size as the camera image, so that a box drawn on it is a box of that image."""

from __future__ import annotations

import cv2
import numpy as np

from edge.uav.base import Estimate, TrackState
from protocols.geometry.types import Image

_COLOURS = {TrackState.VISIBLE: (80, 220, 80), TrackState.COASTING: (0, 170, 255), TrackState.LOST: (60, 60, 230)}
_PARTICLE = (230, 120, 200)  # BGR
_MAX_PARTICLES = 150  # drawn
_ARROW_MARGIN_PX = 14.0  # from the border to the tip of the arrow that points to a target outside the image


def draw(image: Image, estimate: Estimate | None, line: str) -> Image:
    """A copy (h, w, 3) with the estimate drawn on it, an arrow if it lies outside the image, and one line of text."""
    out = image.copy()
    height, width = out.shape[:2]
    colour = (220, 220, 220) if estimate is None else _COLOURS[estimate.state]
    if estimate is not None and estimate.state is not TrackState.LOST and np.isfinite([estimate.x, estimate.y]).all():
        _draw_particles(out, estimate)
        x, y = estimate.x, estimate.y
        if 0 <= x < width and 0 <= y < height:
            half = 0.5 * np.nan_to_num(np.array([estimate.width, estimate.height]), nan=20.0)
            low = np.clip(np.array([x, y]) - half, -1e4, 1e4).astype(int)
            high = np.clip(np.array([x, y]) + half, -1e4, 1e4).astype(int)
            cv2.rectangle(out, (int(low[0]), int(low[1])), (int(high[0]), int(high[1])), colour, 2, cv2.LINE_AA)
            if estimate.state is TrackState.COASTING and np.isfinite(estimate.std):
                radius = int(np.clip(2.0 * estimate.std, 3.0, 2.0 * max(width, height)))
                cv2.circle(out, (int(x), int(y)), radius, colour, 1, cv2.LINE_AA)
        else:
            _draw_arrow(out, x, y, colour)
    cv2.putText(out, line, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(out, line, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, 1, cv2.LINE_AA)
    return out


def _draw_particles(out: Image, estimate: Estimate) -> None:
    if estimate.particles is None or estimate.state is TrackState.VISIBLE:
        return
    points = estimate.particles[:: max(1, len(estimate.particles) // _MAX_PARTICLES)]
    height, width = out.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = (points > 0).all(axis=1) & (points[:, 0] < width - 1) & (points[:, 1] < height - 1)
    x, y = points[inside].astype(np.int64).T
    out[y, x] = _PARTICLE


def _draw_arrow(out: Image, x: float, y: float, colour: tuple[int, int, int]) -> None:
    """Draw an arrow at the border that points to a position outside the image."""
    height, width = out.shape[:2]
    centre = np.array([0.5 * width, 0.5 * height])
    direction = np.array([x, y]) - centre
    fraction = float(np.min((centre - _ARROW_MARGIN_PX) / np.maximum(np.abs(direction), 1e-6)))
    tip, tail = (
        centre + fraction * direction,
        centre + (fraction - 40.0 / max(float(np.hypot(*direction)), 1.0)) * direction,
    )
    start, end = (int(tail[0]), int(tail[1])), (int(tip[0]), int(tip[1]))
    cv2.arrowedLine(out, start, end, colour, 3, cv2.LINE_AA, tipLength=0.4)
