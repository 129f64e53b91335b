"""USB and Pi cameras without hardware: real linuxpy frames and a fake picamera2, with known time stamps."""

from __future__ import annotations

import errno
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest

from edge.devices.base import Frame
from edge.devices.live.opencv_capture import OpenCvCamera
from edge.devices.live.picamera import PiCamera
from edge.devices.live.usb import UsbCamera, V4l2Stream, open_usb
from edge.devices.settings import PiSettings, UsbSettings
from protocols.core.errors import InputError

raw = pytest.importorskip("linuxpy.video.raw", reason="the extra `v4l2` is not installed: V4L2 is not tested")
video = pytest.importorskip("linuxpy.video.device")

PERIOD = 40_000_000
MONOTONIC, START, BAD = 0x2000, 0x10000, 0x40


def kernel_frame(number: int, stamp_ns: int, flags: int = MONOTONIC | START, pixels: str = "YUYV") -> Any:
    """linuxpy's frame of a dequeued buffer: its own types around the kernel's struct."""
    buff = raw.v4l2_buffer()
    buff.sequence, buff.flags = number, flags
    buff.timestamp.secs, buff.timestamp.usecs = divmod(stamp_ns // 1000, 10**6)
    grey = np.full((8, 16), number % 200, np.uint8)
    if pixels == "MJPEG":
        data = cv2.imencode(".jpg", grey)[1].tobytes()
    else:
        data = np.stack([grey, np.full_like(grey, 128)], axis=-1).tobytes() if pixels == "YUYV" else grey.tobytes()
    buff.bytesused = len(data)
    kind = video.PixelFormat[pixels]
    layout = video.Format(16, 8, kind, len(data), 32)
    return video.Frame(data, buff, layout)


class FakeStream:
    """A stream that gives the listed frames; an int is raised as an OSError of that number."""

    def __init__(self, *given: Any, exposure_ns: int = 0) -> None:
        self.given, self.exposure, self.fps, self.closed = list(given), exposure_ns, 25.0, False

    def exposure_ns(self) -> int:
        return self.exposure

    def get(self, timeout_s: float) -> Any:
        item = self.given.pop(0) if self.given else None
        if isinstance(item, int):
            raise OSError(item, "from the kernel")
        return item

    def close(self) -> None:
        self.closed = True


def usb(*streams: FakeStream, now_ns: int = 10**12, **settings: Any) -> UsbCamera:
    left = list(streams)
    clock = [now_ns]

    def stream(_: UsbSettings) -> FakeStream:
        if not left:
            raise OSError(errno.ENOENT, "No such file or directory")
        return left.pop(0)

    def sleep(seconds: float) -> None:
        clock[0] += round(seconds * 1e9)

    def now() -> int:
        clock[0] += 10**6
        return clock[0]

    return UsbCamera(UsbSettings(**settings), stream=stream, now_ns=now, sleep=sleep)


def read_frames(camera: Any, tries: int = 20) -> list[Frame]:
    return [frame for frame in (camera.read(0.1) for _ in range(tries)) if frame is not None]


def test_the_kernels_stamp_is_moved_to_mid_exposure_of_the_middle_row() -> None:
    frames = [kernel_frame(k, 5 * 10**9 + k * PERIOD) for k in range(3)]
    camera = usb(FakeStream(*frames, exposure_ns=6_000_000), readout_s=0.02)
    camera.open()
    got = read_frames(camera)
    assert [frame.device_time_ns for frame in got] == [5 * 10**9 + k * PERIOD + 13_000_000 for k in range(3)]
    assert {frame.exposure_ns for frame in got} == {6_000_000}
    assert (camera.info.driver, camera.info.clock, camera.info.readout_s, camera.info.unknown) == (
        "usb", "monotonic", 0.02, ()
    )  # fmt: skip


def test_a_stamp_at_the_end_of_the_frame_is_moved_back() -> None:
    camera = usb(FakeStream(kernel_frame(0, 10**9, MONOTONIC), exposure_ns=4_000_000), readout_s=0.01)
    camera.open()
    assert read_frames(camera)[0].device_time_ns == 10**9 - 7_000_000


def test_unknown_quantities_are_listed_in_the_description() -> None:
    camera = usb(FakeStream(kernel_frame(0, 10**9, flags=0)))
    camera.open()
    assert abs(read_frames(camera)[0].device_time_ns - 10**12) < 10**9, "not the kernel's clock: stamped on arrival"
    assert "time of capture: stamped on arrival" in camera.info.unknown
    assert any("exposure" in what for what in camera.info.unknown)


def test_dropped_and_damaged_frames_are_gaps_in_the_kernels_numbers() -> None:
    torn = kernel_frame(5, 5 * PERIOD, MONOTONIC | START | BAD)
    camera = usb(
        FakeStream(kernel_frame(2, 2 * PERIOD), kernel_frame(3, 3 * PERIOD), torn, kernel_frame(9, 9 * PERIOD))
    )
    camera.open()
    assert [frame.frame for frame in read_frames(camera)] == [2, 3, 9]


def test_an_unplugged_camera_is_reconnected_and_its_numbers_continue() -> None:
    before = FakeStream(*(kernel_frame(k, k * PERIOD) for k in range(10)), errno.ENODEV)
    after = FakeStream(*(kernel_frame(k, 10**10 + k * PERIOD) for k in range(3)))
    camera = usb(before, after)
    camera.open()
    got = read_frames(camera, 40)
    assert before.closed
    assert camera.reconnections == 1
    assert [frame.frame for frame in got] == [*range(10), 250, 251, 252], "10 s at 25 Hz after the first"


def test_a_busy_kernel_is_polled_again_and_a_missing_camera_is_refused() -> None:
    camera = usb(FakeStream(kernel_frame(0, 0), errno.EAGAIN, kernel_frame(1, PERIOD)))
    camera.open()
    assert [frame.frame for frame in read_frames(camera)] == [0, 1]
    assert camera.reconnections == 0
    with pytest.raises(InputError, match=r"camera /dev/video97 does not answer.*plugged in"):
        UsbCamera(UsbSettings(device="/dev/video97"), stream=V4l2Stream).open()
    with pytest.raises(InputError, match="gives no frame"):
        usb(FakeStream()).open()


@pytest.mark.parametrize(("pixels", "tolerance"), [("YUYV", 18), ("GREY", 0), ("MJPEG", 3)])
def test_each_pixel_format_is_decoded(pixels: str, tolerance: int) -> None:
    camera = usb(FakeStream(kernel_frame(120, 0, pixels=pixels)))
    camera.open()
    (frame,) = read_frames(camera)
    assert frame.image.shape == (8, 16, 3)
    assert np.abs(frame.image.astype(int) - 120).max() <= tolerance


def test_an_unknown_pixel_format_is_refused_and_a_truncated_image_is_dropped() -> None:
    odd = kernel_frame(0, 0)
    odd.format = odd.format._replace(pixel_format=video.PixelFormat.NV12)
    with pytest.raises(InputError, match=r'gives NV12 pixels; set pixels = "MJPG"'):
        usb(FakeStream(odd)).open()
    short = kernel_frame(1, PERIOD)
    short.data = short.data[:10]
    camera = usb(FakeStream(kernel_frame(0, 0), short, kernel_frame(2, 2 * PERIOD)))
    camera.open()
    assert [frame.frame for frame in read_frames(camera)] == [0, 2]


def test_without_linuxpy_opencv_reads_the_camera() -> None:
    assert isinstance(open_usb(UsbSettings(), is_installed=lambda name: False), OpenCvCamera)
    assert isinstance(open_usb(UsbSettings(), is_installed=lambda name: True), UsbCamera)


class FakePicamera2:
    """The part of picamera2 that the driver uses. frames: (SensorTimestamp, ExposureTime in us); None times out."""

    camera_controls: ClassVar = {"FrameDurationLimits": (20_000, 10**6, None)}

    def __init__(self, *frames: tuple[int, int] | None) -> None:
        self.frames, self.orders, self.released, self.configured = list(frames), 0, 0, dict[str, Any]()
        self.stopped = False

    def create_video_configuration(self, **options: Any) -> dict[str, Any]:
        return options

    def configure(self, options: dict[str, Any]) -> None:
        self.configured = options

    def start(self) -> None: ...

    def stop(self) -> None:
        self.stopped = True

    def close(self) -> None: ...

    def capture_request(self, wait: bool) -> object:
        self.orders += 1
        return object()

    def wait(self, order: object, timeout: float) -> FakePicamera2:
        if not self.frames:
            raise TimeoutError
        self.now = self.frames.pop(0)
        if self.now is None:
            raise TimeoutError
        return self

    def get_metadata(self) -> dict[str, Any]:
        assert self.now is not None
        stamp, exposure = self.now
        return {"SensorTimestamp": stamp, "ExposureTime": exposure, "FrameDuration": 40_000, "SensorTemperature": 41.5}

    def make_array(self, _: str) -> Any:
        return np.zeros((48, 64, 3), np.uint8)

    def release(self) -> None:
        self.released += 1


def test_a_pi_cameras_stamp_is_moved_from_the_first_rows_end_to_mid_exposure() -> None:
    """Half a readout later the middle row ends its exposure; mid-exposure is half an exposure earlier."""
    pi = FakePicamera2((10**9, 5000), None, (10**9 + PERIOD, 7000), (10**9 + 3 * PERIOD, 5000))
    camera = PiCamera(PiSettings(size=(64, 48), fps=25.0), make=lambda _: pi)
    camera.open()
    got = read_frames(camera, 6)
    assert [frame.device_time_ns for frame in got] == [
        10**9 + 10_000_000 - 2_500_000,
        10**9 + PERIOD + 10_000_000 - 3_500_000,
        10**9 + 3 * PERIOD + 10_000_000 - 2_500_000,
    ]
    assert [frame.exposure_ns for frame in got] == [5_000_000, 7_000_000, 5_000_000]
    assert [frame.frame for frame in got] == [0, 1, 3], "a lost frame is a gap"
    assert camera.info.readout_s == pytest.approx(0.02)
    assert camera.temperature == 41.5
    assert pi.released == 3
    assert pi.orders == 4, "a request that timed out is waited for again, not repeated"
    assert pi.configured["controls"]["ExposureTime"] == 5000
    assert pi.configured["controls"]["FrameDurationLimits"] == (40_000, 40_000)
    camera.close()
    assert pi.stopped


def test_a_configured_readout_is_used_and_a_missing_package_or_camera_is_refused() -> None:
    camera = PiCamera(PiSettings(size=(64, 48), readout_s=0.004), make=lambda _: FakePicamera2((10**9, 1000)))
    camera.open()
    assert read_frames(camera, 1)[0].device_time_ns == 10**9 + 2_000_000 - 500_000
    with pytest.raises(InputError, match=r"picamera2 is not installed; sudo apt install python3-picamera2"):
        PiCamera(PiSettings()).open()

    def nobody(_: int) -> Any:
        raise IndexError("list index out of range")

    with pytest.raises(InputError, match=r"Pi camera 0 does not answer.*ribbon cable"):
        PiCamera(PiSettings(), make=nobody).open()
