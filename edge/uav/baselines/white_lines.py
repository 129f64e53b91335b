"""Section 3.1: white lines as strong edges, and the road's first section beside the target."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.tracker import Box
from protocols.geometry.types import Bools, Floats

Grey = npt.NDArray[np.uint8]

_LINE_KERNEL = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
_SMALLEST_LINE = 12  # px at half the resolution: less is a speck
_LINE_CONTRAST = 22  # grey levels
_SCALE = 2  # edges are looked for at half the resolution
CAP = 8.0
"""px: an edge farther away than this is no edge of this line."""
_ACROSS = 2.0  # how far from the target the lines are looked for, in its longer side
_CLEAR = 0.15  # nearer than this is the target itself, in the same
_HALF_WIDTHS = (0.35, 1.4)  # of a lane or a road, in the same
_ALONG = (1.5, 4.0)  # how far along the road the edges are averaged, to each side; the second sees across a crossing
_CANDIDATES = 5
_SAMPLES = 41
_ANGLES = 72
_WEAKEST = 8.0  # grey levels, averaged along the road


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """distance: (h/2, w/2) float32, from each pixel of the half-size image to the nearest edge [full-size px]."""

    distance: npt.NDArray[np.float32]

    @classmethod
    def of(cls, grey: Grey, marked: bool = True) -> Edges:
        """Edges of a grey image (h, w): of white lines on a marked road, else of anything.

        White lines are what is brighter than both sides and thin; edges of any kind lie all over grass and trees.
        """
        half = cv2.pyrDown(grey)
        if marked:
            thin = (cv2.morphologyEx(half, cv2.MORPH_TOPHAT, _LINE_KERNEL) > _LINE_CONTRAST).astype(np.uint8)
            _, part, statistics, _ = cv2.connectedComponentsWithStats(thin, connectivity=8)
            large = statistics[:, cv2.CC_STAT_AREA] >= _SMALLEST_LINE
            large[0] = False
            edges = np.where(large[part], 255, 0)
        else:
            edges = cv2.Canny(half, 60, 140)
        gaps = np.asarray(255 - edges, dtype=np.uint8)
        return cls(np.asarray(np.minimum(cv2.distanceTransform(gaps, cv2.DIST_L2, 3), CAP) * _SCALE, dtype=np.float32))

    def at(self, places: Floats) -> tuple[Floats, Bools]:
        """Distances (...) of places (..., 2) [px] to the nearest edge, capped, and which are in the image."""
        height, width = self.distance.shape
        index = np.rint(places / _SCALE - 0.25).astype(np.int64)
        x, y = index[..., 0], index[..., 1]
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        found = self.distance[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
        return np.minimum(found, CAP).astype(np.float64), inside


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """A road across, beside the target: its middle (2,), its heading [rad] (of the two, any) and half width [px]."""

    middle: Floats
    heading: float
    half_width: float


def sections(grey: Grey, target: Box) -> list[Section]:
    """Where the road may be beside the target, empty where there are no edges.

    Section 3.1 looks for strong edges across the direction of travel, which is not known yet: of all directions, those
    are taken in which the edges of white lines are strong on both sides. Where there are no white lines, any edges
    along the road will do. Directions may come twice.
    """
    longer = max(target.width, target.height)
    centre = np.array([target.x + target.width / 2, target.y + target.height / 2])
    angles = np.arange(_ANGLES) * np.pi / _ANGLES
    normal = np.column_stack([-np.sin(angles), np.cos(angles)])
    reach = round(_ACROSS * longer)
    offsets = np.arange(-reach, reach + 1, dtype=np.float64)
    left, right = offsets < -_CLEAR * longer, offsets > _CLEAR * longer
    found: list[Section] = []
    near, far = (_profiles(grey, target, angles, offsets, along * longer) for along in _ALONG)
    for strength in (_ridges(near), _ridges(far), _steps(near)):
        on_left, on_right = strength[:, left].max(axis=1), strength[:, right].max(axis=1)
        both = np.minimum(on_left, on_right)
        score = np.where(both >= _WEAKEST, both + 0.1 * (on_left + on_right), 0.0)
        for _ in range(_CANDIDATES):
            if score.max() <= 0.0:
                break
            best = int(score.argmax())
            a = float(offsets[left][strength[best, left].argmax()])
            b = float(offsets[right][strength[best, right].argmax()])
            if _HALF_WIDTHS[0] * longer < 0.5 * (b - a) < _HALF_WIDTHS[1] * longer:
                found.append(Section(centre + 0.5 * (a + b) * normal[best], float(angles[best]), 0.5 * (b - a)))
            apart = np.abs(np.arange(_ANGLES) - best)
            score[np.minimum(apart, _ANGLES - apart) < _ANGLES // 12] = 0.0
    return found


def _profiles(grey: Grey, target: Box, angles: Floats, offsets: Floats, reach: float) -> Floats:
    """Mean grey level (a, o) of lines in directions (a,), reach [px] both ways, (o,) from the target's middle.

    The target itself does not count; nan where too little of a line is in the image.
    """
    x0, y0 = target.x + target.width / 2, target.y + target.height / 2
    along = np.linspace(-reach, reach, _SAMPLES)
    cos, sin = np.cos(angles)[:, None, None], np.sin(angles)[:, None, None]
    across = offsets[:, None]
    dx, dy = along * cos - across * sin, along * sin + across * cos
    x, y = np.rint(x0 + dx).astype(np.int64), np.rint(y0 + dy).astype(np.int64)
    height, width = grey.shape
    counted = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    counted &= (np.abs(dx) > target.width / 2 + 3.0) | (np.abs(dy) > target.height / 2 + 3.0)
    total = (grey[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)] * counted).sum(axis=2)
    count = counted.sum(axis=2)
    return np.where(count > _SAMPLES // 3, total / np.maximum(count, 1), np.nan)


def _ridges(profile: Floats) -> Floats:
    """How much brighter than both sides, 3 or 6 px away: white lines. profile (a, o) -> (a, o), 0 where unknown."""
    found = np.zeros_like(profile)
    for apart in (3, 6):
        middle = profile[:, apart:-apart]
        sides = np.maximum(profile[:, : -2 * apart], profile[:, 2 * apart :])
        found[:, apart:-apart] = np.fmax(found[:, apart:-apart], middle - sides)
    return found


def _steps(profile: Floats) -> Floats:
    """By how much the two sides differ, 2 px away. profile (a, o) -> (a, o), 0 where unknown."""
    found = np.zeros_like(profile)
    found[:, 2:-2] = np.fmax(0.0, np.abs(profile[:, 4:] - profile[:, :-4]))
    return found
