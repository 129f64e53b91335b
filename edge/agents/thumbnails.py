"""Thumbnails of camera frames for the live view."""

from __future__ import annotations

import cv2

from edge.devices.base import Frame
from protocols.core.jpeg import encode_jpeg
from protocols.messages import syncline_pb2 as pb
from protocols.validation.rules import SCHEMA_VERSION

THUMBNAIL_WIDTH = 320
"""Default width of a thumbnail [px]: 8 kB as JPEG, so that fifty cameras fit a wireless link."""
_JPEG_QUALITY = 70  # 8 kB at 320 px


def thumbnail_message(frame: Frame, camera: str, boot_id: str, width: int = THUMBNAIL_WIDTH) -> pb.Picture:
    """A frame as a JPEG of at most ``width`` px across; takes 1.5 ms for 1280x720."""
    height, full = frame.image.shape[:2]
    image = frame.image
    if full > width:
        # Subsample first: averaging over all pixels of a large image would cost more than the detector.
        step = max(1, full // (2 * width))
        size = (width, max(1, round(height * width / full)))
        image = cv2.resize(image[::step, ::step], size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    return pb.Picture(
        schema_version=SCHEMA_VERSION,
        camera=camera,
        boot_id=boot_id,
        frame=frame.frame,
        device_time_ns=frame.device_time_ns,
        width=full,
        height=height,
        jpeg=encode_jpeg(image, _JPEG_QUALITY),
    )
