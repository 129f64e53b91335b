"""Chessboards that the image's border cuts: their corners keep the numbers that they have on the whole board."""

from __future__ import annotations

import numpy as np
import pytest

from edge.detectors.board.description import Board, parse_board
from edge.detectors.board.detector import BoardDetector
from edge.detectors.board.finder import Finder
from tests.support.boards import cut_chessboards


def board(squares: tuple[int, int] = (9, 6)) -> Board:
    return parse_board({"board": "chessboard", "squares": f"{squares[0]}x{squares[1]}", "inverted": False})


@pytest.mark.parametrize("hidden", [1, 2, 3])
def test_a_cut_chessboard_gives_the_corners_that_are_in_the_image(hidden: int) -> None:
    finder, found = Finder(board()), 0
    for image, truth in cut_chessboards((9, 6), 4, hidden, seed=5):
        assert not len(finder.find(image)[0]), "no whole board is in the image"
        numbers, pixels = finder.find(image, cut=True)
        found += len(numbers) > 0
        assert np.linalg.norm(pixels - truth[numbers], axis=1).max(initial=0.0) < 0.5, "another corner's number"
    assert found >= 3


def test_the_detector_takes_boards_at_the_images_border_for_cut_ones() -> None:
    image, truth = next(cut_chessboards((9, 6), 1, 3, seed=44))
    numbers, pixels = BoardDetector(board()).find(image)
    assert len(numbers) == 25
    assert np.linalg.norm(pixels - truth[numbers], axis=1).max() < 0.5
    # In a larger image the same part ends where nothing cuts it: which part it is, is not known.
    inside = np.pad(image, 300, constant_values=127)
    assert not len(BoardDetector(board()).find(inside)[0])


def test_a_board_that_looks_the_same_upside_down_is_not_numbered_from_a_part() -> None:
    for image, _ in cut_chessboards((8, 6), 3, 2, seed=5):
        assert not len(Finder(board((8, 6))).find(image, cut=True)[0])


def test_a_board_with_a_hidden_end_is_not_numbered() -> None:
    """A sheet hides its other end, too: no part of the board shows which it is."""
    for image, truth in cut_chessboards((9, 6), 4, 2, seed=6, covered=True):
        numbers, pixels = Finder(board()).find(image, cut=True)
        assert np.linalg.norm(pixels - truth[numbers], axis=1).max(initial=0.0) < 0.5


def test_corners_that_are_extrapolated_beyond_the_image_are_no_error() -> None:
    image, truth = next(cut_chessboards((9, 6), 1, 3, seed=44))
    numbers, pixels = Finder(board()).refine(image, (np.arange(len(truth)), truth))
    assert (truth > np.subtract(image.shape[::-1], 1)).any()
    inside = (truth > 0).all(axis=1) & (truth < np.subtract(image.shape[::-1], 20)).all(axis=1)
    assert np.linalg.norm(pixels[inside] - truth[inside], axis=1).max() < 0.5
    assert len(numbers) == len(truth)
