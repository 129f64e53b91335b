"""Live cameras through OpenCV: a USB camera or a network stream, stamped on arrival.

The fallback for ``usb`` and ``network``, whose time stamps are better but which need linuxpy and PyAV.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable

import cv2
import numpy as np

from edge.devices.base import DeviceInfo, Frame
from edge.devices.live.reconnecting import Connection, ConnectionLost, ReconnectingCamera, redact_password
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics

UNKNOWN_WITH_OPENCV = ("exposure", "time of capture: stamped on arrival", "dropped frames")
"""Quantities that OpenCV does not provide for a frame."""
_OPEN_TIMEOUT_MS = 5000  # as of network cameras
_READ_TIMEOUT_MS = 3000  # it blocks the agent's loop
_LOST_AFTER_S = 1.0  # a source that fails and has given no frame for this long is lost


class OpenCvCamera(ReconnectingCamera):
    """A USB camera or a network stream whose frames are stamped by the host on arrival.

    The arrival is later than the exposure by an unknown, mostly constant delay, which the estimated time offset of this
    camera absorbs; frames lost by the driver leave no gap in the numbers. OpenCV's waits cannot be interrupted: a
    silent network stream blocks ``read`` for 3 s, a failing connection attempt for 5 s.
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
        name = f"camera {redact_password(source)}"

        def connect() -> Connection:
            return OpenCvConnection(source, fps, name, now_ns, sleep)

        def describe(connection: OpenCvConnection, width: int, height: int) -> DeviceInfo:
            rate = fps or connection.fps
            return DeviceInfo(width, height, rate, driver, "monotonic", unknown=UNKNOWN_WITH_OPENCV)

        super().__init__(name, connect, describe, intrinsics, remedy=_remedy(source), now_ns=now_ns, sleep=sleep)


class OpenCvConnection:
    """An open cv2.VideoCapture; frames are numbered by arrival."""

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
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # no stale frames; drivers may ignore it
        ok, image = self._capture.read() if self._capture.isOpened() else (False, None)
        if not ok or image is None:
            self._capture.release()
            raise InputError(f"{name} does not answer", remedy=_remedy(source))
        reported = self._capture.get(cv2.CAP_PROP_FPS)
        self.fps = float(reported) if math.isfinite(reported) and 0 < reported <= 1000 else 0.0
        self._frame = -1
        self._alive_ns = now_ns()

    def take(self, timeout_s: float) -> Frame | None:
        if not self._capture.grab():
            if self._now_ns() - self._alive_ns > _LOST_AFTER_S * NANOSECONDS:
                raise ConnectionLost
            self._sleep(min(timeout_s, 0.05))  # an unplugged camera fails immediately: avoid a busy loop
            return None
        time_ns = self._now_ns()
        ok, image = self._capture.retrieve()
        if not ok or image is None:
            return None
        self._frame += 1
        self._alive_ns = time_ns
        return Frame(np.asarray(image, dtype=np.uint8), time_ns, self._frame)

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
    # A stable name, /dev/syncline/…, is a symbolic link; OpenCV recognises cameras by the name /dev/video….
    local = os.path.realpath(source) if isinstance(source, str) else source
    return cv2.VideoCapture(local)


def _remedy(source: str | int) -> str:
    if isinstance(source, str) and "://" in source:
        return "check address, user and password, and that the camera is on this network"
    return "check that it is plugged in, that no other program uses it, and that you may read /dev/video*"
