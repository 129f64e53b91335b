"""The OAK driver on a real host-only depthai pipeline: images with chosen time stamps go through its queues."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from datetime import timedelta
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from edge.devices.live.oak import OakCamera, OakStream, open_stream
from edge.devices.settings import OakSettings
from protocols.core.errors import InputError

dai = pytest.importorskip("depthai", reason="the extra `oak` is not installed: the OAK driver is not tested")

SETTINGS = OakSettings(size=(64, 48), fps=50.0)
EXPOSURE_US = 4000
_KEPT: list[Any] = []


@pytest.fixture
def host_pipelines() -> Iterator[Callable[[int], Callable[[OakSettings], OakStream]]]:
    """Makes a ``connect`` whose connections each give ``count`` images and then hang; stops them at the end."""
    opened: list[OakStream] = []

    def giving(count: int) -> Callable[[OakSettings], OakStream]:
        def connect(settings: OakSettings) -> OakStream:
            opened.append(host_only(settings, count, base_s=100.0 * (len(opened) + 1)))
            return opened[-1]

        return connect

    yield giving
    for stream in opened:
        stream.pipeline.stop()


def host_only(settings: OakSettings, count: int, base_s: float) -> OakStream:
    """``count`` pictures, numbered from 0, whose exposure ends at base_s + k / fps."""

    class Sensor(dai.node.ThreadedHostNode):
        def __init__(self) -> None:
            super().__init__()
            self.out = self.createOutput()
            self.pictures: list[Any] = []
            self.done = threading.Event()

        def run(self) -> None:
            for picture in self.pictures:
                self.out.send(picture)
            self.done.set()

    pipeline = dai.Pipeline(False)
    sensor = pipeline.create(Sensor)
    for number in range(count):
        picture = dai.ImgFrame()
        width, height = settings.size
        pixels = np.full((height, width, 3), (number, 20, 200), np.uint8)
        picture.setCvFrame(pixels, dai.ImgFrame.Type.BGR888i)
        picture.setSequenceNum(number)
        picture.setTimestamp(timedelta(seconds=base_s + number / settings.fps))
        sensor.pictures.append(picture)
    queue = sensor.out.createOutputQueue(maxSize=max(count, 1), blocking=False)
    pipeline.start()
    # depthai joins a Python node's thread with the interpreter held: it must have ended before the pipeline goes.
    assert sensor.done.wait(20.0)
    _KEPT.append((pipeline, sensor, queue))
    return OakStream(pipeline, queue)


def test_frames_have_the_time_stamps_numbers_and_pixels_that_were_sent(host_pipelines: Any) -> None:
    camera = OakCamera(SETTINGS, connect=host_pipelines(5))
    camera.open()
    assert (camera.info.width, camera.info.height, camera.info.driver) == (64, 48, "oak")
    frames = [camera.read(1.0) for _ in range(5)]
    assert all(frame is not None for frame in frames)
    got = [frame for frame in frames if frame is not None]
    assert [frame.frame for frame in got] == [0, 1, 2, 3, 4]
    assert [tuple(frame.image[10, 10]) for frame in got] == [(k, 20, 200) for k in range(5)]
    steps = np.diff([frame.device_time_ns for frame in got])
    assert np.allclose(steps, 20_000_000, atol=2000)
    assert abs(got[0].device_time_ns - 100_000_000_000) < 1_000_000_000
    camera.close()
    assert camera.ended


def test_the_chip_temperature_is_reported_where_a_board_provides_it(host_pipelines: Any) -> None:
    camera = OakCamera(SETTINGS, connect=host_pipelines(3))
    assert camera.temperature is None, "not open"
    camera.open()
    assert camera.temperature is None, "depthai's host-only pipeline has no board"
    camera.close()

    class Board:
        def __init__(self, degrees: float | None) -> None:
            self.degrees = degrees

        def getChipTemperature(self) -> Any:
            if self.degrees is None:
                raise RuntimeError("X_LINK_ERROR")
            heat = dai.ChipTemperature()
            heat.average = self.degrees
            return heat

    for degrees in (57.5, None):
        stream = host_pipelines(3)(SETTINGS)
        patched = OakStream(
            SimpleNamespace(getDefaultDevice=partial(Board, degrees), stop=stream.pipeline.stop), stream.queue
        )
        camera = OakCamera(SETTINGS, connect=lambda _, patched=patched: patched)
        camera.open()
        assert camera.temperature == degrees, "a board that is being unplugged gives no temperature and no error"
        camera.close()


def test_frames_are_stamped_at_mid_exposure() -> None:
    """depthai stamps the end of the exposure by default; the driver requests the middle and reports the exposure."""
    asked: list[Any] = []

    class Picture:
        def getSequenceNum(self) -> int:
            return 7

        def getTimestamp(self, offset: Any) -> timedelta:
            asked.append(offset)
            return timedelta(seconds=5) - timedelta(microseconds=EXPOSURE_US // 2)

        def getExposureTime(self) -> timedelta:
            return timedelta(microseconds=EXPOSURE_US)

        def getCvFrame(self) -> Any:
            return np.zeros((48, 64), np.uint8)

    class Queue:
        def get(self, timeout: timedelta) -> Picture:
            return Picture()

    class Pipeline:
        def stop(self) -> None: ...

    camera = OakCamera(SETTINGS, connect=lambda settings: OakStream(Pipeline(), Queue()))
    camera.open()
    frame = camera.read(0.1)
    assert frame is not None
    assert asked[0] == dai.CameraExposureOffset.MIDDLE
    assert frame.device_time_ns == 5_000_000_000 - 2_000_000
    assert frame.exposure_ns == 4_000_000
    assert frame.image.shape == (48, 64, 3), "a grey image has three channels too"


def test_an_unplugged_board_is_reconnected_and_numbers_continue(host_pipelines: Any) -> None:
    camera = OakCamera(SETTINGS, connect=host_pipelines(3))
    camera.open()
    before = [camera.read(1.0) for _ in range(3)]
    _KEPT[-1][0].stop()  # the connection is lost: the queue is closed
    after = []
    deadline = time.monotonic() + 20.0
    while len(after) < 3 and time.monotonic() < deadline:
        frame = camera.read(0.1)
        if frame is not None:
            after.append(frame)
    numbers = [frame.frame for frame in [*before, *after] if frame is not None]
    assert len(after) == 3
    assert camera.reconnections == 1
    assert numbers == sorted(set(numbers)), "a number was repeated or decreased"
    assert not camera.ended
    camera.close()


def test_a_missing_board_is_reported_in_one_line() -> None:
    def nobody(settings: OakSettings) -> OakStream:
        raise RuntimeError("no OAK board is found")

    with pytest.raises(InputError, match=r"no OAK board is found.*check cable and power"):
        OakCamera(SETTINGS, connect=nobody).open()


def test_a_board_without_frames_is_refused(host_pipelines: Any) -> None:
    clock = iter(range(0, 10**11, 6 * 10**9))
    camera = OakCamera(SETTINGS, connect=host_pipelines(0), now_ns=lambda: next(clock))
    with pytest.raises(InputError, match="gives no frame"):
        camera.open()


def test_the_search_for_a_missing_board_ends_within_seconds() -> None:
    """depthai itself would search for 11 s."""
    if dai.Device.getAllAvailableDevices():
        pytest.skip("an OAK board is plugged in here")
    with pytest.raises(RuntimeError, match="no OAK board"):
        open_stream(OakSettings())
