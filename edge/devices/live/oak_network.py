"""Boxes of a network on an OAK board, converted to the pixels of the delivered image.

Uses depthai's message objects by their methods only, without importing depthai. The NN archive defines the classes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from edge.detectors.network.boxes import NetworkBox
from protocols.core.errors import InputError

_MAX_BOXES = 64  # by confidence: more are noise


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
