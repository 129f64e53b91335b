"""Corners of a known board in one grey image, by OpenCV: ChArUco boards, chessboards, square tags.

A chessboard may be where saddle points of the grey levels are linked as neighbouring corners are.
At a corner of a chessboard the grey levels are those of a saddle, and its neighbours' saddles are turned by 90 degrees
against it, along the edges of the squares. Saddles in other textures are not turned alike, so that their links stay
few (of Duda and Frese, "Accurate Detection and Localization of Checkerboard Corners", BMVC 2018, the idea that corners
come first and the grid next; the measure on a ring is that of Bennett and Lasenby, "ChESS", CVIU 2014).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from edge.detectors.board.description import Board, load_dictionary
from edge.detectors.marker.tag import refined_corners
from protocols.geometry.types import Bools, Floats, Ints

Grey = npt.NDArray[np.uint8]
Corners = tuple[Ints, Floats]
"""Numbers (n,) of the corners, and their pixels (n, 2). A corner's number is its place in ``Finder.labels``."""
NOTHING: Corners = (np.zeros(0, dtype=np.int64), np.zeros((0, 2)))
_SUBPIX_LEAST, _SUBPIX_MOST = 2, 9  # px: half window
_SUBPIX_SHARE, _SUBPIX_SHARE_OF_TAGS = 0.4, 0.12  # of the distance of neighbouring corners; tags are in between
_SUBPIX_MARGIN = 2.0  # px: from a window to the nearest marker of a ChArUco board, whose edge is blurred
_LEAST_CUT = 3  # rows and columns of corners of a part of a chessboard, OpenCV's least
_MOST_CHANGE = 0.4  # of the step between corners to the next: a board seen from 5 squares away, tilted by 60 degrees

_SIGMA = 1.5  # px: smoothing before derivatives
_MIN_CONTRAST = 8.0  # grey levels between dark and light squares
_MOST = 4000  # strongest saddles
_RING = 5  # px: radius at which a saddle's phase is measured
_NEIGHBOURS = 12  # in a board tilted by 60 degrees, the next corner across is the ninth at worst
_ANGLE = np.radians(45.0)  # of a phase, which is twice an angle, from that of ideal corners, seen straight
_BEND = 0.3  # of the step between corners to the next
_SHARE = 0.6  # of the second harmonic in the variance on the ring; 0.81 round an ideal corner, seen straight


class Finder:
    """Finds the corners of one print of a board; keeps no state."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self._numbers: dict[str, int] = {}
        self.labels: list[str] = []
        """Labels of the corners by number; single tags are added as they are seen."""
        places = board.points() if board.squares is not None else {}
        for label in places:
            self._number(label)
        self._places = np.array(list(places.values()))[:, :2] if places else np.zeros((0, 2))
        self._charuco = _charuco_detector(board) if board.kind == "charuco" else None
        self._tags = _tag_detector(board) if board.tags else None

    def find(self, grey: Grey, *, thorough: bool = False, cut: bool = False, rough: bool = False) -> Corners:
        """The corners in an image (H, W) uint8.

        thorough: search a chessboard by every method. cut: it may go on beyond the image's border. rough: `refine`
        follows, so the sides of tags are not measured yet.
        """
        if min(grey.shape) < 24:
            return NOTHING
        print_ = np.asarray(255 - grey if self.board.inverted else grey, dtype=np.uint8)
        if self.board.mirrored:
            print_ = np.ascontiguousarray(print_[:, ::-1])
        if self._charuco is not None:
            numbers, pixels = self._find_charuco(print_, rough)
        elif self._tags is not None:
            numbers, pixels = self._find_tags(print_)
            pixels = pixels if rough else self._measured(print_, pixels)
        else:
            numbers, pixels = self._find_chessboard(print_, False)
            if cut and not len(numbers) and not self.board.symmetric:
                numbers, pixels = self._find_cut_chessboard(print_)
            if thorough and not len(numbers):
                numbers, pixels = self._find_chessboard(print_, True)
        if self.board.mirrored:
            pixels = np.column_stack([grey.shape[1] - 1.0 - pixels[:, 0], pixels[:, 1]])
            numbers = self._mirrored(numbers)
        return numbers, pixels

    def refine(self, grey: Grey, corners: Corners, found_px: float = 1.0) -> Corners:
        """The corners again, near ``corners``, which are in the image's pixels.

        found_px: size of a pixel of the image in which they were found.
        """
        numbers, pixels = corners
        if not len(numbers):
            return corners
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
        # Finders extrapolate grids to beyond the image, where OpenCV refuses to begin.
        begin = np.clip(pixels, 0.0, np.subtract(grey.shape[::-1], 1)).astype(np.float32).reshape(-1, 1, 2)
        halves, refined = self._half_windows(corners), np.zeros_like(pixels)
        for half in np.unique(halves).tolist():
            found = cv2.cornerSubPix(grey, begin[halves == half], (half, half), (-1, -1), criteria)
            refined[halves == half] = np.reshape(found, (-1, 2))
        # In windows of 5 px some end at another edge, 1 to 3 px away; OpenCV's ChArUco corners are less than 1 px off.
        most = 1.5 * halves if self._charuco is None else np.maximum(0.5 * halves, found_px)
        near = np.linalg.norm(refined - pixels, axis=1) < most
        refined = np.where(near[:, None], refined, pixels)
        return numbers, self._measured(np.asarray(255 - grey if self.board.inverted else grey, np.uint8), refined)

    def _half_windows(self, corners: Corners) -> Ints:
        """Half sides (n,) [px] of square windows around the corners with nothing but the four squares there."""
        if self._charuco is None:
            share = _SUBPIX_SHARE if self.board.kind == "chessboard" else _SUBPIX_SHARE_OF_TAGS
            half = np.full(len(corners[0]), share * self.pitch(corners))
        else:
            half = _distance_of_markers(self._places[corners[0]], corners[1], self.board.ratio) - _SUBPIX_MARGIN
        return np.asarray(np.clip(half, _SUBPIX_LEAST, _SUBPIX_MOST).astype(np.int64))

    def _measured(self, print_: Grey, pixels: Floats) -> Floats:
        """Corners (n, 2) of tags, four each, where lines along their sides meet; those of other boards as they are."""
        if not self.board.tags or not len(pixels):
            return pixels
        return np.concatenate([refined_corners(print_, quad) for quad in pixels.reshape(-1, 4, 2)])

    def pitch(self, corners: Corners) -> float:
        """Median distance of a corner from the nearest other one [px]."""
        _, pixels = corners
        if len(pixels) < 2:
            return 30.0
        distance = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
        np.fill_diagonal(distance, np.inf)
        return float(np.median(distance.min(axis=1)))

    def _number(self, label: str) -> int:
        if label not in self._numbers:
            self._numbers[label] = len(self.labels)
            self.labels.append(label)
        return self._numbers[label]

    def _find_charuco(self, grey: Grey, rough: bool) -> Corners:
        assert self._charuco is not None
        corners, ids, _, _ = self._charuco.detectBoard(grey)
        if ids is None or not len(ids):
            return NOTHING
        numbers, pixels = np.asarray(ids, dtype=np.int64).ravel(), np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        # OpenCV's windows reach as far as the markers' corners are, to the corners of a square: into the markers.
        return (numbers, pixels) if rough else self.refine(grey, (numbers, pixels))

    def _find_tags(self, grey: Grey) -> Corners:
        assert self._tags is not None
        quads, ids, _ = self._tags.detectMarkers(grey)
        numbers, pixels = [], []
        for quad, tag in zip(quads, () if ids is None else np.ravel(ids).tolist(), strict=True):
            labels = [f"{tag}.{k}" for k in range(4)]
            if self.board.squares is not None and labels[0] not in self._numbers:
                continue  # not of this grid
            numbers += [self._number(label) for label in labels]
            pixels.append(np.asarray(quad, dtype=np.float64).reshape(4, 2))
        return (np.array(numbers, dtype=np.int64), np.concatenate(pixels)) if numbers else NOTHING

    def _find_chessboard(self, grey: Grey, thorough: bool) -> Corners:
        assert self.board.squares is not None
        inner = self.board.squares[0] - 1, self.board.squares[1] - 1
        numbers = np.arange(inner[0] * inner[1], dtype=np.int64)
        sector, classic = cv2.findChessboardCornersSB, cv2.findChessboardCorners
        # The classic finder likes small boards and blur better.
        methods: list[tuple[Any, int]] = [
            (sector, cv2.CALIB_CB_NORMALIZE_IMAGE),
            (classic, cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK),
        ]
        if thorough:
            methods = [(sector, cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY)]
        for method, flags in methods:
            found, corners = method(grey, inner, flags=flags)
            if not found or corners is None:
                continue
            # The sector-based finder's corners are biased by up to 0.03 px, which unknown lenses take up.
            _, refined = self.refine(grey, (numbers, np.asarray(corners, dtype=np.float64).reshape(-1, 2)))
            pixels = refined.reshape(inner[1], inner[0], 2)
            if _is_regular(pixels) and not any(_goes_on(grey, np.rot90(pixels, turn)) for turn in range(4)):
                return numbers, _ordered(grey, pixels).reshape(-1, 2)
        return NOTHING

    def _find_cut_chessboard(self, grey: Grey) -> Corners:
        """The corners of a chessboard whose other columns, or rows, are beyond the image's border.

        Which part of the board it is follows from the end inside the image: there one more column of squares follows
        the last corners, and then the margin; and from the colours, which differ at the board's two ends.
        """
        assert self.board.squares is not None
        raw = chessboard_of_any_size(grey, _LEAST_CUT)
        if raw is None:
            return NOTHING
        numbers = np.arange(raw.size // 2)
        grid = _right_handed(self.refine(grey, (numbers, raw.reshape(-1, 2)))[1].reshape(raw.shape))
        columns, rows = self.board.squares[0] - 1, self.board.squares[1] - 1
        whole = np.arange(rows * columns).reshape(rows, columns)
        for turn in range(4 if _is_regular(grid) else 0):
            part = np.rot90(grid, turn)
            hidden = rows - part.shape[0], columns - part.shape[1]
            if min(hidden) != 0 or max(hidden) == 0:
                continue
            axis = int(hidden[1] > 0)
            lines, of_board = np.moveaxis(part, axis, 0), np.moveaxis(whole, axis, 0)
            first, other = _diagonal_levels(grey, part)
            for shift in (0, max(hidden)):
                if (first <= other) == (shift % 2 == 0) and _ends(grey, lines[::-1] if shift else lines):
                    seen = of_board[shift : shift + len(lines)]
                    return np.moveaxis(seen, 0, axis).ravel(), part.reshape(-1, 2)
        return NOTHING

    def _mirrored(self, numbers: Ints) -> Ints:
        """The places on the sheet of a mirrored print's corners: its columns are exchanged."""
        if self.board.squares is None or not len(numbers):
            return numbers
        columns = self.board.squares[0]
        if self.board.tags:
            tag, corner = np.divmod(numbers, 4)
            row, column = np.divmod(tag, columns)
            return np.asarray(4 * (row * columns + columns - 1 - column) + np.array([1, 0, 3, 2])[corner])
        row, column = np.divmod(numbers, columns - 1)
        return np.asarray(row * (columns - 1) + columns - 2 - column)


def _distance_of_markers(places: Floats, pixels: Floats, ratio: float) -> Floats:
    """Larger of the distances across and down (n,) [px] from each corner of a ChArUco board to the nearest marker.

    places: (n, 2) of the corners [squares]. ratio: side of a marker over that of a square.
    """
    steps, shifts = (values[None] - values[:, None] for values in (places, pixels))
    weights = 1.0 / np.maximum((steps**2).sum(axis=2), 1e-9) ** 2  # of the nearest corners for the map around one
    weighted = (weights[..., None] * steps).swapaxes(1, 2)
    by_step = np.linalg.pinv(weighted @ steps) @ weighted @ shifts  # (n, 2, 2): pixels a square across and down
    diagonals = 0.5 * (1.0 - ratio) * np.array([[1.0, 1.0], [1.0, -1.0]])
    return np.asarray(np.abs(diagonals @ by_step).max(axis=2).min(axis=1))


def chessboard_of_any_size(grey: Grey, least: int) -> Floats | None:
    """Corners (rows, columns, 2) of a chessboard with at least ``least`` of them each way; None = none is seen."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(grey, (least, least), flags=flags)
    if not found or corners is None or meta is None:
        return None
    return np.asarray(corners, dtype=np.float64).reshape(*np.asarray(meta).shape[:2], 2)


def _is_regular(corners: Floats) -> bool:
    """Whether the steps between corners (rows, columns, 2) change little from one to the next.

    Finders take the edge of the margin for a row of small boards, or a corner for its neighbour.
    """
    for line in (corners, corners.transpose(1, 0, 2)):
        change = np.linalg.norm(line[2:] - 2.0 * line[1:-1] + line[:-2], axis=2)
        if (change > _MOST_CHANGE * 0.5 * np.linalg.norm(line[2:] - line[:-2], axis=2)).any():
            return False
    return True


def _ends(grey: Grey, lines: Floats) -> bool:
    """Whether a board ends inside the image before the first of lines (n, m, 2) of corners, and not after the last.

    Half a step before the first corners are the last squares, dark and light; from one step on, the margin.
    """
    most = np.subtract(grey.shape[::-1], 1)
    step, beyond = lines[0] - lines[1], 2.0 * lines[-1] - lines[-2]
    middle, half = 0.5 * (lines[0, :-1] + lines[0, 1:]), 0.5 * (step[:-1] + step[1:])
    places = [np.rint(middle + far * half).astype(int) for far in (-0.5, 0.5, 1.25)]
    outside = [((one < 0) | (one > most)).any() for one in (places[2], beyond)]
    if outside != [False, True]:
        return False
    levels = [grey[one[:, 1], one[:, 0]].astype(np.float64) for one in places]
    inner, last, margin = (float(one[::2].mean() - one[1::2].mean()) for one in levels)
    light = max(levels[1][::2].mean(), levels[1][1::2].mean()) - 0.25 * abs(inner)
    is_margin = abs(margin) < 0.25 * abs(inner) and levels[2].mean() > light
    return bool(is_margin and -last * np.sign(inner) > 0.5 * abs(inner))


def _goes_on(grey: Grey, lines: Floats) -> bool:
    """Whether another row of squares follows the first of lines (n, m, 2) of corners: part of a larger board.

    Which part is another one from frame to frame. Of the row next to the last squares every square then has the level
    of the square two steps further in; a margin has that of every second one.
    """
    step, middle = lines[0] - lines[1], 0.5 * (lines[0, :-1] + lines[0, 1:])
    inner, after = (np.rint(middle + far * 0.5 * (step[:-1] + step[1:])).astype(int) for far in (-0.5, 1.5))
    if ((after < 0) | (after >= grey.shape[::-1])).any():
        return False
    levels, beyond = (grey[one[:, 1], one[:, 0]].astype(np.float64) for one in (inner, after))
    contrast = abs(levels[::2].mean() - levels[1::2].mean())
    return bool((np.abs(beyond - levels) < 0.5 * contrast).all())


def _right_handed(corners: Floats) -> Floats:
    """Corners (rows, columns, 2) in an order in which rows x columns is a right-handed frame in the image."""
    across, down = corners[0, -1] - corners[0, 0], corners[-1, 0] - corners[0, 0]
    return corners[:, ::-1] if across[0] * down[1] - across[1] * down[0] < 0.0 else corners


def _ordered(grey: Grey, corners: Floats) -> Floats:
    """Corners (rows, columns, 2) of a chessboard in the one order that the same physical corner always has.

    A board with an odd and an even number of squares looks different upside down: its first square is dark.
    Other boards do not: the first corner is then the one further up and left in the image.
    """
    rows, columns = corners.shape[:2]
    corners = _right_handed(corners)  # finders may give a mirrored order
    if (rows + columns) % 2:
        first, other = _diagonal_levels(grey, corners)
        return corners if first <= other else corners[::-1, ::-1]
    middle = corners.mean(axis=(0, 1))
    return corners if (corners[0, 0] - middle).sum() <= (corners[-1, -1] - middle).sum() else corners[::-1, ::-1]


def _diagonal_levels(grey: Grey, corners: Floats) -> tuple[float, float]:
    """Mean grey level of the inner squares of the first one's colour, and of the others."""
    middles = 0.25 * (corners[:-1, :-1] + corners[1:, :-1] + corners[:-1, 1:] + corners[1:, 1:])
    row, column = np.mgrid[: middles.shape[0], : middles.shape[1]]
    places = np.clip(np.rint(middles), 0, [grey.shape[1] - 1, grey.shape[0] - 1]).astype(int)
    levels = grey[places[..., 1], places[..., 0]].astype(np.float64)
    even = (row + column) % 2 == 0
    return float(levels[even].mean()), float(levels[~even].mean()) if (~even).any() else 255.0


def _charuco_detector(board: Board) -> Any:
    assert board.squares is not None
    known = load_dictionary(board.dictionary)
    # Only its own markers: each candidate is compared with all, and 1000 take eight times as long as 27.
    known.bytesList = known.bytesList[: board.squares[0] * board.squares[1] // 2]
    pattern = cv2.aruco.CharucoBoard(board.squares, 1.0, board.ratio, known)
    pattern.setLegacyPattern(bool(board.legacy))
    parameters = cv2.aruco.CharucoParameters()
    parameters.tryRefineMarkers = True  # where the board has them: four times as many corners of small boards
    return cv2.aruco.CharucoDetector(pattern, parameters)


def _tag_detector(board: Board) -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(load_dictionary(board.dictionary), parameters)


Complexes = npt.NDArray[np.complex128]


def linked_saddles(grey: npt.NDArray[np.uint8], least: int) -> list[tuple[Floats, Floats, int]]:
    """Boxes (low, high; each x, y in px) round groups of at least ``least`` linked corners, the largest first.

    The third value is the number of corners.
    """
    pixels, phase = _saddles(grey)
    if len(pixels) < least:
        return []
    near = np.asarray(KDTree(pixels).query(pixels, min(_NEIGHBOURS + 1, len(pixels)))[1])[:, 1:]
    step = pixels[near] - pixels[:, None]
    linked = _are_neighbours(step, phase[:, None], phase[near])
    # Corners lie in rows: of a link counts what goes on, as far and as straight, on the corner's other side.
    inner = np.flatnonzero(linked.sum(axis=1) > 1)
    near, step, linked = near[inner], step[inner], linked[inner]
    size = np.linalg.norm(step, axis=2)
    bend = np.linalg.norm(step[:, :, None] + step[:, None], axis=3) < 0.5 * _BEND * (size[:, :, None] + size[:, None])
    linked &= (bend & linked[:, :, None] & linked[:, None]).any(axis=2)
    first, place = np.nonzero(linked)
    first, second = inner[first], near[first, place]
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(len(pixels), len(pixels)))
    count, group = connected_components(graph, directed=False)
    sizes = np.bincount(group, minlength=count)
    members = [pixels[group == k] for k in np.argsort(-sizes, kind="stable") if sizes[k] >= least]
    return [(one.min(axis=0), one.max(axis=0), len(one)) for one in members]


def _saddles(grey: npt.NDArray[np.uint8]) -> tuple[Floats, Complexes]:
    """Pixels (n, 2) of saddle points, and their second harmonic on a ring (n,), of absolute value 1."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _SIGMA)
    xx, xy, yy = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) for order in ((2, 0), (1, 1), (0, 2)))
    saddle = (0.25 * xy) ** 2 - (0.25 * xx) * (0.25 * yy)
    # A corner of contrast C, smoothed by s, has the mixed derivative C / (pi s^2), and the others are 0.
    weakest = (_MIN_CONTRAST / (np.pi * _SIGMA**2)) ** 2
    peak = (saddle > weakest) & (saddle >= cv2.dilate(saddle, np.ones((5, 5), np.uint8)))
    peak[: _RING + 1] = peak[-_RING - 1 :] = peak[:, : _RING + 1] = peak[:, -_RING - 1 :] = False
    rows, columns = np.nonzero(peak)
    if len(rows) > _MOST:
        best = np.argpartition(-saddle[rows, columns], _MOST)[:_MOST]
        rows, columns = rows[best], columns[best]
    angles = np.arange(16) * np.pi / 8
    x, y = (np.rint(_RING * part(angles)).astype(int) for part in (np.cos, np.sin))
    ring = smooth[rows[:, None] + y, columns[:, None] + x].astype(np.float64)
    ring -= ring.mean(axis=1, keepdims=True)
    second = ring @ np.exp(2j * angles) / 8.0
    share = 0.5 * np.abs(second) ** 2 / np.maximum((ring**2).mean(axis=1), 1e-9)
    good = share > _SHARE
    return np.column_stack([columns, rows])[good].astype(np.float64), (second / np.abs(second))[good]


def _are_neighbours(step: Floats, first: Complexes, second: Complexes) -> Bools:
    """Whether saddles a step (..., 2) apart are turned against each other, and the step follows the edges of both."""
    along = np.exp(2j * np.arctan2(step[..., 1], step[..., 0]))
    opposite = (first * second.conj()).real < -np.cos(_ANGLE)
    edges = [np.abs((one.conj() * along).real) < np.sin(_ANGLE) for one in (first, second)]
    return np.asarray(opposite & edges[0] & edges[1])
