"""Finds a printed board in pictures: a chessboard, or a ChArUco board, which may be partly hidden or cut."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from edge.devices.base import Image
from edge.devices.playback.video_reader import Shot
from protocols.core.errors import InputError
from protocols.geometry.types import Floats

LEAST_CORNERS = 8  # a view with fewer says less than its own pose asks
_MOVED = 0.015  # of the image's width: a board that moved less shows nothing new


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One picture of the board. points: (n, 3) corners on the board [squares], z = 0; pixels: (n, 2)."""

    frame: int
    points: Floats
    pixels: Floats


class Chessboard:
    """A chessboard of ``squares`` (across, down); all of it must be seen."""

    def __init__(self, squares: tuple[int, int]) -> None:
        self._inner = squares[0] - 1, squares[1] - 1
        if min(self._inner) < 3:
            raise InputError(f"a board of {squares[0]}x{squares[1]} squares is too small", remedy="use 4x4 or more")
        down, across = np.mgrid[: self._inner[1], : self._inner[0]]
        self._points = np.column_stack([across.ravel(), down.ravel(), np.zeros(across.size)]).astype(np.float64)

    def find(self, image: Image, frame: int) -> View | None:
        """The board in an image (H, W, 3) BGR; None where it is not there as a whole."""
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        found, corners = cv2.findChessboardCornersSB(grey, self._inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found or corners is None:
            return None
        return View(frame, self._points, np.asarray(corners, dtype=np.float64).reshape(-1, 2))


class Charuco:
    """A ChArUco board of ``squares`` (across, down).

    dictionary: of its markers, as OpenCV calls it without DICT_. ratio: a marker's side in squares.
    """

    def __init__(self, squares: tuple[int, int], dictionary: str = "4X4_50", ratio: float = 0.75) -> None:
        names = {name[5:].upper(): name for name in dir(cv2.aruco) if name.startswith("DICT_")}
        if dictionary.upper() not in names:
            remedy = f"use one of {', '.join(sorted(names))}"
            raise InputError(f"there is no dictionary {dictionary!r}", remedy=remedy)
        book = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, names[dictionary.upper()]))
        if squares[0] * squares[1] // 2 > len(book.bytesList):
            what = f"{squares[0]}x{squares[1]} squares need more markers than {dictionary} has"
            raise InputError(what, remedy="give the board's own dictionary")
        self._detectors = []
        # Boards printed before OpenCV 4.6 begin with a marker where the number of rows is even.
        for legacy in (False, True) if squares[1] % 2 == 0 else (False,):
            board = cv2.aruco.CharucoBoard(squares, 1.0, ratio, book)
            board.setLegacyPattern(legacy)
            self._detectors.append((cv2.aruco.CharucoDetector(board), np.asarray(board.getChessboardCorners())))

    def find(self, image: Image, frame: int) -> View | None:
        """The board's corners in an image (H, W, 3) BGR; None where there are too few to tell its place."""
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        for number, (detector, places) in enumerate(self._detectors):
            corners, ids, _, _ = detector.detectBoard(grey)
            if ids is None or len(ids) < LEAST_CORNERS:
                continue
            points = places[np.asarray(ids).ravel()].astype(np.float64)
            if np.linalg.matrix_rank(points[:, :2] - points[0, :2]) < 2:
                continue  # corners of one row tell no plane
            if number:
                self._detectors.reverse()  # the other kind of board: tried first from now on
            return View(frame, points, np.asarray(corners, dtype=np.float64).reshape(-1, 2))
        return None


def views_of(board: Chessboard | Charuco, shots: Iterable[Shot], step: int, width: int) -> Iterator[View]:
    """Views of every ``step``-th frame in which the board has moved since the last one."""
    before: Floats | None = None
    for shot in shots:
        if shot.frame % step:
            continue
        view = board.find(shot.image(), shot.frame)
        if view is None:
            continue
        spread = np.r_[view.pixels.mean(axis=0), view.pixels.std(axis=0), view.pixels[0] - view.pixels[-1]]
        if before is not None and np.abs(spread - before).max() < _MOVED * width:
            continue
        before = spread
        yield view
