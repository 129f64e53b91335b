"""Section 3.1: detection of white lines as strong edges, and candidate road cross-sections beside the target."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.base import Box
from protocols.geometry.types import Bools, Floats

Grey = npt.NDArray[np.uint8]

_LINE_KERNEL = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
_MIN_LINE_AREA = 12  # px at half the resolution: smaller components are noise
_LINE_CONTRAST = 22  # grey levels
_SCALE = 2  # edges are detected at half the resolution
DISTANCE_CAP = 8.0
"""px: distances to edges are capped here; a farther edge does not belong to the line."""
_SEARCH_RADIUS = 2.0  # search distance from the target, in its longer side
_TARGET_RADIUS = 0.15  # radius of the target itself, in the same unit
_HALF_WIDTHS = (0.35, 1.4)  # of a lane or a road, in the same unit
_ALONG = (1.5, 4.0)  # averaging length along the road, to each side, same unit; the second bridges a crossing
_CANDIDATES = 5  # cross-sections of each kind of line: each more costs a fit of the road
_SAMPLES = 41  # along a line: 0.075 and 0.2 of the target's longer side apart
_ANGLES = 72  # over half a turn: 2.5 degrees apart
_MIN_STRENGTH = 8.0  # grey levels, averaged along the road


@dataclass(frozen=True, slots=True, eq=False)
class EdgeDistance:
    """distance: (h/2, w/2) float32, from each pixel of the half-size image to the nearest edge [full-size px]."""

    distance: npt.NDArray[np.float32]

    @classmethod
    def of(cls, grey: Grey, marked: bool = True) -> EdgeDistance:
        """Edges of a grey image (h, w): of white lines on a marked road, else Canny edges.

        White lines are thin and brighter than both sides; general edges occur everywhere on grass and trees.
        """
        half = cv2.pyrDown(grey)
        if marked:
            thin = (cv2.morphologyEx(half, cv2.MORPH_TOPHAT, _LINE_KERNEL) > _LINE_CONTRAST).astype(np.uint8)
            _, part, statistics, _ = cv2.connectedComponentsWithStats(thin, connectivity=8)
            large = statistics[:, cv2.CC_STAT_AREA] >= _MIN_LINE_AREA
            large[0] = False
            edges = np.where(large[part], 255, 0)
        else:
            edges = cv2.Canny(half, 60, 140)
        gaps = np.asarray(255 - edges, dtype=np.uint8)
        return cls(
            np.asarray(np.minimum(cv2.distanceTransform(gaps, cv2.DIST_L2, 3), DISTANCE_CAP) * _SCALE, dtype=np.float32)
        )

    def at(self, places: Floats) -> tuple[Floats, Bools]:
        """Capped distances (...) of points (..., 2) [px] to the nearest edge, and which are in the image."""
        height, width = self.distance.shape
        index = np.rint(places / _SCALE - 0.25).astype(np.int64)
        x, y = index[..., 0], index[..., 1]
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        found = self.distance[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
        return np.minimum(found, DISTANCE_CAP).astype(np.float64), inside


@dataclass(frozen=True, slots=True, eq=False)
class RoadSection:
    """A road cross-section at the target: midpoint (2,), heading [rad] (modulo pi) and half width [px]."""

    middle: Floats
    heading: float
    half_width: float


def find_sections(grey: Grey, target: Box) -> list[RoadSection]:
    """Candidate cross-sections of the road beside the target, empty without edges.

    Section 3.1 looks for strong edges across the direction of travel, which is not known yet: of all directions, those
    are taken in which white-line edges are strong on both sides. Without white lines, any edges along the road are
    used. Directions may occur twice.
    """
    longer = max(target.width, target.height)
    centre = np.array([target.x + target.width / 2, target.y + target.height / 2])
    angles = np.arange(_ANGLES) * np.pi / _ANGLES
    normal = np.column_stack([-np.sin(angles), np.cos(angles)])
    reach = round(_SEARCH_RADIUS * longer)
    offsets = np.arange(-reach, reach + 1, dtype=np.float64)
    left, right = offsets < -_TARGET_RADIUS * longer, offsets > _TARGET_RADIUS * longer
    found: list[RoadSection] = []
    near, far = (_profiles(grey, target, angles, offsets, along * longer) for along in _ALONG)
    for strength in (_ridges(near), _ridges(far), _steps(near)):
        on_left, on_right = strength[:, left].max(axis=1), strength[:, right].max(axis=1)
        both = np.minimum(on_left, on_right)
        score = np.where(both >= _MIN_STRENGTH, both + 0.1 * (on_left + on_right), 0.0)
        for _ in range(_CANDIDATES):
            if score.max() <= 0.0:
                break
            best = int(score.argmax())
            a = float(offsets[left][strength[best, left].argmax()])
            b = float(offsets[right][strength[best, right].argmax()])
            if _HALF_WIDTHS[0] * longer < 0.5 * (b - a) < _HALF_WIDTHS[1] * longer:
                found.append(RoadSection(centre + 0.5 * (a + b) * normal[best], float(angles[best]), 0.5 * (b - a)))
            separation = np.abs(np.arange(_ANGLES) - best)
            score[np.minimum(separation, _ANGLES - separation) < _ANGLES // 12] = 0.0
    return found


def _profiles(grey: Grey, target: Box, angles: Floats, offsets: Floats, reach: float) -> Floats:
    """Mean grey level (a, o) of lines in directions (a,), reach [px] both ways, (o,) from the target's centre.

    The target itself is excluded; nan where too little of a line is in the image.
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
    """Ridge strength: brightness above both sides, 3 or 6 px away. profile (a, o) -> (a, o), 0 where unknown."""
    found = np.zeros_like(profile)
    for separation in (3, 6):
        middle = profile[:, separation:-separation]
        sides = np.maximum(profile[:, : -2 * separation], profile[:, 2 * separation :])
        found[:, separation:-separation] = np.fmax(found[:, separation:-separation], middle - sides)
    return found


def _steps(profile: Floats) -> Floats:
    """Step strength: difference between the two sides, 2 px away. profile (a, o) -> (a, o), 0 where unknown."""
    found = np.zeros_like(profile)
    found[:, 2:-2] = np.fmax(0.0, np.abs(profile[:, 4:] - profile[:, :-4]))
    return found
