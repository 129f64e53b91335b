"""OAK cameras through depthai: fixed exposure and focus, mid-exposure stamps, back after being unplugged.

The only module that knows depthai, which is imported when a camera is opened (90 MB, half a second).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import numpy as np

from edge.devices.base import DeviceInfo, Frame, check_size
from protocols.errors import InputError
from protocols.geometry.camera import Intrinsics

_RETRY_S = 1.0
_QUEUE = 4  # newest frames: what is older than that has been waited for in vain
_FIRST_FRAME_S = 10.0


@dataclass(frozen=True, slots=True)
class OakSettings:
    """One sensor of one OAK board.

    device: IP address, device id or USB path; "" = the only one there is. socket: CAM_A, CAM_B or CAM_C.
    size: (width, height) [px]. exposure_us, iso: fixed, so that mid-exposure and brightness keep still.
    focus: lens position 0..255 of an auto-focus lens, fixed; None = a lens that cannot move.
    """

    device: str = ""
    socket: str = "CAM_A"
    size: tuple[int, int] = (1280, 800)
    fps: float = 30.0
    exposure_us: int = 5000
    iso: int = 400
    focus: int | None = None


@dataclass(slots=True)
class Stream:
    """An open pipeline and the queue of its pictures (depthai's objects)."""

    pipeline: Any
    queue: Any


class OakCamera:
    """A camera on an OAK board; see ``edge.devices.base.Device``.

    Stamps are the host's CLOCK_MONOTONIC, to which depthai maps the board's clock: that clock goes on when the board
    is plugged in again, as the board's own does not. connect: makes the stream; tests give a host-only one.
    sleep, now: a monotonic clock [s] for trying again.
    """

    def __init__(
        self,
        settings: OakSettings,
        *,
        intrinsics: Intrinsics | None = None,
        connect: Callable[[OakSettings], Stream] | None = None,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._settings = settings
        self._intrinsics = intrinsics
        self._connect = connect or open_stream
        self._now, self._sleep = now, sleep
        self._stream: Stream | None = None
        self._first: Frame | None = None
        self._info: DeviceInfo | None = None
        self._last = -1
        self._last_s = 0.0
        self._offset = 0  # added to the board's frame numbers, which begin anew after a reconnection
        self._again = 0.0
        self._ended = False
        self.reconnections = 0

    @property
    def info(self) -> DeviceInfo:
        """Size as the first picture has it."""
        if self._info is None:
            raise RuntimeError("open the camera first")
        return self._info

    @property
    def ended(self) -> bool:
        """True once closed: an unplugged board is waited for."""
        return self._ended

    @property
    def away(self) -> bool:
        """Whether the board is gone, and is tried again with every ``read``."""
        return self._stream is None and self._info is not None and not self._ended

    def open(self) -> None:
        """Raises InputError where no board answers or no picture comes."""
        name = self._settings.device or "OAK camera"
        try:
            self._stream = self._connect(self._settings)
        except ImportError:
            raise InputError("depthai is not installed", remedy='pip install "syncline[oak]"') from None
        except RuntimeError as error:
            raise InputError(f"{name} does not answer: {_one_line(error)}", remedy=_REMEDY) from None
        self._ended = False
        began = self._now()
        while self._first is None and self._now() - began < _FIRST_FRAME_S:
            self._first = self._next(0.5)
        if self._first is None:
            self.close()
            raise InputError(f"{name} gives no picture", remedy=_REMEDY)
        height, width = self._first.image.shape[:2]
        check_size(self._intrinsics, width, height, name)
        self._info = DeviceInfo(width, height, self._settings.fps, "oak", "monotonic", self._intrinsics)

    def read(self, timeout_s: float) -> Frame | None:
        """The next picture; None while the board is away, which is tried again each second."""
        if self._ended:
            return None
        if self._first is not None:
            frame, self._first = self._first, None
            return frame
        if self._stream is None:
            self._reconnect(timeout_s)
            return None
        return self._next(timeout_s)

    def close(self) -> None:
        """Release the board."""
        self._release()
        self._ended = True

    def _next(self, timeout_s: float) -> Frame | None:
        import depthai as dai

        assert self._stream is not None
        try:
            picture = self._stream.queue.get(timedelta(seconds=timeout_s))
        except (RuntimeError, dai.MessageQueue.QueueException):  # the link is gone
            self._lose()
            return None
        if picture is None:
            if not self._stream.pipeline.isRunning():
                self._lose()
            return None
        return self._frame(picture)

    def _frame(self, picture: Any) -> Frame:
        import depthai as dai

        middle = picture.getTimestamp(dai.CameraExposureOffset.MIDDLE)
        seconds = middle / timedelta(seconds=1)
        number = int(picture.getSequenceNum()) + self._offset
        if number <= self._last:
            # Plugged in again: the board counts anew, and what was missed meanwhile is a gap.
            passed = max(round((seconds - self._last_s) * self._settings.fps), 1)
            self._offset += self._last + passed - number
            number = self._last + passed
        self._last, self._last_s = number, seconds
        return Frame(
            image=np.ascontiguousarray(_bgr(picture.getCvFrame()), dtype=np.uint8),
            device_time_ns=(middle // timedelta(microseconds=1)) * 1000,
            frame=number,
            exposure_ns=(picture.getExposureTime() // timedelta(microseconds=1)) * 1000,
        )

    def _lose(self) -> None:
        self._release()
        self._again = self._now()

    def _reconnect(self, timeout_s: float) -> None:
        if self._now() < self._again:
            self._sleep(min(timeout_s, max(self._again - self._now(), 0.0)))
            return
        self._again = self._now() + _RETRY_S
        try:
            self._stream = self._connect(self._settings)
        except RuntimeError:
            self._again = self._now() + _RETRY_S
            return
        self.reconnections += 1

    def _release(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            with suppress(RuntimeError):
                stream.pipeline.stop()


_REMEDY = (
    "check cable and power, the group of /dev/bus/usb (udev rules: `syncline install`), or the address of a PoE board"
)


def open_stream(settings: OakSettings) -> Stream:
    """Open the board and start its camera. Raises RuntimeError where none answers, ImportError without depthai."""
    import depthai as dai

    if settings.device:
        device = dai.Device(dai.DeviceInfo(settings.device))
    else:
        if not dai.Device.getAllAvailableDevices():
            raise RuntimeError("no OAK board is found")  # opening would look for 11 s
        device = dai.Device()
    pipeline = dai.Pipeline(device)
    camera = pipeline.create(dai.node.Camera).build(getattr(dai.CameraBoardSocket, settings.socket))
    camera.initialControl.setManualExposure(settings.exposure_us, settings.iso)
    if settings.focus is not None:
        camera.initialControl.setManualFocus(settings.focus)
    output = camera.requestOutput(settings.size, dai.ImgFrame.Type.BGR888i, fps=settings.fps)
    queue = output.createOutputQueue(maxSize=_QUEUE, blocking=False)
    pipeline.start()
    return Stream(pipeline, queue)


def _bgr(image: Any) -> Any:
    """(H, W, 3) of a colour or grey picture."""
    return image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:160]
