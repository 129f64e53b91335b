"""JPEG images: encoding; of those that others send the size from the header, the scale of thumbnails, and decoding
within a bound."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

MAX_JPEG_PIXELS = 1 << 25
"""An 8K video has as many. A header of 600 bytes can claim a hundred times more, and the decoder would allocate it."""
_STANDALONE_MARKERS = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without a segment
_START_OF_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # start of frame: the others are tables


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) [px] from the JPEG's start-of-frame segment (ITU-T T.81, B.2.2); None where there is none."""
    place = 2
    if data[:2] != b"\xff\xd8":
        return None
    while place + 9 <= len(data) and data[place] == 0xFF:
        marker = data[place + 1]
        if marker == 0:  # no marker: decoders search on for one, and would find another segment than this does
            return None
        if marker == 0xFF or marker in _STANDALONE_MARKERS:
            place += 1 if marker == 0xFF else 2
            continue
        if marker in _START_OF_FRAME_MARKERS:
            height, width = (int.from_bytes(data[place + at : place + at + 2], "big") for at in (5, 7))
            return (width, height) if width and height else None
        place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    return None


def jpeg_fits(data: bytes) -> bool:
    """Whether it is a JPEG of at most ``MAX_JPEG_PIXELS``."""
    size = jpeg_size(data)
    return size is not None and size[0] * size[1] <= MAX_JPEG_PIXELS


def encode_jpeg(image: npt.NDArray[np.uint8], quality: int) -> bytes:
    """An image (h, w, 3) BGR, or (h, w) grey, as JPEG of quality 0..100; empty if it cannot be encoded."""
    import cv2

    good, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes() if good else b""


def decode_jpeg(data: bytes) -> npt.NDArray[np.uint8] | None:
    """The image (h, w, 3), BGR; None if it is missing, damaged, or has more than ``MAX_JPEG_PIXELS``."""
    import cv2

    if not jpeg_fits(data):
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, np.uint8)


class ThumbnailScale(NamedTuple):
    """Mapping from an image's pixels to its thumbnail's: (u + 0.5) across - 0.5. width, height: of the picture [px]."""

    scale_x: float
    scale_y: float
    width: int
    height: int

    def place(self, u: float, v: float) -> tuple[float, float]:
        """The thumbnail's pixel of an image's pixel."""
        return (u + 0.5) * self.scale_x - 0.5, (v + 0.5) * self.scale_y - 0.5

    def matrix(self) -> npt.NDArray[np.float64]:
        """The mapping as a matrix (3, 3) for homogeneous pixels."""
        scale_x, scale_y = self.scale_x, self.scale_y
        return np.array([[scale_x, 0.0, 0.5 * scale_x - 0.5], [0.0, scale_y, 0.5 * scale_y - 0.5], [0.0, 0.0, 1.0]])


def thumbnail_scale(picture: Any) -> ThumbnailScale | None:
    """The mapping of a thumbnail message; None if it is not a JPEG."""
    size = jpeg_size(picture.jpeg)
    if size is None or not (picture.width and picture.height):
        return None
    return ThumbnailScale(size[0] / picture.width, size[1] / picture.height, *size)
