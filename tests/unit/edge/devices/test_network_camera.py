"""Network cameras on loopback: a real RTSP stream with delayed frames, MJPEG over HTTP, a lost connection."""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest

from edge.devices.base import Frame
from edge.devices.live.network import NetworkCamera, StreamClock, open_network
from edge.devices.live.opencv_capture import OpenCvCamera
from protocols.core.errors import InputError
from tests.support.mjpeg_camera import MjpegCamera
from tests.support.rtsp_camera import RtspCamera

pytest.importorskip("av", reason="the extra `video` is not installed: network streams are not tested")


def read_frames(camera: NetworkCamera, count: int, patience_s: float = 20.0) -> list[Frame]:
    frames: list[Frame] = []
    deadline = time.monotonic() + patience_s
    while len(frames) < count and time.monotonic() < deadline:
        frame = camera.read(0.2)
        frames += [] if frame is None else [frame]
    return frames


def test_frame_times_follow_the_cameras_clock_and_not_the_network_delay() -> None:
    """Two of five frames come 25 and 15 ms late; RTP's stamps are 40 ms apart whatever the network does."""
    server = RtspCamera(late_s=(0.0, 0.025, 0.0, 0.015, 0.0))
    camera = NetworkCamera(server.url)
    camera.open()
    frames = read_frames(camera, 45)
    camera.close()
    server.close()
    assert len(frames) == 45
    assert (camera.info.driver, camera.info.clock, camera.info.width) == ("rtsp", "monotonic", 64)
    assert "time of capture: late by the camera's own delay" in camera.info.unknown
    steps = np.diff([frame.device_time_ns for frame in frames[30:]]) / 1e6
    assert steps == pytest.approx(40.0, abs=0.1), "after the first second the intervals are those of the capture"


def test_lost_frames_are_a_gap_in_the_numbers() -> None:
    server = RtspCamera(skip=tuple(range(6, 500, 10)) + tuple(range(7, 500, 10)))
    camera = NetworkCamera(server.url, fps=25.0)
    camera.open()
    numbers = np.array([frame.frame for frame in read_frames(camera, 25)])
    camera.close()
    server.close()
    assert sorted(set(np.diff(numbers).tolist())) == [1, 3], "two of ten were never sent"


def test_an_unplugged_camera_is_reconnected() -> None:
    server = RtspCamera()
    camera = NetworkCamera(server.url, fps=25.0)
    camera.open()
    before = read_frames(camera, 5)
    server.close()
    deadline = time.monotonic() + 20.0
    while not camera.disconnected and time.monotonic() < deadline:
        camera.read(0.1)
    assert camera.disconnected
    again = RtspCamera(server.port)
    after = read_frames(camera, 3)
    camera.close()
    again.close()
    assert len(after) == 3
    assert camera.reconnections == 1
    assert after[0].frame > before[-1].frame + 1, "missed frames are a gap"
    assert after[0].device_time_ns > before[-1].device_time_ns


@pytest.fixture
def motion_jpeg() -> Iterator[str]:
    camera = MjpegCamera(period_s=0.02)
    yield camera.url
    camera.unplug()


def test_motion_jpeg_is_stamped_on_arrival_and_described_so(motion_jpeg: str) -> None:
    camera = NetworkCamera(motion_jpeg)
    camera.open()
    frames = read_frames(camera, 10)
    camera.close()
    assert [frame.frame for frame in frames] == list(range(10))
    assert "time of capture: stamped on arrival" in camera.info.unknown
    assert abs(frames[-1].device_time_ns - time.monotonic_ns()) < 10 * 10**9
    assert all(b.device_time_ns > a.device_time_ns for a, b in pairwise(frames))


def test_the_error_of_an_unreachable_camera_hides_the_password() -> None:
    with pytest.raises(InputError, match=r"camera rtsp://…@127\.0\.0\.1:9/live does not answer: .*; check") as error:
        NetworkCamera("rtsp://user:secret@127.0.0.1:9/live").open()
    assert "secret" not in str(error.value)


def test_without_pyav_opencv_reads_the_stream() -> None:
    assert isinstance(open_network("rtsp://camera/live", is_installed=lambda name: False), OpenCvCamera)


def test_a_restarted_sender_is_mapped_anew_and_times_never_decrease() -> None:
    clock = StreamClock()
    places = [
        clock.to_host_time(stamp, arrived, 0.0)[0]
        for stamp, arrived in ((10**10, 5), (10**10 + 40, 60), (0, 90), (40, 140))
    ]
    assert places == [5, 45, 90, 130]
    assert StreamClock().to_host_time(7, 100, 25.0) == (100, 1)
