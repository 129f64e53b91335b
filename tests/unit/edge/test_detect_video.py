"""``edge.detect_video`` on short rendered videos: rows, files and tables agree with `syncline detect`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import edge
from deploy.cli import run
from edge.detectors.marker.ball import MarkerModel
from edge.offline.detections import HEADER
from edge.offline.video import VideoDetections, detect_video, marker_toml
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from tests.support.rendered_markers import add_spot, add_tag, dim_room, exposed, tag_image
from tests.support.videos import Image, write_video

FRAMES = 12


def frame(index: int) -> Image:
    """A ball of the demo's colour, a point of light and a tag on a dim background (240, 320, 3); the ball moves."""
    rng = np.random.default_rng(index)
    picture = dim_room(3, 320, 240, 50.0)
    add_spot(picture, 60.0, 60.0, 1.5, 900.0)
    tag = tag_image(cv2.aruco.DICT_APRILTAG_36h11, 7, 400)
    add_tag(picture, tag, np.array([240.0, 170.0]), 60.0, np.zeros(3), np.zeros(2))
    image = exposed(picture, 2.0, rng)
    cv2.circle(image, (100 + 10 * index, 90), 10, (22, 112, 246), -1, cv2.LINE_AA)
    return image


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("videos") / "left.mp4"
    write_video(file, [frame(index) for index in range(FRAMES)], np.arange(FRAMES) / 10)
    return file


@pytest.fixture(scope="module")
def found(video: Path) -> VideoDetections:
    return detect_video(video)


def test_the_ball_is_detected_in_every_frame_at_its_place_and_time(found: VideoDetections) -> None:
    table = [row.split(",") for row in found.rows]
    assert (found.frames, found.frames_with_detection, found.size) == (FRAMES, FRAMES, (320, 240))
    assert found.warnings == ()
    assert {(row[0], row[6]) for row in table} == {("left", "marker")}
    assert [float(row[2]) for row in table] == pytest.approx(np.arange(FRAMES) / 10, abs=1e-4)
    assert [float(row[3]) for row in table] == pytest.approx(100.0 + 10.0 * np.arange(FRAMES), abs=0.5)


@pytest.mark.parametrize(
    ("detector", "options"), [("marker", []), ("bright", ["--mode", "bright"]), ("tag", ["--mode", "tag"])]
)
def test_the_saved_file_is_that_of_the_command(video: Path, tmp_path: Path, detector: str, options: list[str]) -> None:
    command, saved = tmp_path / "command.csv", tmp_path / "saved.csv"
    assert run(["detect", "marker", str(video), "--camera", "a", "--out", str(command), *options]) == 0
    detect_video(str(video), detector, camera="a").save(saved)  # type: ignore[arg-type]
    assert saved.read_bytes() == command.read_bytes()
    assert len(saved.read_text().splitlines()) > FRAMES // 2


def test_people_have_the_columns_of_the_command_also_where_there_are_none(video: Path) -> None:
    nobody = detect_video(video, "person")
    assert nobody.to_csv() == (
        "camera,frame,time,u,v,size,label,score,kind,cov_uu,cov_uv,cov_vv,"
        "head_u,head_v,foot_u,foot_v,box_x,box_y,box_w,box_h\n"
    )


def test_a_dataframe_has_the_columns_and_numbers_of_the_csv(found: VideoDetections) -> None:
    pandas = pytest.importorskip("pandas")
    table = found.to_dataframe()
    assert list(table.columns) == HEADER.split(",")
    assert table["frame"].tolist() == list(range(FRAMES))
    assert table["u"].tolist() == [float(row.split(",")[3]) for row in found.rows]
    unmeasured = VideoDetections(
        ("NA,3,0.1,1,2,,nan,1" + ",," * 6,), 1, 1, 0, 0, (4, 3), 30.0, (0.0, 0.0)
    ).to_dataframe()
    assert unmeasured["camera"].tolist() == ["NA"]
    assert unmeasured["label"].tolist() == ["nan"]
    assert pandas.isna(unmeasured["size"][0])


def test_without_pandas_the_error_names_the_remedy(found: VideoDetections, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match="pip install pandas"):
        found.to_dataframe()


def test_a_marker_is_given_as_a_model_or_a_file(video: Path, tmp_path: Path) -> None:
    file = tmp_path / "marker.toml"
    with pytest.raises(InputError, match=r"marker\.toml"):
        detect_video(video, marker=file)
    file.write_text(marker_toml(MarkerModel.of_colour(246, 112, 22, label="orange")))
    for marker in (file, MarkerModel.of_colour(246, 112, 22, label="orange")):
        found = detect_video(video, marker=marker)
        assert found.frames_with_detection == FRAMES
        assert {row.split(",")[6] for row in found.rows} == {"orange"}


def test_options_that_do_not_fit_are_refused(video: Path) -> None:
    lens = Intrinsics(640, 480, np.diag([500.0, 500.0, 1.0]), np.zeros(5))
    with pytest.raises(InputError, match="320x240"):
        detect_video(video, intrinsics=lens)
    with pytest.raises(InputError, match="no effect on the detector tag"):
        detect_video(video, "tag", intrinsics=lens)
    with pytest.raises(InputError, match="there is no detector 'ball'; use one of marker, bright"):
        detect_video(video, "ball")  # type: ignore[arg-type]


def test_progress_and_overlay_are_those_of_the_video(video: Path, tmp_path: Path) -> None:
    steps: list[tuple[str, float]] = []
    out = tmp_path / "seen.mp4"
    with_overlay = detect_video(video, overlay=out, progress=lambda text, fraction: steps.append((text, fraction)))
    assert with_overlay.rows == detect_video(video).rows
    assert out.stat().st_size > 1000
    assert steps[0][0] == f"frame 10 of {FRAMES}"
    assert 0.0 < steps[0][1] <= 1.0


def test_the_package_offers_its_names_lazily() -> None:
    assert edge.detect_video is detect_video
    assert set(edge.__all__) <= set(dir(edge))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = edge.nothing
    code = "import edge, sys; print([name for name in ('numpy', 'cv2', 'typing') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-S", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
