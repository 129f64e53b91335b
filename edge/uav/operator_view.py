"""The picture as the operator sees it: same size, so that a box drawn on it is a box of the camera's picture."""

from __future__ import annotations

import cv2
import numpy as np

from edge.uav.tracker import Estimate, Image, State

_COLOURS = {State.VISIBLE: (80, 220, 80), State.COASTING: (0, 170, 255), State.LOST: (60, 60, 230)}
_PARTICLE = (230, 120, 200)
_MOST = 150  # particles drawn
_EDGE = 14.0  # from the border to the tip of the arrow that points to a target outside [px]


def draw(image: Image, estimate: Estimate | None, line: str) -> Image:
    """A copy (h, w, 3) with the estimate on it, an arrow where it is outside, and one line of text."""
    out = image.copy()
    height, width = out.shape[:2]
    colour = (220, 220, 220) if estimate is None else _COLOURS[estimate.state]
    if estimate is not None and estimate.state is not State.LOST and np.isfinite([estimate.x, estimate.y]).all():
        _particles(out, estimate)
        x, y = estimate.x, estimate.y
        if 0 <= x < width and 0 <= y < height:
            half = 0.5 * np.nan_to_num(np.array([estimate.width, estimate.height]), nan=20.0)
            low = np.clip(np.array([x, y]) - half, -1e4, 1e4).astype(int)
            high = np.clip(np.array([x, y]) + half, -1e4, 1e4).astype(int)
            cv2.rectangle(out, (int(low[0]), int(low[1])), (int(high[0]), int(high[1])), colour, 2, cv2.LINE_AA)
            if estimate.state is State.COASTING and np.isfinite(estimate.std):
                radius = int(np.clip(2.0 * estimate.std, 3.0, 2.0 * max(width, height)))
                cv2.circle(out, (int(x), int(y)), radius, colour, 1, cv2.LINE_AA)
        else:
            _arrow(out, x, y, colour)
    cv2.putText(out, line, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(out, line, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, 1, cv2.LINE_AA)
    return out


def _particles(out: Image, estimate: Estimate) -> None:
    if estimate.particles is None or estimate.state is State.VISIBLE:
        return
    points = estimate.particles[:: max(1, len(estimate.particles) // _MOST)]
    height, width = out.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = (points > 0).all(axis=1) & (points[:, 0] < width - 1) & (points[:, 1] < height - 1)
    x, y = points[inside].astype(np.int64).T
    out[y, x] = _PARTICLE


def _arrow(out: Image, x: float, y: float, colour: tuple[int, int, int]) -> None:
    """From inside towards a place outside."""
    height, width = out.shape[:2]
    middle = np.array([0.5 * width, 0.5 * height])
    way = np.array([x, y]) - middle
    share = float(np.min((middle - _EDGE) / np.maximum(np.abs(way), 1e-6)))
    tip, tail = middle + share * way, middle + (share - 40.0 / max(float(np.hypot(*way)), 1.0)) * way
    start, end = (int(tail[0]), int(tail[1])), (int(tip[0]), int(tip[1]))
    cv2.arrowedLine(out, start, end, colour, 3, cv2.LINE_AA, tipLength=0.4)
