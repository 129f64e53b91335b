"""What moves in a folder of videos: the detector that a name, board.toml or a look at some frames gives."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from deploy.offline.progress import Progress
from edge.detectors.base import Detector
from edge.detectors.board.description import BOARD_FILE, Board, BoardKind, load_dictionary, read_board
from edge.detectors.board.detector import SEARCH_PX, BoardDetector
from edge.detectors.board.finder import Finder, chessboard_of_any_size, linked_saddles
from edge.detectors.marker.ball import MarkerModel
from edge.detectors.marker.factory import ball_detector, bright_or_tag_detector
from edge.devices.playback.video_reader import VideoFrame, VideoReader
from edge.offline.sampling import sample_images
from protocols.core.errors import InputError, Refused
from protocols.geometry.types import Image

BOARDS = ("charuco", "chessboard", "tag")
DETECTORS = ("charuco", "chessboard", "tag", "bright", "marker", "person", "vehicle", "auto")
"""What ``calibrate VIDEOS --detector`` names, besides networks and other packages' detectors."""
_SAMPLES, _LOOK_AT = 8, 4  # frames of a video; videos in which tags of any kind are searched
_LEAST_FRAMES, _LEAST_VIDEOS = 2, 2  # sampled frames of a video, and videos, in which it must be found
_LEAST_PERIMETER = 0.06  # of a tag, over the longer side of the image: smaller ones are hardly measured
_LEAST_SHEET, _SHEET_SHARE = 4, 0.5  # tags of a ChArUco board; corners of it in an image that shows some
_BALL_SHARE = 0.3  # of the sampled frames
# Dictionaries of one size are prefixes of their largest: these stand for all.
_DICTIONARIES = (
    "4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000",
    "APRILTAG_36H11", "APRILTAG_25H9", "APRILTAG_16H5", "APRILTAG_36H10", "ARUCO_MIP_36H12", "ARUCO_ORIGINAL",
)  # fmt: skip
_CELL, _LEAST_CHANGE, _CHANGE_SIGMAS = 8, 4.0, 6.0  # px; grey levels, and stds of the noise of a cell's mean
_LOOK_S = 6.0  # of a video, around the largest change, in which a person or a vehicle is searched
_LEAST_SEEN = 10  # frames of these in which it is seen: a shorter track is of nothing
_EXAMPLE = 'board = "charuco", squares = "8x5", square_size = 0.03 [m]'

Grey = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Target:
    """What is searched in the videos. kind: the detector's name. board: of charuco, chessboard, tag; its print is
    known. notes: sentences for the user."""

    kind: str
    board: Board | None = None
    notes: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The target in words."""
        if self.board is None:
            return {"marker": "ball", "bright": "light"}.get(self.kind, self.kind)
        return "tag" if self.board.tags and self.board.squares is None else "board"


def find_target(folder: Path, videos: Sequence[Path], detector: str, model: MarkerModel, progress: Progress) -> Target:
    """The target of a folder of videos.

    detector: a name of DETECTORS; ``auto`` looks at some frames with all of them. Raises InputError for a board that
    is not described, and Refused, with the list of what was tried, where auto finds nothing.
    """
    file = folder / BOARD_FILE
    board = read_board(file) if file.exists() else None
    if detector in ("charuco", "chessboard") and (board is None or board.kind != detector):
        found = "there is no board.toml in this folder" if board is None else f"board.toml describes a {board.kind}"
        remedy = f"write board.toml: {_EXAMPLE}" if board is None else f"use --detector auto, or correct {BOARD_FILE}"
        raise InputError(f"--detector {detector}: {found}", file=folder, remedy=remedy)
    if detector not in (*BOARDS, "auto"):
        return Target(detector)
    looks = _Looks(videos, progress)
    if detector != "auto":
        if board is None:
            tags = looks.tags(("APRILTAG_36H11", *(name for name in _DICTIONARIES if name != "APRILTAG_36H11")))
            return Target("tag", tags[0] if tags else Board("apriltag", None, "APRILTAG_36H11"))
        if detector == "tag" and not board.tags:
            what = f"--detector tag, and board.toml describes a {board.kind}"
            raise InputError(what, file=file, remedy=f"use --detector {board.kind}")
        return Target("tag" if board.tags else board.kind, looks.print_of(board)[0])
    return _look(looks, board, model)


def _look(looks: _Looks, board: Board | None, model: MarkerModel) -> Target:
    tried = []
    if sum(bool(looks.changing(path)) for path in looks.paths) < _LEAST_VIDEOS:
        raise _nothing(["what changes between some frames of a video, anywhere in the image"])
    if board is not None:
        described, videos = looks.print_of(board)
        if videos >= _LEAST_VIDEOS:
            name = "tag" if board.tags else board.kind
            return Target(name, described, (f"auto: the board of {BOARD_FILE} is in the videos ({described.text})",))
        tried.append(f"the board of {BOARD_FILE} ({board.text}, in every print)")
    tags = looks.tags(_DICTIONARIES)
    if tags is not None:
        found, numbers = tags
        sheet = looks.charuco(found, numbers)
        if sheet is not None:
            notes = (f"auto: a {sheet.text}; {BOARD_FILE} with its squares and square_size gives the scale",)
            return Target("charuco", sheet, notes)
        hint = (
            f"; if they are on a ChArUco board, {BOARD_FILE} with it finds more and gives the scale ({_EXAMPLE})"
            if len(numbers) >= 4
            else f"; {BOARD_FILE} with tag_size gives the scale"
        )
        notes = (
            f"auto: {len(numbers)} tags of {found.dictionary}{', white on black' if found.inverted else ''}{hint}",
        )
        return Target("tag", found, notes)
    tried.append("ArUco and AprilTag tags of all dictionaries, black or white")
    squares = looks.chessboard()
    if squares is not None:
        board = Board("chessboard", squares)
        size = f"{squares[0]}x{squares[1]}"
        notes = (f"auto: a chessboard of {size} squares; {BOARD_FILE} with square_size gives the scale",)
        return Target("chessboard", board, notes)
    tried.append("chessboards")
    if looks.single(lambda size: ball_detector(model, None, size), _BALL_SHARE) >= _LEAST_VIDEOS:
        return Target("marker", None, ("auto: a coloured ball",))
    tried.append("a coloured ball (marker.toml, else orange)")
    if looks.single(lambda size: bright_or_tag_detector("bright"), _BALL_SHARE) >= _LEAST_VIDEOS:
        return Target("bright", None, ("auto: a point of light",))
    tried.append("a point of light")
    for kind in ("person", "vehicle"):
        if looks.moving(kind) >= _LEAST_VIDEOS:
            return Target(kind, None, (f"auto: a moving {kind}",))
        tried.append(f"one moving {kind}")
    raise _nothing(tried)


def _nothing(tried: list[str]) -> Refused:
    return Refused(
        f"nothing that moves was found in at least {_LEAST_VIDEOS} videos; tried: {', '.join(tried)}; name it with "
        "--detector, describe a board in board.toml, or teach a ball's colour with `syncline detect marker --teach`"
    )


class _Looks:
    """A few frames of every video, decoded when they are first needed."""

    def __init__(self, videos: Sequence[Path], progress: Progress) -> None:
        self.paths, self._progress = videos, progress
        self._samples: dict[Path, list[Image]] = {}
        self._changes: dict[Path, list[Grey]] = {}
        cv2.setNumThreads(1)

    def images(self, path: Path) -> list[Image]:
        """Sampled images of a video; none where it cannot be read."""
        if path not in self._samples:
            self._progress(f"looking at {path.name}", len(self._samples) / len(self.paths))
            try:
                self._samples[path] = list(sample_images(VideoReader(path), _SAMPLES))
            except InputError:
                self._samples[path] = []
        return self._samples[path]

    def changes(self, path: Path) -> list[Grey]:
        """By sampled image, the cells of ``_CELL`` px (rows, columns) that are not as in most of the others: 1, else 0.

        What moves is among them; with fewer than three images every cell is.
        """
        if path not in self._changes:
            cells = [_cells(_grey(image)) for image in self.images(path)]
            if len(cells) < 3:
                self._changes[path] = [np.ones(one.shape, dtype=np.uint8) for one in cells]
            else:
                off = np.stack(cells) - np.median(cells, axis=0)
                off -= np.median(off, axis=(1, 2), keepdims=True)  # the camera's exposure
                limit = max(_LEAST_CHANGE, _CHANGE_SIGMAS * 1.4826 * float(np.median(np.abs(off))))
                self._changes[path] = list((np.abs(off) > limit).astype(np.uint8))
        return self._changes[path]

    def changing(self, path: Path) -> list[int]:
        """The sampled images in which something changes, most first."""
        counts = [int(np.count_nonzero(one)) for one in self.changes(path)]
        return [index for index in np.argsort(counts)[::-1].tolist() if counts[index]]

    def print_of(self, board: Board) -> tuple[Board, int]:
        """The print of a board in which most corners are found, and the number of videos with it."""
        best, most, seen = next(iter(board.prints())), 0, 0
        for print_ in board.prints():
            counts = []
            for path in self.paths:
                detector = BoardDetector(print_)
                found = [len(detector.find(_grey(image))[0]) for image in self.images(path)]
                counts.append((sum(found), sum(count >= 4 for count in found)))
            total = sum(count for count, _ in counts)
            if total > most:
                best, most, seen = print_, total, sum(frames >= _LEAST_FRAMES for _, frames in counts)
        return best, seen

    def tags(self, dictionaries: Sequence[str]) -> tuple[Board, set[int]] | None:
        """Single tags of the dictionary of which most are seen again and again, and their numbers."""
        videos = [[_small(_grey(image)) for image in self.images(path)] for path in self.paths[:_LOOK_AT]]
        black, either = cv2.aruco.DetectorParameters(), cv2.aruco.DetectorParameters()
        black.minMarkerPerimeterRate = either.minMarkerPerimeterRate = _LEAST_PERIMETER
        either.detectInvertedMarker = True
        seen = _steady_tags(videos, dictionaries, either, first=True)
        name = max(seen, key=lambda one: len(seen[one]))
        if not seen[name]:
            return None
        steady = _steady_tags(videos, (name,), either)[name]
        dark = _steady_tags(videos, (name,), black)[name]
        inverted = 2 * len(dark) < len(steady)
        kind: BoardKind = "apriltag" if name.startswith("APRILTAG") else "aruco"
        board = Board("aruco", None, _smallest(name, max(steady)), inverted=inverted, mirrored=False, legacy=False)
        return replace(board, kind=kind), steady

    def charuco(self, tags: Board, numbers: set[int]) -> Board | None:
        """The ChArUco board that carries these tags; None = none.

        A board's tags are numbered from 0: their number leaves a few shapes, of which one has corners where tags say.
        """
        count = max(numbers) + 1
        if not _LEAST_SHEET <= count < 2 * len(numbers):
            return None
        images = [_small(_grey(image)) for path in self.paths for image in self.images(path)[::3]]
        best, most = None, 0.0
        for columns, rows in itertools.product(range(3, count + 1), repeat=2):
            if columns * rows // 2 != count:
                continue
            sheet = replace(tags, kind="charuco", squares=(columns, rows))
            for print_ in replace(sheet, mirrored=False, legacy=None).prints():
                finder = Finder(print_)
                shares = [len(finder.find(image)[0]) / len(finder.labels) for image in images]
                share = float(np.mean([one for one in shares if one > 0.0] or [0.0]))
                if share * np.count_nonzero(shares) > most and share >= _SHEET_SHARE:
                    best, most = print_, share * np.count_nonzero(shares)
        return best

    def chessboard(self) -> tuple[int, int] | None:
        """Squares of the chessboard that most frames show; None where there is none."""
        sizes: Counter[tuple[int, int]] = Counter()
        for path in self.paths[:_LOOK_AT]:
            for image in map(_small, map(_grey, self.images(path))):
                if not linked_saddles(image, 8):
                    continue
                corners = chessboard_of_any_size(image, 4)
                if corners is not None:
                    rows, columns = corners.shape[:2]
                    sizes[max(rows, columns) + 1, min(rows, columns) + 1] += 1
        if not sizes:
            return None
        size, count = sizes.most_common(1)[0]
        return size if count >= _LEAST_FRAMES * _LEAST_VIDEOS else None

    def single(self, make: Callable[[tuple[int, int]], Detector], share: float) -> int:
        """Number of videos in which a detector of single points finds something in a share of the frames, moving."""
        videos = 0
        for path in self.paths:
            images = self.images(path)
            if len(self.changing(path)) < _LEAST_FRAMES:
                continue
            detector = make((images[0].shape[1], images[0].shape[0]))
            places = []
            for image, changed in zip(images, self.changes(path), strict=True):
                found = detector.detect(image)
                if len(found) == 1 and _is_in(changed, found[0].u, found[0].v):
                    places.append((found[0].u / image.shape[1], found[0].v / image.shape[0]))
            moved = len(places) >= 2 and float(np.ptp(places, axis=0).max()) > 0.02
            videos += len(places) >= max(share * len(images), _LEAST_FRAMES) and moved
        return videos

    def moving(self, kind: str) -> int:
        """Number of videos in which a detector of moving objects confirms one."""
        from edge.offline.detections import Collected, run_detector
        from edge.offline.moving import confirmed_labels, moving_detector

        videos, left = 0, [path for path in self.paths if self.changing(path)]
        while left and videos < _LEAST_VIDEOS <= videos + len(left):
            path = left.pop(0)
            reader = VideoReader(path)
            detector = moving_detector("person" if kind == "person" else "vehicle", "mog2", reader.info.fps)
            images, most = self.images(path), self.changing(path)[0]
            self._progress(f"{path.name}: {kind}", 0.9)
            if len(images) > 4:
                detector.initialise(images)
            middle = (most + 0.5) / len(images) * reader.info.frames / reader.info.fps
            shown: Collected = {}
            run_detector(_Part(path, middle - 0.5 * _LOOK_S, middle + 0.5 * _LOOK_S), "look", detector, collected=shown)
            names = confirmed_labels(shown, detector)
            videos += sum(any(one.label in names for one in seen) for _, seen in shown.values()) >= _LEAST_SEEN
        return videos


class _Part(VideoReader):
    """The frames of a video from one time [s] to another, at least of its beginning."""

    def __init__(self, path: Path, begin: float, end: float) -> None:
        super().__init__(path)
        length = self.info.frames / self.info.fps
        self._begin = max(min(begin, length - (end - begin)), 0.0)
        self._end = self._begin + end - begin

    def __iter__(self) -> Iterator[VideoFrame]:
        for frame in super().__iter__():
            if frame.time > self._end:
                return
            if frame.time >= self._begin:
                yield frame


def _steady_tags(
    videos: Sequence[Sequence[Grey]],
    dictionaries: Sequence[str],
    parameters: cv2.aruco.DetectorParameters,
    first: bool = False,
) -> dict[str, set[int]]:
    """By dictionary, the numbers of the tags that are in several frames of several videos.

    first: look no further once there are some; the codes of all dictionaries take most of the time.
    """
    detector = cv2.aruco.ArucoDetector([load_dictionary(name) for name in dictionaries], parameters)
    frames: Counter[tuple[int, int, int]] = Counter()  # with a dictionary's tag, by video
    steady: dict[str, set[int]] = {name: set() for name in dictionaries}
    for images in itertools.zip_longest(*videos):
        for video, image in enumerate(images):
            ids, which = (None, None) if image is None else detector.detectMarkersMultiDict(image)[1::2]
            if ids is not None and which is not None:
                for index, number in {(int(i), int(n)) for i, n in zip(np.ravel(which), np.ravel(ids), strict=True)}:
                    frames[video, index, number] += 1
        videos_with = Counter(key[1:] for key, count in frames.items() if count >= _LEAST_FRAMES)
        for (index, number), count in videos_with.items():
            if count >= _LEAST_VIDEOS:
                steady[dictionaries[index]].add(number)
        if first and any(steady.values()):
            break
    return steady


def _smallest(name: str, largest: int) -> str:
    """The smallest dictionary with this number of those that begin as ``name`` does: fewer are mistaken."""
    if not name.endswith("_1000"):
        return name
    return next(f"{name[:3]}_{size}" for size in (50, 100, 250, 1000) if largest < size)


def _cells(grey: Grey) -> npt.NDArray[np.float32]:
    """Mean grey levels of cells of ``_CELL`` px."""
    size = max(grey.shape[1] // _CELL, 1), max(grey.shape[0] // _CELL, 1)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _is_in(changed: Grey, u: float, v: float) -> bool:
    """Whether a place [px] lies in a cell that changed, or beside one."""
    row, column = int(v // _CELL), int(u // _CELL)
    return bool(changed[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].any())


def _grey(image: Image) -> Grey:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def _small(grey: Grey) -> Grey:
    scale = min(1.0, SEARCH_PX / max(grey.shape))
    size = max(round(grey.shape[1] * scale), 1), max(round(grey.shape[0] * scale), 1)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if scale < 1.0 else grey, dtype=np.uint8)
