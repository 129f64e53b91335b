"""CPU time of detection in 3840x2160 images, on one core.

    python -m tests.bench.large_images

Drawn images of a textured background: a moving ChArUco board, the same without it, a moving orange ball.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from edge.detectors.base import Detection
from edge.detectors.board.description import parse_board
from edge.detectors.board.detector import BoardDetector
from edge.detectors.marker.ball import MarkerModel
from edge.detectors.marker.factory import ball_detector
from protocols.geometry.types import Image
from tests.support import boards

_FRAMES = 16
_BOARDS = {
    kind: parse_board({"board": kind, "squares": "8x6", "inverted": False, "mirrored": False, "legacy": False})
    for kind in ("charuco", "chessboard")
}


def _background() -> Image:
    noise = np.random.default_rng(0).integers(0, 255, (2160, 3840), dtype=np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 9).astype(np.float64)
    return np.clip((smooth - 127) * 8 + 127, 0, 255).astype(np.uint8)


def board_images(board: Image, background: Image) -> Iterator[Image]:
    """A board that moves by 40 px a frame."""
    height, width = board.shape
    source = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float32)
    for k in range(_FRAMES):
        target = np.array([[900, 500], [1900, 560], [1850, 1300], [880, 1250]], dtype=np.float32) + [40 * k, 0]
        matrix = cv2.getPerspectiveTransform(source, target.astype(np.float32))
        out = cv2.warpPerspective(board, matrix, (3840, 2160), dst=background.copy(), borderMode=cv2.BORDER_TRANSPARENT)
        yield np.asarray(cv2.cvtColor(out, cv2.COLOR_GRAY2BGR), dtype=np.uint8)


def ball_images(background: Image) -> Iterator[Image]:
    """An orange ball that moves by 50 px a frame."""
    for k in range(_FRAMES):
        image = np.asarray(cv2.cvtColor(background, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
        yield np.asarray(cv2.circle(image, (1000 + 50 * k, 900), 40, (0, 120, 255), -1, cv2.LINE_AA), dtype=np.uint8)


def measure(name: str, detect: Callable[[Image], list[Detection]], images: Iterator[Image]) -> None:
    """Print the mean and largest CPU seconds a frame, and how many frames had a detection."""
    seconds, found = [], 0
    for image in images:
        began = time.process_time()
        found += bool(detect(image))
        seconds.append(time.process_time() - began)
    print(f"{name:13s} mean {np.mean(seconds):.3f} s, largest {max(seconds):.3f} s a frame, found in {found}/{_FRAMES}")


def main() -> None:
    """Run all."""
    cv2.setNumThreads(1)
    background = _background()
    empty = np.asarray(cv2.cvtColor(background, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    for kind, image in (("charuco", boards.charuco_image()), ("chessboard", boards.chessboard_image())):
        measure(kind, BoardDetector(_BOARDS[kind]).detect, board_images(image, background))
        measure(f"no {kind}", BoardDetector(_BOARDS[kind]).detect, iter([empty] * _FRAMES))
    measure("ball", ball_detector(MarkerModel.default(), None, (3840, 2160)).detect, ball_images(background))


if __name__ == "__main__":
    main()
