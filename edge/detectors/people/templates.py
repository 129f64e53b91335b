"""Templates of people, and how well they explain a silhouette.

A template is three bars (head, trunk, legs) of the height that people have at that place. What one explains is sums
over boxes, which integral images tell: of all places that are to be compared at once, as calls upon short arrays are
most of what a template costs.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.people.height_model import Stature
from protocols.geometry.types import Bools, Floats, Ints

Image = npt.NDArray[np.uint8]
_Picture = npt.NDArray[np.float32]
Box = tuple[float, float, float, float]
Window = tuple[int, int, int, int]  # left, top, right, bottom
BARS = ((0.065, 0.0, 0.14), (0.125, 0.14, 0.52), (0.095, 0.52, 1.0))
"""Half-breadth, upper and lower end of each bar, of the height."""
AREA = sum(2.0 * half * (low - high) for half, high, low in BARS)
# Log-likelihood ratio of body to background where no silhouette is, against that of a silhouette's pixel.
EMPTY = -0.45
_COUNTS = (2.5, 1.0, 1.0)  # a head is small, but says most about where somebody stands
_ABOVE, _BELOW = (0.07, -0.1, -0.02), (0.1, 0.02, 0.12)
"""What must be empty, as BARS: above the head, and (from the foot down) below the feet."""
_BEYOND = 1.0  # by how much a silhouette that goes on above the head or below the feet speaks against a template
_TORSO = (0.1, 0.2, 0.5)  # as BARS
_COLOUR, _LOOKS = 45.0, 1.0  # 8-bit steps by which clothes differ from themselves; weight of a torso's pixel
_FROM_TOP = np.array([*BARS, _ABOVE, _TORSO, _BELOW]).T
_EDGES = np.stack([-_FROM_TOP[0], _FROM_TOP[0], _FROM_TOP[1], _FROM_TOP[2]])[:, :, None]
"""Left, right, upper and lower edges of a template's boxes, of the height: (4, 6, 1); the last from the foot down."""


@dataclass(slots=True)
class Template:
    """A template: its middle u, foot and height [px of a part of the working picture].

    stature: its height, of the usual one there; of: what that is expected to be.
    expected: which expectation it is, -1 = none; home: where that was. gain: what it explains, see ``Scene.gains``.
    still: window that it was last sought in, and what covered that, if it stayed where it was.
    """

    u: float
    foot: float
    tall: float
    stature: float = 1.0
    expected: int = -1
    home: tuple[float, float] | None = None
    gain: float = 0.0
    of: float = 1.0
    still: tuple[Window, bytes] | None = None

    @property
    def top(self) -> float:
        """Of the head."""
        return self.foot - self.tall

    def bars(self) -> list[tuple[slice, slice]]:
        """Rows and columns of its head, trunk and legs."""
        return [self._part(*bar) for bar in BARS]

    def torso(self) -> tuple[slice, slice]:
        """Rows and columns of its clothes between shoulders and hips."""
        return self._part(*_TORSO)

    def _part(self, half: float, high: float, low: float) -> tuple[slice, slice]:
        a, b = round(self.u - half * self.tall), round(self.u + half * self.tall)
        c, d = round(self.top + high * self.tall), round(self.top + low * self.tall)
        return slice(max(c, 0), max(d, 0)), slice(max(a, 0), max(b, 0))


@dataclass(frozen=True, slots=True)
class Places:
    """Where n templates would be. corners: (4, 6, n) of their boxes in the flattened integral image of a window."""

    window: Window
    corners: Ints


class Scene:
    """One part of the working picture, and what of it is explained.

    weight: (h, w) what it speaks for a body there; filled: (h, w) 0..1 silhouette.
    origin: of the part in the working picture, x and y; scales: working px a px, x and y.
    """

    def __init__(
        self,
        weight: _Picture,
        filled: _Picture,
        origin: tuple[int, int],
        scales: tuple[float, float],
        stature: Stature,
    ) -> None:
        self.weight, self.filled = weight, filled
        self.origin, self.scales, self.stature = origin, scales, stature
        self._covered = np.zeros(weight.shape, np.uint8)  # by how many
        self._clear, self._open = np.ones(weight.shape, np.float32), weight.copy()  # where by nobody, 1; weight there
        self._bars: dict[int, list[tuple[slice, slice]]] = {}  # of those who cover it
        self._looks: dict[int, _Picture] = {}
        wide, high = stature.size
        left, top = origin
        # What is beyond the picture cannot be seen; what is only beyond this part is empty.
        self._limits: Window = -left, -top, round(wide * scales[0]) - left, round(high * scales[1]) - top

    @property
    def at_bottom(self) -> bool:
        """Whether the picture ends where this part does: feet may be below it."""
        return self._limits[3] <= int(self.weight.shape[0]) + 1

    def dress(self, colours: Image, clothes: dict[int, Floats]) -> None:
        """Let those who are expected be known by their clothes. colours: (h, w, 3) of this part."""
        planes = [plane.astype(np.float32) for plane in cv2.split(colours)]
        for index, one in clothes.items():
            blue, green, red = (np.square(plane - of) for plane, of in zip(planes, one.astype(np.float32), strict=True))
            away = (blue + green + red) / np.float32(_COLOUR**2)
            self._looks[index] = (np.float32(1.0) - np.minimum(away, np.float32(2.0))) * self.filled

    def inward(self, u: float, foot: float, tall: float) -> tuple[float, float, float]:
        """A foot point and height [px] of the picture in this part."""
        fx, fy = self.scales
        return u * fx - self.origin[0], foot * fy - self.origin[1], tall * fy

    def heights(self, u: Floats, foot: Floats) -> Floats:
        """Heights [working px] of people whose feet are at places of this part."""
        fx, fy = self.scales
        return self.stature.at((u + self.origin[0]) / fx, (foot + self.origin[1]) / fy) * fy

    def places(self, u: Floats, foot: Floats, tall: Floats) -> Places:
        """Where templates (n,) would be."""
        edges = _EDGES * tall
        edges[:2] += u
        edges[2:, :5] += foot - tall
        edges[2:, 5] += foot
        at = np.rint(edges, out=edges).astype(np.intp)
        # The trunk is the broadest box; nothing is higher than what is above the head or lower than what is below.
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
        return Places(inside, corners)

    def gains(self, places: Places, owner: int = -1) -> Floats:
        """What templates (n,) would explain of what is not yet, less what they cover of nothing.

        owner: of the expectation that they are for, whose clothes count too.
        """
        held = _held(self._open, places, slice(None), EMPTY)
        gains: Floats = _COUNTS[0] * held[0] + _COUNTS[1] * held[1] + _COUNTS[2] * held[2]
        gains -= _BEYOND * (np.maximum(held[3], 0.0) + np.maximum(held[5], 0.0))
        # What a torso has of its clothes' colours where no other hides it, less what has not.
        looks = self._looks.get(owner)
        return gains if looks is None else gains + _LOOKS * _held(looks, places, 4, 0.0, self._clear)

    def own_gains(self, placed: list[Template]) -> Floats:
        """As ``gains`` of templates (n,) that cover this part, each of them as if it alone were not there."""
        u, foot, tall = np.array([(one.u, one.foot, one.tall) for one in placed]).T
        places = self.places(u, foot, tall)
        # Within its own bars nobody else is where one template covers; above and below them it covers nothing itself.
        single = (self._covered <= 1).astype(np.float32)
        own = _held(self.weight * single, places, slice(0, 3), EMPTY)
        near = _held(self._open, places, slice(3, 6, 2), EMPTY)
        gains: Floats = _COUNTS[0] * own[0] + _COUNTS[1] * own[1] + _COUNTS[2] * own[2]
        gains -= _BEYOND * (np.maximum(near[0], 0.0) + np.maximum(near[1], 0.0))
        for index, one in enumerate(placed):
            looks = self._looks.get(one.expected)
            if looks is not None:
                torso = one.torso()
                gains[index] += _LOOKS * float((looks[torso] * single[torso]).sum())
        return gains

    def cover(self, one: Template) -> None:
        """What a template covers is explained."""
        bars = self._bars[id(one)] = one.bars()
        for bar in bars:
            self._covered[bar] += 1
        self._note(bars)

    def uncover(self, one: Template) -> None:
        """It is not there any more."""
        bars = self._bars.pop(id(one))
        for bar in bars:
            self._covered[bar] -= 1
        self._note(bars)

    def _note(self, bars: list[tuple[slice, slice]]) -> None:
        """What is not covered now, of what is within the bars of a template."""
        (head, _), (_, trunk), (legs, _) = bars
        part = slice(head.start, legs.stop), trunk
        clear = self._clear[part] = self._covered[part] == 0
        np.multiply(self.weight[part], clear, out=self._open[part])

    def others(self, window: Window) -> bytes:
        """What covers a window, to be compared with what did at another time."""
        left, top, right, bottom = (max(edge, 0) for edge in window)
        return self._covered[top:bottom, left:right].tobytes()

    def unexplained(self) -> _Picture:
        """What speaks for a body (h, w), 0 and more, and is not covered."""
        return np.asarray(np.maximum(self._open, np.float32(0.0)), dtype=np.float32)


def _held(
    values: _Picture, places: Places, boxes: slice | int, outside: float, clear: _Picture | None = None
) -> Floats:
    """Sums of values (h, w) over those boxes of templates: (boxes, n).

    outside: what is there beyond (h, w). clear: (h, w) values are multiplied by it.
    """
    left, top, right, bottom = places.window
    corners = places.corners[:, boxes]
    if left >= right or top >= bottom:
        return np.zeros(corners.shape[1:])
    height, width = values.shape
    x, y, end, below = inside = _clipped(places.window, (0, 0, width, height))
    part = values[y:below, x:end]
    if clear is not None:
        part = part * clear[y:below, x:end]
    if inside != places.window:
        # Faster than a border of cv2's.
        framed = np.full((bottom - top, right - left), outside, np.float32)
        framed[y - top : below - top, x - left : end - left] = part
        part = framed
    sums = cv2.integral(part).ravel()
    lower_right, upper_right, lower_left, upper_left = sums.take(corners)
    return np.asarray(lower_right - upper_right - lower_left + upper_left, dtype=np.float64)


def _clipped(window: Window, limits: Window) -> Window:
    (a, b, c, d), (left, top, right, bottom) = window, limits
    return min(max(a, left), right), min(max(b, top), bottom), min(max(c, left), right), min(max(d, top), bottom)


def mask(one: Template, shape: tuple[int, ...]) -> Bools:
    """Which pixels (h, w) a template covers."""
    covered = np.zeros(shape, dtype=np.bool_)
    for rows, columns in one.bars():
        covered[rows, columns] = True
    return covered
