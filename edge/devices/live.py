"""Live cameras through OpenCV: a USB camera, or a network stream."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import cv2
import numpy as np

from edge.devices.base import DeviceInfo, Frame, check_size
from protocols.clocks import NANOSECONDS
from protocols.errors import InputError
from protocols.geometry.camera import Intrinsics

_OPEN_TIMEOUT_MS = 5000
_READ_TIMEOUT_MS = 3000
_GONE_AFTER_S = 5.0  # a live source without a frame for this long is gone


class LiveCamera:
    """A USB camera or a network stream. Its frames are stamped by the host when they arrive.

    That is later than the exposure by an unknown, mostly constant delay, which the estimated offset of this camera
    absorbs; frames that the driver loses are not seen as gaps.
    """

    def __init__(
        self,
        source: str | int,
        *,
        fps: float | None = None,
        intrinsics: Intrinsics | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._source = source
        self._fps = fps
        self._intrinsics = intrinsics
        self._now_ns = now_ns
        self._capture: cv2.VideoCapture | None = None
        self._info: DeviceInfo | None = None
        self._frame = 0
        self._last_ns = 0
        self._ended = False

    @property
    def info(self) -> DeviceInfo:
        """Size and rate as the camera reports them."""
        if self._info is None:
            raise RuntimeError("open the camera first")
        return self._info

    @property
    def ended(self) -> bool:
        """True once the camera is gone."""
        return self._ended

    def open(self) -> None:
        """Raises InputError where the camera does not answer."""
        capture = self._connect()
        if self._fps is not None:
            capture.set(cv2.CAP_PROP_FPS, self._fps)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # old frames are worth nothing; drivers may ignore it
        good, image = capture.read() if capture.isOpened() else (False, None)
        if not good or image is None:
            capture.release()
            network = isinstance(self._source, str) and "://" in self._source
            remedy = (
                "check address, user and password, and that the camera is on this network"
                if network
                else "check that it is plugged in, that no other program uses it, and that you may read /dev/video*"
            )
            raise InputError(f"camera {_without_password(self._source)} does not answer", remedy=remedy)
        height, width = image.shape[:2]
        check_size(self._intrinsics, width, height, f"camera {_without_password(self._source)}")
        reported = capture.get(cv2.CAP_PROP_FPS)
        fps = self._fps or (reported if math.isfinite(reported) and 0 < reported <= 1000 else 0.0)
        unknown = ("exposure", "time of capture: stamped on arrival", "dropped frames")
        self._info = DeviceInfo(width, height, float(fps), "video", "monotonic", self._intrinsics, unknown=unknown)
        self._capture = capture
        self._last_ns = self._now_ns()

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame. OpenCV's wait cannot be cut short: a silent network stream holds this up for 3 s."""
        if self._ended or self._capture is None:
            return None
        if not self._capture.grab():
            if self._now_ns() - self._last_ns > _GONE_AFTER_S * NANOSECONDS:
                self._ended = True
            else:
                time.sleep(min(timeout_s, 0.05))  # an unplugged camera fails at once: do not spin
            return None
        moment = self._now_ns()
        good, image = self._capture.retrieve()
        if not good or image is None:
            return None
        self._last_ns = moment
        frame = Frame(np.asarray(image, dtype=np.uint8), moment, self._frame)
        self._frame += 1
        return frame

    def close(self) -> None:
        """Release the camera."""
        if self._capture is not None:
            self._capture.release()
        self._capture = None
        self._ended = True

    def _connect(self) -> cv2.VideoCapture:
        if isinstance(self._source, str) and "://" in self._source:
            limits = [
                cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
                _OPEN_TIMEOUT_MS,
                cv2.CAP_PROP_READ_TIMEOUT_MSEC,
                _READ_TIMEOUT_MS,
            ]
            return cv2.VideoCapture(self._source, cv2.CAP_FFMPEG, limits)
        return cv2.VideoCapture(self._source)


def _without_password(source: str | int) -> str:
    """A source as it may stand in an error or a log."""
    text = str(source)
    if "://" not in text or "@" not in text:
        return text
    scheme, rest = text.split("://", 1)
    return f"{scheme}://…@{rest.rsplit('@', 1)[1]}"
