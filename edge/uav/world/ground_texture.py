"""Ground texture, one large image, north up: grass, soil, yards, pavements, asphalt, white lines, shadows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.world.noise import value_noise
from edge.uav.world.roads import STEP, Road, crossing_outline
from protocols.geometry.types import Floats

METRES_PER_PIXEL = 0.1  # of the rendered ground
_SHIFT = 4  # bits of OpenCV's fixed-point coordinates
_GRASS, _SOIL, _YARD = (np.array(c, np.float32) for c in ((66, 112, 98), (104, 132, 150), (146, 150, 150)))
_ASPHALT, _PAVEMENT, _PAINT = (np.array(c, np.float32) for c in ((94, 92, 90), (150, 156, 160), (224, 226, 226)))
_PAVEMENT_WIDTH = 1.6  # m
_SHADOW_DEPTH = np.float32(0.42)


@dataclass(frozen=True, slots=True)
class Area:
    """A rectangle of ground [m]."""

    north: tuple[float, float]
    east: tuple[float, float]

    @property
    def size(self) -> float:
        """Area [m²]."""
        return (self.north[1] - self.north[0]) * (self.east[1] - self.east[0])

    def contains(self, points: Floats) -> npt.NDArray[np.bool_]:
        """Which of points (n, 2) lie in it."""
        n, e = points[:, 0], points[:, 1]
        return np.asarray((n > self.north[0]) & (n < self.north[1]) & (e > self.east[0]) & (e < self.east[1]))


@dataclass(frozen=True, slots=True, eq=False)
class GroundTexture:
    """The ground texture. image: (h, w, 3) BGR; ground_from_pixel: (3, 3), (north, east, 1) from (column, row, 1)."""

    image: npt.NDArray[np.uint8]
    ground_from_pixel: Floats


def paint_ground(
    rng: np.random.Generator, area: Area, roads: Sequence[Road], yards: Sequence[Floats], shadows: Sequence[Floats]
) -> GroundTexture:
    """Paint the ground texture. yards, shadows: outlines (k, 2) [m]."""
    canvas = _Canvas(area)
    rows, columns = canvas.shape
    fine = value_noise(rng, rows, columns, 3.0, 2, gain=0.8)
    middle = value_noise(rng, rows, columns, 18.0, 3, gain=0.7)
    large = value_noise(rng, rows, columns, 160.0, 2)
    soil = np.clip(1.6 * (large - 0.75) + 0.35 * middle, 0.0, 1.0)[..., None]
    dry = np.clip(0.5 + 0.25 * middle + 0.2 * large, 0.0, 1.0)[..., None]
    texture = (1.0 - soil) * (_GRASS + dry * np.array([8, 6, 40], np.float32)) + soil * _SOIL
    texture *= (1.0 + 0.11 * fine + 0.13 * middle + 0.05 * large)[..., None]
    asphalt_tone = 1.0 + 0.055 * fine + 0.04 * middle + 0.04 * large
    _blend(texture, canvas.filled(yards), asphalt_tone, _YARD)
    slabs = np.asarray(1.0 + 0.05 * fine + 0.05 * np.sign(middle), np.float32)
    _blend(texture, canvas.bands(roads, 2.0 * _PAVEMENT_WIDTH), slabs, _PAVEMENT)
    _add_repairs(rng, asphalt_tone, canvas, roads)
    aprons = [
        outline
        for k, one in enumerate(roads)
        for other in roads[:k]
        if (outline := crossing_outline(one, other)) is not None
    ]
    open_space = canvas.filled(aprons)
    _blend(texture, np.asarray(cv2.max(canvas.bands(roads, 0.0), open_space), np.uint8), asphalt_tone, _ASPHALT)
    worn = np.asarray(1.0 - 0.1 * np.clip(middle, 0.0, 3.0) + 0.04 * fine, np.float32)
    _blend(texture, canvas.markings(roads, open_space), worn, _PAINT)
    dark = np.asarray(cv2.GaussianBlur(canvas.filled(shadows), (0, 0), 2.0), np.uint8)
    shaded = dark > 0
    texture[shaded] *= (1.0 - _SHADOW_DEPTH / 255.0 * dark[shaded].astype(np.float32))[:, None]
    return GroundTexture(np.clip(texture, 0, 255).astype(np.uint8), canvas.ground_from_pixel)


def _blend(
    texture: npt.NDArray[np.float32],
    mask: npt.NDArray[np.uint8],
    tone: npt.NDArray[np.float32],
    colour: npt.NDArray[np.float32],
) -> None:
    """Alpha-blend a colour of varying tone where the mask is set, in place."""
    chosen = mask > 0
    under = texture[chosen]
    texture[chosen] = under + (mask[chosen].astype(np.float32) / 255.0)[:, None] * (
        tone[chosen][:, None] * colour - under
    )


def _add_repairs(
    rng: np.random.Generator, tone: npt.NDArray[np.float32], canvas: _Canvas, roads: Sequence[Road]
) -> None:
    """Patches of newer asphalt, cracks and oil stains, in place."""
    for road in roads:
        curve = road.centre
        for s in rng.uniform(curve.begin, curve.end, int((curve.end - curve.begin) / 9.0)):
            length, width = rng.uniform(0.6, 6.0), rng.uniform(0.15, 1.6)
            box = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array([length, width]) / 2
            side = rng.uniform(-0.42, 0.42) * road.width
            outline, _ = curve.at(s + box[:, 0], 0.0)
            _, course = curve.at(np.array([s]))
            outline = outline + (side + box[:, 1])[:, None] * np.array([-np.sin(course[0]), np.cos(course[0])])
            mask = canvas.fixed(outline)
            value = float(rng.choice([0.78, 0.86, 0.9, 1.1]))
            cv2.fillPoly(tone, [mask], value, cv2.LINE_8, _SHIFT)


class _Canvas:
    """Rasterises masks in the ground texture's pixels."""

    def __init__(self, area: Area) -> None:
        self.shape = (
            int(np.ceil((area.north[1] - area.north[0]) / METRES_PER_PIXEL)),
            int(np.ceil((area.east[1] - area.east[0]) / METRES_PER_PIXEL)),
        )
        self._north, self._east = area.north[1], area.east[0]
        g = METRES_PER_PIXEL
        self.ground_from_pixel = np.array([[0.0, -g, self._north], [g, 0.0, self._east], [0.0, 0.0, 1.0]])

    def fixed(self, ground: Floats) -> npt.NDArray[np.int32]:
        """Points (n, 2) [m] as fixed-point pixels (n, 2)."""
        pixels = np.column_stack([ground[:, 1] - self._east, self._north - ground[:, 0]]) / METRES_PER_PIXEL
        return np.rint(np.clip(pixels, -1e5, 1e5) * (1 << _SHIFT)).astype(np.int32)

    def filled(self, outlines: Sequence[Floats]) -> npt.NDArray[np.uint8]:
        """Mask of polygons."""
        mask = np.zeros(self.shape, np.uint8)
        for outline in outlines:
            cv2.fillPoly(mask, [self.fixed(outline)], 255, cv2.LINE_AA, _SHIFT)
        return mask

    def bands(self, roads: Sequence[Road], extra: float) -> npt.NDArray[np.uint8]:
        """Mask of roads, widened by ``extra`` [m] in total."""
        mask = np.zeros(self.shape, np.uint8)
        for road in roads:
            half = 0.5 * (road.width + extra)
            left, right = road.centre.offset(-half).points, road.centre.offset(half).points
            for k in range(0, len(left) - 1, 8):  # in pieces: the outline of a bend may intersect itself
                piece = np.vstack([left[k : k + 10], right[k : k + 10][::-1]])
                cv2.fillPoly(mask, [self.fixed(piece)], 255, cv2.LINE_AA, _SHIFT)
        return mask

    def markings(self, roads: Sequence[Road], open_space: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Mask of white lines: solid edges, dashed middles, none within crossings."""
        total = np.zeros(self.shape, np.uint8)
        for number, road in enumerate(roads):
            mask = np.zeros(self.shape, np.uint8)
            for side in (-1.0, 1.0):
                self._line(mask, road.centre.offset(side * (0.5 * road.width - 0.25)).points)
            middle, dash = road.centre.points, int(3.0 / STEP)
            for k in range(0, len(middle), 2 * dash):
                self._line(mask, middle[k : k + dash + 1])
            others = [other for k, other in enumerate(roads) if k != number]
            if others:
                mask[self.bands(others, 1.0) > 0] = 0
            total = np.asarray(cv2.max(total, mask), np.uint8)
        total[open_space > 0] = 0
        return total

    def _line(self, mask: npt.NDArray[np.uint8], points: Floats) -> None:
        if len(points) > 1:
            cv2.polylines(mask, [self.fixed(points)], False, 255, 2, cv2.LINE_AA, _SHIFT)
