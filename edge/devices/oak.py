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
from edge.devices.returning import Connection, Gone, ReturningCamera
from protocols.errors import InputError
from protocols.geometry.camera import Intrinsics

_QUEUE = 4  # newest frames: what is older than that has been waited for in vain


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


class OakCamera(ReturningCamera):
    """A camera on an OAK board; see ``edge.devices.base.Device``.

    Stamps are the host's CLOCK_MONOTONIC, to which depthai maps the board's clock: that clock goes on when the board
    is plugged in again, as the board's own does not. connect: makes the stream; tests give a host-only one.
    now_ns: a monotonic clock; sleep: for trying again.
    """

    def __init__(
        self,
        settings: OakSettings,
        *,
        intrinsics: Intrinsics | None = None,
        connect: Callable[[OakSettings], Stream] | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        name = settings.device or "OAK camera"
        make = connect or open_stream

        def connected() -> Connection:
            try:
                return OakConnection(make(settings))
            except ImportError:
                raise InputError("depthai is not installed", remedy='pip install "syncline[oak]"') from None
            except RuntimeError as error:
                raise InputError(f"{name} does not answer: {_one_line(error)}", remedy=_REMEDY) from None

        def describe(connection: Connection, first: Frame) -> DeviceInfo:
            height, width = first.image.shape[:2]
            check_size(intrinsics, width, height, name)
            return DeviceInfo(width, height, settings.fps, "oak", "monotonic", intrinsics)

        super().__init__(name, connected, describe, remedy=_REMEDY, now_ns=now_ns, sleep=sleep)


class OakConnection:
    """The pictures of one open stream."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream

    def take(self, timeout_s: float) -> Frame | None:
        import depthai as dai

        try:
            picture = self._stream.queue.get(timedelta(seconds=timeout_s))
        except (RuntimeError, dai.MessageQueue.QueueException):  # the link is gone
            raise Gone from None
        if picture is None:
            if not self._stream.pipeline.isRunning():
                raise Gone
            return None
        middle = picture.getTimestamp(dai.CameraExposureOffset.MIDDLE)
        return Frame(
            image=np.ascontiguousarray(_bgr(picture.getCvFrame()), dtype=np.uint8),
            device_time_ns=(middle // timedelta(microseconds=1)) * 1000,
            frame=int(picture.getSequenceNum()),
            exposure_ns=(picture.getExposureTime() // timedelta(microseconds=1)) * 1000,
        )

    def close(self) -> None:
        with suppress(RuntimeError):
            self._stream.pipeline.stop()

    @property
    def temperature(self) -> float | None:
        """Of the board's chip [°C]; None where it does not tell."""
        device = getattr(self._stream.pipeline, "getDefaultDevice", lambda: None)()
        try:
            return None if device is None else float(device.getChipTemperature().average)
        except (RuntimeError, AttributeError):
            return None


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
