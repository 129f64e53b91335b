"""Renders a calibration board through known intrinsics, for the tests of `syncline intrinsics`."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import numpy.typing as npt

from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

SQUARES = (8, 6)
_PIXELS = 60  # per square of the board image
_SUPERSAMPLING = 2  # samples per pixel and direction


def chessboard_image() -> npt.NDArray[np.uint8]:
    """The image (H, W) of a chessboard with a white margin one square wide."""
    rows, columns = np.mgrid[: SQUARES[1] * _PIXELS, : SQUARES[0] * _PIXELS] // _PIXELS
    board = np.where((rows + columns) % 2, 235, 20).astype(np.uint8)
    return np.pad(board, _PIXELS, constant_values=235)


def charuco_image() -> npt.NDArray[np.uint8]:
    """The image (H, W) of a ChArUco board with a white margin one square wide."""
    book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard(SQUARES, 1.0, 0.75, book)
    size = ((SQUARES[0] + 2) * _PIXELS, (SQUARES[1] + 2) * _PIXELS)
    return np.asarray(board.generateImage(size, marginSize=_PIXELS, borderBits=1), dtype=np.uint8)


def board_poses(count: int, seed: int, tilt: float = 0.6, reach: float = 0.75) -> Iterator[tuple[Floats, Floats]]:
    """Rotations (3, 3) and positions of the board's centre (3,) [squares] in camera axes.

    tilt: largest [rad]. reach: how far off the axis (tangent) the centre goes.
    """
    rng = np.random.default_rng(seed)
    for index in range(count):
        turn = 2 * np.pi * 0.382 * index
        off = reach * np.sqrt((index + 0.5) / count)
        depth = rng.uniform(8.0, 13.0)
        axis = rng.normal(size=3) * [1.0, 1.0, 0.3]
        rotation = so3.exp(axis / np.linalg.norm(axis) * rng.uniform(0.4, 1.0) * tilt)
        yield rotation, depth * np.array([off * np.cos(turn), 0.75 * off * np.sin(turn), 1.0])


class BoardRenderer:
    """Renders a board through one camera model by intersecting each pixel's rays with the board's plane."""

    def __init__(self, lens: Intrinsics, seed: int) -> None:
        self._shape = lens.height * _SUPERSAMPLING, lens.width * _SUPERSAMPLING
        self._size = lens.width, lens.height
        self._noise = np.random.default_rng(seed)
        u = (np.arange(self._shape[1]) + 0.5) / _SUPERSAMPLING - 0.5
        v = (np.arange(self._shape[0]) + 0.5) / _SUPERSAMPLING - 0.5
        grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        self._rays = np.column_stack([lens.unproject(grid), np.ones(len(grid))])

    def draw(self, board: npt.NDArray[np.uint8], rotation: Floats, centre: Floats) -> npt.NDArray[np.uint8]:
        """The image (H, W, 3) of a board at a pose as ``board_poses`` gives it, with sensor noise."""
        with np.errstate(invalid="ignore", divide="ignore"):
            far = (rotation[:, 2] @ centre) / (self._rays @ rotation[:, 2])
        across, down = (
            ((self._rays @ rotation[:, axis]) * far - centre @ rotation[:, axis] + 0.5 * SQUARES[axis] + 1.0) * _PIXELS
            - 0.5
            for axis in (0, 1)
        )
        maps = [
            np.nan_to_num(place, nan=-1e4).clip(-1e4, 1e4).reshape(self._shape).astype(np.float32)
            for place in (across, down)
        ]
        sharp = cv2.remap(board, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=[110])
        picture = cv2.resize(sharp, self._size, interpolation=cv2.INTER_AREA).astype(np.float32)
        picture += 2.0 * self._noise.standard_normal(picture.shape, dtype=np.float32)
        return np.repeat(np.clip(np.rint(picture), 0, 255).astype(np.uint8)[..., None], 3, axis=-1)


def cut_chessboards(
    squares: tuple[int, int], count: int, hidden: int, seed: int, covered: bool = False
) -> Iterator[tuple[npt.NDArray[np.uint8], Floats]]:
    """Grey images of a chessboard that a side of the image cuts, and the pixels (n, 2) of all its inner corners.

    hidden: columns, and where that leaves three rows, in every second image rows of corners beyond the border.
    covered: a grey sheet hides the columns at the board's other end.
    """
    rng = np.random.default_rng(seed)
    columns, rows = squares
    unit, shape = 27, (640, 480)
    y, x = np.mgrid[: rows * unit, : columns * unit] // unit
    sheet = np.pad(np.where((x + y) % 2, 225, 25).astype(np.uint8), unit, constant_values=225)
    if covered:
        sheet[:, : 4 * unit] = 127
    # Where squares meet are the edges of pixels, whose centres are whole numbers.
    corners = np.array([[i + 2, j + 2] for j in range(rows - 1) for i in range(columns - 1)]) * unit - 0.5
    texture = cv2.GaussianBlur(rng.integers(0, 255, shape[::-1], dtype=np.uint8), (0, 0), 5).astype(np.float64)
    background = np.clip((texture - 127) * 6 + 127, 0, 255).astype(np.uint8)
    size = np.array(sheet.shape[::-1], dtype=np.float64)
    square = np.array([[0, 0], [size[0], 0], size, [0, size[1]]])
    for index in range(count):
        by_rows = not covered and index // 4 % 2 == 1 and rows - 1 - hidden >= 3
        turn = np.pi / 2 * (index % 4) + rng.uniform(-0.12, 0.12)
        bent = (square - 0.5 * size) * rng.uniform(0.9, 1.3) * (1 + rng.uniform(-0.06, 0.06, (4, 2)))
        turned = bent @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        side = (index + by_rows) % 4
        axis, sign = side % 2, 1 if side < 2 else -1

        def placed(target: Floats) -> tuple[Floats, Floats]:
            matrix = cv2.getPerspectiveTransform(square.astype(np.float32), target.astype(np.float32))
            return matrix, cv2.perspectiveTransform(corners[None], matrix)[0]

        grid = placed(turned)[1].reshape(rows - 1, columns - 1, 2)
        lines = sign * (grid if by_rows else grid.transpose(1, 0, 2))[..., axis]
        border = sign * 0.5 * (lines[-hidden:].min() + lines[: len(lines) - hidden].max())
        shift = 0.5 * np.array(shape) - turned.mean(axis=0)
        shift[axis] = (shape[axis] - 1 if sign > 0 else 0) - border
        matrix, place = placed(turned + shift)
        image = cv2.warpPerspective(sheet, matrix, shape, dst=background.copy(), borderMode=cv2.BORDER_TRANSPARENT)
        noisy = cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(0.0, 2.0, image.shape)
        yield np.clip(noisy, 0, 255).astype(np.uint8), place
