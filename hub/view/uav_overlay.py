"""Overlay of a drone's image: road, particles and target estimate on a canvas larger than the image.

And the view state of a drone: its last image, and the target, particle and road messages by frame.
"""

from __future__ import annotations

import html
import itertools
import math
from collections import deque
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from protocols.geometry.types import Floats, Image
from protocols.messages import syncline_pb2 as pb

_MARGIN = 0.35
"""Canvas margin on each side as a fraction of the image: within it an estimate outside the image is drawn at its
position, beyond it as an arrow at the edge."""
_WIDTH = 720  # of the canvas [px]
_BACKGROUND, _FRAME = (40, 44, 50), (255, 255, 255)  # RGB
_ROAD, _PARTICLES = (120, 160, 210), (240, 150, 220)  # RGB
_STATES = {"visible": (90, 220, 90), "coasting": (255, 175, 50), "lost": (235, 70, 60)}
SIGNS = {"visible": "✓", "coasting": "…", "lost": "✗"}
"""Sign before a state's name, so that it can be read without colour."""


def draw_uav(uav: UavView, picture: Image | None) -> Image:
    """(h, w, 3) RGB: the image in the middle of the canvas, with the tracker's output for the same frame drawn over it.

    picture: the decoded image, None if none has arrived. The estimate is a box (solid if the car is visible, dashed if
    predicted) and a circle of two standard deviations.
    """
    import cv2

    size = (640, 480) if picture is None else (picture.shape[1], picture.shape[0])
    if uav.picture is not None and uav.picture.width and uav.picture.height:
        size = (uav.picture.width, uav.picture.height)
    elif uav.info is not None and uav.info.width and uav.info.height:
        size = (uav.info.width, uav.info.height)
    scale = min(_WIDTH / size[0], 2 * _WIDTH / size[1]) / (1 + 2 * _MARGIN)
    height = max(2, round(size[1] * (1 + 2 * _MARGIN) * scale))
    canvas = np.full((height, _WIDTH, 3), _BACKGROUND, np.uint8)
    left, top = round(_MARGIN * size[0] * scale), round(_MARGIN * size[1] * scale)
    inner = (max(1, round(size[0] * scale)), max(1, round(size[1] * scale)))
    if picture is not None:
        canvas[top : top + inner[1], left : left + inner[0]] = cv2.resize(picture, inner, interpolation=cv2.INTER_AREA)[
            : height - top, : _WIDTH - left
        ]

    def placed(pixels: Floats) -> Floats:
        return np.asarray((pixels + 0.5) * scale - 0.5 + (left, top), dtype=np.float64)

    target, particles, road = uav.at_image()
    if road is not None and len(road.pixels) > 1:
        dots(canvas, placed(_pairs(road.pixels)), _ROAD, 2)
    if particles is not None and target is not None and target.state != "lost" and len(particles.pixels) > 1:
        dots(canvas, placed(_pairs(particles.pixels)), _PARTICLES, 3)
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


def pad_to_aspect(image: Image, aspect: float) -> Image:
    """The image centred on a canvas whose width is ``aspect`` times its height."""
    height, width = image.shape[:2]
    if not (math.isfinite(aspect) and 0.05 < aspect < 20.0):
        return image
    size = (max(width, round(height * aspect)), max(height, round(width / aspect)))
    canvas = np.full((size[1], size[0], 3), _BACKGROUND, np.uint8)
    left, top = (size[0] - width) // 2, (size[1] - height) // 2
    canvas[top : top + height, left : left + width] = image
    return canvas


def uav_panel_html(uav: UavView, now: float) -> str:
    """The drone's panel as HTML: target state, position, uncertainty, and age of the data."""
    target, _, _ = uav.at_image()
    name = html.escape(uav.name)
    lines = [f"<b>{name}: no target</b>"]
    if target is not None:
        sign = SIGNS.get(target.state, "?")
        text = f"{sign} {html.escape(target.state)}"
        outside = _outside(uav, (target.centre[0], target.centre[1])) if len(target.centre) == 2 else ""
        if outside:
            text += f", {outside}"
        lines = [f"<b>{name}: {text}</b>"]
        details = []
        if len(target.centre) == 2 and target.state != "lost":
            details.append(f"± {target.std_px:.0f} px")
        if target.std_m > 0.0:
            details.append(f"± {target.std_m:.1f} m on the ground")
        if len(target.velocity) == 2:
            details.append(f"{3.6 * math.hypot(*target.velocity):.0f} km/h")
        if len(target.geo) == 3:
            details.append(f"{target.geo[0]:.6f}°, {target.geo[1]:.6f}°")
        if details:
            lines.append(" · ".join(details))
        if len(target.hypotheses) > 1:
            lines.append(f"{len(target.hypotheses)} path hypotheses")
    if uav.picture is None:
        lines.append("no picture yet")
    elif uav.last_picture is not None and now - uav.last_picture > 3.0:
        lines.append(f"picture {now - uav.last_picture:.0f} s old")
    if uav.status is not None and uav.status.message:
        lines.append(html.escape(f"{uav.status.state}: {uav.status.message}"))
    state = "none" if target is None else html.escape(target.state)
    where = html.escape(uav.name, quote=True)
    paragraphs = "".join(f"<p>{line}</p>" for line in lines)
    style = "font:12px/1.35 system-ui,sans-serif;padding:0 .75em .5em"
    return f"<div style='{style}' data-flight='{where}' data-target='{state}'>{paragraphs}</div>"


def _outside(uav: UavView, centre: tuple[float, float]) -> str:
    """On which sides a pixel is outside the image, "" inside."""
    shown = uav.picture or uav.info
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


def dots(canvas: Image, points: Floats, colour: tuple[int, int, int], size: int) -> None:
    """Square dots at those points that are on the canvas."""
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
    """An arrow at the edge of the canvas towards a point beyond it."""
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


_FrameMessage = TypeVar("_FrameMessage", pb.TargetState, pb.TargetCloud, pb.RoadMap)


@dataclass(slots=True, eq=False)
class UavView:
    """One UAV agent. pictures: count. full_resolution: its images are those of the tracker, from a log."""

    name: str
    info: pb.UavInfo | None = None
    boot: str = ""
    picture: pb.Picture | None = None
    pictures: int = 0
    full_resolution: bool = False
    targets: deque[pb.TargetState] = field(default_factory=lambda: deque(maxlen=300))
    particle_sets: deque[pb.TargetCloud] = field(default_factory=lambda: deque(maxlen=50))
    roads: deque[pb.RoadMap] = field(default_factory=lambda: deque(maxlen=20))
    last_picture: float | None = None
    status: pb.AgentStatus | None = None

    def handle(
        self, message: pb.UavInfo | pb.TargetState | pb.TargetCloud | pb.RoadMap | pb.FlightImage, now: float
    ) -> None:
        """Process one message of this agent; a new boot id clears the history."""
        if message.boot_id != self.boot:
            self.boot = message.boot_id
            for history in (self.targets, self.particle_sets, self.roads):
                history.clear()
        if isinstance(message, pb.UavInfo):
            self.info = message
        elif isinstance(message, pb.TargetState):
            self.targets.append(message)
        elif isinstance(message, pb.TargetCloud):
            self.particle_sets.append(message)
        elif isinstance(message, pb.RoadMap):
            self.roads.append(message)
        else:
            self.full_resolution = True
            size = {"width": message.width, "height": message.height, "frame": message.frame}
            self._show(pb.Picture(camera=message.agent, boot_id=message.boot_id, jpeg=message.jpeg, **size), now)

    def show_thumbnail(self, picture: pb.Picture, now: float) -> None:
        """Show a thumbnail, unless full-resolution images are available."""
        if not self.full_resolution:
            self._show(picture, now)

    def at_image(self) -> tuple[pb.TargetState | None, pb.TargetCloud | None, pb.RoadMap | None]:
        """The messages of the image's frame, or the last before it: images are rarer and arrive later."""
        frame = None if self.picture is None else self.picture.frame
        return _last_up_to(self.targets, frame), _last_up_to(self.particle_sets, frame), _last_up_to(self.roads, frame)

    def _show(self, picture: pb.Picture, now: float) -> None:
        self.picture, self.pictures, self.last_picture = picture, self.pictures + 1, now


def _last_up_to(messages: deque[_FrameMessage], frame: int | None) -> _FrameMessage | None:
    """The last message of a frame up to ``frame``; the newest if there is no image."""
    for message in reversed(messages):
        if frame is None or message.frame <= frame:
            return message
    return None
