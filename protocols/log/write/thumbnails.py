"""How a small picture lies in the image it was made of, told by its JPEG without decoding it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb

_ALONE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers that nothing follows
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # start of frame: the others are tables


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) [px] as its start of frame tells (ITU-T T.81, B.2.2); None where there is none."""
    place = 2
    if data[:2] != b"\xff\xd8":
        return None
    while place + 9 <= len(data) and data[place] == 0xFF:
        marker = data[place + 1]
        if marker == 0xFF or marker in _ALONE:
            place += 1 if marker == 0xFF else 2
            continue
        if marker in _FRAMES:
            height, width = (int.from_bytes(data[place + at : place + at + 2], "big") for at in (5, 7))
            return (width, height) if width and height else None
        place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    return None


class Scale(NamedTuple):
    """From an image's pixels to its small picture's: (u + 0.5) across - 0.5. width, height: of the picture [px]."""

    across: float
    down: float
    width: int
    height: int

    def place(self, u: float, v: float) -> tuple[float, float]:
        """The same place in the picture."""
        return (u + 0.5) * self.across - 0.5, (v + 0.5) * self.down - 0.5

    def matrix(self) -> Floats:
        """The same as (3, 3), for homogeneous pixels."""
        across, down = self.across, self.down
        return np.array([[across, 0.0, 0.5 * across - 0.5], [0.0, down, 0.5 * down - 0.5], [0.0, 0.0, 1.0]])


def scale_of(picture: pb.Picture) -> Scale | None:
    """Where ``picture`` lies in its camera's image; None where it is no picture."""
    size = jpeg_size(picture.jpeg)
    if size is None or not (picture.width and picture.height):
        return None
    return Scale(size[0] / picture.width, size[1] / picture.height, *size)
