"""What a network on an OAK board found, as detections in the pixels of the board's picture.

Knows depthai's messages by their methods only, and no board. The archive decides what is looked for.
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
    from edge.detectors.moving.tracklets import Following

_MOST = 64
_KINDS: dict[str, Literal["person", "vehicle"]] = {
    "person": "person",
    **dict.fromkeys(("vehicle", "car", "truck", "bus", "motorcycle", "motorbike"), "vehicle"),
}
_STD_OF_SIDE = 0.05  # of a box's centre, by the box's side: a guess, nobody has measured it
_LEAST_STD_PX = 0.5


@dataclass(frozen=True, slots=True)
class Box:
    """label: the network's word for it. confidence: 0..1. left, top, width, height: px of the picture."""

    label: str
    confidence: float
    left: float
    top: float
    width: float
    height: float


def boxes(message: Any, picture: Any, size: tuple[int, int], keep: Sequence[str] = ()) -> list[Box]:
    """The boxes of a depthai ImgDetections in the picture (ImgFrame) of size (width, height) px, surest first.

    keep: only these labels; none = all. Both messages tell how they were cut and scaled out of the sensor's image;
    raises InputError where one does not, as then nobody knows where in the picture a box lies.
    """
    found, shown = message.getTransformation(), picture.getTransformation()
    if found is None or shown is None or not (found.isValid() and shown.isValid()):
        raise InputError("the network's results do not tell where in the picture they are", remedy="update depthai")
    result = []
    for one in message.transformTo(shown).detections:
        left, right = one.xmin * size[0], one.xmax * size[0]
        top, bottom = one.ymin * size[1], one.ymax * size[1]
        sound = all(math.isfinite(value) for value in (left, right, top, bottom, one.confidence))
        label = one.labelName or str(one.label)
        if sound and right > left and bottom > top and (not keep or label in keep):
            box = Box(label, min(max(one.confidence, 0.0), 1.0), left, top, right - left, bottom - top)
            if 0.0 <= left + 0.5 * box.width <= size[0] and 0.0 <= top + 0.5 * box.height <= size[1]:
                result.append(box)
    return sorted(result, key=lambda box: box.confidence, reverse=True)[:_MOST]


class Naming:
    """Makes detections of boxes. People and vehicles are followed from picture to picture, and named by that.

    prefix: of their names, so that two cameras do not seem to see the same one.
    """

    def __init__(self, prefix: str) -> None:
        self._prefix = prefix
        self._following: dict[str, Following] = {}

    def detections(self, found: Sequence[Box], time_ns: int, size: tuple[int, int]) -> tuple[Detection, ...]:
        """Of one picture, (width, height) px, taken at ``time_ns``; anything else than those keeps its label."""
        names = {id(box): box.label for box in found}
        time = time_ns / NANOSECONDS
        for kind in ("person", "vehicle"):
            mine = [box for box in found if _KINDS.get(box.label) == kind]
            if not mine and kind not in self._following:
                continue
            following = self._followed(kind)
            places = [(box.left, box.top, box.width, box.height) for box in mine]
            owners = following.assign(places, [None] * len(mine), time, [None] * len(mine))
            for box, place, owner in zip(mine, places, owners, strict=True):
                if owner.time < time:
                    owner.see(place, time, None)
                names[id(box)] = owner.name
            following.forget(time, size)
        return tuple(_detection(box, names[id(box)]) for box in found)

    def _followed(self, kind: str) -> Following:
        if kind not in self._following:
            from edge.detectors.moving.tracklets import Following  # scipy: only where people or vehicles are looked for

            self._following[kind] = Following(f"{self._prefix}-{'p' if kind == 'person' else 't'}", 0.0)
        return self._following[kind]


def _detection(box: Box, name: str) -> Detection:
    kind: Literal["person", "vehicle", "marker"] = _KINDS.get(box.label) or "marker"
    u = box.left + 0.5 * box.width - 0.5  # pixels count from the centre of the first, a box from its corner
    v = box.top + (0.35 if kind == "person" else 0.5) * box.height - 0.5
    std = (max(_STD_OF_SIDE * box.width, _LEAST_STD_PX), max(_STD_OF_SIDE * box.height, _LEAST_STD_PX))
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
