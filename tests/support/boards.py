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
