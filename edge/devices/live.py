"""Live cameras through OpenCV: a USB camera, or a network stream; back after being unplugged."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable

import cv2
import numpy as np

from edge.devices.base import DeviceInfo, Frame, Image, check_size
from protocols.clocks import NANOSECONDS
from protocols.errors import InputError
from protocols.geometry.camera import Intrinsics

_OPEN_TIMEOUT_MS = 5000
_READ_TIMEOUT_MS = 3000
_GONE_AFTER_S = 1.0  # a source that fails, and has given no frame for this long, is gone
_RETRY_S, _SLOWEST_RETRY_S = 0.5, 5.0


class LiveCamera:
    """A USB camera or a network stream. Its frames are stamped by the host when they arrive.

    That is later than the exposure by an unknown, mostly constant delay, which the estimated offset of this camera
    absorbs; frames that the driver loses are not seen as gaps. One that is gone is tried again, after 0.5 s and then
    ever more slowly, at last each 5 s; its times go on, for they are the host's, and the frames that it must have
    missed are a gap in their numbers. now_ns: the host's monotonic clock; sleep: for trying again.
    """

    def __init__(
        self,
        source: str | int,
        *,
        fps: float | None = None,
        intrinsics: Intrinsics | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._source = source
        self._fps = fps
        self._intrinsics = intrinsics
        self._now_ns = now_ns
        self._sleep = sleep
        self._capture: cv2.VideoCapture | None = None
        self._info: DeviceInfo | None = None
        self._frame = -1
        self._first_ns = self._last_ns = 0
        self._alive_ns = 0  # of the last frame or connection
        self._period_ns = 0.0
        self._since = 0  # frames since first_ns, the first one after the last (re)connection
        self._again_ns = 0
        self._pause_s = _RETRY_S
        self._ended = False
        self.reconnections = 0

    @property
    def info(self) -> DeviceInfo:
        """Size and rate as the camera reports them."""
        if self._info is None:
            raise RuntimeError("open the camera first")
        return self._info

    @property
    def ended(self) -> bool:
        """True once closed: an unplugged camera is waited for."""
        return self._ended

    @property
    def away(self) -> bool:
        """Whether the camera is gone, and is tried again with every ``read``."""
        return self._capture is None and self._info is not None and not self._ended

    def open(self) -> None:
        """Raises InputError where the camera does not answer."""
        capture, image = self._start()
        name = _without_password(self._source)
        if image is None:
            network = isinstance(self._source, str) and "://" in self._source
            remedy = (
                "check address, user and password, and that the camera is on this network"
                if network
                else "check that it is plugged in, that no other program uses it, and that you may read /dev/video*"
            )
            raise InputError(f"camera {name} does not answer", remedy=remedy)
        height, width = image.shape[:2]
        check_size(self._intrinsics, width, height, f"camera {name}")
        reported = capture.get(cv2.CAP_PROP_FPS)
        fps = self._fps or (reported if math.isfinite(reported) and 0 < reported <= 1000 else 0.0)
        unknown = ("exposure", "time of capture: stamped on arrival", "dropped frames")
        self._info = DeviceInfo(width, height, float(fps), "video", "monotonic", self._intrinsics, unknown=unknown)
        self._capture = capture
        self._ended = False
        self._last_ns = self._alive_ns = self._now_ns()

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame; None while the camera is away.

        OpenCV's waits cannot be cut short: a silent network stream holds this up for 3 s, one that is sought for 5 s.
        Raises InputError where the camera comes back with another picture size.
        """
        if self._ended or self._info is None:
            return None
        if self._capture is None:
            self._reconnect(timeout_s)
            return None
        if not self._capture.grab():
            if self._now_ns() - self._alive_ns > _GONE_AFTER_S * NANOSECONDS:
                self._lose()
            else:
                self._sleep(min(timeout_s, 0.05))  # an unplugged camera fails at once: do not spin
            return None
        moment = self._now_ns()
        good, image = self._capture.retrieve()
        if not good or image is None:
            return None
        self._frame += 1 + (self._missed(moment) if self._since == 0 else 0)
        self._first_ns = moment if self._since == 0 else self._first_ns
        self._since += 1
        self._last_ns = self._alive_ns = moment
        return Frame(np.asarray(image, dtype=np.uint8), moment, self._frame)

    def _missed(self, moment: int) -> int:
        """Frames between the last one and the first one after an outage, at the rate that the camera had before."""
        if self._frame < 0 or self._period_ns <= 0.0:
            return 0
        return max(round((moment - self._last_ns) / self._period_ns) - 1, 0)

    def _lose(self) -> None:
        if self._capture is not None:
            self._capture.release()
        self._capture = None
        if self._since > 1:
            self._period_ns = (self._last_ns - self._first_ns) / (self._since - 1)
        if self._since > 0:
            self._pause_s = _RETRY_S
        self._since = 0
        self._again_ns = self._now_ns()

    def _reconnect(self, timeout_s: float) -> None:
        assert self._info is not None
        wait_ns = self._again_ns - self._now_ns()
        if wait_ns > 0:
            self._sleep(min(timeout_s, wait_ns / NANOSECONDS))
            return
        began = self._now_ns()
        capture, image = self._start()
        if image is None:
            self._again_ns = began + round(self._pause_s * NANOSECONDS)
            self._pause_s = min(2.0 * self._pause_s, _SLOWEST_RETRY_S)
            return
        if image.shape[:2] != (self._info.height, self._info.width):
            capture.release()
            raise InputError(
                f"camera {_without_password(self._source)} came back as {image.shape[1]}x{image.shape[0]}, "
                f"it was {self._info.width}x{self._info.height}",
                remedy="plug the same camera in, or start its agent again",
            )
        self._capture = capture
        self._alive_ns = self._now_ns()
        self.reconnections += 1

    def _start(self) -> tuple[cv2.VideoCapture, Image | None]:
        """The source, and its first picture; None, and nothing open, where it does not answer."""
        capture = self._connect()
        if self._fps is not None:
            capture.set(cv2.CAP_PROP_FPS, self._fps)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # old frames are worth nothing; drivers may ignore it
        good, image = capture.read() if capture.isOpened() else (False, None)
        if not good or image is None:
            capture.release()
            return capture, None
        return capture, np.asarray(image, dtype=np.uint8)

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
        # A stable name, /dev/syncline/…, is a link; OpenCV tells cameras from files by the name /dev/video….
        local = os.path.realpath(self._source) if isinstance(self._source, str) else self._source
        return cv2.VideoCapture(local)


def _without_password(source: str | int) -> str:
    """A source as it may stand in an error or a log."""
    text = str(source)
    if "://" not in text or "@" not in text:
        return text
    scheme, rest = text.split("://", 1)
    return f"{scheme}://…@{rest.rsplit('@', 1)[1]}"
