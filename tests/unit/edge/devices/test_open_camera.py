"""``open_camera``: each kind of source opens the right device, and bad sources are refused with a remedy."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.agents.thumbnails import thumbnail_message
from edge.devices import camera as module
from edge.devices.base import Frame
from edge.devices.camera import open_camera
from edge.devices.live import usb
from edge.devices.live.network import NetworkCamera
from edge.devices.live.oak import OakCamera
from edge.devices.live.opencv_capture import OpenCvCamera
from edge.devices.live.picamera import PiCamera
from edge.devices.live.usb import UsbCamera
from edge.devices.simulated.camera import SimulatedDevice
from protocols.core.errors import InputError
from protocols.log.write.writer import LogWriter
from protocols.topics import PICTURE


@pytest.fixture
def video(tmp_path: Path) -> Path:
    file = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    for level in range(0, 100, 10):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    return file


def test_a_video_file_is_iterated_to_its_end_and_closed(video: Path) -> None:
    with open_camera(video) as camera:
        assert (camera.info.width, camera.info.height, camera.info.fps) == (64, 48, 25.0)
        frames = list(camera)
        assert camera.ended
    assert [frame.frame for frame in frames] == list(range(10))
    assert [frame.device_time_ns for frame in frames] == [40_000_000 * k for k in range(10)]
    assert camera.read(0.1) is None
    camera.close()


def test_fps_replaces_the_time_stamps_of_a_video(video: Path) -> None:
    with open_camera(str(video), fps=50.0) as camera:
        assert [frame.device_time_ns for frame in islice(camera, 3)] == [0, 20_000_000, 40_000_000]


def test_an_image_folder_is_played_in_the_order_of_names(tmp_path: Path) -> None:
    for name, level in (("a10.png", 20), ("a9.png", 10)):
        cv2.imwrite(str(tmp_path / name), np.full((48, 64, 3), level, np.uint8))
    with open_camera(tmp_path, fps=10.0) as camera:
        assert [(int(frame.image.mean()), frame.device_time_ns) for frame in camera] == [(10, 0), (20, 100_000_000)]


def test_one_camera_of_a_log_is_played_with_its_recorded_times(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    with LogWriter(log) as writer:
        for number in range(3):
            frame = Frame(np.full((48, 64, 3), 80, np.uint8), 7 + 10**9 * number, number)
            for name in ("cam0", "cam1"):
                writer.write(PICTURE, name, "local", thumbnail_message(frame, name, "b"), 10**18 + number)
    for source in (f"{log}#cam1", Path(f"{log}#cam1")):
        with open_camera(source) as camera:
            assert camera.info.driver == "log"
            assert [frame.device_time_ns for frame in camera] == [7, 10**9 + 7, 2 * 10**9 + 7]
    with pytest.raises(InputError, match="no images of cam5 in this log, only of cam0, cam1"):
        open_camera(f"{log}#cam5")
    with pytest.raises(InputError, match=r'several cameras; give "a\.mcap#CAMERA"'):
        open_camera(log)
    with pytest.raises(InputError, match="leave fps out"):
        open_camera(f"{log}#cam1", fps=5.0)


@pytest.mark.parametrize(
    ("source", "name"), [("simulated", "cam0"), ("simulated:marker", "cam0"), ("simulated:marker-outdoor/cam2", "cam2")]
)
def test_a_simulated_camera_delivers_rendered_frames(source: str, name: str) -> None:
    with open_camera(source, size=(160, 120)) as camera:
        assert isinstance(camera.device, SimulatedDevice)
        assert camera.device._camera.name == name
        assert camera.info.intrinsics is not None
        (frame,) = islice(camera, 1)
        assert frame.image.shape == (camera.info.height, 160, 3)


@pytest.mark.parametrize(
    ("source", "device"),
    [
        ("rtsp://user:secret@camera/live", (NetworkCamera, OpenCvCamera)),
        ("http://camera/video.mjpg", (NetworkCamera, OpenCvCamera)),
        ("oak", OakCamera),
        ("oak:192.168.1.20", OakCamera),
        ("picamera2", PiCamera),
    ],
)
def test_live_sources_select_their_driver(source: str, device: type) -> None:
    assert isinstance(module._device(source, 15.0, None, None), device)


@pytest.mark.parametrize("source", [0, "0", "/dev/video0"])
@pytest.mark.parametrize("linuxpy", [True, False])
def test_a_usb_camera_is_read_through_linuxpy_where_it_is_installed(
    source: int | str, linuxpy: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for user in (module, usb):
        monkeypatch.setattr(user, "find_spec", lambda name: linuxpy or None)
    device = module._device(source, None, (640, 480), None)
    assert isinstance(device, UsbCamera if linuxpy else OpenCvCamera)


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("webcam", "'webcam' is not a camera, and no such file exists; give 0 or"),
        ("gone.mp4", "'gone.mp4' is not a camera, and no such file exists"),
        ("gone.mcap#cam0", "gone.mcap: this log does not exist"),
        ("", "is not a camera; give 0 or"),
        (None, "None is not a camera"),
        (True, "True is not a camera"),
        (-1, "there is no camera -1; count USB cameras from 0"),
        ("/dev/video97", "camera /dev/video97 does not answer"),
        ("gopher://camera", "gopher:// is not a network camera"),
        ("simulated:moon", "there is no scene 'moon'"),
        ("simulated:marker/cam9", "has no camera 'cam9'"),
    ],
)
def test_a_bad_source_is_refused_in_one_line_with_a_remedy(source: object, reason: str) -> None:
    with pytest.raises(InputError) as error:
        open_camera(source)  # type: ignore[arg-type]
    assert reason in str(error.value)
    assert error.value.remedy
    assert "\n" not in str(error.value)


def test_options_that_a_source_does_not_support_are_refused(video: Path) -> None:
    for options, remedy in (
        ({"size": (32, 24)}, "leave size out"),
        ({"fps": -1.0}, "above 0"),
        ({"size": (0, 1)}, "give"),
    ):
        with pytest.raises(InputError, match=remedy):
            open_camera(video, **options)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="leave intrinsics out"), open_camera("simulated") as camera:
        open_camera("simulated", intrinsics=camera.info.intrinsics)
