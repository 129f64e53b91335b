"""`syncline calibrate VIDEOS` with boards: rendered clips of an inverted ChArUco board, names, and bad descriptions."""

from __future__ import annotations

import json
import shutil
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deploy.cli import run
from edge.detectors.board.description import Board, parse_board
from edge.detectors.board.detector import BoardDetector
from edge.detectors.board.finder import Finder
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.session.calibration import read_calibration
from tests.support import boards
from tests.support.board_session import BoardWorld, board_world, render_videos
from tests.support.command_line import refusal

Capture = pytest.CaptureFixture[str]
BOARD = 'board = "charuco"\nsquares = "8x6"\nsquare_size = 0.1\n'
NAMES = ("CVLab1", "GoPro 2")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, BoardWorld]:
    """Two clips of an inverted board, named as users name cameras, with board.toml and no lenses."""
    folder = tmp_path_factory.mktemp("board") / "videos"
    world = board_world(5, (10.0, 12.0), lag=1.5, squares=(8, 6), size=0.1)
    render_videos(world, folder, 6.0, inverted=True, scale=0.6)
    for old, new in zip(world.cameras, NAMES, strict=True):
        (folder / f"{old}.mp4").rename(folder / f"{new}.mp4")
    (folder / "board.toml").write_text(BOARD)
    return folder, world


def test_two_clips_of_a_board_give_clocks_poses_lenses_and_metres(
    recorded: tuple[Path, BoardWorld], tmp_path: Path, capsys: Capture
) -> None:
    folder, world = recorded
    out = tmp_path / "out"
    assert run(["calibrate", str(folder), "--detector", "charuco", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "board in" in printed
    assert "marker" not in printed
    rig, cameras = read_calibration(out / "calibration.toml")
    assert list(cameras) == list(NAMES)
    assert rig.metadata["scale"] == "metric"
    first, second = world.cameras.values()
    true = first.pose.camera_from_world(second.pose.position[None])[0]
    found = cameras["CVLab1"].pose.camera_from_world(cameras["GoPro 2"].pose.position[None])[0]
    assert np.linalg.norm(found - true) < 0.03
    at = 3.0
    clock = cameras["GoPro 2"].time_map
    expected = second.rate * at + second.offset
    assert abs(clock.clock_rate * at + clock.time_offset - expected) < 0.005
    stated = json.loads((out / "result.json").read_text())["cameras"]["GoPro 2"]
    assert stated["lag_std_s"] == cameras["GoPro 2"].time_offset_std > 0.0
    session = tomllib.loads((out / "session" / "rig.toml").read_text())
    assert len(session["metadata"]["bodies"]["board"]) == 35


def test_auto_takes_the_board_that_is_there_and_says_so(recorded: tuple[Path, BoardWorld], tmp_path: Path) -> None:
    from deploy.offline.recognition import find_target
    from edge.detectors.marker.ball import MarkerModel

    folder, _ = recorded
    paths = sorted(folder.glob("*.mp4"))
    target = find_target(folder, paths, "auto", MarkerModel.default(), lambda text, share: None)
    assert target.board is not None
    assert (target.kind, target.board.inverted) == ("charuco", True)
    assert "inverted" in target.notes[0]
    bare = tmp_path / "bare"
    bare.mkdir()
    for path in paths:
        shutil.copy(path, bare)
    target = find_target(bare, sorted(bare.glob("*.mp4")), "auto", MarkerModel.default(), lambda text, share: None)
    assert target.board is not None
    assert (target.kind, target.board.squares, target.board.dictionary) == ("charuco", (8, 6), "4X4_50")
    assert target.board.inverted
    assert "board.toml" in target.notes[0]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('board = "charuco"\n', "needs its squares"),
        ('board = "charuco"\nsquares = "8by5"\n', "squares = '8by5'"),
        ('board = "circles"\nsquares = "8x5"\n', "board = 'circles'"),
        ('board = "charuco"\nsquares = "8x5"\nsquare_sise = 0.03\n', "did you mean square_size"),
        ('board = "charuco"\nsquares = "8x5"\ndictionary = "4X4_51"\n', "did you mean"),
        ('board = "charuco"\nsquares = "20x20"\ndictionary = "4X4_50"\n', "more markers"),
        ('board = "charuco"\nsquares = "8x5"\ninverted = 1\n', "inverted = 1"),
    ],
)
def test_a_wrong_board_toml_is_bad_input_in_one_line(
    recorded: tuple[Path, BoardWorld], tmp_path: Path, capsys: Capture, text: str, problem: str
) -> None:
    for path in recorded[0].glob("*.mp4"):
        shutil.copy(path, tmp_path)
    (tmp_path / "board.toml").write_text(text)
    assert problem in refusal(capsys, ["calibrate", str(tmp_path), "--out", str(tmp_path / "out")])


def test_a_board_of_another_dictionary_and_millimetres_are_named_as_such(
    recorded: tuple[Path, BoardWorld], tmp_path: Path, capsys: Capture
) -> None:
    for path in recorded[0].glob("*.mp4"):
        shutil.copy(path, tmp_path)
    (tmp_path / "board.toml").write_text(BOARD.replace("0.1", "100") + 'dictionary = "7X7_50"\n')
    command = ["calibrate", str(tmp_path), "--detector", "charuco", "--out", str(tmp_path / "out")]
    assert run(command) == 3
    printed = capsys.readouterr()
    assert "charuco of 8x6 squares, 7X7_50; compare its squares and dictionary" in printed.err
    assert 'a square is 100 m wide: give metres, or units = "mm"' in printed.out + printed.err


def test_a_board_detector_without_board_toml_names_the_file(
    recorded: tuple[Path, BoardWorld], tmp_path: Path, capsys: Capture
) -> None:
    for path in recorded[0].glob("*.mp4"):
        shutil.copy(path, tmp_path)
    assert run(["calibrate", str(tmp_path), "--detector", "charuco", "--out", str(tmp_path / "out")]) == 2
    assert "write board.toml" in capsys.readouterr().err


def _drawn(name: str, columns: int, rows: int, legacy: bool) -> np.ndarray:
    book = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
    board = cv2.aruco.CharucoBoard((columns, rows), 1.0, 0.7, book)
    board.setLegacyPattern(legacy)
    return np.asarray(board.generateImage((columns * 60 + 120, rows * 60 + 120), marginSize=60), dtype=np.uint8)


@pytest.mark.parametrize(
    ("dictionary", "legacy", "inverted", "mirrored"),
    [("5X5_100", True, False, False), ("6X6_250", False, True, True), ("APRILTAG_36H11", False, False, True)],
)
def test_every_print_is_recognised_and_gives_the_same_corners(
    dictionary: str, legacy: bool, inverted: bool, mirrored: bool
) -> None:
    image = _drawn(dictionary, 6, 4, legacy)
    image = image[:, ::-1].copy() if mirrored else image
    image = 255 - image if inverted else image
    board = Board("charuco", (6, 4), dictionary, 0.7)
    counts = {print_: len(Finder(print_).find(image)[0]) for print_ in board.prints()}
    best = max(counts, key=counts.__getitem__)
    assert (best.legacy, best.inverted, best.mirrored) == (legacy, inverted, mirrored)
    finder = Finder(best)
    numbers, pixels = finder.find(image)
    assert len(numbers) == 15
    points = np.array([board.points()[finder.labels[number]][:2] for number in numbers])
    assert np.abs(60 * points + 59.5 - pixels).max() < 1.0


def test_a_board_is_compared_with_its_own_markers_only() -> None:
    board = Board("charuco", (8, 6), "4X4_1000", inverted=False, mirrored=False, legacy=False)
    detector = Finder(board)._charuco
    assert detector is not None
    assert len(detector.getBoard().getDictionary().bytesList) == 24
    assert len(Finder(board).find(boards.charuco_image())[0]) == 35


def test_a_chessboard_has_one_order_of_its_corners_also_upside_down() -> None:
    board = next(iter(Board("chessboard", (8, 5)).prints()))
    squares = (np.indices((5, 8)).sum(axis=0) % 2 * 255).astype(np.uint8)
    image = np.pad(np.kron(squares, np.ones((40, 40), np.uint8)), 60, constant_values=255)
    upright = dict(zip(*map(list, Finder(board).find(image)), strict=True))
    turned = dict(zip(*map(list, Finder(board).find(np.ascontiguousarray(image[::-1, ::-1]))), strict=True))
    size = np.array(image.shape[::-1]) - 1.0
    assert len(upright) == 28
    for number, pixel in upright.items():
        assert np.abs(size - turned[number] - pixel).max() < 1.0


def test_a_large_image_gives_the_corners_of_full_resolution() -> None:
    lens = Intrinsics(1920, 1080, np.array([[1600.0, 0, 960], [0, 1600.0, 540], [0, 0, 1]]))
    image = boards.BoardRenderer(lens, 1).draw(boards.charuco_image(), np.eye(3), np.array([0.5, 0.2, 12.0]))
    grey = image[..., 0].copy()
    detector = BoardDetector(parse_board({"board": "charuco", "squares": "8x6", "inverted": False, "mirrored": False}))
    detector.find(grey)
    numbers, pixels = detector.find(grey)  # tracked
    full_numbers, full = Finder(detector.board).find(grey)
    common, a, b = np.intersect1d(numbers, full_numbers, return_indices=True)
    assert len(common) == 35
    assert np.abs(pixels[a] - full[b]).max() < 0.25


@pytest.mark.parametrize("place", [(300, 200), (2000, 900), (3300, 1700)])
def test_a_board_too_small_for_the_reduced_image_is_found_within_nine_frames(place: tuple[int, int]) -> None:
    board = parse_board({"board": "charuco", "squares": "8x6", "inverted": False, "mirrored": False, "legacy": False})
    grey = np.full((2160, 3840), 120, np.uint8)
    small = cv2.resize(boards.charuco_image(), (256, 192), interpolation=cv2.INTER_AREA)
    grey[place[1] : place[1] + 192, place[0] : place[0] + 256] = small
    detector = BoardDetector(board)
    assert max(len(detector.find(grey)[0]) for _ in range(9)) == 35
    assert len(detector.find(grey)[0]) == 35  # tracked from then on


def _corner_errors(kind: str, focal: float, enlarged: float = 2.0) -> np.ndarray:
    """Errors [px] of the corners found in 8 views of a board by a camera of 640x480. enlarged: its images, at most."""
    lens = Intrinsics(640, 480, np.array([[focal, 0.0, 319.5], [0.0, focal, 239.5], [0.0, 0.0, 1.0]]))
    board = next(iter(Board(kind, (8, 6), inverted=False, mirrored=False).prints()))  # type: ignore[arg-type]
    drawing = boards.charuco_image() if kind == "charuco" else boards.chessboard_image()
    renderer, errors = boards.BoardRenderer(lens, 1), []
    points = np.array(list(board.points().values())) - [4.0, 3.0, 0.0]
    for rotation, centre in boards.board_poses(8, 3, 0.5, 0.15):
        numbers, pixels = BoardDetector(board, enlarged).find(renderer.draw(drawing, rotation, centre)[..., 0].copy())
        true = lens.project(points @ rotation.T + centre)
        nearest = np.linalg.norm(pixels[:, None] - true[None], axis=2).argmin(axis=1)
        errors.append(pixels - true[nearest])
        assert len(numbers) == len(pixels)
    return np.concatenate(errors)


def test_corners_of_a_chessboard_have_no_bias_that_an_unknown_lens_would_take_up() -> None:
    errors = _corner_errors("chessboard", 320.0)
    assert len(errors) == 8 * 35
    assert np.abs(errors.mean(axis=0)).max() < 0.005
    assert errors.std() < 0.05


def test_corners_of_a_charuco_board_are_not_drawn_into_its_markers() -> None:
    """OpenCV's windows reach into the markers of small boards: each corner was off by its own 0.1 to 0.6 px, in every
    view alike, and focal lengths by up to 4 of their stds."""
    errors = _corner_errors("charuco", 600.0, 1.0)
    assert len(errors) > 100
    assert errors.std() < 0.08
    assert np.abs(errors).max() < 0.3


def test_a_grid_with_the_margin_for_a_column_is_searched_again_by_another_method(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    board = next(iter(Board("chessboard", (8, 5)).prints()))
    squares = (np.indices((5, 8)).sum(axis=0) % 2 * 255).astype(np.uint8)
    image = np.pad(np.kron(squares, np.ones((24, 24), np.uint8)), 40, constant_values=255)
    true = np.stack(np.meshgrid(24.0 * np.arange(1, 8) + 39.5, 24.0 * np.arange(1, 5) + 39.5), axis=-1)
    margin = true.copy()
    margin[:, 6] += [17.0, 0.0]
    monkeypatch.setattr(cv2, "findChessboardCornersSB", lambda *_, **__: (True, margin.astype(np.float32)))
    _, pixels = Finder(board).find(image)
    assert len(pixels) == 28
    assert np.abs(np.sort(pixels, axis=0) - np.sort(true.reshape(-1, 2), axis=0)).max() < 0.1


def test_a_chessboard_is_searched_only_where_saddle_points_are_linked_as_its_corners_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (720, 1280), dtype=np.uint8)
    texture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]
    with_board = texture.copy()
    with_board[300:460, 700:900] = cv2.resize(boards.chessboard_image(), (200, 160), interpolation=cv2.INTER_AREA)
    searched, sector = [], cv2.findChessboardCornersSB
    monkeypatch.setattr(
        cv2, "findChessboardCornersSB", lambda image, *a, **k: searched.append(image.shape) or sector(image, *a, **k)
    )
    board = Board("chessboard", (8, 6), inverted=False)
    assert not len(BoardDetector(board).find(texture)[0])
    assert not searched
    _, pixels = BoardDetector(board).find(with_board)
    assert np.abs(pixels.min(axis=0) - [739.5, 339.5]).max() < 0.5
    assert np.abs(pixels.max(axis=0) - [859.5, 419.5]).max() < 0.5
    assert all(height < 400 for height, _ in searched)


def test_tags_of_two_pixels_a_bit_are_read_and_leave_the_corners_next_to_them_alone() -> None:
    errors = _corner_errors("charuco", 170.0)
    assert len(errors) > 200
    assert errors.std() < 0.13


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"board": "chessboard", "squares": "3x3"}, "too small"),
        ({"squares": "8x5", "ratio": 1.0}, "ratio = 1 is no marker within its square"),
        ({"squares": "8x5", "square_size": 0.04, "tag_size": 0.05}, "tag_size = 0.05 is no marker within"),
        ({"squares": "8x5", "square_size": 20.0, "tag_size": 0.015}, "tag_size = 0.015 is no marker within"),
        ({"board": "aruco", "square_size": 0.1}, "square_size = 0.1 without squares; give tag_size"),
    ],
)
def test_what_is_no_board_is_bad_input(values: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        parse_board(values)


def test_sizes_of_square_and_marker_give_their_ratio() -> None:
    board = parse_board({"board": "charuco", "squares": "8x5", "square_size": 0.04, "tag_size": 0.02})
    assert (board.ratio, board.size) == (0.5, 0.04)
    alone = parse_board({"board": "charuco", "squares": "8x5", "tag_size": 0.03})
    assert (alone.ratio, alone.size) == (0.75, pytest.approx(0.04))


def test_a_chessboard_that_looks_the_same_upside_down_keeps_its_order_while_it_turns() -> None:
    board = next(iter(Board("chessboard", (8, 6)).prints()))
    squares = (np.indices((6, 8)).sum(axis=0) % 2 * 255).astype(np.uint8)
    image = np.pad(np.kron(squares, np.ones((40, 40), np.uint8)), 140, constant_values=255)
    middle = (np.array(image.shape[::-1]) - 1.0) / 2.0
    detector = BoardDetector(board)
    first = None
    for degrees in range(0, 200, 20):
        turn = cv2.getRotationMatrix2D(tuple(middle.tolist()), degrees, 1.0)
        grey = cv2.warpAffine(image, turn, image.shape[::-1], borderValue=255)
        _, pixels = detector.find(np.asarray(grey, dtype=np.uint8))
        back = cv2.transform(pixels[None].astype(np.float64), cv2.invertAffineTransform(turn))[0]
        first = back if first is None else first
        assert np.abs(back - first).max() < 1.0


def test_a_part_of_a_larger_chessboard_is_not_the_board() -> None:
    # Which part would be another one from frame to frame. 7x5: the inner corners, as some tools count.
    lens = Intrinsics(640, 480, np.array([[520.0, 0.0, 319.5], [0.0, 520.0, 239.5], [0.0, 0.0, 1.0]]))
    renderer, drawing = boards.BoardRenderer(lens, 1), boards.chessboard_image()
    images = [renderer.draw(drawing, *pose)[..., 0].copy() for pose in boards.board_poses(8, 5, 0.5, 0.15)]
    found = {}
    for squares in ((8, 6), (7, 6), (8, 5), (7, 5)):
        board = next(iter(Board("chessboard", squares, inverted=False, mirrored=False).prints()))
        found[squares] = sum(len(Finder(board).find(image)[0]) > 0 for image in images)
    assert found == {(8, 6): len(images), (7, 6): 0, (8, 5): 0, (7, 5): 0}
