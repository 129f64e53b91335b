"""Views of a calibration board in a video: the corners in frames between which the board has moved."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np

from edge.detectors.board.description import Board
from edge.detectors.board.detector import BoardDetector
from edge.detectors.board.finder import Corners
from edge.devices.playback.video_reader import VideoFrame
from protocols.geometry.types import Floats

MIN_CORNERS = 8  # with fewer, a view constrains little beyond its own pose
_MIN_MOTION = 0.015  # of the image width: views with less motion are redundant
_PRINT_FRAMES = 12  # frames with which the print of a board is found out
_NO_BOARD, _NOT_MOVED = "without the board", "with the board where it was before"
_FEW_CORNERS = f"with fewer than {MIN_CORNERS} of its corners, or only those of one line"


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """One view of the board. points: (n, 3) corners on the board [squares], z = 0; pixels: (n, 2)."""

    frame: int
    points: Floats
    pixels: Floats


def board_views(
    board: Board, frames: Iterable[VideoFrame], step: int, width: int, unused: Counter[str]
) -> Iterator[BoardView]:
    """Views in every ``step``-th frame, without those in which the board has not moved. width: of the image [px].

    unused: counts of the frames without a view, by reason. Inverted, mirrored and legacy prints are found out from the
    first frames that show any of them.
    """
    chosen = (frame for frame in frames if frame.frame % step == 0)
    finders = [BoardDetector(print_, 1.0) for print_ in board.prints()]
    points = np.array(list(board.points().values()))
    before: Floats | None = None
    while begin := list(islice(chosen, _PRINT_FRAMES if len(finders) > 1 else 1)):
        if len(finders) > 1:
            counts = [sum(len(_find(finder, frame)[0]) for frame in begin) for finder in finders]
            if not any(counts):
                unused[_NO_BOARD] += len(begin)
                continue
            finders = [BoardDetector(finders[int(np.argmax(counts))].board, 1.0)]
        for frame in begin:
            numbers, pixels = _find(finders[0], frame)
            if not len(numbers):
                unused[_NO_BOARD] += 1
                continue
            if len(numbers) < MIN_CORNERS or np.linalg.matrix_rank(points[numbers][:, :2] - points[numbers[0], :2]) < 2:
                unused[_FEW_CORNERS] += 1  # collinear corners do not define a pose
                continue
            signature = np.r_[pixels.mean(axis=0), pixels.std(axis=0), pixels[0] - pixels[-1]]
            if before is not None and np.abs(signature - before).max() < _MIN_MOTION * width:
                unused[_NOT_MOVED] += 1
                continue
            before = signature
            yield BoardView(frame.frame, points[numbers], pixels)


def _find(detector: BoardDetector, frame: VideoFrame) -> Corners:
    grey = np.asarray(cv2.cvtColor(frame.image(), cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    return detector.find(grey)
