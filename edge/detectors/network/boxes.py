"""Boxes of a detection network as detections: labels by tracking in the image, and the points of a person."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.base import CUT_VEHICLE_STD, Detection
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Image

if TYPE_CHECKING:
    from edge.detectors.moving.tracklets import ShortTermTracker

Point = tuple[float, float]

KINDS: dict[str, Literal["person", "vehicle"]] = {
    "person": "person",
    **dict.fromkeys(("vehicle", "car", "truck", "bus", "motorcycle", "motorbike"), "vehicle"),
}
"""Kinds by the usual names of classes."""
BOX_STD = 0.05
"""Std of a box's centre over the box's side: assumed, not measured."""
_MIN_STD_PX = 0.5  # boxes are whole pixels of the network's input at best
_MIDDLE = {"person": 0.38, "vehicle": 0.5}
"""Of the representative point, over the height below the top: 0.62 of a person's height above the ground, as the
maximum of a silhouette's distance transform (0.12 above the centre in the hub's model of a person)."""
_FACE = ("nose", "left_eye", "right_eye", "left_ear", "right_ear")
_ANKLES, _WRISTS = ("left_ankle", "right_ankle"), ("left_wrist", "right_wrist")
_TORSO = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
_ANKLE_HEIGHT = 0.039
"""Of an ankle above the ground, over a person's height (Drillis and Contini 1966)."""
_CROWN_ABOVE_FACE = 0.07
"""Of the top of the head above eyes and nose, over a person's height: half a head, which is 0.13 of it (ibid.)."""
_SEEN = 0.5
"""Least confidence of a keypoint that is used."""
_CUT_STD = 3.0
"""Factor of the std of a box that the image border cuts across, whose centre is not the object's."""


@dataclass(frozen=True, slots=True)
class NetworkBox:
    """One detected box. label: the network's class name. confidence: 0..1. left, top, width, height [px].

    A box begins at the corner of a pixel. keypoints: by name, u, v [px, as the box] of those that are seen.
    """

    label: str
    confidence: float
    left: float
    top: float
    width: float
    height: float
    keypoints: Mapping[str, Point] = field(default_factory=dict)


class BoxLabeller:
    """Converts boxes to detections. People and vehicles are tracked from frame to frame and labelled by their track.

    prefix: of the track labels, so that labels of two cameras are never equal. box_std: see ``BOX_STD``.
    """

    def __init__(self, prefix: str, box_std: float = BOX_STD) -> None:
        self._prefix = prefix
        self._box_std = box_std
        self._trackers: dict[str, ShortTermTracker] = {}

    def detections(
        self, found: Sequence[NetworkBox], time_ns: int, size: tuple[int, int], image: Image | None = None
    ) -> tuple[Detection, ...]:
        """Detections of one image of ``size`` (width, height) px at ``time_ns``; other classes keep their label.

        image: (H, W, 3) BGR, where the colour of torsos is to be measured.
        """
        names = {id(box): box.label for box in found}
        colours = {id(box): None if image is None else torso_colour(image, box) for box in found}
        time = time_ns / NANOSECONDS
        for kind in ("person", "vehicle"):
            of_kind = [box for box in found if KINDS.get(box.label) == kind]
            if not of_kind and kind not in self._trackers:
                continue
            tracker = self._tracker(kind)
            rectangles = [(box.left, box.top, box.width, box.height) for box in of_kind]
            seen = [None if (one := colours[id(box)]) is None else np.array(one, dtype=np.float64) for box in of_kind]
            tracks = tracker.assign(rectangles, seen, time, [None] * len(of_kind))
            for box, rectangle, colour, track in zip(of_kind, rectangles, seen, tracks, strict=True):
                if track.time < time:
                    track.update(rectangle, time, colour)
                names[id(box)] = track.name
            tracker.prune(time, size)
        return tuple(_detection(box, names[id(box)], size, colours[id(box)], self._box_std) for box in found)

    def _tracker(self, kind: str) -> ShortTermTracker:
        if kind not in self._trackers:
            from edge.detectors.moving.tracklets import (
                ShortTermTracker,  # needs scipy: imported only where people or vehicles are detected
            )

            self._trackers[kind] = ShortTermTracker(f"{self._prefix}{'p' if kind == 'person' else 't'}", 0.0)
        return self._trackers[kind]


def _detection(
    box: NetworkBox, name: str, size: tuple[int, int], colour: tuple[int, int, int] | None, box_std: float
) -> Detection:
    kind: Literal["person", "vehicle", "marker"] = KINDS.get(box.label) or "marker"
    across, above, below = _cut(box, size)
    std = [max(box_std * side, _MIN_STD_PX) for side in (box.width, box.height)]
    cut = [CUT_VEHICLE_STD * side if kind == "vehicle" else 0.0 for side in (box.height, box.width)]
    u_std = max(_CUT_STD * std[0], cut[0]) if across else std[0]
    v_std = max(_CUT_STD * std[1], cut[1]) if above or below else std[1]
    centre = box.left + 0.5 * box.width - 0.5, box.top + 0.5 * box.height - 0.5  # pixel centres are whole numbers
    head = foot = None
    middle = centre[0], box.top + _MIDDLE.get(kind, 0.5) * box.height - 0.5
    length = math.sqrt(box.width * box.height)
    if kind == "person":
        top, ground = head_point(box), foot_point(box)
        head, foot = None if across or above else top, None if across or below else ground
        length = 0.0
        if head is not None and foot is not None:
            length = math.hypot(head[0] - foot[0], head[1] - foot[1])
            middle = centre[0], head[1] + _MIDDLE["person"] * (foot[1] - head[1])
    return Detection(
        u=middle[0],
        v=middle[1],
        size=length,
        score=box.confidence,
        label=name,
        colour=colour,
        covariance=(u_std**2, 0.0, v_std**2),
        kind=kind,
        head=head,
        foot=foot,
        box=(box.left, box.top, box.width, box.height),
    )


def _cut(box: NetworkBox, size: tuple[int, int]) -> tuple[bool, bool, bool]:
    """Whether the image border cuts a box at a side, above, and below: as far as a network places an edge exactly."""
    margin = 0.005 * max(size)
    across = box.left <= margin or box.left + box.width >= size[0] - margin
    return across, box.top <= margin, box.top + box.height >= size[1] - margin


def head_point(box: NetworkBox) -> Point:
    """The top of a person's head (u, v) [px, pixel centres are whole numbers].

    The top of the box, above the face where one is seen; below a raised hand.
    """
    face = _mean(box, _FACE)
    u = box.left + 0.5 * box.width if face is None else face[0]
    hands = [box.keypoints[name][1] for name in _WRISTS if name in box.keypoints]
    if face is not None and hands and min(hands) < face[1]:
        return u - 0.5, max(face[1] - _CROWN_ABOVE_FACE * (box.top + box.height - face[1]), box.top) - 0.5
    return u - 0.5, box.top - 0.5


def foot_point(box: NetworkBox) -> Point:
    """The foot point (u, v) [px] on the ground: below the middle of the ankles where both are seen, else of the box."""
    bottom = box.top + box.height
    if not all(name in box.keypoints for name in _ANKLES):
        return box.left + 0.5 * box.width - 0.5, bottom - 0.5
    ankles = _mean(box, _ANKLES)
    assert ankles is not None
    return ankles[0] - 0.5, min(ankles[1] + _ANKLE_HEIGHT * box.height, bottom) - 0.5


def _mean(box: NetworkBox, names: Sequence[str]) -> Point | None:
    seen = [box.keypoints[name] for name in names if name in box.keypoints]
    return (sum(u for u, _ in seen) / len(seen), sum(v for _, v in seen) / len(seen)) if seen else None


def torso_colour(image: Image, box: NetworkBox) -> tuple[int, int, int] | None:
    """Mean sRGB of the clothes between shoulders and hips; None where nothing of them is in the image (H, W, 3) BGR.

    The rectangle of the four keypoints where all are seen, else the middle third of the box, 0.2 to 0.5 of its height
    below the top.
    """
    left, right = box.left + box.width / 3.0, box.left + box.width * 2.0 / 3.0
    top, bottom = box.top + 0.2 * box.height, box.top + 0.5 * box.height
    if all(name in box.keypoints for name in _TORSO):
        u, v = zip(*(box.keypoints[name] for name in _TORSO), strict=True)
        top, bottom = min(v), max(v)
        if max(u) - min(u) > 0.3 * (right - left):  # seen from the side, shoulders and hips are one line
            left, right = min(u), max(u)
    rows = slice(max(math.floor(top), 0), max(math.ceil(bottom), 0))
    part = image[rows, max(math.floor(left), 0) : max(math.ceil(right), 0)]
    if part.size == 0:
        return None
    blue, green, red = cv2.mean(np.ascontiguousarray(part))[:3]
    return round(red), round(green), round(blue)


def seen_keypoints(names: Sequence[str], points: npt.NDArray[np.float64]) -> dict[str, Point]:
    """Keypoints by name of those that are seen. points: (K, 3) u, v, confidence."""
    return {
        name: (float(u), float(v))
        for name, (u, v, confidence) in zip(names, points, strict=True)
        if confidence >= _SEEN
    }
