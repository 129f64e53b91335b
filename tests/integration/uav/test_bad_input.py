"""`syncline track` on damaged recordings: truncated files, corrupted frames, faulty telemetry."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from deploy.cli import run

SIZE = (320, 240)
FRAMES = 40
FPS = 25.0
TARGET = "92,118,36,16"


def car_centre_x(i: int) -> float:
    """Image x of the car's centre in frame i."""
    return 92.0 + 3.0 * i + 17.5


def rendered_frames() -> list[npt.NDArray[np.uint8]]:
    """A red car that moves 3 px a frame to the right, on a road between static meadows."""
    rng = np.random.default_rng(3)
    ground = cv2.GaussianBlur(rng.uniform(0, 250, (240, 320, 3)).astype(np.float32), (0, 0), 2.0) * 2.0 - 125.0
    ground[100:150] = ground[100:150] * 0.2 + 80.0
    out = []
    for i in range(FRAMES):
        image = np.clip(ground, 0, 240).astype(np.uint8)
        x = 92 + 3 * i
        image[118:134, x : x + 36] = (40, 40, 210)
        image[120:132, x + 22 : x + 27] = (40, 30, 30)
        out.append(image + rng.integers(0, 5, (240, 320, 3), np.uint8))
    return out


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """film.avi, whose frames are coded independently, and rig.toml."""
    folder = tmp_path_factory.mktemp("flight")
    writer = cv2.VideoWriter(str(folder / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), FPS, SIZE)
    for image in rendered_frames():
        writer.write(image)
    writer.release()
    (folder / "rig.toml").write_text(
        "[drone]\nname = 'drone'\nsize = [320, 240]\nfps = 25.0\n"
        "matrix = [[300, 0, 159.5], [0, 300, 119.5], [0, 0, 1]]\n"
        "body_from_camera = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]\n"
    )
    return folder


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "track.csv").open() as stream:
        return list(csv.DictReader(stream))


def test_a_truncated_video_is_tracked_to_its_end_and_reported_short(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (folder / "film.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(whole[: len(whole) // 2])
    assert run(["track", str(tmp_path / "cut.avi"), "--target", TARGET, "--out", str(tmp_path / "out")]) == 0
    output = capsys.readouterr()
    found = rows(tmp_path / "out")
    assert FRAMES // 4 < len(found) < FRAMES
    assert (
        f"it ends at {(len(found) - 1) / FPS:.1f} s, its container says {FRAMES / FPS:.1f} s" in output.out + output.err
    )
    assert float(found[-1]["x"]) == pytest.approx(car_centre_x(len(found) - 1), abs=4.0)


def test_corrupted_frames_are_not_reported_visible_and_the_car_is_reacquired(folder: Path, tmp_path: Path) -> None:
    """Frames of noise, as from a radio link: decodable, but without content."""
    rng = np.random.default_rng(5)
    writer = cv2.VideoWriter(str(tmp_path / "torn.avi"), cv2.VideoWriter.fourcc(*"MJPG"), FPS, SIZE)
    corrupted = range(15, 19)
    for i, image in enumerate(rendered_frames()):
        writer.write(rng.integers(0, 255, image.shape, np.uint8) if i in corrupted else image)
    writer.release()
    assert run(["track", str(tmp_path / "torn.avi"), "--target", TARGET, "--out", str(tmp_path / "out")]) == 0
    found = rows(tmp_path / "out")
    assert len(found) == FRAMES
    assert {found[i]["state"] for i in corrupted} == {"coasting"}
    assert found[-1]["state"] == "visible"
    assert float(found[-1]["x"]) == pytest.approx(car_centre_x(FRAMES - 1), abs=4.0)
    del folder


def test_a_folder_with_an_unreadable_image_is_rejected_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in").mkdir()
    for i, image in enumerate(rendered_frames()[:12]):
        cv2.imwrite(str(tmp_path / "in" / f"{i:03d}.png"), image)
    (tmp_path / "in" / "007.png").write_bytes(b"junk" * 100)
    assert run(["track", str(tmp_path / "in"), "--target", TARGET, "--out", str(tmp_path / "out")]) == 2
    assert "007.png" in capsys.readouterr().err


def telemetry_rows(fault: str) -> list[str]:
    """Telemetry of a hovering aircraft: one second of gap, NaN in every third row, a clock 3 s ahead, or no fault."""
    out = []
    for k in range(60):
        time, numbers = k / 10 - 1.0, "1,0,0,0,0,0,-30"
        if fault == "gap" and 0.3 < time < 1.3:
            continue
        if fault == "nan" and k % 3 == 0:
            numbers = "nan,nan,nan,nan,nan,nan,nan"
        out.append(f"{time + (3.0 if fault == 'ahead' else 0.0)},{numbers}")
    return out


@pytest.mark.parametrize("fault", ["gap", "nan", "ahead"])
def test_faulty_telemetry_does_not_lose_the_target(folder: Path, tmp_path: Path, fault: str) -> None:
    text = "time,qw,qx,qy,qz,north,east,down\n" + "\n".join(telemetry_rows(fault)) + "\n"
    (tmp_path / "telemetry.csv").write_text(text)
    extra = ["--rig", str(folder / "rig.toml"), "--telemetry", str(tmp_path / "telemetry.csv")]
    out = ["--target", TARGET, "--out", str(tmp_path / "out")]
    assert run(["track", str(folder / "film.avi"), *out, *extra]) == 0
    found = rows(tmp_path / "out")
    assert len(found) == FRAMES
    assert float(found[-1]["x"]) == pytest.approx(car_centre_x(FRAMES - 1), abs=4.0)
