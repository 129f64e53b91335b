"""Shape tests of single silhouettes: isolated people, fragments, and groups of silhouettes near each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.people.height_model import LEAST_HEIGHT, HeightModel
from edge.detectors.people.templates import BACKGROUND_WEIGHT, BARS, TEMPLATE_AREA, Box
from protocols.geometry.types import Bools, Floats, Image

WORK_HEIGHT = 64.0  # px: images of taller people are downscaled to this height
BULK = 0.28
"""Largest area of one person over the square of the height."""
_LOW, _HIGH, _BROAD, _HEAD, _SLENDER = 0.85, 1.17, 0.62, 0.22, 0.34
"""Of one whole silhouette: height over the height model; breadth, breadth of the head, and breadth up to which the
shape is not tested, over the height.
"""
_FRAGMENT_HEIGHT, _FRAGMENT_BESIDE, _FRAGMENT_ALONG = 0.6, 0.15, 0.6
"""Over the height of a silhouette: largest height of its fragments, and their largest distance from it, across and
along.
"""
_MIN_TEMPLATE_OVERLAP = 0.7  # overlap of template and silhouette of an isolated person, over either
_SLIM, _STOUT = 1.15, 7.0  # height over breadth of an isolated person, without a height model
_FRAGMENT_GAP, _MIN_UNION_FIT = 0.15, 0.28
"""Largest gap between fragments of a person over the height, and smallest gain of their common template over its area:
as of a template that is kept (``occupancy``).
"""
_LEAST_FRAGMENT, _MAX_FRAGMENTS = 4, 60  # px; largest silhouettes that are joined
_THIN, _SPECK = 0.05, 0.02  # over the height: lower structures are no limbs; over its square: smaller areas are specks


@dataclass(frozen=True, slots=True)
class PersonSilhouette:
    """One person in the foreground mask. box: x, y, w, h [px]. fill: share of its visible pixels that are foreground.

    visible: share that no nearer person occludes. isolated: it is a connected silhouette of its own. expected: index of
    the prediction that it was placed by, -1 = none. truncated: the image border cuts it.
    """

    box: Box
    fill: float
    visible: float
    isolated: bool
    expected: int = -1
    truncated: bool = False


class IsolatedPeople:
    """The silhouettes of a foreground mask (H, W) 0/255 that have the shape of one whole person."""

    def __init__(self, foreground: Image) -> None:
        self._figure = foreground
        # Contours cost a tenth of connected-component labels.
        outlines, nesting = cv2.findContours(foreground, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        boxes = [
            cv2.boundingRect(one)
            for one, tree in zip(outlines, nesting[0] if outlines else (), strict=True)
            if tree[3] < 0
        ]
        self._boxes = [(int(x), int(y), int(w), int(h)) for x, y, w, h in reversed(boxes)]
        self._is_fragment = _fragments(np.array(self._boxes, dtype=np.float64).reshape(-1, 4))

    def find(self) -> list[tuple[float, float, float]]:
        """Foot points u, v and heights [px] of isolated people."""
        found = []
        for (x, y, w, h), is_fragment in zip(self._boxes, self._is_fragment, strict=True):
            if (
                h < LEAST_HEIGHT
                or is_truncated((x, y, w, h), self._figure.shape)
                or not 1.8 * w < h < 4.5 * w
                or is_fragment
            ):
                continue
            if _matches_template(_touching_all_sides(self._figure[y : y + h, x : x + w])):
                found.append((x + 0.5 * w, float(y + h), float(h)))
        return found


def _touching_all_sides(part: Image) -> Bools:
    """The silhouette that touches all sides of an image part (h, w), without others in it."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(part, connectivity=8)
    if count <= 2:
        return np.asarray(part > 0, dtype=np.bool_)
    whole = (stats[1:, 2] == part.shape[1]) & (stats[1:, 3] == part.shape[0])
    return np.asarray(labels == 1 + int(whole.argmax()), dtype=np.bool_)


def _fragments(boxes: Floats) -> Bools:
    """Whether each silhouette may be a fragment of a much taller one near it; boxes x, y, w, h (n, 4)."""
    x, y, w, h = boxes.T
    u, v = x + 0.5 * w, y + 0.5 * h
    beside, along = _FRAGMENT_BESIDE * h, _FRAGMENT_ALONG * h
    near = (u[:, None] > (x - beside)[None]) & (u[:, None] < (x + w + beside)[None])
    near &= (v[:, None] > (y - along)[None]) & (v[:, None] < (y + h + along)[None])
    near &= h[:, None] < _FRAGMENT_HEIGHT * h[None]
    return np.asarray(near.any(axis=1))


def _matches_template(mask: Bools) -> bool:
    """Whether a silhouette (h, w), cropped to its bounding box, has the shape of the template."""
    h = mask.shape[0]
    u = float(np.median(np.nonzero(mask[: max(h // 8, 2)])[1])) + 0.5  # centre of the head
    inside = covered = 0
    for half, high, low in BARS:
        left, right = max(round(u - half * h), 0), max(round(u + half * h), 0)
        inside += int(np.count_nonzero(mask[round(high * h) : round(low * h), left:right]))
        covered += round(2.0 * half * h) * (round(low * h) - round(high * h))
    return inside > _MIN_TEMPLATE_OVERLAP * covered and inside > _MIN_TEMPLATE_OVERLAP * int(np.count_nonzero(mask))


def segment_by_shape(foreground: Image, expected: Sequence[Box]) -> list[PersonSilhouette]:
    """People without a height model: silhouettes (H, W) 0/255 with the aspect ratio of one person.

    Fragments are joined where one template of their common box explains them. expected: predicted boxes [px].
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStats(foreground, connectivity=8, ltype=cv2.CV_16U)
    owners = [_owner(np.asarray(labels, dtype=np.uint16), box) for box in expected]
    bodies = []
    for members in _joined_fragments(foreground, np.asarray(stats[1:], dtype=np.int32)):
        low = stats[members, :2].min(axis=0)
        w, h = (int(side) for side in (stats[members, :2] + stats[members, 2:4]).max(axis=0) - low)
        x, y, area = int(low[0]), int(low[1]), int(stats[members, cv2.CC_STAT_AREA].sum())
        if h < LEAST_HEIGHT or w < 3 or area < 0.16 * min(w, h) * h:
            continue
        truncated = is_truncated((x, y, w, h), foreground.shape)
        if _SLIM <= h / w <= _STOUT or (truncated and h >= 0.8 * w):
            # Predictions of former fragments do not split a whole silhouette.
            mine = [at for at, owner in enumerate(owners) if owner in members and expected[at][3] > 0.6 * h]
            bodies.append(PersonSilhouette((x, y, w, h), area / (w * h), 1.0, True, mine[0] if mine else -1, truncated))
    return bodies


def _joined_fragments(foreground: Image, stats: npt.NDArray[np.int32]) -> list[list[int]]:
    """Labels of the silhouettes (H, W) 0/255 of each person; stats: x, y, w, h, area (n, 5) of labels 1 …

    The largest come first: each takes the fragments with which one template explains both.
    """
    sums = np.asarray(cv2.integral(cv2.threshold(foreground, 0, 1, cv2.THRESH_BINARY)[1]), dtype=np.int32)
    order = [int(index) for index in np.argsort(-stats[:, cv2.CC_STAT_AREA]) if stats[index, 3] >= _LEAST_FRAGMENT]
    order = order[:_MAX_FRAGMENTS]
    groups: list[list[int]] = []
    for seed in order:
        if any(seed + 1 in group for group in groups):
            continue
        group, left, top = [seed + 1], int(stats[seed, 0]), int(stats[seed, 1])
        right, bottom = left + int(stats[seed, 2]), top + int(stats[seed, 3])
        for other in order:
            if other == seed or any(other + 1 in each for each in (*groups, group)):
                continue
            x, y, w, h = (int(value) for value in stats[other, :4])
            union = min(left, x), min(top, y), max(right, x + w), max(bottom, y + h)
            wide, high = union[2] - union[0], union[3] - union[1]
            gap = max(y - bottom, top - y - h, 0)
            if gap > _FRAGMENT_GAP * high or high < _SLIM * wide:
                continue
            if _template_fit(sums, union) >= _MIN_UNION_FIT:
                group.append(other + 1)
                left, top, right, bottom = union
        groups.append(group)
    return groups


def _template_fit(sums: npt.NDArray[np.int32], box: tuple[int, int, int, int]) -> float:
    """Log-likelihood ratio of a template in a box (left, top, right, bottom) to background, over the template's area.

    sums: integral image (H + 1, W + 1) of the silhouettes, 0 or 1.
    """
    left, top, right, bottom = box
    height, middle, gain = bottom - top, 0.5 * (left + right), 0.0
    for half, high, low in BARS:
        a, b = round(middle - half * height), round(middle + half * height)
        c, d = round(top + high * height), round(top + low * height)
        a0, b0 = (min(max(edge, 0), sums.shape[1] - 1) for edge in (a, b))
        inside = int(sums[d, b0]) - int(sums[c, b0]) - int(sums[d, a0]) + int(sums[c, a0])
        gain += inside + BACKGROUND_WEIGHT * ((b - a) * (d - c) - inside)
    return gain / (TEMPLATE_AREA * max(height, 1) ** 2)


def _owner(labels: npt.NDArray[np.uint16], box: Box) -> int:
    """Label of the silhouette that fills most of a box's core; 0 = none."""
    x, y, w, h = box
    part = labels[max(int(y), 0) : max(int(y + h) + 1, 0), max(int(x + 0.15 * w), 0) : max(int(x + 0.85 * w) + 1, 0)]
    counts = np.bincount(part.ravel())
    if len(counts) < 2:
        return 0
    counts[0] = 0
    best = int(counts.argmax())
    return best if counts[best] > 0.08 * part.size else 0


def is_truncated(box: Box, shape: tuple[int, ...]) -> bool:
    """Whether the border of an image (H, W) cuts a box."""
    x, y, w, h = box
    return x <= 1 or y <= 1 or x + w >= shape[1] - 2 or y + h >= shape[0] - 2


def group_silhouettes(
    small: Image, height_model: HeightModel, scales: tuple[float, float], expected: Sequence[Box]
) -> list[tuple[slice, slice, list[int]]]:
    """Regions of the working image that contain silhouettes near each other, and the predictions in each.

    small: foreground mask (h, w) 0..255 of the working image; scales: its px per image px, x and y. expected: predicted
    boxes [px].
    """
    reach = max(round(0.08 * min(height_model.median_height * scales[1], WORK_HEIGHT)), 1)
    near = cv2.dilate(small, np.ones((4 * reach + 1, 2 * reach + 1), np.uint8))
    joined = cv2.threshold(near, 100, 255, cv2.THRESH_BINARY)[1]
    count, labels, stats, _ = cv2.connectedComponentsWithStats(joined, connectivity=8, ltype=cv2.CV_16U)
    fx, fy = scales
    owners = [_owner(np.asarray(labels, dtype=np.uint16), (x * fx, y * fy, w * fx, h * fy)) for x, y, w, h in expected]
    parts = []
    for one in range(1, count):
        x, y, w, h = (int(value) for value in stats[one, :4])
        mine = [index for index, owner in enumerate(owners) if owner == one]
        foot = float(height_model.heights_at(np.array([(x + 0.5 * w) / fx]), np.array([(y + h) / fy]))[0])
        if h / fy < 0.3 * foot and not mine:
            continue
        parts.append((slice(y, y + h), slice(x, x + w), mine))
    return parts


def main_silhouette(mask: Image, tall: float) -> Image:
    """The largest silhouette of a mask (h, w) 0/255, those above or below it, and others as large as a limb.

    Thin structures (a wire, swaying barrier tape) and specks at a shadow's rim are removed: each would widen the box.
    tall: height [px] of the person.
    """
    opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((max(round(_THIN * tall), 2), 1), np.uint8))
    count, labels, stats, middles = cv2.connectedComponentsWithStats(opened, connectivity=8)
    if count <= 1:
        return mask
    if count == 2:
        return np.asarray(opened, dtype=np.uint8)
    area = stats[:, cv2.CC_STAT_AREA]
    left, _, wide = stats[1 + int(area[1:].argmax()), :3]
    kept = (middles[:, 0] >= left) & (middles[:, 0] < left + wide) | (area > _SPECK * tall**2)
    kept[0] = False
    return np.where(kept[labels], 255, 0).astype(np.uint8)


def as_single_person(
    foreground: Image, part: tuple[slice, slice], scales: tuple[float, float], height_model: HeightModel
) -> PersonSilhouette | None:
    """The silhouette in a part of the working image as one person, if its height and breadth are those of one there.

    foreground: full-resolution mask (H, W) 0/255; scales: working px per image px, x and y.
    """
    (fx, fy), (rows, columns) = scales, part
    left, top = int(columns.start / fx), int(rows.start / fy)
    mask = foreground[top : int(rows.stop / fy) + 1, left : int(columns.stop / fx) + 1]
    mask = main_silhouette(mask, (rows.stop - rows.start) / fy)
    x, y, w, h = cv2.boundingRect(mask)
    box = float(left + x), float(top + y), float(w), float(h)
    if h < LEAST_HEIGHT or is_truncated(box, foreground.shape):
        return None
    model_height = float(height_model.heights_at(np.array([box[0] + 0.5 * w]), np.array([box[1] + h]))[0])
    fill = cv2.countNonZero(mask) / (w * h)
    if not (_LOW * model_height < h < _HIGH * model_height and w < _BROAD * h and fill * w < BULK * h):
        return None
    # Two heads side by side are broader than one, whatever the legs' pose.
    head = np.flatnonzero(mask[y : y + max(round(0.12 * h), 2), x : x + w].any(axis=0))
    if head[-1] - head[0] > _HEAD * h or (w > _SLENDER * h and not _matches_template(mask[y : y + h, x : x + w] > 0)):
        return None
    return PersonSilhouette(box, fill, 1.0, True)
