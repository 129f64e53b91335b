"""Pixel mapping from a camera's image to its thumbnail, from the JPEG header without decoding."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb

_STANDALONE_MARKERS = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without a segment
_START_OF_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # start of frame: the others are tables


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) [px] from the JPEG's start-of-frame segment (ITU-T T.81, B.2.2); None where there is none."""
    place = 2
    if data[:2] != b"\xff\xd8":
        return None
    while place + 9 <= len(data) and data[place] == 0xFF:
        marker = data[place + 1]
        if marker == 0xFF or marker in _STANDALONE_MARKERS:
            place += 1 if marker == 0xFF else 2
            continue
        if marker in _START_OF_FRAME_MARKERS:
            height, width = (int.from_bytes(data[place + at : place + at + 2], "big") for at in (5, 7))
            return (width, height) if width and height else None
        place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    return None


class ThumbnailScale(NamedTuple):
    """Mapping from an image's pixels to its thumbnail's: (u + 0.5) across - 0.5. width, height: of the picture [px]."""

    scale_x: float
    scale_y: float
    width: int
    height: int

    def place(self, u: float, v: float) -> tuple[float, float]:
        """The thumbnail's pixel of an image's pixel."""
        return (u + 0.5) * self.scale_x - 0.5, (v + 0.5) * self.scale_y - 0.5

    def matrix(self) -> Floats:
        """The mapping as a matrix (3, 3) for homogeneous pixels."""
        scale_x, scale_y = self.scale_x, self.scale_y
        return np.array([[scale_x, 0.0, 0.5 * scale_x - 0.5], [0.0, scale_y, 0.5 * scale_y - 0.5], [0.0, 0.0, 1.0]])


def thumbnail_scale(picture: pb.Picture) -> ThumbnailScale | None:
    """The mapping of a thumbnail message; None if it is not a JPEG."""
    size = jpeg_size(picture.jpeg)
    if size is None or not (picture.width and picture.height):
        return None
    return ThumbnailScale(size[0] / picture.width, size[1] / picture.height, *size)
