"""USB cameras (V4L2) with the kernel's own time stamps, sequence numbers and exposure, through linuxpy.

The kernel stamps a buffer on CLOCK_MONOTONIC when its first packet arrives ("start of exposure" in uvcvideo's terms) or
when it is complete, and numbers all frames, including those that were not read. Without linuxpy the camera is read
through OpenCV, which stamps on arrival.
"""

from __future__ import annotations

import errno
import os
import select
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from typing import Any

import cv2
import msgspec
import numpy as np

from edge.devices.base import Device, DeviceInfo, Frame
from edge.devices.live.opencv_capture import OpenCvCamera
from edge.devices.live.reconnecting import Connection, ConnectionLost, ReconnectingCamera
from edge.devices.settings import UsbSettings
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Image

_MONOTONIC, _CLOCK_MASK = 0x2000, 0xE000  # V4L2_BUF_FLAG_TIMESTAMP_…
_START_OF_EXPOSURE, _SOURCE_MASK = 0x10000, 0x70000  # V4L2_BUF_FLAG_TSTAMP_SRC_…; else the end of the frame
_DAMAGED = 0x40  # V4L2_BUF_FLAG_ERROR: the pixels are damaged
_BUFFERS = 4  # of the kernel: 130 ms at 30 Hz
_REMEDY = "check that it is plugged in, that no other program uses it, and that you may read /dev/video*"
_EXPOSURE_UNIT_US = 100  # V4L2_CID_EXPOSURE_ABSOLUTE


def open_usb(
    settings: UsbSettings,
    *,
    intrinsics: Intrinsics | None = None,
    is_installed: Callable[[str], bool] = lambda name: find_spec(name) is not None,
) -> Device:
    """The device for a USB camera, not yet open: through linuxpy, or through OpenCV, which stamps on arrival."""
    if settings.device.isdecimal():
        settings = msgspec.structs.replace(settings, device=f"/dev/video{settings.device}")
    if is_installed("linuxpy"):
        return UsbCamera(settings, intrinsics=intrinsics)
    return OpenCvCamera(settings.device, fps=settings.fps, intrinsics=intrinsics, driver="usb")


class UsbCamera(ReconnectingCamera):
    """A V4L2 camera; see ``edge.devices.base.Device``. stream: opens the V4L2 stream; replaced in tests."""

    def __init__(
        self,
        settings: UsbSettings,
        *,
        intrinsics: Intrinsics | None = None,
        stream: Callable[[UsbSettings], Any] | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        name = f"camera {settings.device}"
        make = stream or V4l2Stream

        def connect() -> Connection:
            try:
                return UsbConnection(make(settings), settings, now_ns)
            except OSError as error:
                what = f"{name} does not answer: {error.strerror or error}"
                raise InputError(what, remedy=_REMEDY) from None

        def describe(connection: UsbConnection, width: int, height: int) -> DeviceInfo:
            readout_s, unknown = settings.readout_s, connection.unknown
            return DeviceInfo(width, height, connection.fps, "usb", "monotonic", None, readout_s, unknown)

        super().__init__(name, connect, describe, intrinsics, remedy=_REMEDY, now_ns=now_ns, sleep=sleep)


class V4l2Stream:
    """A V4L2 device with memory-mapped buffers, through linuxpy. Raises OSError where it does not answer."""

    def __init__(self, settings: UsbSettings) -> None:
        from linuxpy.video.device import Device as V4l2Device
        from linuxpy.video.device import V4L2Error, VideoCapture

        self._device = V4l2Device(os.path.realpath(settings.device))
        try:
            self._device.open()
            self._capture = VideoCapture(self._device, size=_BUFFERS)
            if settings.size is not None:
                self._capture.set_format(*settings.size, settings.pixels)
            if settings.fps is not None:
                self._capture.set_fps(settings.fps)
            with suppress(OSError, ZeroDivisionError):
                self.fps = float(self._capture.get_fps())
            self._fix(settings)
            self._capture.open()
        except V4L2Error as error:
            self.close()
            raise OSError(errno.EINVAL, str(error)) from None
        except OSError:
            self.close()
            raise

    fps = 0.0

    def _fix(self, settings: UsbSettings) -> None:
        """Set the fixed exposure and gain. Raises OSError where the camera lacks the control."""
        controls = self._device.controls
        if settings.exposure_us is not None:
            if "auto_exposure" not in controls or "exposure_time_absolute" not in controls:
                raise OSError(errno.EINVAL, "it cannot fix its exposure; leave exposure_us out")
            controls["auto_exposure"].value = 1  # V4L2_EXPOSURE_MANUAL
            controls["exposure_time_absolute"].value = max(round(settings.exposure_us / _EXPOSURE_UNIT_US), 1)
        if settings.gain is not None:
            if "gain" not in controls:
                raise OSError(errno.EINVAL, "it has no gain; leave gain out")
            controls["gain"].value = settings.gain

    def exposure_ns(self) -> int:
        """The present exposure; 0 where it is automatic, as it may vary by frame, or not reported."""
        controls = self._device.controls
        if "auto_exposure" not in controls or "exposure_time_absolute" not in controls:
            return 0
        if int(controls["auto_exposure"].value) != 1:
            return 0
        return int(controls["exposure_time_absolute"].value) * _EXPOSURE_UNIT_US * 1000

    def get(self, timeout_s: float) -> Any:
        """linuxpy's frame; None if none came. Raises OSError where the camera is lost."""
        ready, _, broken = select.select([self._device], [], [self._device], timeout_s)
        if broken and not ready:
            raise OSError(errno.ENODEV, "unplugged")
        return self._capture.buffer.raw_read() if ready else None

    def close(self) -> None:
        """Stop and release the buffers; also after the camera was unplugged."""
        for close in (getattr(getattr(self, "_capture", None), "close", None), self._device.close):
            with suppress(OSError, ValueError, AttributeError):
                if close is not None:
                    close()


class UsbConnection:
    """The frames of one open V4L2 stream, stamped at mid-exposure as far as exposure and readout are known."""

    def __init__(self, stream: Any, settings: UsbSettings, now_ns: Callable[[], int]) -> None:
        self._stream = stream
        self._readout_ns = round(settings.readout_s * NANOSECONDS)
        self._now_ns = now_ns
        self._exposure_ns = int(stream.exposure_ns())
        self.fps = float(settings.fps or stream.fps)
        self._first: Any = None
        self._arrival = False

    @property
    def unknown(self) -> tuple[str, ...]:
        """Quantities that this camera does not report."""
        unknown_items = [] if self._exposure_ns else ["exposure: automatic"]
        if not self._readout_ns:
            unknown_items.append("readout of a rolling shutter")
        if self._arrival:
            unknown_items.append("time of capture: stamped on arrival")
        return tuple(unknown_items)

    def take(self, timeout_s: float) -> Frame | None:
        try:
            frame = self._stream.get(timeout_s)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EINTR):
                return None
            raise ConnectionLost from None
        if frame is None:
            return None
        flags = int(frame.buff.flags)
        image = None if flags & _DAMAGED else decode_frame(frame)
        if image is None:  # its number stays a gap
            return None
        return Frame(image, self._middle(frame, flags), int(frame.frame_nb), self._exposure_ns)

    def close(self) -> None:
        self._stream.close()

    def _middle(self, frame: Any, flags: int) -> int:
        """Mid-exposure of the middle row [ns]."""
        stamp = frame.buff.timestamp
        time_ns = int(stamp.secs) * NANOSECONDS + int(stamp.usecs) * 1000
        self._arrival = flags & _CLOCK_MASK != _MONOTONIC
        if self._arrival:
            return self._now_ns()
        to_middle = (self._exposure_ns + self._readout_ns) // 2
        return time_ns + to_middle if flags & _SOURCE_MASK == _START_OF_EXPOSURE else time_ns - to_middle


def decode_frame(frame: Any) -> Image | None:
    """(H, W, 3) BGR image of a linuxpy frame; None where it is damaged. Raises InputError for an unknown format."""
    kind = frame.pixel_format.name
    data = np.frombuffer(bytes(frame.data), dtype=np.uint8)
    if kind in ("MJPEG", "JPEG"):
        image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
        return None if image is None else np.asarray(image, dtype=np.uint8)
    depth = {"YUYV": 2, "UYVY": 2, "GREY": 1, "BGR24": 3, "RGB24": 3}.get(kind)
    if depth is None:
        raise InputError(f"the camera gives {kind} pixels", remedy='set pixels = "MJPG" or "YUYV" in [usb]')
    shape = (frame.height, frame.width, depth)
    if data.size < int(np.prod(shape)):
        return None
    raw = data[: int(np.prod(shape))].reshape(shape)
    if kind == "BGR24":
        return raw.copy()
    code = {
        "YUYV": cv2.COLOR_YUV2BGR_YUY2,
        "UYVY": cv2.COLOR_YUV2BGR_UYVY,
        "GREY": cv2.COLOR_GRAY2BGR,
        "RGB24": cv2.COLOR_RGB2BGR,
    }[kind]
    return np.asarray(cv2.cvtColor(raw, code), dtype=np.uint8)
