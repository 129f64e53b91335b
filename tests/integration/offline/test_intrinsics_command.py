"""`syncline intrinsics`: calibration from rendered boards against the ground truth, and refused sets of views."""

from __future__ import annotations

import json
import tomllib
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from deploy.cli import run
from edge.detectors.board.description import Board
from edge.detectors.board.detector import BoardDetector
from edge.lens.board import BoardView
from protocols.geometry.camera import Intrinsics
from tests.support import boards

Capture = pytest.CaptureFixture[str]

PINHOLE = Intrinsics(
    640,
    480,
    np.array([[520.0, 0.0, 325.0], [0.0, 518.0, 236.0], [0.0, 0.0, 1.0]]),
    np.array([-0.18, 0.05, 0.001, -0.0008, 0.0]),
)
FISHEYE = Intrinsics(
    640,
    480,
    np.array([[300.0, 0.0, 325.0], [0.0, 300.0, 236.0], [0.0, 0.0, 1.0]]),
    np.array([0.03, -0.01, 0.002, -0.001]),
    True,
)


@cache
def renderer(fisheye: bool) -> boards.BoardRenderer:
    return boards.BoardRenderer(FISHEYE if fisheye else PINHOLE, 3)


def render_board(
    folder: Path, kind: str, fisheye: bool, count: int = 22, tilt: float = 0.6, reach: float = 0.5, seed: int = 1
) -> Path:
    """A folder of rendered images of a board."""
    folder.mkdir()
    drawing = boards.chessboard_image() if kind == "chessboard" else boards.charuco_image()
    for i, (rotation, centre) in enumerate(boards.board_poses(count, seed, tilt, reach)):
        cv2.imwrite(str(folder / f"{i:03d}.bmp"), renderer(fisheye).draw(drawing, rotation, centre))
    return folder


def command(video: Path, out: Path, kind: str, *more: str) -> list[str]:
    return ["intrinsics", str(video), "--out", str(out), "--board", kind, "--squares", "8x6", "--json", *more]


@pytest.mark.parametrize(
    ("kind", "fisheye", "reach", "within"),
    [("charuco", False, 0.55, 0.005), ("chessboard", False, 0.35, 0.005), ("charuco", True, 0.9, 0.012)],
)
def test_intrinsics_are_estimated_from_a_board(
    tmp_path: Path, capsys: Capture, kind: str, fisheye: bool, reach: float, within: float
) -> None:
    truth = FISHEYE if fisheye else PINHOLE
    video = render_board(tmp_path / "cam7", kind, fisheye, reach=reach)
    out = tmp_path / "rig.toml"
    assert run(command(video, out, kind, *(["--fisheye"] if fisheye else []))) == 0
    report = json.loads(capsys.readouterr().out)
    table = tomllib.loads(out.read_text())["cam7"]
    assert (table["size"], table.get("fisheye", False)) == ([640, 480], fisheye)
    found = Intrinsics(640, 480, np.array(table["matrix"]), np.array(table["distortions"]), fisheye)
    assert abs(found.focal / truth.focal - 1) < within
    assert report["rms_px"] < 0.5
    assert report["coverage"] > 0.6
    # Compare ray directions instead of parameters, which are correlated.
    pixels = np.stack(np.meshgrid(np.linspace(60, 580, 9), np.linspace(40, 440, 7)), axis=-1).reshape(-1, 2)
    again = found.project_normalised(truth.unproject(pixels))
    assert np.sqrt(np.mean((again - pixels) ** 2)) < 1.0


def test_small_squares_at_the_rim_of_a_fisheye_have_no_corner_at_another_edge() -> None:
    """In windows of 5 px the iteration ends up to 3 px away."""
    board = next(iter(Board("charuco", boards.SQUARES, inverted=False, mirrored=False).prints()))
    places = np.array(list(board.points().values())) - [0.5 * boards.SQUARES[0], 0.5 * boards.SQUARES[1], 0.0]
    off = []
    for rotation, centre in boards.board_poses(10, 4, reach=0.9):
        image = renderer(True).draw(boards.charuco_image(), rotation, 0.55 * centre)
        numbers, pixels = BoardDetector(board, 1.0).find(image[..., 0].copy())
        off.append(pixels - FISHEYE.project(places[numbers] @ rotation.T + 0.55 * centre))
    assert sum(map(len, off)) > 300
    assert np.abs(np.concatenate(off)).max() < 1.0


def test_other_cameras_and_keys_of_the_rig_file_are_kept(tmp_path: Path) -> None:
    out = tmp_path / "rig.toml"
    before = (
        '[metadata]\nunits = "cm"\ndistances = [["cam0", "cam7", 42.0]]\n\n[cam0]\nname = "cam0"\nsize = [64, 48]\n'
    )
    out.write_text(before + '\n[cam7]\nname = "cam7"\nsize = [640, 480]\nposition = [1.0, 2.0, 3.0]\n')
    (tmp_path / "cam7").mkdir()
    cv2.imwrite(str(tmp_path / "cam7" / "0.png"), np.zeros((480, 640, 3), np.uint8))
    assert run(["intrinsics", str(tmp_path / "cam7"), "--field-of-view", "60", "--out", str(out)]) == 0
    tables = tomllib.loads(out.read_text())
    assert tables["metadata"]["distances"] == [["cam0", "cam7", 42.0]]
    assert tables["cam0"] == {"name": "cam0", "size": [64, 48]}
    assert tables["cam7"]["position"] == [1.0, 2.0, 3.0]
    assert tables["cam7"]["matrix"][0][0] == pytest.approx(320 / np.tan(np.deg2rad(30)))


def test_a_board_that_is_never_tilted_does_not_determine_the_focal_length(tmp_path: Path, capsys: Capture) -> None:
    video = render_board(tmp_path / "flat", "charuco", False, tilt=0.01)
    assert run(command(video, tmp_path / "rig.toml", "charuco")) == 3
    assert "tilt the board" in capsys.readouterr().err
    assert not (tmp_path / "rig.toml").exists()


def test_a_board_only_at_the_image_centre_is_refused(tmp_path: Path, capsys: Capture) -> None:
    video = render_board(tmp_path / "middle", "charuco", False, count=12, reach=0.02)
    assert run(command(video, tmp_path / "rig.toml", "charuco")) == 3
    assert "covers" in capsys.readouterr().err


def test_a_few_views_give_a_lens_with_its_std(tmp_path: Path, capsys: Capture) -> None:
    video = render_board(tmp_path / "some", "charuco", False, count=5)
    first = cv2.imread(str(video / "000.bmp"))
    assert first is not None
    cv2.imwrite(str(video / "empty.bmp"), np.full_like(first, 128))
    cv2.imwrite(str(video / "emptier.bmp"), np.full_like(first, 120))
    first[:, 330:] = 128  # about the middle of the board, which is in the middle
    cv2.imwrite(str(video / "half.bmp"), first)
    assert run(command(video, tmp_path / "rig.toml", "charuco")) == 0
    report = json.loads(capsys.readouterr().out)
    table = tomllib.loads((tmp_path / "rig.toml").read_text())["some"]
    assert 0.001 < table["focal_std"] < 0.05
    assert abs(table["matrix"][0][0] / PINHOLE.focal - 1) < 3 * table["focal_std"]
    assert report["views"] == 5
    warning, _border = report["warnings"]
    assert warning.startswith(
        "3 of 8 photographs are not used: 2 without the board, 1 with fewer than 8 of its corners"
    )


def test_an_inverted_board_is_found_without_a_setting(tmp_path: Path, capsys: Capture) -> None:
    video = render_board(tmp_path / "cam7", "charuco", False, reach=0.55)
    for file in video.glob("*.bmp"):
        cv2.imwrite(str(file), 255 - cv2.imread(str(file)))
    assert run(command(video, tmp_path / "rig.toml", "charuco")) == 0
    assert json.loads(capsys.readouterr().out)["views"] >= 15


@pytest.mark.parametrize(("k1", "what"), [(-0.18, "are known to ± "), (-0.9, "are not known, the distortion folds")])
def test_a_border_without_the_board_is_warned_of(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch, k1: float, what: str
) -> None:
    lens = Intrinsics(640, 480, PINHOLE.matrix, np.array([k1, 0.0, 0.0, 0.0, 0.0]))
    points = np.array([[x, y, 0.0] for y in range(1, 6) for x in range(1, 8)])
    rng = np.random.default_rng(7)
    views = []
    for number, (rotation, centre) in enumerate(boards.board_poses(5, 2, 0.6, 0.1)):
        pixels = lens.project((points - [4.0, 3.0, 0.0]) @ rotation.T + 1.6 * centre)
        views.append(BoardView(number, points, pixels + rng.normal(0.0, 0.1, pixels.shape)))
    monkeypatch.setattr("edge.lens.board.board_views", lambda *_: iter(views))
    (tmp_path / "cam7").mkdir()
    cv2.imwrite(str(tmp_path / "cam7" / "0.png"), np.zeros((480, 640, 3), np.uint8))
    assert run(command(tmp_path / "cam7", tmp_path / "rig.toml", "charuco")) == 0
    report = json.loads(capsys.readouterr().out)
    (warning,) = [one for one in report["warnings"] if "border" in one]
    assert what in warning
    assert warning.endswith("show the board near the corners and the sides too")
    assert (report["border_std_px"] is None) == (k1 == -0.9)


def test_few_views_or_none_are_refused(tmp_path: Path, capsys: Capture) -> None:
    video = render_board(tmp_path / "few", "charuco", False, count=2)
    assert run(command(video, tmp_path / "rig.toml", "charuco")) == 3
    assert "2 different views, 3 give an approximate lens, 8 a good one" in capsys.readouterr().err
    assert run([*command(video, tmp_path / "rig.toml", "charuco"), "--dictionary", "6X6_50"]) == 3
    report = capsys.readouterr().err
    assert "in no frame" in report
    assert "2 of 2 photographs are not used: 2 without the board" in report


def test_images_of_other_sizes_are_named(tmp_path: Path, capsys: Capture) -> None:
    """They were left out without a word; where the first one was the odd one, the board was "seen in 1 view"."""
    video = render_board(tmp_path / "mixed", "charuco", False, count=10)
    first = video / "000.bmp"
    cv2.imwrite(str(first), cv2.resize(cv2.imread(str(first)), (320, 240)))
    assert run(command(video, tmp_path / "rig.toml", "charuco")) == 3
    assert "9 frames are not of the first one's size, 320x240" in capsys.readouterr().err


def test_a_fisheye_taken_for_a_pinhole_is_refused(tmp_path: Path, capsys: Capture) -> None:
    video = render_board(tmp_path / "wide", "charuco", True, reach=1.2)
    assert run(command(video, tmp_path / "rig.toml", "charuco")) == 3
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("more", "report"),
    [
        (["--squares", "8"], "--squares"),
        (["--dictionary", "7X9"], "dictionary"),
        (["--ratio", "1.5"], "--ratio"),
        (["--field-of-view", "181"], "--field-of-view"),
    ],
)
def test_usage_errors_are_one_line(tmp_path: Path, capsys: Capture, more: list[str], report: str) -> None:
    (tmp_path / "cam7").mkdir()
    cv2.imwrite(str(tmp_path / "cam7" / "0.png"), np.zeros((48, 64, 3), np.uint8))
    assert run(["intrinsics", str(tmp_path / "cam7"), "--out", str(tmp_path / "rig.toml"), *more]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert report in line
