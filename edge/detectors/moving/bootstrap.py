"""Bootstrap of the background from images in which objects move: per-cell selection of the images with least motion."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Image

Motion = npt.NDArray[np.float32]

_MAX_IMAGES = 32  # that are kept for the first background: bounds the memory
_CELL, _BLUR_CELLS = 8, 3  # cell size [px]; width [cells] of the motion blur filter
_MOTION_LAG_S = 0.1  # between the images whose difference measures motion
# share of the images used per cell; quantile of their values, because shadows only darken
_STILL_SHARE, _LIT_QUANTILE = 0.25, 0.65
# factor on the median change below which there is no motion; quantisation steps per doubling
_NOISE_FACTOR, _STEPS_PER_OCTAVE = 1.3, 2.0
_SHORTEST_SHARE = 0.34  # share of the images that show the background of a place, at least


class BackgroundBootstrap:
    """Images sampled evenly over the first seconds of a camera, each with a map of the motion in it."""

    def __init__(self) -> None:
        # In cells (h, w, _CELL, _CELL, 3), because whole cells are selected.
        self._images: list[Image] = []
        self._shape: tuple[int, ...] = ()
        self._motion: list[Motion] = []
        self._number: list[int] = []
        self._stride = 1
        self._seen = 0
        self._small: deque[Image] = deque()

    def __len__(self) -> int:
        return len(self._images)

    def sample(self, count: int) -> list[Image]:
        """About ``count`` of the stored images, (H, W, 3) each, evenly over the time."""
        return [_from_cells(one, self._shape) for one in self._images[:: max(len(self) // count, 1)]]

    def add(self, image: Image, period: float) -> None:
        """Add an image (H, W, 3), ``period`` [s] after the last one."""
        lag = max(round(_MOTION_LAG_S / period), 1)
        small = np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        self._small.append(small)
        while len(self._small) > lag + 1:
            self._small.popleft()
        change = _motion_energy(self._small[0], small, image.shape)
        if self._seen - lag in self._number:  # motion after an image counts for it too
            index = self._number.index(self._seen - lag)
            self._motion[index] = np.maximum(self._motion[index], change)
        if self._seen % self._stride == 0:
            self._shape = image.shape
            self._images.append(_to_cells(image))
            self._motion.append(change)
            self._number.append(self._seen)
        self._seen += 1
        if len(self._images) > _MAX_IMAGES:
            self._images, self._motion = self._images[::2], self._motion[::2]
            self._number, self._stride = self._number[::2], 2 * self._stride

    def overwrite(self, image: Image, where: Image) -> None:
        """Overwrite parts of all stored images by an image (H, W, 3) where ``where`` (H, W) is 255: it shows the
        background.
        """
        shown, there = _to_cells(image), _to_cells(where)[..., None] > 0
        row, column = np.nonzero(there.any(axis=(2, 3, 4)))
        for one in self._images:
            one[row, column] = np.where(there[row, column], shown[row, column], one[row, column])

    def background(self) -> Image:
        """The background (H, W, 3): per cell from the images with the least motion there.

        Bodies move more than the background, also where they cover it most of the time. Of the selected images a high
        quantile is taken, because shadows only darken.
        """
        motion = np.array(self._motion)
        count = len(motion)
        # Without motion all images rank equal: then those spread over the whole time are taken.
        steps = np.floor(
            _STEPS_PER_OCTAVE * np.log2(np.maximum(motion / (_NOISE_FACTOR * max(float(np.median(motion)), 1e-6)), 1.0))
        )
        order = np.argsort(_bit_reversed_order(count)).astype(np.float32) / (count + 1)
        share = min(max(round(_STILL_SHARE * count), 3), count)
        stillest = np.argsort(steps + order[:, None, None], axis=0, kind="stable")[:share]
        row, column = np.indices(stillest.shape[1:])
        size = stillest.shape[1] * _CELL
        stack = np.array(self._images)
        values = [stack[one, row, column].reshape(size, -1) for one in stillest]
        for low, high in sorting_network(share):
            one, other = values[low], values[high]
            values[low], values[high] = np.asarray(cv2.min(one, other)), np.asarray(cv2.max(one, other))
        found = values[min(int(_LIT_QUANTILE * share), share - 1)]
        return _from_cells(found.astype(np.uint8).reshape(stack.shape[1:]), self._shape)


def _to_cells(image: Image) -> Image:
    """An image (H, W) or (H, W, 3) in cells (h, w, _CELL, _CELL) or (h, w, _CELL, _CELL, 3), its border replicated."""
    (height, width), deep = image.shape[:2], image.shape[2:]
    down, across = -height % _CELL, -width % _CELL
    whole = cv2.copyMakeBorder(image, 0, down, 0, across, cv2.BORDER_REPLICATE) if down or across else image
    split = whole.reshape((height + down) // _CELL, _CELL, (width + across) // _CELL, _CELL, *deep)
    return np.ascontiguousarray(split.swapaxes(1, 2), dtype=np.uint8)


def _from_cells(cells: Image, shape: tuple[int, ...]) -> Image:
    """The image (H, W, 3) of cells (h, w, _CELL, _CELL, 3)."""
    h, w = cells.shape[:2]
    whole = cells.swapaxes(1, 2).reshape(h * _CELL, w * _CELL, 3)
    return np.ascontiguousarray(whole[: shape[0], : shape[1]])


def _motion_energy(one: Image, other: Image, shape: tuple[int, ...]) -> Motion:
    """Difference (h, w) of two images of half the size in and around each cell; ``shape``: of the full images."""
    blue, green, red = cv2.split(cv2.absdiff(one, other))
    total = cv2.add(cv2.add(blue, green, dtype=cv2.CV_32F), red, dtype=cv2.CV_32F)
    size = -(-shape[1] // _CELL), -(-shape[0] // _CELL)
    return np.asarray(cv2.blur(cv2.resize(total, size, interpolation=cv2.INTER_AREA), (_BLUR_CELLS, _BLUR_CELLS)))


def _bit_reversed_order(count: int) -> list[int]:
    """The numbers below ``count`` in bit-reversed order: every prefix is spread evenly."""
    bits = max(count - 1, 1).bit_length()
    return sorted(range(count), key=lambda number: int(format(number, f"0{bits}b")[::-1], 2))


def background_mode(images: Sequence[Image]) -> Image:
    """Per-pixel mode of images (n of (H, W, 3)) far apart in time: the median of the shortest interval that holds a
    third.

    Unlike the median it also holds where passing objects cover a place for more than half of the time, because these
    differ.
    """
    count, shape = len(images), images[0].shape
    share = max(round(_SHORTEST_SHARE * count), 1)
    values = [np.ascontiguousarray(image).reshape(shape[0], -1) for image in images]
    for low, high in sorting_network(count):
        one, other = values[low], values[high]
        values[low], values[high] = np.asarray(cv2.min(one, other)), np.asarray(cv2.max(one, other))
    found = values[share // 2].copy()
    least = cv2.subtract(values[share - 1], values[0])
    for start in range(1, count - share + 1):
        width = cv2.subtract(values[start + share - 1], values[start])
        cv2.copyTo(values[start + share // 2], cv2.compare(width, least, cv2.CMP_LT), found)
        least = cv2.min(least, width)
    return found.reshape(shape)


def sorting_network(count: int) -> list[tuple[int, int]]:
    """Comparators (low, high) that sort ``count`` values when applied in order: Batcher's odd-even merge sort.

    Whole images are compared at once, which is faster than numpy's sort along the stack.
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
