"""What one silhouette tells by its own shape: whether it is one whole person, and where near ones are together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.people.height_model import Stature
from edge.detectors.people.templates import BARS, Box
from protocols.geometry.types import Bools, Floats

Image = npt.NDArray[np.uint8]
WORK_HEIGHT = 64.0  # px: larger people are looked for in a smaller picture
_LOW, _HIGH, _BROAD, _BULK, _HEAD, _SLENDER = 0.85, 1.17, 0.62, 0.28, 0.22, 0.34
"""Of one whole silhouette: height, of the usual; breadth, area over height, breadth of the head, and
breadth up to which no more is asked, of the height."""
_PIECE, _PIECE_BESIDE, _PIECE_ALONG = 0.6, 0.15, 0.6
"""Of the height of a silhouette: how tall a piece of it may be, and how far it may be from it, across and along."""
_LIKE = 0.7  # share of template and silhouette that one who stands alone has in common
_SLIM, _STOUT = 1.15, 7.0  # height to breadth of one who stands alone, where nothing is known of the place
_THIN, _SPECK = 0.05, 0.02  # of the height: what is lower is no limb; of its square: what has less area is none
_LEAST_HEIGHT = 12.0  # px


@dataclass(frozen=True, slots=True)
class Body:
    """One person in the silhouettes. box: x, y, w, h [px]. fill: share of what is in view of it that is silhouette.

    seen: share of it that nobody nearer hides. alone: the whole silhouette is this one's.
    expected: index of the expectation that it was placed by; -1 = none. cut: the image's border cuts it.
    """

    box: Box
    fill: float
    seen: float
    alone: bool
    expected: int = -1
    cut: bool = False


class LonePeople:
    """The silhouettes of a picture (H, W) 0/255 that have the shape of one whole person."""

    def __init__(self, figure: Image) -> None:
        self._figure = figure
        # Outlines cost a tenth of labels.
        outlines, nesting = cv2.findContours(figure, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        boxes = [
            cv2.boundingRect(one)
            for one, tree in zip(outlines, nesting[0] if outlines else (), strict=True)
            if tree[3] < 0
        ]
        self._boxes = [(int(x), int(y), int(w), int(h)) for x, y, w, h in reversed(boxes)]
        self._piece = _pieces(np.array(self._boxes, dtype=np.float64).reshape(-1, 4))

    def find(self, *, strict: bool = True) -> list[tuple[float, float, float]]:
        """Their foot points u, v and heights [px].

        Not strict: that are as slim; somebody who begins to walk, and the place where he stood, are one broader one.
        """
        found = []
        for (x, y, w, h), piece in zip(self._boxes, self._piece, strict=True):
            if (
                h < _LEAST_HEIGHT
                or is_cut((x, y, w, h), self._figure.shape)
                or not (1.8 if strict else 1.2) * w < h < 4.5 * w
                or piece
            ):
                continue
            if not strict or _shaped(_alone(self._figure[y : y + h, x : x + w])):
                found.append((x + 0.5 * w, float(y + h), float(h)))
        return found


def _alone(part: Image) -> Bools:
    """The silhouette that touches all sides of a part (h, w) of the picture, without others that are in it."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(part, connectivity=8)
    if count <= 2:
        return np.asarray(part > 0, dtype=np.bool_)
    whole = (stats[1:, 2] == part.shape[1]) & (stats[1:, 3] == part.shape[0])
    return np.asarray(labels == 1 + int(whole.argmax()), dtype=np.bool_)


def _pieces(boxes: Floats) -> Bools:
    """Which silhouettes may be pieces of a much taller one near; of their boxes x, y, w, h (n, 4)."""
    x, y, w, h = boxes.T
    u, v = x + 0.5 * w, y + 0.5 * h
    beside, along = _PIECE_BESIDE * h, _PIECE_ALONG * h
    near = (u[:, None] > (x - beside)[None]) & (u[:, None] < (x + w + beside)[None])
    near &= (v[:, None] > (y - along)[None]) & (v[:, None] < (y + h + along)[None])
    near &= h[:, None] < _PIECE * h[None]
    return np.asarray(near.any(axis=1))


def _shaped(mask: Bools) -> bool:
    """Whether a silhouette (h, w), cropped to itself, is shaped as the template."""
    h = mask.shape[0]
    u = float(np.median(np.nonzero(mask[: max(h // 8, 2)])[1])) + 0.5  # the head's middle
    inside = covered = 0
    for half, high, low in BARS:
        left, right = max(round(u - half * h), 0), max(round(u + half * h), 0)
        inside += int(np.count_nonzero(mask[round(high * h) : round(low * h), left:right]))
        covered += round(2.0 * half * h) * (round(low * h) - round(high * h))
    return inside > _LIKE * covered and inside > _LIKE * int(np.count_nonzero(mask))


def by_shape(figure: Image, expected: Sequence[Box]) -> list[Body]:
    """Where nothing is known of the place: silhouettes (H, W) 0/255 that are as slim as one person.

    expected: boxes [px] where some should be.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(figure, connectivity=8, ltype=cv2.CV_16U)
    owners = [_owner(np.asarray(labels, dtype=np.uint16), box) for box in expected]
    bodies = []
    for one in range(1, count):
        x, y, w, h, area = (int(value) for value in stats[one])
        if h < _LEAST_HEIGHT or w < 3 or area < 0.16 * min(w, h) * h:
            continue
        cut = is_cut((x, y, w, h), figure.shape)
        if _SLIM <= h / w <= _STOUT or (cut and h >= 0.8 * w):
            # Pieces that were once taken for somebody do not make several of one whole.
            mine = [at for at, owner in enumerate(owners) if owner == one and expected[at][3] > 0.6 * h]
            bodies.append(Body((x, y, w, h), area / (w * h), 1.0, True, mine[0] if mine else -1, cut))
    return bodies


def _owner(labels: npt.NDArray[np.uint16], box: Box) -> int:
    """The silhouette that fills most of a box's core; 0 = none."""
    x, y, w, h = box
    part = labels[max(int(y), 0) : max(int(y + h) + 1, 0), max(int(x + 0.15 * w), 0) : max(int(x + 0.85 * w) + 1, 0)]
    counts = np.bincount(part.ravel())
    if len(counts) < 2:
        return 0
    counts[0] = 0
    best = int(counts.argmax())
    return best if counts[best] > 0.08 * part.size else 0


def is_cut(box: Box, shape: tuple[int, ...]) -> bool:
    """Whether the border of a picture (H, W) cuts a box."""
    x, y, w, h = box
    return x <= 1 or y <= 1 or x + w >= shape[1] - 2 or y + h >= shape[0] - 2


def clusters(
    small: Image, stature: Stature, scales: tuple[float, float], expected: Sequence[Box]
) -> list[tuple[slice, slice, list[int]]]:
    """Parts of the working picture that hold near silhouettes together, and who is expected in each.

    small: silhouettes (h, w) 0..255 of the working picture; scales: its px a px, x and y. expected: boxes [px].
    """
    reach = max(round(0.08 * min(stature.typical * scales[1], WORK_HEIGHT)), 1)
    near = cv2.dilate(small, np.ones((4 * reach + 1, 2 * reach + 1), np.uint8))
    joined = cv2.threshold(near, 100, 255, cv2.THRESH_BINARY)[1]
    count, labels, stats, _ = cv2.connectedComponentsWithStats(joined, connectivity=8, ltype=cv2.CV_16U)
    fx, fy = scales
    owners = [_owner(np.asarray(labels, dtype=np.uint16), (x * fx, y * fy, w * fx, h * fy)) for x, y, w, h in expected]
    parts = []
    for one in range(1, count):
        x, y, w, h = (int(value) for value in stats[one, :4])
        mine = [index for index, owner in enumerate(owners) if owner == one]
        foot = float(stature.at(np.array([(x + 0.5 * w) / fx]), np.array([(y + h) / fy]))[0])
        if h / fy < 0.3 * foot and not mine:
            continue
        parts.append((slice(y, y + h), slice(x, x + w), mine))
    return parts


def bulk(mask: Image, tall: float) -> Image:
    """The largest silhouette of a mask (h, w) 0/255, what is above or below it, and others as large as a limb.

    Without what is thin, as a wire or barrier tape that sways, and without the specks of a shadow's rim: each would
    make the body's box broader. tall: height [px] of the body.
    """
    firm = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((max(round(_THIN * tall), 2), 1), np.uint8))
    count, labels, stats, middles = cv2.connectedComponentsWithStats(firm, connectivity=8)
    if count <= 1:
        return mask
    if count == 2:
        return np.asarray(firm, dtype=np.uint8)
    area = stats[:, cv2.CC_STAT_AREA]
    left, _, wide = stats[1 + int(area[1:].argmax()), :3]
    kept = (middles[:, 0] >= left) & (middles[:, 0] < left + wide) | (area > _SPECK * tall**2)
    kept[0] = False
    return np.where(kept[labels], 255, 0).astype(np.uint8)


def whole(figure: Image, part: tuple[slice, slice], scales: tuple[float, float], stature: Stature) -> Body | None:
    """The silhouette in a part of the working picture as one person, if it is as tall and as slim as one there.

    figure: the picture (H, W) 0/255 itself; scales: working px a px, x and y.
    """
    (fx, fy), (rows, columns) = scales, part
    left, top = int(columns.start / fx), int(rows.start / fy)
    mask = figure[top : int(rows.stop / fy) + 1, left : int(columns.stop / fx) + 1]
    mask = bulk(mask, (rows.stop - rows.start) / fy)
    x, y, w, h = cv2.boundingRect(mask)
    box = float(left + x), float(top + y), float(w), float(h)
    if h < _LEAST_HEIGHT or is_cut(box, figure.shape):
        return None
    usual = float(stature.at(np.array([box[0] + 0.5 * w]), np.array([box[1] + h]))[0])
    fill = cv2.countNonZero(mask) / (w * h)
    if not (_LOW * usual < h < _HIGH * usual and w < _BROAD * h and fill * w < _BULK * h):
        return None
    # Two heads side by side are broader than one, whatever the legs do.
    head = np.flatnonzero(mask[y : y + max(round(0.12 * h), 2), x : x + w].any(axis=0))
    if head[-1] - head[0] > _HEAD * h or (w > _SLENDER * h and not _shaped(mask[y : y + h, x : x + w] > 0)):
        return None
    return Body(box, fill, 1.0, True)
