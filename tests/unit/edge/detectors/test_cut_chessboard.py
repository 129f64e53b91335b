"""Chessboards that the image's border cuts: their corners keep the numbers that they have on the whole board."""

from __future__ import annotations

import numpy as np
import pytest

from edge.detectors.board.description import parse_board
from edge.detectors.board.detector import BoardDetector
from tests.support.boards import cut_chessboards

SQUARES = (9, 6)


def board(squares: tuple[int, int]) -> BoardDetector:
    table = {"board": "chessboard", "squares": f"{squares[0]}x{squares[1]}", "inverted": False}
    return BoardDetector(parse_board(table))


@pytest.mark.parametrize("hidden", [1, 2, 3])
def test_a_cut_chessboard_gives_the_corners_that_are_in_the_image(hidden: int) -> None:
    views, found = 0, 0
    for image, truth in cut_chessboards(SQUARES, 16, hidden, seed=5):
        views += 1
        numbers, pixels = board(SQUARES).find(image)
        if not len(numbers):
            continue
        found += 1
        assert np.linalg.norm(pixels - truth[numbers], axis=1).max() < 1.0, "a corner has another one's number"
    assert found >= 0.6 * views, (found, views)


def test_a_board_that_looks_the_same_upside_down_is_not_numbered_from_a_part() -> None:
    for image, _ in cut_chessboards((8, 6), 6, 2, seed=5):
        assert not len(board((8, 6)).find(image)[0])


def test_a_board_with_a_hidden_end_is_not_numbered() -> None:
    """The columns beyond the border and some at the other end are hidden: no part of the board tells which it is."""
    for image, truth in cut_chessboards(SQUARES, 8, 2, seed=6, covered=True):
        numbers, pixels = board(SQUARES).find(image)
        assert not len(numbers) or np.linalg.norm(pixels - truth[numbers], axis=1).max() < 1.0
