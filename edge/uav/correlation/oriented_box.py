"""A box that turns with its target, and its pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.special import ndtr

from edge.uav.base import Box
from protocols.geometry.types import Floats, Image, Ints

_MAX_SHRINK = 2.0  # by linear interpolation alone; beyond, pixels are averaged first, against aliasing


@dataclass(frozen=True, slots=True)
class OrientedBox:
    """Centre x, y, width and height [px], and the angle [rad] from the image's x axis to the box's, y down."""

    x: float
    y: float
    width: float
    height: float
    angle: float = 0.0

    @staticmethod
    def upright(box: Box) -> OrientedBox:
        """A box that stands upright in the image."""
        return OrientedBox(box.x + 0.5 * (box.width - 1.0), box.y + 0.5 * (box.height - 1.0), box.width, box.height)

    @property
    def centre(self) -> Floats:
        """(2,) [px]."""
        return np.array([self.x, self.y])

    @property
    def sides(self) -> Floats:
        """Width and height (2,) [px]."""
        return np.array([self.width, self.height])

    @property
    def axes(self) -> Floats:
        """(2, 2): image from box axes."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.array([[c, -s], [s, c]])

    @property
    def extent(self) -> Floats:
        """Sides (2,) of the upright rectangle about it."""
        c, s = abs(np.cos(self.angle)), abs(np.sin(self.angle))
        return np.array([c * self.width + s * self.height, s * self.width + c * self.height])

    def at(self, centre: Floats) -> OrientedBox:
        """The same box about another centre (2,)."""
        return replace(self, x=float(centre[0]), y=float(centre[1]))

    def sized(self, sides: Floats) -> OrientedBox:
        """The same box with other sides (2,)."""
        return replace(self, width=float(sides[0]), height=float(sides[1]))

    def turned(self, angle: float) -> OrientedBox:
        """The same box turned by ``angle`` [rad]."""
        return replace(self, angle=float((self.angle + angle + np.pi) % (2.0 * np.pi) - np.pi))

    def share_inside(self, size: tuple[int, int]) -> float:
        """Share of its upright rectangle that lies in an image of this size."""
        half = 0.5 * self.extent
        low = np.maximum(self.centre - half, -0.5)
        high = np.minimum(self.centre + half, np.array(size) - 0.5)
        return float(np.prod(np.clip(high - low, 0.0, None)) / np.prod(2.0 * half))

    def probability_inside(self, std: float, size: tuple[int, int]) -> float:
        """Probability that the centre lies in an image of this size; std: of it, one coordinate [px]."""
        low, high = -self.centre / std, (np.array(size) - 1.0 - self.centre) / std
        return float(np.prod(ndtr(high) - ndtr(low)))


def crop(image: Image, box: OrientedBox, size: tuple[int, int]) -> Image:
    """The pixels of a box, resampled to ``size`` (width, height) [px]; beyond the image its border is repeated."""
    factor = np.array([box.width / size[0], box.height / size[1]])
    axes, centre = box.axes, box.centre
    linear = axes * factor
    if factor.max() > _MAX_SHRINK:
        # Along each axis by its own factor: a person is some four times as high as wide.
        shrink = np.maximum(np.square(axes) @ factor, 1.0).astype(int)
        image, low = _averaged(image, box, shrink)
        centre = (centre - low + 0.5) / shrink - 0.5
        linear = linear / shrink[:, None]
    matrix = np.column_stack([linear, centre - linear @ (0.5 * (np.array(size) - 1.0))])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(image, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def _averaged(image: Image, box: OrientedBox, shrink: Ints) -> tuple[Image, Floats]:
    """The part of the image about a box, reduced by integers (2,) along x and y, and its first pixel (2,)."""
    rows, columns = image.shape[:2]
    half = 0.5 * box.extent + 2 * shrink
    limit = np.array([columns, rows]) - shrink
    low = np.clip(np.floor(box.centre - half), 0, np.maximum(limit, 0)).astype(int)
    high = np.clip(np.ceil(box.centre + half), low + shrink, [columns, rows]).astype(int)
    cells = np.maximum((high - low) // shrink, 1)
    end = low + cells * shrink
    part = image[low[1] : end[1], low[0] : end[0]]
    small = cv2.resize(part, (int(cells[0]), int(cells[1])), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8), low.astype(np.float64)
