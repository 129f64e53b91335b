"""Explains silhouettes by people: one, or several who stand together or hide each other.

A person is a template of three bars (head, trunk, legs) of the height that people have at that place. Those templates
are sought whose union covers what is silhouette and little else, each one worth its place; a person who is followed is
sought about where it is expected. After the occupancy by ground plane templates of Fleuret et al. (2008), with greedy
placing and coordinate descent in place of its mean field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.stature import Stature
from protocols.geometry.types import Bools, Floats, Ints

Image = npt.NDArray[np.uint8]
Box = tuple[float, float, float, float]
_BARS = ((0.065, 0.0, 0.14), (0.125, 0.14, 0.52), (0.095, 0.52, 1.0))
"""Half-breadth, upper and lower end of each bar, of the height."""
_AREA = sum(2.0 * half * (low - high) for half, high, low in _BARS)
_WORK_HEIGHT = 64.0  # px: larger people are looked for in a smaller picture
# Log-likelihood ratios of body to background, against that of a silhouette's pixel.
_EMPTY, _SHADOW = -0.45, -0.08
_NEW, _KEPT = 0.45, 0.28  # gain of a template, of its area, that makes it worth its place
_COUNTS = (2.5, 1.0, 1.0)  # a head is small, but says most about where somebody stands
_BOXES = np.array([*_BARS, (0.07, -0.1, -0.02), (0.1, 0.02, 0.12)]).T[:, :, None]
"""The bars, and what must be empty: above the head (of the height from the head down), below the feet (from them)."""
_BEYOND = 1.0  # by how much a silhouette that goes on above the head or below the feet speaks against a template
_TORSO = (0.1, 0.2, 0.5)  # as _BARS
_COLOUR, _LOOKS = 45.0, 1.0  # 8-bit steps by which clothes differ from themselves; weight of a torso's pixel
_ROUNDS = 3  # of seeking those whom nobody expected
_REACH = 0.14  # of the height: how far somebody may be from where it is expected
_PULL = 3.0  # of its area, by the square of that distance over the height
_SHORT, _LONG = 0.8, 1.2  # of the usual height at a place, that somebody may have
_STRETCHED = np.array([0.95, 1.0, 1.05])  # tried of the height that somebody has
_COMING = np.array([0.88, 1.0, 1.1])  # tried of somebody whom nobody expected
_STIFF = 8.0  # of its area, by the square of the logarithm of the height over what is expected
_LOW, _HIGH, _BROAD, _BULK, _HEAD, _SLENDER = 0.85, 1.17, 0.62, 0.28, 0.22, 0.34
"""Of one whole silhouette: height, of the usual; breadth, area over height, breadth of the head, and
breadth up to which no more is asked, of the height."""
_MOST = 12  # people in one silhouette
_PIECE, _PIECE_BESIDE, _PIECE_ALONG = 0.6, 0.15, 0.6
"""Of the height of a silhouette: how tall a piece of it may be, and how far it may be from it, across and along."""
_LIKE = 0.7  # share of template and silhouette that one who stands alone has in common
_SLIM, _STOUT = 1.15, 7.0  # height to breadth of one who stands alone, where nothing is known of the place
_LEAST_HEIGHT = 12.0  # px
_MERGE, _SPLIT = 0.45, 0.26  # distance of two who may be one, of the height; what one may explain less, of its area
_STATURES = np.array([0.92, 1.0, 1.08, 1.16, 1.25, 1.35])
_TRIM = 0.3
_LONE, _GROUPED = 0.1, 0.17
BREADTH = 0.36  # of a person's box, of the height


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


@dataclass(slots=True)
class _Placed:
    """A template: its middle u, foot and height [px of the working picture].

    stature: its height, of the usual one there; of: what that is expected to be.
    expected: which expectation it is; home: where that was.
    """

    u: float
    foot: float
    tall: float
    stature: float = 1.0
    expected: int = -1
    home: tuple[float, float] | None = None
    gain: float = 0.0
    of: float = 1.0

    @property
    def top(self) -> float:
        return self.foot - self.tall


def explain(
    figure: Image,
    shadow: Image,
    stature: Stature,
    expected: list[Box],
    image: Image | None = None,
    clothes: Sequence[Floats | None] = (),
    statures: Sequence[float] = (),
) -> list[Body]:
    """People in a clean silhouette picture (H, W) 0/255.

    shadow: (H, W) what is only darker than the background: somebody may stand there in dark clothes, or a shadow lie.
    expected: boxes [px] where some should be; clothes: their torsos' mean colours (3,), as far as known, in ``image``
    (H, W, 3). statures: their heights, of what is usual, as far as known.
    """
    if not stature.known:
        return _by_shape(figure, expected)
    scale = min(1.0, _WORK_HEIGHT / stature.typical)
    size = max(round(figure.shape[1] * scale), 1), max(round(figure.shape[0] * scale), 1)
    scales = size[0] / figure.shape[1], size[1] / figure.shape[0]
    small, dim = figure, shadow
    if scale < 1.0:
        small = np.asarray(cv2.resize(figure, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        dim = np.asarray(cv2.resize(shadow, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    filled = small.astype(np.float32) / 255.0
    weight = filled + _SHADOW * dim.astype(np.float32) / 255.0
    weight += _EMPTY * np.clip(1.0 - filled - dim.astype(np.float32) / 255.0, 0.0, 1.0)
    colours = None
    if image is not None and len(clothes) == len(expected):
        # Finer than the clothes' pattern need not be.
        blurred = image if scale == 1.0 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        colours = np.asarray(cv2.blur(blurred, (5, 5)), dtype=np.uint8)
    bodies: list[Body] = []
    for rows, columns, mine in _clusters(small, stature, scales, expected):
        whole = _whole(figure, (rows, columns), scales, stature) if len(mine) < 2 else None
        if whole is not None:
            near = [index for index in mine if _overlap(expected[index], whole.box) > 0.25]
            owner = max(near, key=lambda index: _overlap(expected[index], whole.box), default=-1)
            bodies.append(replace(whole, expected=owner))
            continue
        scene = _Cluster(weight[rows, columns], filled[rows, columns], (columns.start, rows.start), scales, stature)
        if colours is not None:
            scene.dress(colours[rows, columns], {index: clothes[index] for index in mine})
        told = len(statures) == len(expected)
        placed = scene.explain([(index, expected[index], statures[index] if told else 1.0) for index in mine])
        bodies += scene.bodies(placed, figure)
    return bodies


def lone_people(figure: Image, *, strict: bool = True) -> list[tuple[float, float, float]]:
    """Foot points u, v and heights [px] of silhouettes that have the shape of one whole person.

    Not strict: that are as slim; somebody who begins to walk, and the place where he stood, are one broader one.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(figure, connectivity=8)
    found = []
    piece = _pieces(np.asarray(stats))
    for one in range(1, count):
        x, y, w, h = (int(value) for value in stats[one, :4])
        if (
            h < _LEAST_HEIGHT
            or _is_cut((x, y, w, h), figure.shape)
            or not (1.8 if strict else 1.2) * w < h < 4.5 * w
            or piece[one]
        ):
            continue
        if not strict or _shaped(np.asarray(labels[y : y + h, x : x + w] == one, dtype=np.bool_)):
            found.append((x + 0.5 * w, float(y + h), float(h)))
    return found


def _pieces(stats: npt.NDArray[Any]) -> Bools:
    """Which silhouettes (n,) may be pieces of a much taller one near: (n, 5+) x, y, w, h, area; the first is no one."""
    x, y, w, h = (stats[:, column].astype(np.float64) for column in range(4))
    u, v = x + 0.5 * w, y + 0.5 * h
    beside, along = _PIECE_BESIDE * h, _PIECE_ALONG * h
    near = (u[:, None] > (x - beside)[None]) & (u[:, None] < (x + w + beside)[None])
    near &= (v[:, None] > (y - along)[None]) & (v[:, None] < (y + h + along)[None])
    near &= h[:, None] < _PIECE * h[None]
    near[:, 0] = False
    return np.asarray(near.any(axis=1))


def _shaped(mask: Bools) -> bool:
    """Whether a silhouette (h, w), cropped to itself, is shaped as the template."""
    h = mask.shape[0]
    u = float(np.median(np.nonzero(mask[: max(h // 8, 2)])[1])) + 0.5  # the head's middle
    inside = covered = 0
    for half, high, low in _BARS:
        left, right = max(round(u - half * h), 0), max(round(u + half * h), 0)
        inside += int(mask[round(high * h) : round(low * h), left:right].sum())
        covered += round(2.0 * half * h) * (round(low * h) - round(high * h))
    return inside > _LIKE * covered and inside > _LIKE * int(mask.sum())


def _by_shape(figure: Image, expected: list[Box]) -> list[Body]:
    """Where nothing is known of the place: silhouettes that are as slim as one person."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(figure, connectivity=8)
    owners = [_owner(np.asarray(labels, dtype=np.int32), box) for box in expected]
    bodies = []
    for one in range(1, count):
        x, y, w, h, area = (int(value) for value in stats[one])
        if h < _LEAST_HEIGHT or w < 3 or area < 0.16 * min(w, h) * h:
            continue
        cut = _is_cut((x, y, w, h), figure.shape)
        if _SLIM <= h / w <= _STOUT or (cut and h >= 0.8 * w):
            # Pieces that were once taken for somebody do not make several of one whole.
            mine = [at for at, owner in enumerate(owners) if owner == one and expected[at][3] > 0.6 * h]
            bodies.append(Body((x, y, w, h), area / (w * h), 1.0, True, mine[0] if mine else -1, cut))
    return bodies


def _within(values: Ints, low: int, high: int) -> Ints:
    """``np.clip`` without its bookkeeping, which for arrays as short as these costs more than the work."""
    return np.asarray(np.minimum(np.maximum(values, low), high))


def _owner(labels: Ints | npt.NDArray[np.int32], box: Box) -> int:
    """The silhouette that fills most of a box's core; 0 = none."""
    x, y, w, h = box
    part = labels[max(int(y), 0) : max(int(y + h) + 1, 0), max(int(x + 0.15 * w), 0) : max(int(x + 0.85 * w) + 1, 0)]
    counts = np.bincount(part.ravel())
    if len(counts) < 2:
        return 0
    counts[0] = 0
    best = int(counts.argmax())
    return best if counts[best] > 0.08 * part.size else 0


def _is_cut(box: Box, shape: tuple[int, ...]) -> bool:
    x, y, w, h = box
    return x <= 1 or y <= 1 or x + w >= shape[1] - 2 or y + h >= shape[0] - 2


def _clusters(
    small: Image, stature: Stature, scales: tuple[float, float], expected: list[Box]
) -> list[tuple[slice, slice, list[int]]]:
    """Parts of the working picture that hold near silhouettes together, and who is expected in each."""
    reach = max(round(0.08 * min(stature.typical * scales[1], _WORK_HEIGHT)), 1)
    near = cv2.dilate(small, np.ones((4 * reach + 1, 2 * reach + 1), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats((near > 100).astype(np.uint8), connectivity=8)
    fx, fy = scales
    owners = [_owner(np.asarray(labels, dtype=np.int32), (x * fx, y * fy, w * fx, h * fy)) for x, y, w, h in expected]
    parts = []
    for one in range(1, count):
        x, y, w, h = (int(value) for value in stats[one, :4])
        mine = [index for index, owner in enumerate(owners) if owner == one]
        foot = float(stature.at(np.array([(x + 0.5 * w) / fx]), np.array([(y + h) / fy]))[0])
        if h / fy < 0.3 * foot and not mine:
            continue
        parts.append((slice(y, y + h), slice(x, x + w), mine))
    return parts


def _whole(figure: Image, part: tuple[slice, slice], scales: tuple[float, float], stature: Stature) -> Body | None:
    """The silhouette in a part of the working picture as one person, if it is as tall and as slim as one there."""
    (fx, fy), (rows, columns) = scales, part
    left, top = int(columns.start / fx), int(rows.start / fy)
    mask = figure[top : int(rows.stop / fy) + 1, left : int(columns.stop / fx) + 1]
    x, y, w, h = cv2.boundingRect(mask)
    box = float(left + x), float(top + y), float(w), float(h)
    if h < _LEAST_HEIGHT or _is_cut(box, figure.shape):
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


def _overlap(a: Box, b: Box) -> float:
    """Intersection over union of two boxes."""
    across = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    down = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    if across <= 0 or down <= 0:
        return 0.0
    return across * down / (a[2] * a[3] + b[2] * b[3] - across * down)


class _Cluster:
    """One part of the working picture. weight: (h, w) what it speaks for a body there; filled: (h, w) 0..1 silhouette.

    origin: of the part in the working picture, x and y; scales: working px a px, x and y.
    """

    def __init__(
        self,
        weight: npt.NDArray[np.float32],
        filled: npt.NDArray[np.float32],
        origin: tuple[int, int],
        scales: tuple[float, float],
        stature: Stature,
    ) -> None:
        self._weight, self._filled = weight, filled
        self._origin, self._scales, self._stature = origin, scales, stature
        self._covered = np.zeros(weight.shape, np.int16)
        self._looks: dict[int, npt.NDArray[np.float32]] = {}
        self._sums: npt.NDArray[np.float64] | None = None  # of the weight that nobody covers; None: not known yet
        wide, high = stature.size
        self._limits = -origin[0], round(wide * scales[0]) - origin[0], -origin[1], round(high * scales[1]) - origin[1]
        self._at_bottom = self._limits[3] <= weight.shape[0] + 1

    def dress(self, colours: Image, clothes: dict[int, Floats | None]) -> None:
        """Let those who are expected be known by their clothes. colours: (h, w, 3) of this part."""
        for index, one in clothes.items():
            if one is not None:
                away = np.square(colours.astype(np.float32) - one.astype(np.float32)).sum(axis=2) / _COLOUR**2
                self._looks[index] = np.asarray((1.0 - np.minimum(away, 2.0)) * self._filled, dtype=np.float32)

    def _dressed(self, one: _Placed, u: Floats, foot: Floats, tall: Floats) -> Floats | float:
        """How many pixels of the torso, where no other hides it, have its colours, less those that have not."""
        looks = self._looks.get(one.expected)
        if looks is None:
            return 0.0
        h, w = self._weight.shape
        half, high, low = _TORSO
        a, b = (np.rint(u + side * half * tall).astype(np.intp).clip(0, w) for side in (-1.0, 1.0))
        c, d = (np.rint(foot - (1.0 - part) * tall).astype(np.intp).clip(0, h) for part in (high, low))
        # Summed only where the torsos are that are asked for: that is little of a large group.
        left, right, top, bottom = int(a.min()), int(b.max()), int(c.min()), int(d.max())
        if left >= right or top >= bottom:
            return 0.0
        free = np.where(self._covered[top:bottom, left:right] == 0, looks[top:bottom, left:right], np.float32(0.0))
        sums = cv2.integral(np.ascontiguousarray(free))
        a, b, c, d = a - left, b - left, c - top, d - top
        return np.asarray(_LOOKS * (sums[d, b] - sums[c, b] - sums[d, a] + sums[c, a]), dtype=np.float64)

    def explain(self, expected: list[tuple[int, Box, float]]) -> list[_Placed]:
        """The templates that explain the silhouettes, nearest last expectations first: index, box, stature."""
        placed: list[_Placed] = []
        for index, (x, y, w, h), stature in sorted(expected, key=lambda one: -(one[1][1] + one[1][3])):
            u, foot, _ = self._inward(x + 0.5 * w, y + h, h)
            usual = float(self._heights(np.array([u]), np.array([foot]))[0])
            one = _Placed(u, foot, stature * usual, stature, index, (u, foot), of=stature)
            self._settle(one)
            self._cover(one, 1)
            placed.append(one)
        if len(placed) > 1:
            self._descend(placed, 2)
        grid = self._grid()
        # Who is expected and not there must not keep others out; of those who come some are not worth their place once
        # all have settled, and what they covered is free again.
        for _ in range(_ROUNDS):
            before = len(placed)
            placed = self._merged(self._worthy(placed))
            gone = before - len(placed)
            came = 0
            while len(placed) < _MOST:
                new = self._best_new(*grid)
                if new is None:
                    break
                self._cover(new, 1)
                placed.append(new)
                came += 1
                self._descend(placed, 1)
            if not came and not gone:
                break
        return self._worthy(placed)

    def _worthy(self, placed: list[_Placed]) -> list[_Placed]:
        """Those who explain enough that no other does, the least sure asked first; the others' pixels are free."""
        for one in placed:
            self._cover(one, -1)
            one.gain = self._gain(one) / (_AREA * one.tall**2)
            self._cover(one, 1)
        for one in sorted(placed, key=lambda each: each.gain):
            self._cover(one, -1)
            one.gain = self._gain(one) / (_AREA * one.tall**2)
            if one.gain < (_KEPT if one.expected >= 0 else 0.7 * _NEW):
                placed = [each for each in placed if each is not one]
                continue
            self._cover(one, 1)
        return placed

    def _merged(self, placed: list[_Placed]) -> list[_Placed]:
        """With one template in place of two near each other wherever it explains nearly as much as both.

        Of any height within what people may have where heights are not known well yet: somebody taller than is usual
        at a place is else taken for two short ones.
        """
        for one in sorted(placed, key=lambda each: -each.tall):
            for other in placed:
                if other is one or not any(each is one for each in placed):
                    continue
                if abs(one.u - other.u) > _MERGE * one.tall or abs(one.foot - other.foot) > _MERGE * one.tall:
                    continue
                self._cover(one, -1)
                self._cover(other, -1)
                both = self._gain(one)
                self._cover(one, 1)
                both += self._gain(other)
                self._cover(one, -1)
                single = self._between(one, other)
                if single.gain > both - _SPLIT * _AREA * max(one.tall, other.tall) ** 2:
                    placed = [each for each in placed if each is not one and each is not other] + [single]
                    self._cover(single, 1)
                    return self._merged(placed)
                self._cover(one, 1)
                self._cover(other, 1)
        return placed

    def _between(self, one: _Placed, other: _Placed) -> _Placed:
        """The best single template about where two are, of whoever of them is expected."""
        steps = np.linspace(0.0, 1.0, 7)
        low, high = min(one.top, other.top), max(one.foot, other.foot)
        u, foot, stature = (
            values.ravel()
            for values in np.meshgrid(one.u + (other.u - one.u) * steps, high - 0.3 * (high - low) * steps, _STATURES)
        )
        tall = stature * self._heights(u, foot)
        gains = self._gains(u, foot, tall)
        best = int(np.argmax(gains))
        owner = max((one, other), key=lambda each: (each.expected >= 0, each.tall))
        return replace(
            owner,
            u=float(u[best]),
            foot=float(foot[best]),
            tall=float(tall[best]),
            stature=float(stature[best]),
            gain=float(gains[best]),
        )

    def _inward(self, u: float, foot: float, tall: float) -> tuple[float, float, float]:
        fx, fy = self._scales
        return u * fx - self._origin[0], foot * fy - self._origin[1], tall * fy

    def _heights(self, u: Floats, foot: Floats) -> Floats:
        """Heights [working px] of people whose feet are at places of this part."""
        fx, fy = self._scales
        return self._stature.at((u + self._origin[0]) / fx, (foot + self._origin[1]) / fy) * fy

    def _grid(self) -> tuple[Floats, Floats, Floats]:
        """Where somebody's foot may be, n places, and heights there: below what may be a head."""
        h, w = self._weight.shape
        step = 2 if h > 24 else 1
        # Feet may be below the picture; elsewhere the part has all of them.
        reach = int(0.7 * self._stature.typical * self._scales[1]) if self._at_bottom else 0
        u, foot = (one.ravel() for one in np.meshgrid(np.arange(0.5, w, step), np.arange(4.0, h + reach, step)))
        tall = self._heights(u, foot)
        chest = np.rint(foot - 0.7 * tall).astype(np.intp)
        inside = (chest >= 0) & (chest < h)
        inside[inside] = self._filled[chest[inside], u[inside].astype(np.intp)] > 0.3
        return u[inside], foot[inside], tall[inside]

    def _gains(self, u: Floats, foot: Floats, tall: Floats) -> Floats:
        """What templates (n,) would explain of what is not yet, less what they cover of nothing."""
        held = self._sum(u, np.stack([foot - tall] * 4 + [foot]), tall)
        total = _COUNTS[0] * held[0] + _COUNTS[1] * held[1] + _COUNTS[2] * held[2]
        return np.asarray(total - _BEYOND * (np.maximum(held[3], 0.0) + np.maximum(held[4], 0.0)), dtype=np.float64)

    def _sum(self, u: Floats, base: Floats, tall: Floats) -> Floats:
        """What each of the boxes of ``_BOXES`` holds: (5, n) for n templates; base: (5, n) where their heights begin.

        All boxes at once: calls upon short arrays are most of what a template costs.
        """
        h, w = self._weight.shape
        half, high, low = _BOXES
        a, b = np.rint(u - half * tall).astype(np.intp), np.rint(u + half * tall).astype(np.intp)
        c, d = np.rint(base + high * tall).astype(np.intp), np.rint(base + low * tall).astype(np.intp)
        ai, bi, ci, di = _within(a, 0, w), _within(b, 0, w), _within(c, 0, h), _within(d, 0, h)
        if self._sums is None:
            self._sums = np.asarray(cv2.integral(np.where(self._covered == 0, self._weight, np.float32(0.0))))
        sums = self._sums.ravel()
        upper, lower = ci * (w + 1), di * (w + 1)
        inner = sums[lower + bi] - sums[upper + bi] - sums[lower + ai] + sums[upper + ai]
        # What is beyond the picture cannot be seen; what is only beyond this part is empty.
        left, right, top, bottom = self._limits
        wide = _within(b, left, right) - _within(a, left, right)
        beyond = wide * (_within(d, top, bottom) - _within(c, top, bottom)) - (bi - ai) * (di - ci)
        return np.asarray(inner + _EMPTY * beyond, dtype=np.float64)

    def _gain(self, one: _Placed) -> float:
        u, foot, tall = np.array([one.u]), np.array([one.foot]), np.array([one.tall])
        return float((self._gains(u, foot, tall) + self._dressed(one, u, foot, tall))[0])

    def _settle(self, one: _Placed) -> None:
        """Move a template to the best place near, drawn to where it is expected."""
        reach = max(_REACH * one.tall, 2.0)
        steps = np.linspace(-reach, reach, 9)
        u, foot, stature = (
            values.ravel() for values in np.meshgrid(one.u + steps, one.foot + steps, one.stature * _STRETCHED)
        )
        stature = np.clip(stature, _SHORT, _LONG)
        tall = stature * self._heights(u, foot)
        gains = self._gains(u, foot, tall) + self._dressed(one, u, foot, tall)
        home = one.home or (one.u, one.foot)
        pull = _PULL if one.home is not None else 0.3
        away = pull * ((u - home[0]) ** 2 + (foot - home[1]) ** 2) / one.tall**2
        away += _STIFF * np.log(stature / one.of) ** 2
        best = int(np.argmax(gains - away * _AREA * one.tall**2))
        one.u, one.foot, one.tall, one.gain = float(u[best]), float(foot[best]), float(tall[best]), float(gains[best])
        one.stature = float(stature[best])

    def _descend(self, placed: list[_Placed], sweeps: int) -> None:
        for _ in range(sweeps):
            for one in placed:
                self._cover(one, -1)
                self._settle(one)
                self._cover(one, 1)

    def _best_new(self, u: Floats, foot: Floats, tall: Floats) -> _Placed | None:
        if not len(u):
            return None
        gains = np.stack([self._gains(u, foot, stature * tall) for stature in _COMING])
        worth = gains / (_AREA * np.square(_COMING[:, None] * tall)) - _STIFF * np.log(_COMING[:, None]) ** 2
        size, best = np.unravel_index(int(np.argmax(worth)), worth.shape)
        if worth[size, best] < _NEW:
            return None
        stature = float(_COMING[size])
        return _Placed(
            float(u[best]), float(foot[best]), stature * float(tall[best]), stature, gain=float(gains[size, best])
        )

    def _cover(self, one: _Placed, by: int) -> None:
        for half, high, low in _BARS:
            a, b = round(one.u - half * one.tall), round(one.u + half * one.tall)
            c, d = round(one.top + high * one.tall), round(one.top + low * one.tall)
            self._covered[max(c, 0) : max(d, 0), max(a, 0) : max(b, 0)] += by
        self._sums = None

    def bodies(self, placed: list[_Placed], figure: Image) -> list[Body]:
        """The templates as bodies [px of the picture], with the breadth that their silhouettes have."""
        if not placed:
            return []
        h, w = self._weight.shape
        y, x = np.mgrid[:h, :w] + 0.5
        # Whose each pixel is: the one in whose rows it lies and whose middle is nearest.
        distance = np.full((len(placed), h, w), np.inf)
        for index, one in enumerate(placed):
            rows = (y > one.top - 0.1 * one.tall) & (y < one.top + 1.12 * one.tall)
            distance[index] = np.where(rows, np.abs(x - one.u) / one.tall, np.inf)
        owner = distance.argmin(axis=0)
        mine_all = (distance.min(axis=0) < 0.33) & (self._filled > 0.5)
        order = np.argsort([one.top + one.tall for one in placed])[::-1]
        nearer = np.zeros((h, w), dtype=bool)
        found: list[Body] = []
        for index in order:
            one = placed[index]
            own = self._template(one)
            seen = float((own & ~nearer).sum() / max(own.sum(), 1))
            view = own & ~nearer
            fill = float(self._filled[view].mean()) if view.any() else 0.0
            nearer |= own
            found.append(self._body(one, mine_all & (owner == index), seen, fill, len(placed) == 1, figure.shape))
        return found

    def _template(self, one: _Placed) -> Bools:
        mask = np.zeros(self._weight.shape, dtype=np.bool_)
        for half, high, low in _BARS:
            a, b = round(one.u - half * one.tall), round(one.u + half * one.tall)
            c, d = round(one.top + high * one.tall), round(one.top + low * one.tall)
            mask[max(c, 0) : max(d, 0), max(a, 0) : max(b, 0)] = True
        return mask

    def _body(self, one: _Placed, own: Bools, seen: float, fill: float, alone: bool, shape: tuple[int, ...]) -> Body:
        left, right = one.u - 0.5 * BREADTH * one.tall, one.u + 0.5 * BREADTH * one.tall
        top, bottom = one.top, one.top + one.tall
        columns = own.sum(axis=0)
        full = np.flatnonzero(columns >= max(0.04 * one.tall, 1))
        if len(full) and seen > 0.6:
            least = _LONE if alone else _GROUPED
            left = float(np.clip(full[0], one.u - 0.33 * one.tall, one.u - least * one.tall))
            right = float(np.clip(full[-1] + 1, one.u + least * one.tall, one.u + 0.33 * one.tall))
        if alone:
            rows = np.flatnonzero(own.sum(axis=1) >= max(0.03 * one.tall, 1))
            if len(rows):
                first, last = float(rows[0]), float(rows[-1] + 1)
                if abs(first - top) < 0.12 * one.tall:
                    top = first
                if abs(last - bottom) < 0.2 * one.tall:
                    bottom = last
        elif seen > 0.6:
            # Legs end where the silhouette does, unless what is below is hidden or taken for a shadow.
            rows = np.flatnonzero(own.sum(axis=1) >= max(0.03 * one.tall, 1))
            if len(rows) and 0.0 < bottom - float(rows[-1] + 1) < _TRIM * one.tall:
                bottom = float(rows[-1] + 1)
        fx, fy = self._scales
        x, y = (left + self._origin[0]) / fx, (top + self._origin[1]) / fy
        w, h = (right - left) / fx, (bottom - top) / fy
        cut = _is_cut((x, y, w, h), shape)
        x1, y1 = min(x + w, float(shape[1])), min(y + h, float(shape[0]))
        x, y = max(x, 0.0), max(y, 0.0)
        return Body((x, y, max(x1 - x, 1.0), max(y1 - y, 1.0)), fill, seen, alone, one.expected, cut)
