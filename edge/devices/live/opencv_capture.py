"""Live cameras through OpenCV: a USB camera, or a network stream. Any machine with OpenCV has it.

``usb`` and ``network`` know more of when a picture was taken, where their packages are installed.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable

import cv2
import numpy as np

from edge.devices.base import DeviceInfo, Frame, check_size
from edge.devices.live.reconnecting import Connection, Gone, ReturningCamera, without_password
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics

ON_ARRIVAL = ("exposure", "time of capture: stamped on arrival", "dropped frames")
"""What is unknown of frames that OpenCV gives."""
_OPEN_TIMEOUT_MS = 5000
_READ_TIMEOUT_MS = 3000
_GONE_AFTER_S = 1.0  # a source that fails, and has given no frame for this long, is gone


class LiveCamera(ReturningCamera):
    """A USB camera or a network stream. Its frames are stamped by the host when they arrive.

    That is later than the exposure by an unknown, mostly constant delay, which the estimated offset of this camera
    absorbs; frames that the driver loses are not seen as gaps. OpenCV's waits cannot be cut short: a silent network
    stream holds ``read`` up for 3 s, one that is sought for 5 s.
    """

    def __init__(
        self,
        source: str | int,
        *,
        fps: float | None = None,
        intrinsics: Intrinsics | None = None,
        driver: str = "video",
        now_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        name = f"camera {without_password(source)}"

        def connect() -> Connection:
            return _Capture(source, fps, name, now_ns, sleep)

        def describe(connection: Connection, first: Frame) -> DeviceInfo:
            assert isinstance(connection, _Capture)
            height, width = first.image.shape[:2]
            check_size(intrinsics, width, height, name)
            return DeviceInfo(width, height, fps or connection.fps, driver, "monotonic", intrinsics, unknown=ON_ARRIVAL)

        super().__init__(name, connect, describe, remedy=_remedy(source), now_ns=now_ns, sleep=sleep)


class _Capture:
    """OpenCV's capture of a source, numbered as its pictures come."""

    def __init__(
        self,
        source: str | int,
        fps: float | None,
        name: str,
        now_ns: Callable[[], int],
        sleep: Callable[[float], None],
    ) -> None:
        self._now_ns, self._sleep = now_ns, sleep
        self._capture = _open(source)
        if fps is not None:
            self._capture.set(cv2.CAP_PROP_FPS, fps)
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # old frames are worth nothing; drivers may ignore it
        good, image = self._capture.read() if self._capture.isOpened() else (False, None)
        if not good or image is None:
            self._capture.release()
            raise InputError(f"{name} does not answer", remedy=_remedy(source))
        reported = self._capture.get(cv2.CAP_PROP_FPS)
        self.fps = float(reported) if math.isfinite(reported) and 0 < reported <= 1000 else 0.0
        self._frame = -1
        self._alive_ns = now_ns()

    def take(self, timeout_s: float) -> Frame | None:
        if not self._capture.grab():
            if self._now_ns() - self._alive_ns > _GONE_AFTER_S * NANOSECONDS:
                raise Gone
            self._sleep(min(timeout_s, 0.05))  # an unplugged camera fails at once: do not spin
            return None
        moment = self._now_ns()
        good, image = self._capture.retrieve()
        if not good or image is None:
            return None
        self._frame += 1
        self._alive_ns = moment
        return Frame(np.asarray(image, dtype=np.uint8), moment, self._frame)

    def close(self) -> None:
        self._capture.release()


def _open(source: str | int) -> cv2.VideoCapture:
    if isinstance(source, str) and "://" in source:
        limits = [
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
            _OPEN_TIMEOUT_MS,
            cv2.CAP_PROP_READ_TIMEOUT_MSEC,
            _READ_TIMEOUT_MS,
        ]
        return cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)
    # A stable name, /dev/syncline/…, is a link; OpenCV tells cameras from files by the name /dev/video….
    local = os.path.realpath(source) if isinstance(source, str) else source
    return cv2.VideoCapture(local)


def _remedy(source: str | int) -> str:
    if isinstance(source, str) and "://" in source:
        return "check address, user and password, and that the camera is on this network"
    return "check that it is plugged in, that no other program uses it, and that you may read /dev/video*"
