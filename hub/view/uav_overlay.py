"""A drone's picture on a larger canvas: road, particles and the estimate, also where they lie outside it."""

from __future__ import annotations

import html
import itertools
import math

import numpy as np
import numpy.typing as npt

from hub.view.uav_state import FlightView
from protocols.geometry.types import Floats

Image = npt.NDArray[np.uint8]

_MARGIN = 0.35
"""Of the picture, on each side: so far outside an estimate is drawn at its place, farther with an arrow at the edge."""
_WIDTH = 720  # of the canvas [px]
_GROUND, _FRAME = (40, 44, 50), (255, 255, 255)
_ROAD, _CLOUD = (120, 160, 210), (240, 150, 220)
_STATES = {"visible": (90, 220, 90), "coasting": (255, 175, 50), "lost": (235, 70, 60)}
SIGNS = {"visible": "✓", "coasting": "…", "lost": "✗"}
"""Before a state's name, so that it is not told by colour alone."""


def draw(flight: FlightView, picture: Image | None) -> Image:
    """(h, w, 3) RGB: the picture in the middle, and what its tracker said of this very frame around and over it.

    picture: the decoded one, None while none has come. The estimate is a box (solid where the car is seen, dashed
    where it is only predicted) and a circle of two stds.
    """
    import cv2

    size = (640, 480) if picture is None else (picture.shape[1], picture.shape[0])
    if flight.picture is not None and flight.picture.width and flight.picture.height:
        size = (flight.picture.width, flight.picture.height)
    elif flight.info is not None and flight.info.width and flight.info.height:
        size = (flight.info.width, flight.info.height)
    scale = min(_WIDTH / size[0], 2 * _WIDTH / size[1]) / (1 + 2 * _MARGIN)
    height = max(2, round(size[1] * (1 + 2 * _MARGIN) * scale))
    canvas = np.full((height, _WIDTH, 3), _GROUND, np.uint8)
    left, top = round(_MARGIN * size[0] * scale), round(_MARGIN * size[1] * scale)
    inner = (max(1, round(size[0] * scale)), max(1, round(size[1] * scale)))
    if picture is not None:
        canvas[top : top + inner[1], left : left + inner[0]] = cv2.resize(picture, inner, interpolation=cv2.INTER_AREA)[
            : height - top, : _WIDTH - left
        ]

    def placed(pixels: Floats) -> Floats:
        return np.asarray((pixels + 0.5) * scale - 0.5 + (left, top), dtype=np.float64)

    target, cloud, road = flight.at_picture()
    if road is not None and len(road.pixels) > 1:
        _dots(canvas, placed(_pairs(road.pixels)), _ROAD, 2)
    if cloud is not None and target is not None and target.state != "lost" and len(cloud.pixels) > 1:
        _dots(canvas, placed(_pairs(cloud.pixels)), _CLOUD, 3)
    cv2.rectangle(canvas, (left, top), (left + inner[0] - 1, top + inner[1] - 1), _FRAME, 1)
    if target is not None and len(target.centre) == 2 and target.state != "lost":
        colour = _STATES.get(target.state, _FRAME)
        at = placed(np.array([target.centre]))[0]
        if not (0 <= at[0] < _WIDTH and 0 <= at[1] < height):
            _arrow(canvas, at, colour)
        elif math.isfinite(target.std_px):
            radius = int(min(2.0 * target.std_px * scale, 4.0 * _WIDTH))
            cv2.circle(canvas, (round(at[0]), round(at[1])), radius, colour, 1, cv2.LINE_AA)
        half = 0.5 * scale * np.array(target.size) if len(target.size) == 2 else np.array([4.0, 4.0])
        _box(canvas, at, half, colour, dashed=target.state != "visible")
    return canvas


def padded(image: Image, aspect: float) -> Image:
    """The same in the middle of a canvas whose width is ``aspect`` times its height."""
    height, width = image.shape[:2]
    if not (math.isfinite(aspect) and 0.05 < aspect < 20.0):
        return image
    size = (max(width, round(height * aspect)), max(height, round(width / aspect)))
    canvas = np.full((size[1], size[0], 3), _GROUND, np.uint8)
    left, top = (size[0] - width) // 2, (size[1] - height) // 2
    canvas[top : top + height, left : left + width] = image
    return canvas


def words(flight: FlightView, now: float) -> str:
    """The drone's panel as HTML: state, where and how sure, and how old that is."""
    target, _, _ = flight.at_picture()
    name = html.escape(flight.name)
    lines = [f"<b>{name}: no target</b>"]
    if target is not None:
        sign = SIGNS.get(target.state, "?")
        text = f"{sign} {html.escape(target.state)}"
        outside = _outside(flight, (target.centre[0], target.centre[1])) if len(target.centre) == 2 else ""
        if outside:
            text += f", {outside}"
        lines = [f"<b>{name}: {text}</b>"]
        told = []
        if len(target.centre) == 2 and target.state != "lost":
            told.append(f"± {target.std_px:.0f} px")
        if target.std_m > 0.0:
            told.append(f"± {target.std_m:.1f} m on the ground")
        if len(target.velocity) == 2:
            told.append(f"{3.6 * math.hypot(*target.velocity):.0f} km/h")
        if len(target.geo) == 3:
            told.append(f"{target.geo[0]:.6f}°, {target.geo[1]:.6f}°")
        if told:
            lines.append(" · ".join(told))
        if len(target.hypotheses) > 1:
            lines.append(f"{len(target.hypotheses)} ways it may have gone")
    if flight.picture is None:
        lines.append("no picture yet")
    elif flight.last_picture is not None and now - flight.last_picture > 3.0:
        lines.append(f"picture {now - flight.last_picture:.0f} s old")
    if flight.status is not None and flight.status.message:
        lines.append(html.escape(f"{flight.status.state}: {flight.status.message}"))
    state = "none" if target is None else html.escape(target.state)
    where = html.escape(flight.name, quote=True)
    paragraphs = "".join(f"<p>{line}</p>" for line in lines)
    style = "font:12px/1.35 system-ui,sans-serif;padding:0 .75em .5em"
    return f"<div style='{style}' data-flight='{where}' data-target='{state}'>{paragraphs}</div>"


def _outside(flight: FlightView, centre: tuple[float, float]) -> str:
    """Which way a place lies outside the picture, "" inside."""
    shown = flight.picture or flight.info
    if shown is None or not (shown.width and shown.height):
        return ""
    sides = []
    if centre[1] < -0.5:
        sides.append("above")
    elif centre[1] > shown.height - 0.5:
        sides.append("below")
    if centre[0] < -0.5:
        sides.append("left of")
    elif centre[0] > shown.width - 0.5:
        sides.append("right of")
    return f"{' and '.join(sides)} the picture" if sides else ""


def _pairs(values: object) -> Floats:
    numbers = np.array(values, dtype=np.float64)
    return np.asarray(numbers[: len(numbers) // 2 * 2].reshape(-1, 2))


def _dots(canvas: Image, points: Floats, colour: tuple[int, int, int], size: int) -> None:
    """Square dots, those on the canvas."""
    height, width = canvas.shape[:2]
    with np.errstate(invalid="ignore"):
        good = np.isfinite(points).all(axis=1) & (points >= 0).all(axis=1)
        good &= (points[:, 0] < width - size) & (points[:, 1] < height - size)
    x, y = points[good].astype(np.int64).T
    for down in range(size):
        for right in range(size):
            canvas[y + down, x + right] = colour


def _box(canvas: Image, at: Floats, half: Floats, colour: tuple[int, int, int], *, dashed: bool) -> None:
    import cv2

    if not np.isfinite([*at, *half]).all() or np.abs(at).max() > 1e4:
        return
    half = np.clip(half, 3.0, 1e3)
    corners = at + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    for start, end in itertools.pairwise(corners):
        steps = max(2, round(float(np.linalg.norm(end - start)) / 4.0)) if dashed else 1
        ends = start + np.linspace(0.0, 1.0, steps + 1)[:, None] * (end - start)
        for index in range(0, steps, 2):
            a, b = np.round(ends[index]).astype(int), np.round(ends[index + 1]).astype(int)
            cv2.line(canvas, (int(a[0]), int(a[1])), (int(b[0]), int(b[1])), colour, 2, cv2.LINE_AA)


def _arrow(canvas: Image, at: Floats, colour: tuple[int, int, int]) -> None:
    """At the canvas's edge, towards a place beyond it."""
    import cv2

    if not np.isfinite(at).all():
        return
    height, width = canvas.shape[:2]
    middle = np.array([0.5 * width, 0.5 * height])
    way = at - middle
    length = float(np.linalg.norm(way))
    if length < 1.0:
        return
    share = float(np.min((middle - 8.0) / np.maximum(np.abs(way), 1e-6)))
    tip = middle + share * way
    tail = tip - 36.0 * way / length
    start, end = (round(float(tail[0])), round(float(tail[1]))), (round(float(tip[0])), round(float(tip[1])))
    cv2.arrowedLine(canvas, start, end, colour, 3, cv2.LINE_AA, tipLength=0.4)
