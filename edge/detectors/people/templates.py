"""Templates of people, and how well they explain a silhouette.

A template consists of three bars (head, trunk, legs) of the height that the height model gives at that place. Its gain
is a sum over boxes, evaluated by integral images for all candidate places at once, because calls on short arrays make
up most of a template's cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from edge.detectors.people.height_model import HeightModel
from protocols.geometry.types import Bools, Floats, Image, Ints, Singles

Box = tuple[float, float, float, float]
Window = tuple[int, int, int, int]  # left, top, right, bottom
BARS = ((0.065, 0.0, 0.14), (0.125, 0.14, 0.52), (0.095, 0.52, 1.0))
"""Half-breadth, upper and lower end of each bar, over the height."""
TEMPLATE_AREA = sum(2.0 * half * (low - high) for half, high, low in BARS)
# Log-likelihood ratio of body to background where there is no silhouette, relative to that of a silhouette pixel.
BACKGROUND_WEIGHT = -0.45
_BAR_WEIGHTS = (2.5, 1.0, 1.0)  # a head is small, but determines the place best
_ABOVE, _BELOW = (0.07, -0.1, -0.02), (0.1, 0.02, 0.12)
"""Boxes that must be empty, as BARS: above the head, and (from the foot down) below the feet."""
_OVERSHOOT_PENALTY = 1.0  # weight against a template where the silhouette extends above the head or below the feet
_TORSO = (0.1, 0.2, 0.5)  # as BARS
# std of clothing colours [8-bit steps]; weight of a torso's pixel
_COLOUR_STD, _CLOTHING_WEIGHT = 45.0, 1.0
_FROM_TOP = np.array([*BARS, _ABOVE, _TORSO, _BELOW]).T
_EDGES = np.stack([-_FROM_TOP[0], _FROM_TOP[0], _FROM_TOP[1], _FROM_TOP[2]])[:, :, None]
"""Left, right, upper and lower edges of a template's boxes, over the height: (4, 6, 1); the last box from the foot
down.
"""


@dataclass(slots=True)
class Template:
    """A template: centre column u, foot row and height [px of a silhouette region].

    relative_height: its height over that of the height model at this place; expected_relative_height: prior of it.
    expected: index of the prediction that it belongs to, -1 = none; expected_place: predicted place. gain: see
    ``SilhouetteRegion.gains``. unmoved_state: search window and its coverage at the last refinement, if the template
    did not move.
    """

    u: float
    foot: float
    height: float
    relative_height: float = 1.0
    expected: int = -1
    expected_place: tuple[float, float] | None = None
    gain: float = 0.0
    expected_relative_height: float = 1.0
    unmoved_state: tuple[Window, bytes] | None = None

    @property
    def top(self) -> float:
        """Row of the top of the head."""
        return self.foot - self.height

    def bars(self) -> list[tuple[slice, slice]]:
        """Rows and columns of head, trunk and legs."""
        return [self._part(*bar) for bar in BARS]

    def torso(self) -> tuple[slice, slice]:
        """Rows and columns of the clothes between shoulders and hips."""
        return self._part(*_TORSO)

    def _part(self, half: float, high: float, low: float) -> tuple[slice, slice]:
        a, b = round(self.u - half * self.height), round(self.u + half * self.height)
        c, d = round(self.top + high * self.height), round(self.top + low * self.height)
        return slice(max(c, 0), max(d, 0)), slice(max(a, 0), max(b, 0))


@dataclass(frozen=True, slots=True)
class Placements:
    """Boxes of n candidate templates. corners: (4, 6, n) of the boxes in the flattened integral image of a window."""

    window: Window
    corners: Ints


class SilhouetteRegion:
    """One region of the working image with its silhouettes, and which of its pixels templates cover.

    weight: (h, w) log-likelihood ratio of body to background; filled: (h, w) 0..1 silhouette. origin: of the region in
    the working image, x and y; scales: working px per image px, x and y.
    """

    def __init__(
        self,
        weight: Singles,
        filled: Singles,
        origin: tuple[int, int],
        scales: tuple[float, float],
        height_model: HeightModel,
    ) -> None:
        self.weight, self.filled = weight, filled
        self.origin, self.scales, self.height_model = origin, scales, height_model
        self._covered = np.zeros(weight.shape, np.uint8)  # number of templates that cover a pixel
        self._uncovered = np.ones(weight.shape, np.float32)  # 1 where no template covers
        self._uncovered_weight = weight.copy()
        self._bars: dict[int, list[tuple[slice, slice]]] = {}  # of the templates that cover the region
        self._clothing_evidence: dict[int, Singles] = {}
        wide, high = height_model.size
        left, top = origin
        # Beyond the image nothing is known; beyond this region only, it is empty.
        self._limits: Window = -left, -top, round(wide * scales[0]) - left, round(high * scales[1]) - top

    @property
    def at_bottom(self) -> bool:
        """Whether the image ends where this region does: feet may be below it."""
        return self._limits[3] <= int(self.weight.shape[0]) + 1

    def set_clothing(self, colours: Image, clothing: dict[int, Floats]) -> None:
        """Use clothing colours as evidence for predicted people.

        colours: (h, w, 3) BGR of this region. clothing: mean BGR colour (3,) by index of the prediction.
        """
        planes = [plane.astype(np.float32) for plane in cv2.split(colours)]
        for index, one in clothing.items():
            blue, green, red = (
                np.square(plane - value) for plane, value in zip(planes, one.astype(np.float32), strict=True)
            )
            away = (blue + green + red) / np.float32(_COLOUR_STD**2)
            self._clothing_evidence[index] = (np.float32(1.0) - np.minimum(away, np.float32(2.0))) * self.filled

    def from_image(self, u: float, foot: float, height: float) -> tuple[float, float, float]:
        """A foot point and height [px of the image] in this region."""
        fx, fy = self.scales
        return u * fx - self.origin[0], foot * fy - self.origin[1], height * fy

    def heights(self, u: Floats, foot: Floats) -> Floats:
        """Heights [working px] of people whose foot points are in this region."""
        fx, fy = self.scales
        return self.height_model.heights_at((u + self.origin[0]) / fx, (foot + self.origin[1]) / fy) * fy

    def placements(self, u: Floats, foot: Floats, height: Floats) -> Placements:
        """Boxes of templates (n,)."""
        edges = _EDGES * height
        edges[:2] += u
        edges[2:, :5] += foot - height
        edges[2:, 5] += foot
        at = np.rint(edges, out=edges).astype(np.intp)
        # The trunk is the broadest box; the empty boxes above the head and below the feet are the outermost rows.
        window = int(at[0, 1].min()), int(at[2, 3].min()), int(at[1, 1].max()), int(at[3, 5].max())
        inside = _clipped(window, self._limits)
        if inside != window:
            left, top, right, bottom = self._limits
            for one, least, most in ((at[:2], left, right), (at[2:], top, bottom)):
                np.minimum(np.maximum(one, least, out=one), most, out=one)
        left, top, right, _ = inside
        at[:2] -= left
        at[2:] -= top
        at[2:] *= right - left + 1
        corners = np.empty((4, *at.shape[1:]), dtype=np.intp)
        np.add(at[3], at[1], out=corners[0])
        np.add(at[2], at[1], out=corners[1])
        np.add(at[3], at[0], out=corners[2])
        np.add(at[2], at[0], out=corners[3])
        return Placements(inside, corners)

    def gains(self, placements: Placements, owner: int = -1) -> Floats:
        """Gains (n,) of templates: the weight that they newly explain, less the empty pixels that they cover.

        owner: index of the prediction that they belong to, whose clothing counts too.
        """
        sums = _box_sums(self._uncovered_weight, placements, slice(None), BACKGROUND_WEIGHT)
        gains: Floats = _BAR_WEIGHTS[0] * sums[0] + _BAR_WEIGHTS[1] * sums[1] + _BAR_WEIGHTS[2] * sums[2]
        gains -= _OVERSHOOT_PENALTY * (np.maximum(sums[3], 0.0) + np.maximum(sums[5], 0.0))
        # Torso pixels that match the clothing and are not covered count for the template, others against it.
        clothing_evidence = self._clothing_evidence.get(owner)
        return (
            gains
            if clothing_evidence is None
            else gains + _CLOTHING_WEIGHT * _box_sums(clothing_evidence, placements, 4, 0.0, self._uncovered)
        )

    def marginal_gains(self, placed: list[Template]) -> Floats:
        """As ``gains``, of templates (n,) that cover this region: each as if it alone were missing."""
        u, foot, height = np.array([(one.u, one.foot, one.height) for one in placed]).T
        placements = self.placements(u, foot, height)
        # Within its bars no other template covers where the count is one; above and below them it covers nothing
        # itself.
        single = (self._covered <= 1).astype(np.float32)
        own = _box_sums(self.weight * single, placements, slice(0, 3), BACKGROUND_WEIGHT)
        near = _box_sums(self._uncovered_weight, placements, slice(3, 6, 2), BACKGROUND_WEIGHT)
        gains: Floats = _BAR_WEIGHTS[0] * own[0] + _BAR_WEIGHTS[1] * own[1] + _BAR_WEIGHTS[2] * own[2]
        gains -= _OVERSHOOT_PENALTY * (np.maximum(near[0], 0.0) + np.maximum(near[1], 0.0))
        for index, one in enumerate(placed):
            clothing_evidence = self._clothing_evidence.get(one.expected)
            if clothing_evidence is not None:
                torso = one.torso()
                gains[index] += _CLOTHING_WEIGHT * float((clothing_evidence[torso] * single[torso]).sum())
        return gains

    def cover(self, one: Template) -> None:
        """Mark the pixels of a template as explained."""
        bars = self._bars[id(one)] = one.bars()
        for bar in bars:
            self._covered[bar] += 1
        self._update_uncovered(bars)

    def uncover(self, one: Template) -> None:
        """Remove a template."""
        bars = self._bars.pop(id(one))
        for bar in bars:
            self._covered[bar] -= 1
        self._update_uncovered(bars)

    def _update_uncovered(self, bars: list[tuple[slice, slice]]) -> None:
        """Update the uncovered weight within the bars of a template."""
        (head, _), (_, trunk), (legs, _) = bars
        part = slice(head.start, legs.stop), trunk
        clear = self._uncovered[part] = self._covered[part] == 0
        np.multiply(self.weight[part], clear, out=self._uncovered_weight[part])

    def coverage(self, window: Window) -> bytes:
        """Coverage of a window as bytes, to detect changes."""
        left, top, right, bottom = (max(edge, 0) for edge in window)
        return self._covered[top:bottom, left:right].tobytes()

    def unexplained(self) -> Singles:
        """Positive weight (h, w) that no template covers."""
        return np.asarray(np.maximum(self._uncovered_weight, np.float32(0.0)), dtype=np.float32)


def _box_sums(
    values: Singles, placements: Placements, boxes: slice | int, outside: float, clear: Singles | None = None
) -> Floats:
    """Sums of values (h, w) over boxes of templates: (boxes, n).

    outside: value beyond (h, w). clear: (h, w) factor of the values.
    """
    left, top, right, bottom = placements.window
    corners = placements.corners[:, boxes]
    if left >= right or top >= bottom:
        return np.zeros(corners.shape[1:])
    height, width = values.shape
    x, y, end, below = inside = _clipped(placements.window, (0, 0, width, height))
    part = values[y:below, x:end]
    if clear is not None:
        part = part * clear[y:below, x:end]
    if inside != placements.window:
        # Faster than cv2.copyMakeBorder.
        framed = np.full((bottom - top, right - left), outside, np.float32)
        framed[y - top : below - top, x - left : end - left] = part
        part = framed
    sums = cv2.integral(part).ravel()
    lower_right, upper_right, lower_left, upper_left = sums.take(corners)
    return np.asarray(lower_right - upper_right - lower_left + upper_left, dtype=np.float64)


def _clipped(window: Window, limits: Window) -> Window:
    (a, b, c, d), (left, top, right, bottom) = window, limits
    return min(max(a, left), right), min(max(b, top), bottom), min(max(c, left), right), min(max(d, top), bottom)


def template_mask(one: Template, shape: tuple[int, ...]) -> Bools:
    """Pixels (h, w) that a template covers."""
    covered = np.zeros(shape, dtype=np.bool_)
    for rows, columns in one.bars():
        covered[rows, columns] = True
    return covered
