"""Description of a printed board or of square tags, and of board.toml: which labelled corners are where on the body.

=============  ========================================================================================================
board          ``charuco``, ``chessboard``, ``aruco`` or ``apriltag``
squares        columns x rows, ``"8x5"``: of a ChArUco board or a chessboard; of a grid of ArUco or AprilTag markers
tag_size       side of the black border of single tags [rig units]; without ``squares`` every tag is a body of its own
dictionary     of the markers, OpenCV's name with or without ``DICT_``; default 4X4_50, for AprilTags APRILTAG_36H11
ratio          side of a marker over side of a square (in a grid: over the distance between markers); default 0.75
square_size    side of a square [rig units]: gives the scale
inverted, mirrored, legacy   the print: white on black; seen in a mirror or through the sheet; OpenCV's pattern from
               before 4.6. Default: found out from the pictures
=============  ========================================================================================================
"""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np

from protocols.core.errors import InputError
from protocols.core.files import read_toml
from protocols.geometry.types import Floats

BOARD_FILE = "board.toml"
BoardKind = Literal["charuco", "chessboard", "aruco", "apriltag"]
_KEYS = ("board", "squares", "tag_size", "dictionary", "ratio", "square_size", "inverted", "mirrored", "legacy")
_PRINTS = ("inverted", "mirrored", "legacy")
_MOST_SQUARES, _LARGEST = 100, 1e6  # each way; units: bounds of what a file may say
_EXAMPLE = 'as board = "charuco", squares = "8x5", square_size = 0.03'


@dataclass(frozen=True, slots=True)
class Board:
    """A printed board, or square tags.

    squares: columns, rows; None = every tag by itself. size: side of a square, or of a tag where there are no squares
    [rig units]; None = not known, lengths are then in squares. inverted, mirrored, legacy: None = not known.
    """

    kind: BoardKind = "charuco"
    squares: tuple[int, int] | None = None
    dictionary: str = "4X4_50"
    ratio: float = 0.75
    size: float | None = None
    inverted: bool | None = None
    mirrored: bool | None = None
    legacy: bool | None = None

    @property
    def tags(self) -> bool:
        """Whether it consists of tags alone, whose own corners are detected."""
        return self.kind in ("aruco", "apriltag")

    @property
    def symmetric(self) -> bool:
        """Whether it looks the same turned by 180°: which corner is the first is then a matter of its neighbours."""
        return self.kind == "chessboard" and self.squares is not None and sum(self.squares) % 2 == 0

    @property
    def text(self) -> str:
        """The board in words."""
        grid = "" if self.squares is None else f" of {self.squares[0]}x{self.squares[1]} squares"
        prints = [name for name in _PRINTS if getattr(self, name)]
        markers = "" if self.kind == "chessboard" else f", {self.dictionary}"
        return f"{self.kind}{grid}{markers}{''.join(f', {name}' for name in prints)}"

    def prints(self) -> Iterator[Board]:
        """The board in every print that is compatible with what is known of it, the usual one first."""
        flags = []
        for name in _PRINTS:
            given = getattr(self, name)
            if name == "legacy" and (self.kind != "charuco" or (self.squares or (0, 1))[1] % 2):
                given = bool(given)  # patterns differ only where the number of rows is even
            if name != "legacy" and self.kind == "chessboard":
                given = bool(given)  # its inverse and its mirror image are chessboards too
            flags.append((False, True) if given is None else (given,))
        for legacy, mirrored, inverted in itertools.product(flags[2], flags[1], flags[0]):
            yield replace(self, inverted=inverted, mirrored=mirrored, legacy=legacy)

    def bodies(self, labels: list[str]) -> dict[str, dict[str, Floats]]:
        """The rigid bodies: by name, their points (3,) by label [rig units, or squares]. labels: those that were seen.

        The board's plane is z = 0; x goes along its columns, y down its rows.
        """
        size = 1.0 if self.size is None else self.size
        if self.squares is None:
            numbers = sorted({label.split(".")[0] for label in labels}, key=lambda text: (len(text), text))
            square = size * np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
            return {f"tag{n}": {f"{n}.{k}": square[k] for k in range(4)} for n in numbers}
        return {"board": {label: size * point for label, point in self.points().items()}}

    def points(self) -> dict[str, Floats]:
        """The points (3,) of a board with squares by label [squares]."""
        assert self.squares is not None
        columns, rows = self.squares
        if not self.tags:
            return {
                str(row * (columns - 1) + column): np.array([column + 1.0, row + 1.0, 0.0])
                for row in range(rows - 1)
                for column in range(columns - 1)
            }
        side = self.ratio
        corners = np.array([[0.0, 0.0, 0.0], [side, 0.0, 0.0], [side, side, 0.0], [0.0, side, 0.0]])
        return {
            f"{row * columns + column}.{k}": corners[k] + [column, row, 0.0]
            for row in range(rows)
            for column in range(columns)
            for k in range(4)
        }


def load_dictionary(name: str) -> Any:
    """OpenCV's dictionary of this name, with or without ``DICT_``. Raises InputError."""
    names = {name[5:].upper(): name for name in dir(cv2.aruco) if name.startswith("DICT_")}
    wanted = name.upper().removeprefix("DICT_")
    if wanted not in names:
        close = difflib.get_close_matches(wanted, names, 3, 0.5)
        hint = f"did you mean {', '.join(close)}?" if close else f"use one of {', '.join(sorted(names))}"
        raise InputError(f"there is no dictionary {name!r}", remedy=hint)
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, names[wanted]))


def parse_squares(text: Any) -> tuple[int, int]:
    """Columns and rows of ``"8x5"``. Raises InputError."""
    found = re.fullmatch(r"\s*(\d{1,3})\s*[xX×]\s*(\d{1,3})\s*", text) if isinstance(text, str) else None
    if found is None or not all(1 <= int(part) <= _MOST_SQUARES for part in found.groups()):
        raise InputError(f"squares = {text!r} is no board", remedy='give columns x rows as printed: squares = "8x5"')
    return int(found[1]), int(found[2])


def read_board(file: Path) -> Board:
    """Read a board.toml. Raises InputError."""
    values, text = read_toml(file, "board file")
    try:
        return parse_board(values)
    except InputError as error:
        key = next((key for key in values if f"{key} =" in error.what or repr(key) in error.what), None)
        lines = [n for n, row in enumerate(text.splitlines(), 1) if key and re.match(rf"\s*{re.escape(key)}\s*=", row)]
        line = lines[0] if lines else None
        raise InputError(error.what, file=file, line=line, remedy=error.remedy) from None


def parse_board(values: Mapping[str, Any]) -> Board:
    """A board from the content of board.toml. Raises InputError."""
    unknown = next((key for key in values if key not in _KEYS), None)
    if unknown is not None:
        close = difflib.get_close_matches(str(unknown), _KEYS, 1, 0.5)
        hint = f"did you mean {close[0]}?" if close else f"keys are {', '.join(_KEYS)}"
        raise InputError(f"{unknown!r} is no key of a board", remedy=hint)
    kind = values.get("board", "charuco")
    if kind not in get_args(BoardKind):
        raise InputError(f"board = {kind!r} is not known", remedy=f"use one of {', '.join(get_args(BoardKind))}")
    tags = kind in ("aruco", "apriltag")
    squares = parse_squares(values["squares"]) if "squares" in values else None
    if squares is None and not tags:
        raise InputError(f"a {kind} needs its squares", remedy=f"give columns x rows as printed, {_EXAMPLE}")
    dictionary = values.get("dictionary", "APRILTAG_36H11" if kind == "apriltag" else "4X4_50")
    if not isinstance(dictionary, str):
        raise InputError(f"dictionary = {dictionary!r} is not text", remedy='give dictionary = "4X4_50"')
    ratio = _number(values, "ratio", 0.05, 1.0)
    square, tag = (_number(values, key, 1e-9, _LARGEST) for key in ("square_size", "tag_size"))
    if squares is None and square is not None:
        raise InputError(
            f"square_size = {square:g} without squares", remedy="give tag_size, or the squares of their grid"
        )
    marked = squares is not None and kind != "chessboard"
    if marked and square is not None and tag is not None:
        ratio = tag / square
    if marked and ratio is not None and not 0.05 <= ratio < 1.0:
        what = f"ratio = {ratio:g}" if tag is None else f"tag_size = {tag:g}"
        raise InputError(f"{what} is no marker within its square", remedy="measure both on the print, in one unit")
    prints = {name: values.get(name) for name in _PRINTS}
    for name, value in prints.items():
        if value is not None and not isinstance(value, bool):
            raise InputError(f"{name} = {value!r} is not true or false", remedy=f"give {name} = true or false")
    board = Board(kind, squares, dictionary, ratio or 0.75, square if squares is not None else tag, **prints)
    if marked and square is None and tag is not None:
        board = replace(board, size=tag / board.ratio)
    check_board(board)
    return board


def check_board(board: Board) -> None:
    """Raise InputError for a board that cannot be detected."""
    least = {"charuco": 2, "chessboard": 4}.get(board.kind, 1)
    if board.squares is not None and min(board.squares) < least:
        shown = f"{board.squares[0]}x{board.squares[1]}"
        raise InputError(f"squares = {shown!r} is too small a {board.kind}", remedy=f"use {least}x{least} or more")
    if board.kind == "chessboard":
        return
    known = load_dictionary(board.dictionary)
    if board.squares is not None:
        columns, rows = board.squares
        needed = columns * rows if board.tags else columns * rows // 2
        if needed > len(known.bytesList):
            what = f"{columns}x{rows} squares need more markers than dictionary = {board.dictionary!r} has"
            raise InputError(what, remedy="give the board's own dictionary")


def _number(values: Mapping[str, Any], key: str, least: float, most: float) -> float | None:
    value = values.get(key)
    if value is None:
        return None
    if not isinstance(value, int | float) or isinstance(value, bool) or not least <= value <= most:
        raise InputError(f"{key} = {value!r} is out of range", remedy=f"give {key} between {least:g} and {most:g}")
    return float(value)
