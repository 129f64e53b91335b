"""Detector of a board's corners in the images of one camera: an image pyramid, and tracking between full searches.

The board is searched in an image of at most ``SEARCH_PX``; where it was a moment ago, only its surroundings are
searched, at the resolution at which it is large enough; while it is nowhere, a tile of the full image a frame, too.
Corners are then refined in the full image. Small images of
boards with tags are enlarged: the bits of a tag 14 px wide are two pixels, and next to its corners are others.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.base import Detection, Prediction
from edge.detectors.board.description import Board
from edge.detectors.board.finder import NOTHING, Corners, Finder, Grey, linked_saddles
from protocols.geometry.types import Floats

SEARCH_PX = 1280
"""Longer side [px] of the image in which the whole frame is searched."""
_TRACK_PX, _TRACK_PX_OF_TAGS = 640, 960  # … in which the surroundings of the last place are searched
_ENLARGED = 2.0  # at most
_MARGIN = 1.0  # of the board's extent around its last place, or around half of its corners
_NEAR, _NEARLY_ALL = 0.6, 0.9  # the same for chessboards, and around so many of their corners: half as many pixels
_KEPT_SHARE = 0.8  # fewer of the corners of the last frame: the whole frame is searched
_TILES = 3  # each way, half an image wide and high: one a frame is searched at full resolution while no board is seen
_MOST_GROUPS = 4  # of saddle points, searched at each level

Box = tuple[int, int, int, int]
"""A part of an image: x, y, right, bottom [px]."""


class BoardDetector:
    """Detects the corners of a board whose print is known, ``board``; labels are those of ``Board.points``."""

    def __init__(self, board: Board, enlarged: float = _ENLARGED) -> None:
        self._enlarged = enlarged
        self.board = next(iter(board.prints()))
        self._finder = Finder(self.board)
        self._last: Floats | None = None
        self._missed = 0
        self._order: Floats | None = None

    def detect(
        self, image: npt.NDArray[np.uint8], time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        """The corners in an image (H, W, 3) uint8 BGR."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        numbers, pixels = self.find(grey)
        height, width = grey.shape
        labels = self._finder.labels
        return [
            Detection(u=float(u), v=float(v), label=labels[number], kind="corner")
            for number, (u, v) in zip(numbers.tolist(), pixels, strict=True)
            if -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5
        ]

    def find(self, grey: Grey) -> Corners:
        """Numbers and pixels of the corners in the next image (H, W) of this camera."""
        corners = self._search_nearby(grey)
        if corners is None:
            search = self._search_saddles if self.board.kind == "chessboard" else self._search_whole
            corners = search(grey, self._tile(grey.shape) if max(grey.shape) > SEARCH_PX else None)
        found = len(corners[0]) > 0
        if found and self.board.symmetric:
            corners = corners[0], self._as_before(corners[1])
        self._last = corners[1] if found else None
        self._missed = 0 if found else self._missed + 1
        return corners

    def _as_before(self, pixels: Floats) -> Floats:
        """The corners (n, 2) of a board that looks the same upside down, in the order of the last frame that had it."""
        last, upside_down = self._order, pixels[::-1]
        if last is not None and np.abs(upside_down - last).sum() < np.abs(pixels - last).sum():
            pixels = upside_down
        self._order = pixels
        return pixels

    def _tile(self, shape: tuple[int, ...]) -> Box:
        """The part of the image whose turn it is, the middle first: a board of a quarter of the image is in one."""
        row, column = divmod((4 + 4 * self._missed) % _TILES**2, _TILES)
        height, width = shape
        x, y = (count * place // (2 * (_TILES - 1)) for count, place in ((width, column), (height, row)))
        return x, y, x + width // 2, y + height // 2

    def _search_whole(self, grey: Grey, tile: Box | None) -> Corners:
        """The corners in the reduced image, and where none are, in a tile of the full one."""
        corners = self._search(grey, (0, 0, grey.shape[1], grey.shape[0]), SEARCH_PX, False)
        if tile is None or len(corners[0]):
            return corners
        return self._search(grey, tile, max(grey.shape) // 2, False)

    def _search_saddles(self, grey: Grey, tile: Box | None) -> Corners:
        """The corners of a chessboard around the groups of saddle points of a pyramid, whose last level is of a tile.

        OpenCV's finders take seconds for an image with much texture and no board.
        """
        rows, columns = (count - 1 for count in self.board.squares or (0, 0))
        whole = 0, 0, grey.shape[1], grey.shape[0]
        levels = [(whole, SEARCH_PX // 2), (whole, SEARCH_PX), *([(tile, SEARCH_PX)] if tile else [])]
        for box, longest in levels:
            x, y, right, bottom = box
            part = grey[y:bottom, x:right]
            scale = min(longest / max(part.shape), 1.0)
            level = np.asarray(cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
            for low, high, count in linked_saddles(level, max(rows * columns // 2, 4))[:_MOST_GROUPS]:
                margin = _NEAR if count > _NEARLY_ALL * rows * columns else _MARGIN
                corners = self._search_around(grey, low / scale + [x, y], high / scale + [x, y], box == whole, margin)
                if len(corners[0]):
                    return corners
        return NOTHING

    def _search_nearby(self, grey: Grey) -> Corners | None:
        """The corners around the last place; None if that is not known, or too few are there."""
        if self._last is None:
            return None
        margin = _NEAR if self.board.kind == "chessboard" else _MARGIN
        corners = self._search_around(grey, self._last.min(axis=0), self._last.max(axis=0), False, margin)
        return corners if len(corners[0]) >= max(_KEPT_SHARE * len(self._last), 1.0) else None

    def _search_around(self, grey: Grey, low: Floats, high: Floats, thorough: bool, margin: float) -> Corners:
        """The corners in the surroundings of a box from low (2,) to high (2,). margin: over its longer side."""
        reach = margin * max(float((high - low).max()), 60.0)
        x, y = np.maximum(np.floor(low - reach), 0).astype(int).tolist()
        right, bottom = np.minimum(np.ceil(high + reach), [grey.shape[1], grey.shape[0]]).astype(int).tolist()
        most = _TRACK_PX if self.board.kind == "chessboard" else _TRACK_PX_OF_TAGS
        resolution_kept = (1.0 + 2.0 * margin) / (1.0 + 2.0 * _MARGIN)
        return self._search(grey, (x, y, right, bottom), round(most * resolution_kept), thorough)

    def _search(self, grey: Grey, box: Box, most: int, thorough: bool) -> Corners:
        """The corners in a part of the image, reduced to ``most`` pixels."""
        x, y, right, bottom = box
        part = np.ascontiguousarray(grey[y:bottom, x:right])
        if min(part.shape) < 24:
            return self._finder.find(part)
        scale = min(1.0 if self.board.kind == "chessboard" else self._enlarged, most / max(part.shape))
        size = max(round(part.shape[1] * scale), 1), max(round(part.shape[0] * scale), 1)
        kernel = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
        resized = part if scale == 1.0 else np.asarray(cv2.resize(part, size, interpolation=kernel), dtype=np.uint8)
        cut = x == 0 or y == 0 or right == grey.shape[1] or bottom == grey.shape[0]
        numbers, pixels = self._finder.find(resized, thorough=thorough, cut=cut, rough=scale < 1.0)
        full = (pixels + 0.5) * [part.shape[1] / size[0], part.shape[0] / size[1]] - 0.5
        if scale < 1.0:
            numbers, full = self._finder.refine(part, (numbers, full), 1.0 / scale)
        return numbers, full + [x, y]
