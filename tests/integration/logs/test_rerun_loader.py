"""A log in rerun's own MCAP loader, without its window: cameras, pictures and points, and all in the right place.

rerun-sdk (700 MB) is no dependency: the test asks the `rerun` on the PATH, or the one that RERUN_COMMAND names.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from deploy.logs.rerun_export import write_rrd
from edge.agents.thumbnails import thumbnail_message
from edge.devices.base import Frame
from hub.view.player import LogRecording
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.log.write.writer import LogWriter
from protocols.topics import CALIBRATION, CAMERA_INFO, OBSERVATION, PICTURE, TRACK
from tests.support.samples import calibration, camera_info, observation, track

TIME_NS = 1_700_000_000_000_000_000
COUNT = 40
LENS = Intrinsics(1280, 720, np.array([[900.0, 0.0, 650.0], [0.0, 905.0, 350.0], [0.0, 0.0, 1.0]]), np.zeros(5))
POSE = Pose(so3.exp(np.array([0.1, -0.6, 0.2])), np.array([1.5, -0.4, -0.8]))


def rerun() -> str:
    """Where the rerun command is; "" where there is none."""
    beside = Path(sys.executable).with_name("rerun")
    return os.environ.get("RERUN_COMMAND") or shutil.which("rerun") or (str(beside) if beside.exists() else "")


pytestmark = pytest.mark.skipif(
    not rerun(),
    reason="NO RERUN: install rerun-sdk anywhere and put `rerun` on the PATH (or RERUN_COMMAND=/path/to/rerun)",
)


def path_of(index: int) -> np.ndarray:
    """Where the point is [m]: in front of the camera, on the move."""
    ahead = np.array([0.4 * np.cos(0.2 * index), 0.2 * np.sin(0.3 * index), 3.0])
    return np.asarray(POSE.world_from_camera(ahead[None])[0])


def filmed(pixel: np.ndarray) -> np.ndarray:
    """The camera's image: a white disc about a place on grey."""
    image = np.full((LENS.height, LENS.width, 3), 60, np.uint8)
    cv2.circle(image, tuple(int(v) for v in np.round(pixel)), 20, (255, 255, 255), -1, cv2.LINE_AA)
    return image


def write(path: Path) -> Path:
    info = camera_info("cam0")
    info.width, info.height, info.matrix[:] = LENS.width, LENS.height, LENS.matrix.ravel().tolist()
    del info.distortions[:]
    answer = calibration()
    answer.cameras[0].rotation[:] = POSE.rodrigues.tolist()
    answer.cameras[0].translation[:] = POSE.translation.tolist()
    with LogWriter(path, views=True) as log:
        for index in range(COUNT):
            now = TIME_NS + index * 50_000_000
            place = path_of(index)
            pixel = LENS.project(POSE.camera_from_world(place[None]))[0]
            picture = thumbnail_message(Frame(filmed(pixel), now, index), "cam0", "boot-1")
            found = track(index)
            found.position[:] = place.tolist()
            seen = observation("cam0", index)
            seen.detections[0].u, seen.detections[0].v = pixel
            log.write(PICTURE, "cam0", "yard", picture, now)
            log.write(CAMERA_INFO, "cam0", "yard", info, now)
            log.write(OBSERVATION, "cam0", "yard", seen, now)
            log.write(CALIBRATION, "hub", "yard", answer, now)
            log.write(TRACK, "hub", "yard", found, now)
            if index % 8 == 7:
                log.sync()  # as a recorder: many small chunks
    return path


def printed(rrd: Path, entity: str) -> list[dict[str, str]]:
    """The rows of one entity as rerun prints them: component to text, in order of time."""
    words = [rerun(), "rrd", "print", "-vvv", str(rrd), "--entity", entity]
    text = subprocess.run(words, capture_output=True, text=True, check=True, timeout=120).stdout
    rows: list[dict[str, str]] = []
    heads: list[str] = []
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("│ ").split("┆")]
        if "RowId" in cells[0]:
            heads = cells
        elif cells[0].startswith("row_") and "McapChannel:id" not in heads:
            rows.append(dict(zip(heads, cells, strict=True)))
    return sorted(rows, key=lambda row: row.get("message_log_time", ""))


def numbers(text: str) -> np.ndarray:
    """The numbers in a printed cell."""
    return np.array([float(one) for one in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", text)])


def test_the_picture_lies_in_the_cameras_frustum_and_the_point_where_the_picture_shows_it(tmp_path: Path) -> None:
    log, rrd = write(tmp_path / "a.mcap"), tmp_path / "a.rrd"
    subprocess.run([rerun(), "mcap", "convert", str(log), "-o", str(rrd)], check=True, capture_output=True, timeout=120)
    places = printed(rrd, "/foxglove/yard/transforms")
    lenses = printed(rrd, "/foxglove/yard/cam0/calibration")
    pictures = printed(rrd, "/foxglove/yard/cam0/image")
    points = printed(rrd, "/foxglove/yard/points")
    assert [len(rows) for rows in (places, lenses, pictures, points)] == [COUNT] * 4, "rerun has every message"

    place, lens = places[-1], lenses[-1]
    assert (place["Transform3D:parent_frame"], place["Transform3D:child_frame"]) == ("[world]", "[cam0]")
    assert lens["Pinhole:parent_frame"] == "[cam0]"
    assert {row["CoordinateFrame:frame"] for row in pictures} == {lens["Pinhole:child_frame"]}
    assert {row["CoordinateFrame:frame"] for row in points} == {"[world]"}
    assert numbers(lens["Pinhole:resolution"]) == pytest.approx([320, 180])

    x, y, z, w = numbers(place["Transform3D:quaternion"])
    v = np.array([x, y, z])
    world_from_camera = (w**2 - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * so3.hat(v)
    matrix = numbers(lens["Pinhole:image_from_camera"]).reshape(3, 3).T  # rerun's columns come first
    for index, row in enumerate(points):
        shown = numbers(row["Points3D:positions"])
        np.testing.assert_allclose(shown, path_of(index), atol=1e-5)
        ray = matrix @ world_from_camera.T @ (shown - numbers(place["Transform3D:translation"]))
        pixel = LENS.project(POSE.camera_from_world(path_of(index)[None]))[0]
        jpeg = thumbnail_message(Frame(filmed(pixel), 0, 0), "cam0", "boot-1").jpeg
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        bright = np.argwhere(image > 150).mean(axis=0)[::-1]
        np.testing.assert_allclose(ray[:2] / ray[2], bright, atol=0.7)  # of 320 px; a wrong scale is off by 100


def test_our_own_export_puts_the_same_at_the_same_place(tmp_path: Path) -> None:
    """`view --rerun`: the path projected by the exported camera falls on the exported detections."""
    pytest.importorskip("rerun", reason="NO RERUN PACKAGE: pip install rerun-sdk into this environment")
    rrd = tmp_path / "b.rrd"
    assert write_rrd(LogRecording(write(tmp_path / "a.mcap")), rrd) > 4 * COUNT
    merged: dict[str, str] = {}
    for row in printed(rrd, "/world/cameras/cam0"):
        merged.update({key: value for key, value in row.items() if value != "null"})
    matrix = numbers(merged["Pinhole:image_from_camera"]).reshape(3, 3).T
    # rerun prints the beginning of a long cell only: two columns identify the third.
    first, second = numbers(merged["Transform3D:mat3x3"])[:6].reshape(2, 3)
    turn = np.column_stack([first, second, np.cross(first, second)])  # world from camera
    points = [numbers(row["Points3D:positions"]) for row in printed(rrd, "/world/paths/marker")]
    seen = [numbers(row["Points2D:positions"]) for row in printed(rrd, "/world/cameras/cam0/detections")]
    assert len(printed(rrd, "/world/cameras/cam0/picture")) == len(points) == len(seen) == COUNT
    for point, pixel in zip(points, seen, strict=True):
        ray = matrix @ turn.T @ (point - numbers(merged["Transform3D:translation"]))
        np.testing.assert_allclose(ray[:2] / ray[2], pixel, atol=0.01)
