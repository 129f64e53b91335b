"""Detections of a network on an OAK board, converted to the pixels of the delivered image.

Uses depthai's message objects by their methods only, without importing depthai. The NN archive defines the classes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from edge.detectors.base import Detection
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError

if TYPE_CHECKING:
    from edge.detectors.moving.tracklets import ShortTermTracker

_MAX_BOXES = 64
_KINDS: dict[str, Literal["person", "vehicle"]] = {
    "person": "person",
    **dict.fromkeys(("vehicle", "car", "truck", "bus", "motorcycle", "motorbike"), "vehicle"),
}
_STD_PER_SIDE = 0.05  # std of a box's centre relative to the box's side: assumed, not measured
_MIN_STD_PX = 0.5


@dataclass(frozen=True, slots=True)
class NetworkBox:
    """One detected box. label: the network's class name. confidence: 0..1. left, top, width, height [px]."""

    label: str
    confidence: float
    left: float
    top: float
    width: float
    height: float


def boxes_in_image(message: Any, image: Any, size: tuple[int, int], keep: Sequence[str] = ()) -> list[NetworkBox]:
    """The boxes of a depthai ImgDetections in an image (ImgFrame) of ``size`` (width, height) px, by confidence.

    keep: only these labels; empty = all. Both messages carry the transformation from the sensor's image (crop, scale);
    raises InputError where one lacks it, because the boxes then cannot be located in the image.
    """
    found, image_transform = message.getTransformation(), image.getTransformation()
    if found is None or image_transform is None or not (found.isValid() and image_transform.isValid()):
        raise InputError(
            "the network's results carry no image transformation, so their boxes cannot be located",
            remedy="update depthai",
        )
    result = []
    for detection in message.transformTo(image_transform).detections:
        left, right = detection.xmin * size[0], detection.xmax * size[0]
        top, bottom = detection.ymin * size[1], detection.ymax * size[1]
        valid = all(math.isfinite(value) for value in (left, right, top, bottom, detection.confidence))
        label = detection.labelName or str(detection.label)
        if valid and right > left and bottom > top and (not keep or label in keep):
            box = NetworkBox(label, min(max(detection.confidence, 0.0), 1.0), left, top, right - left, bottom - top)
            if 0.0 <= left + 0.5 * box.width <= size[0] and 0.0 <= top + 0.5 * box.height <= size[1]:
                result.append(box)
    return sorted(result, key=lambda box: box.confidence, reverse=True)[:_MAX_BOXES]


class BoxLabeller:
    """Converts boxes to detections. People and vehicles are tracked from frame to frame and labelled by their track.

    prefix: of the track labels, so that labels of two cameras are never equal.
    """

    def __init__(self, prefix: str) -> None:
        self._prefix = prefix
        self._trackers: dict[str, ShortTermTracker] = {}

    def detections(self, found: Sequence[NetworkBox], time_ns: int, size: tuple[int, int]) -> tuple[Detection, ...]:
        """Detections of one image of ``size`` (width, height) px at ``time_ns``; other classes keep their label."""
        names = {id(box): box.label for box in found}
        time = time_ns / NANOSECONDS
        for kind in ("person", "vehicle"):
            of_kind = [box for box in found if _KINDS.get(box.label) == kind]
            if not of_kind and kind not in self._trackers:
                continue
            tracker = self._tracker(kind)
            rectangles = [(box.left, box.top, box.width, box.height) for box in of_kind]
            tracks = tracker.assign(rectangles, [None] * len(of_kind), time, [None] * len(of_kind))
            for box, rectangle, track in zip(of_kind, rectangles, tracks, strict=True):
                if track.time < time:
                    track.update(rectangle, time, None)
                names[id(box)] = track.name
            tracker.prune(time, size)
        return tuple(_detection(box, names[id(box)]) for box in found)

    def _tracker(self, kind: str) -> ShortTermTracker:
        if kind not in self._trackers:
            from edge.detectors.moving.tracklets import (
                ShortTermTracker,  # needs scipy: imported only where people or vehicles are detected
            )

            self._trackers[kind] = ShortTermTracker(f"{self._prefix}-{'p' if kind == 'person' else 't'}", 0.0)
        return self._trackers[kind]


def _detection(box: NetworkBox, name: str) -> Detection:
    kind: Literal["person", "vehicle", "marker"] = _KINDS.get(box.label) or "marker"
    u = box.left + 0.5 * box.width - 0.5  # pixel centres are integers; a box starts at the corner of a pixel
    v = box.top + (0.35 if kind == "person" else 0.5) * box.height - 0.5
    std = (max(_STD_PER_SIDE * box.width, _MIN_STD_PX), max(_STD_PER_SIDE * box.height, _MIN_STD_PX))
    return Detection(
        u=u,
        v=v,
        size=box.height if kind == "person" else math.sqrt(box.width * box.height),
        score=box.confidence,
        label=name,
        covariance=(std[0] ** 2, 0.0, std[1] ** 2),
        kind=kind,
        head=(u, box.top - 0.5) if kind == "person" else None,
        foot=(u, box.top + box.height - 0.5) if kind == "person" else None,
        box=(box.left, box.top, box.width, box.height),
    )
