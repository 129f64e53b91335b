"""What is behind people, from pictures in which they are: the values of a place while nothing moved there."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
Motion = npt.NDArray[np.float32]

_KEPT = 32  # pictures
_CELL, _AROUND = 8, 3  # pixels of a cell's side; cells beside it that count
_APART_S = 0.1  # between pictures whose difference is motion
_CALMEST, _BRIGHT = 0.25, 0.65  # share of the pictures that tell a place; of those, as many are darker: shadows are
_STILL, _FINE = 1.3, 2.0  # times the usual change that is no motion; steps a doubling of it
_CLOSEST = 0.34  # of the pictures that show a place's background, at least


class Album:
    """Pictures of the first time before a camera, evenly over it, each with what moved where."""

    def __init__(self) -> None:
        # In cells (h, w, _CELL, _CELL, 3), as whole cells are chosen.
        self._pictures: list[Image] = []
        self._shape: tuple[int, ...] = ()
        self._motion: list[Motion] = []
        self._number: list[int] = []
        self._stride = 1
        self._seen = 0
        self._small: deque[Image] = deque()

    def __len__(self) -> int:
        return len(self._pictures)

    def some(self, count: int) -> list[Image]:
        """About so many of those that are kept, (H, W, 3) each, evenly over the time."""
        return [_joined(one, self._shape) for one in self._pictures[:: max(len(self) // count, 1)]]

    def add(self, picture: Image, period: float) -> None:
        """One more picture (H, W, 3), ``period`` [s] after the last."""
        lag = max(round(_APART_S / period), 1)
        small = np.asarray(cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        self._small.append(small)
        while len(self._small) > lag + 1:
            self._small.popleft()
        change = _change(self._small[0], small, picture.shape)
        if self._seen - lag in self._number:  # what moves after a picture has moved in it
            index = self._number.index(self._seen - lag)
            self._motion[index] = np.maximum(self._motion[index], change)
        if self._seen % self._stride == 0:
            self._shape = picture.shape
            self._pictures.append(_cells(picture))
            self._motion.append(change)
            self._number.append(self._seen)
        self._seen += 1
        if len(self._pictures) > _KEPT:
            self._pictures, self._motion = self._pictures[::2], self._motion[::2]
            self._number, self._stride = self._number[::2], 2 * self._stride

    def paint(self, picture: Image, where: Image) -> None:
        """Take over parts of a picture (H, W, 3) where ``where`` (H, W) is 255: there it shows the background."""
        shown, there = _cells(picture), _cells(where)[..., None] > 0
        row, column = np.nonzero(there.any(axis=(2, 3, 4)))
        for one in self._pictures:
            one[row, column] = np.where(there[row, column], shown[row, column], one[row, column])

    def background(self) -> Image:
        """What is behind it all (H, W, 3): of each place the pictures in which least moved there.

        Bodies move more than what is behind them, also where they cover it for most of the time; of the pictures that
        are left a place's brighter ones count, as shadows only darken.
        """
        motion = np.array(self._motion)
        count = len(motion)
        # Where nothing moves the pictures are equal: then those spread over the whole time are taken.
        steps = np.floor(_FINE * np.log2(np.maximum(motion / (_STILL * max(float(np.median(motion)), 1e-6)), 1.0)))
        order = np.argsort(_spread(count)).astype(np.float32) / (count + 1)
        share = min(max(round(_CALMEST * count), 3), count)
        calm = np.argsort(steps + order[:, None, None], axis=0, kind="stable")[:share]
        row, column = np.indices(calm.shape[1:])
        size = calm.shape[1] * _CELL
        stack = np.array(self._pictures)
        values = [stack[one, row, column].reshape(size, -1) for one in calm]
        for low, high in comparisons(share):
            one, other = values[low], values[high]
            values[low], values[high] = np.asarray(cv2.min(one, other)), np.asarray(cv2.max(one, other))
        found = values[min(int(_BRIGHT * share), share - 1)]
        return _joined(found.astype(np.uint8).reshape(stack.shape[1:]), self._shape)


def _cells(picture: Image) -> Image:
    """A picture (H, W) or (H, W, 3) in cells (h, w, _CELL, _CELL) or (h, w, _CELL, _CELL, 3), its border repeated."""
    (height, width), deep = picture.shape[:2], picture.shape[2:]
    down, across = -height % _CELL, -width % _CELL
    whole = cv2.copyMakeBorder(picture, 0, down, 0, across, cv2.BORDER_REPLICATE) if down or across else picture
    split = whole.reshape((height + down) // _CELL, _CELL, (width + across) // _CELL, _CELL, *deep)
    return np.ascontiguousarray(split.swapaxes(1, 2), dtype=np.uint8)


def _joined(cells: Image, shape: tuple[int, ...]) -> Image:
    """The picture (H, W, 3) of cells (h, w, _CELL, _CELL, 3)."""
    h, w = cells.shape[:2]
    whole = cells.swapaxes(1, 2).reshape(h * _CELL, w * _CELL, 3)
    return np.ascontiguousarray(whole[: shape[0], : shape[1]])


def _change(one: Image, other: Image, shape: tuple[int, ...]) -> Motion:
    """How much two pictures of half the size differ in and around each cell; (h, w) of pictures of ``shape``."""
    blue, green, red = cv2.split(cv2.absdiff(one, other))
    total = cv2.add(cv2.add(blue, green, dtype=cv2.CV_32F), red, dtype=cv2.CV_32F)
    size = -(-shape[1] // _CELL), -(-shape[0] // _CELL)
    return np.asarray(cv2.blur(cv2.resize(total, size, interpolation=cv2.INTER_AREA), (_AROUND, _AROUND)))


def _spread(count: int) -> list[int]:
    """The numbers below ``count`` in an order of which every beginning is spread evenly (bits reversed)."""
    bits = max(count - 1, 1).bit_length()
    return sorted(range(count), key=lambda number: int(format(number, f"0{bits}b")[::-1], 2))


def usual(pictures: Sequence[Image]) -> Image:
    """What is behind it all in pictures (n of (H, W, 3)) far apart: of each value the middle of the closest third.

    Unlike the median it holds where something passes for more than half of the time, as what passes differs.
    """
    count, shape = len(pictures), pictures[0].shape
    share = max(round(_CLOSEST * count), 1)
    values = [np.ascontiguousarray(picture).reshape(shape[0], -1) for picture in pictures]
    for low, high in comparisons(count):
        one, other = values[low], values[high]
        values[low], values[high] = np.asarray(cv2.min(one, other)), np.asarray(cv2.max(one, other))
    found = values[share // 2].copy()
    least = cv2.subtract(values[share - 1], values[0])
    for start in range(1, count - share + 1):
        width = cv2.subtract(values[start + share - 1], values[start])
        cv2.copyTo(values[start + share // 2], cv2.compare(width, least, cv2.CMP_LT), found)
        least = cv2.min(least, width)
    return found.reshape(shape)


def comparisons(count: int) -> list[tuple[int, int]]:
    """Pairs (low, high) of places that, put in order one after the other, sort so many values.

    Batcher's odd-even merge sort: whole pictures are compared at once, which numpy's sort along them is slower than.
    """
    pairs = []
    run = 1
    while run < count:
        gap = run
        while gap >= 1:
            for begin in range(gap % run, count - gap, 2 * gap):
                for low in range(begin, begin + min(gap, count - begin - gap)):
                    if low // (2 * run) == (low + gap) // (2 * run):
                        pairs.append((low, low + gap))
            gap //= 2
        run *= 2
    return pairs
