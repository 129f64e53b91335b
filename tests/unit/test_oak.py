"""The OAK driver on depthai's own path, host-only: pictures with chosen stamps go through a real pipeline and queue."""

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

from edge.devices.live.oak import OakCamera, OakSettings, Stream, open_stream
from protocols.core.errors import InputError

dai = pytest.importorskip("depthai", reason="the extra `oak` is not installed: the OAK driver is not tested")

SETTINGS = OakSettings(size=(64, 48), fps=50.0)
EXPOSURE_US = 4000
_KEPT: list[Any] = []


@pytest.fixture
def boards() -> Iterator[Callable[[int], Callable[[OakSettings], Stream]]]:
    """Makes a ``connect`` whose every connection gives so many pictures and then hangs; ends them all."""
    opened: list[Stream] = []

    def giving(count: int) -> Callable[[OakSettings], Stream]:
        def connect(settings: OakSettings) -> Stream:
            opened.append(host_only(settings, count, base_s=100.0 * (len(opened) + 1)))
            return opened[-1]

        return connect

    yield giving
    for stream in opened:
        stream.pipeline.stop()


def host_only(settings: OakSettings, count: int, base_s: float) -> Stream:
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
    return Stream(pipeline, queue)


def test_pictures_come_with_their_stamps_numbers_and_pixels(boards: Any) -> None:
    camera = OakCamera(SETTINGS, connect=boards(5))
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


def test_the_boards_heat_is_told_where_there_is_a_board_that_tells_it(boards: Any) -> None:
    camera = OakCamera(SETTINGS, connect=boards(3))
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
        stream = boards(3)(SETTINGS)
        told = Stream(
            SimpleNamespace(getDefaultDevice=partial(Board, degrees), stop=stream.pipeline.stop), stream.queue
        )
        camera = OakCamera(SETTINGS, connect=lambda _, told=told: told)
        camera.open()
        assert camera.temperature == degrees, "a board that is just going away tells nothing, and ends nobody"
        camera.close()


def test_the_stamp_is_of_mid_exposure() -> None:
    """A depthai stamp is of the exposure's end; the driver asks for its middle, and it tells the exposure."""
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

    camera = OakCamera(SETTINGS, connect=lambda settings: Stream(Pipeline(), Queue()))
    camera.open()
    frame = camera.read(0.1)
    assert frame is not None
    assert asked[0] == dai.CameraExposureOffset.MIDDLE
    assert frame.device_time_ns == 5_000_000_000 - 2_000_000
    assert frame.exposure_ns == 4_000_000
    assert frame.image.shape == (48, 64, 3), "a grey picture has three channels too"


def test_an_unplugged_board_is_waited_for_and_numbers_go_on(boards: Any) -> None:
    camera = OakCamera(SETTINGS, connect=boards(3))
    camera.open()
    before = [camera.read(1.0) for _ in range(3)]
    _KEPT[-1][0].stop()  # the link is gone: the queue is closed
    after = []
    deadline = time.monotonic() + 20.0
    while len(after) < 3 and time.monotonic() < deadline:
        frame = camera.read(0.1)
        if frame is not None:
            after.append(frame)
    numbers = [frame.frame for frame in [*before, *after] if frame is not None]
    assert len(after) == 3
    assert camera.reconnections == 1
    assert numbers == sorted(set(numbers)), "a number came twice, or ran back"
    assert not camera.ended
    camera.close()


def test_a_board_that_is_not_there_is_told_in_one_line() -> None:
    def nobody(settings: OakSettings) -> Stream:
        raise RuntimeError("no OAK board is found")

    with pytest.raises(InputError, match=r"no OAK board is found.*check cable and power"):
        OakCamera(SETTINGS, connect=nobody).open()


def test_a_board_without_pictures_is_told(boards: Any) -> None:
    clock = iter(range(0, 10**11, 6 * 10**9))
    camera = OakCamera(SETTINGS, connect=boards(0), now_ns=lambda: next(clock))
    with pytest.raises(InputError, match="gives no picture"):
        camera.open()


def test_no_board_is_found_within_seconds() -> None:
    """depthai itself would look for eleven."""
    if dai.Device.getAllAvailableDevices():
        pytest.skip("an OAK board is plugged in here")
    with pytest.raises(RuntimeError, match="no OAK board"):
        open_stream(OakSettings())
