"""Pixel mapping from a camera's image to its thumbnail, from the JPEG header without decoding."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from protocols.core.jpeg import jpeg_size
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb


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
