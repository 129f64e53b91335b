"""The overlay video of `track`, on a canvas larger than the image that also shows estimates out of view."""

from __future__ import annotations

import cv2
import numpy as np

from deploy.offline.track import TrackedFrame
from edge.uav.base import TrackState
from protocols.geometry.types import Floats, Image

_MARGIN = 0.5  # fraction of the image size added on each side
_MAX_CANVAS_PX = 1280  # side of the overlay's picture: fits a screen
_COLOURS = {TrackState.VISIBLE: (80, 220, 80), TrackState.COASTING: (40, 170, 255), TrackState.LOST: (60, 60, 230)}
_LAYERS = {"road": (110, 80, 30), "tracks": (160, 160, 160)}
_OTHER_LAYER = (0, 220, 220)  # BGR
_PARTICLE = (230, 120, 230)  # BGR


def draw(image: Image, tracked: TrackedFrame) -> Image:
    """The image on a larger canvas (h, w, 3) with road, tracks, paths, particles and the estimate; even sizes."""
    height, width = image.shape[:2]
    scale = min(1.0, _MAX_CANVAS_PX / (width * (1 + 2 * _MARGIN)))
    canvas_size = tuple(int(side * (1 + 2 * _MARGIN) * scale) // 2 * 2 for side in (width, height))
    canvas = np.full((canvas_size[1], canvas_size[0], 3), 28, np.uint8)
    small = cv2.resize(image, (int(width * scale), int(height * scale)), interpolation=cv2.INTER_AREA)
    x0, y0 = int(width * _MARGIN * scale), int(height * _MARGIN * scale)
    canvas[y0 : y0 + small.shape[0], x0 : x0 + small.shape[1]] = small
    estimate = tracked.estimate
    for name, points in estimate.layers.items():
        _dots(canvas, _to_canvas(points, scale, x0, y0), _LAYERS.get(name, _OTHER_LAYER))
    if estimate.particles is not None:
        _dots(canvas, _to_canvas(estimate.particles, scale, x0, y0), _PARTICLE)
    cv2.rectangle(canvas, (x0, y0), (x0 + small.shape[1] - 1, y0 + small.shape[0] - 1), (255, 255, 255), 1)
    colour = _COLOURS[estimate.state]
    for hypothesis in estimate.hypotheses:
        at = _to_canvas(np.array([[hypothesis.x, hypothesis.y]]), scale, x0, y0)[0]
        if _drawable(at):
            cv2.circle(canvas, (int(at[0]), int(at[1])), 5, colour, 1, cv2.LINE_AA)
    at = _to_canvas(np.array([[estimate.x, estimate.y]]), scale, x0, y0)[0]
    if _drawable(at) and estimate.state is not TrackState.LOST:
        half = 0.5 * scale * np.array([estimate.width, estimate.height])
        if np.isfinite(half).all():
            low, high = (at - half).astype(int), (at + half).astype(int)
            cv2.rectangle(canvas, (int(low[0]), int(low[1])), (int(high[0]), int(high[1])), colour, 2, cv2.LINE_AA)
        if np.isfinite(estimate.std):
            radius = int(min(2.0 * estimate.std * scale, 4000.0))
            cv2.circle(canvas, (int(at[0]), int(at[1])), radius, colour, 1, cv2.LINE_AA)
    text = f"{tracked.frame}  {tracked.time:.2f} s  {estimate.state.value}"
    cv2.putText(canvas, text, (12, 26), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, 1, cv2.LINE_AA)
    if estimate.basis is not None:
        why = f"{estimate.basis.value}: {estimate.reason}"
        cv2.putText(canvas, why, (12, 48), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (200, 200, 200), 1, cv2.LINE_AA)
    return canvas


def _to_canvas(points: Floats, scale: float, x0: int, y0: int) -> Floats:
    return np.asarray(points * scale + [x0, y0], dtype=np.float64)


def _drawable(at: Floats) -> bool:
    return bool(np.isfinite(at).all() and np.abs(at).max() < 1e4)


def _dots(canvas: Image, points: Floats, colour: tuple[int, int, int]) -> None:
    """Dots of 2 x 2 pixels, those on the canvas."""
    height, width = canvas.shape[:2]
    with np.errstate(invalid="ignore"):
        good = np.isfinite(points).all(axis=1)
        good &= (points > 0).all(axis=1) & (points[:, 0] < width - 2) & (points[:, 1] < height - 2)
    x, y = points[good].astype(np.int64).T
    for dy in (0, 1):
        for dx in (0, 1):
            canvas[y + dy, x + dx] = colour
