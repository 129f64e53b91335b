"""Detection of a calibration board: a chessboard, or a ChArUco board, which may be partly occluded or cropped."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from edge.devices.base import Image
from edge.devices.playback.video_reader import VideoFrame
from protocols.core.errors import InputError
from protocols.geometry.types import Floats

MIN_CORNERS = 8  # with fewer, a view constrains little beyond its own pose
_MIN_MOTION = 0.015  # of the image width: views with less motion are redundant


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """One view of the board. points: (n, 3) corners on the board [squares], z = 0; pixels: (n, 2)."""

    frame: int
    points: Floats
    pixels: Floats


class Chessboard:
    """A chessboard of ``squares`` (across, down); it must be visible as a whole."""

    def __init__(self, squares: tuple[int, int]) -> None:
        self._inner = squares[0] - 1, squares[1] - 1
        if min(self._inner) < 3:
            raise InputError(f"a board of {squares[0]}x{squares[1]} squares is too small", remedy="use 4x4 or more")
        down, across = np.mgrid[: self._inner[1], : self._inner[0]]
        self._points = np.column_stack([across.ravel(), down.ravel(), np.zeros(across.size)]).astype(np.float64)

    def find(self, image: Image, frame: int) -> BoardView | None:
        """Detect the board in an image (H, W, 3) BGR; None where it is not completely visible."""
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        found, corners = cv2.findChessboardCornersSB(grey, self._inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found or corners is None:
            return None
        return BoardView(frame, self._points, np.asarray(corners, dtype=np.float64).reshape(-1, 2))


class CharucoBoard:
    """A ChArUco board of ``squares`` (across, down).

    dictionary: of its markers, OpenCV's name without DICT_. ratio: marker side over square side.
    """

    def __init__(self, squares: tuple[int, int], dictionary: str = "4X4_50", ratio: float = 0.75) -> None:
        names = {name[5:].upper(): name for name in dir(cv2.aruco) if name.startswith("DICT_")}
        if dictionary.upper() not in names:
            remedy = f"use one of {', '.join(sorted(names))}"
            raise InputError(f"there is no dictionary {dictionary!r}", remedy=remedy)
        dictionary_ = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, names[dictionary.upper()]))
        if squares[0] * squares[1] // 2 > len(dictionary_.bytesList):
            what = f"{squares[0]}x{squares[1]} squares need more markers than {dictionary} has"
            raise InputError(what, remedy="give the board's own dictionary")
        self._detectors = []
        # Patterns from before OpenCV 4.6 start with a marker if the number of rows is even.
        for legacy in (False, True) if squares[1] % 2 == 0 else (False,):
            board = cv2.aruco.CharucoBoard(squares, 1.0, ratio, dictionary_)
            board.setLegacyPattern(legacy)
            self._detectors.append((cv2.aruco.CharucoDetector(board), np.asarray(board.getChessboardCorners())))

    def find(self, image: Image, frame: int) -> BoardView | None:
        """Detect the board's corners in an image (H, W, 3) BGR; None with too few corners for a pose."""
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        for number, (detector, places) in enumerate(self._detectors):
            corners, ids, _, _ = detector.detectBoard(grey)
            if ids is None or len(ids) < MIN_CORNERS:
                continue
            points = places[np.asarray(ids).ravel()].astype(np.float64)
            if np.linalg.matrix_rank(points[:, :2] - points[0, :2]) < 2:
                continue  # collinear corners do not define a pose
            if number:
                self._detectors.reverse()  # try this pattern first from now on
            return BoardView(frame, points, np.asarray(corners, dtype=np.float64).reshape(-1, 2))
        return None


def board_views(
    board: Chessboard | CharucoBoard, frames: Iterable[VideoFrame], step: int, width: int
) -> Iterator[BoardView]:
    """Views in every ``step``-th frame, without those in which the board has not moved. width: of the image [px]."""
    before: Floats | None = None
    for frame in frames:
        if frame.frame % step:
            continue
        view = board.find(frame.image(), frame.frame)
        if view is None:
            continue
        signature = np.r_[view.pixels.mean(axis=0), view.pixels.std(axis=0), view.pixels[0] - view.pixels[-1]]
        if before is not None and np.abs(signature - before).max() < _MIN_MOTION * width:
            continue
        before = signature
        yield view
