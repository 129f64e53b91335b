"""Network cameras (RTSP, or MJPEG over HTTP) with the stream's own frame times, through PyAV.

An RTSP camera stamps its frames by its own clock (RTP): they come later by a network that delays each differently, yet
their stamps keep the camera's rhythm. Motion JPEG over HTTP has no stamps, and is stamped on arrival. Without PyAV the
stream is read through OpenCV.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np

from edge.devices.base import Device, DeviceInfo, Frame, check_size
from edge.devices.live.opencv_capture import LiveCamera
from edge.devices.live.reconnecting import Connection, Gone, ReturningCamera, without_password
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics

_OPEN_S, _READ_S = 5.0, 3.0
_REMEDY = "check address, user and password, and that the camera is on this network"
_STAMPED = ("rtsp", "rtp", "srt", "udp")  # kinds of stream whose sender stamps


def open_network(
    url: str,
    *,
    transport: Literal["tcp", "udp"] = "tcp",
    fps: float | None = None,
    intrinsics: Intrinsics | None = None,
    there: Callable[[str], bool] = lambda name: find_spec(name) is not None,
    now_ns: Callable[[], int] = time.monotonic_ns,
) -> Device:
    """The camera through PyAV; without it through OpenCV, which stamps on arrival. It still has to be opened."""
    if there("av"):
        return NetworkCamera(url, transport=transport, fps=fps, intrinsics=intrinsics, now_ns=now_ns)
    return LiveCamera(url, fps=fps, intrinsics=intrinsics, driver="rtsp", now_ns=now_ns)


class NetworkCamera(ReturningCamera):
    """A network stream; see ``edge.devices.base.Device``.

    Stamps of one connection are laid on the host's clock at the picture that came with the least delay of its first
    second, so that times go on after a reconnection. How late that one was nobody knows; the offset that is estimated
    for this camera absorbs it, anew after each reconnection. ``read`` is held up for 3 s at most by a silent stream.
    """

    def __init__(
        self,
        url: str,
        *,
        transport: Literal["tcp", "udp"] = "tcp",
        fps: float | None = None,
        intrinsics: Intrinsics | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        name = f"camera {without_password(url)}"

        def connect() -> Connection:
            return NetworkConnection(url, transport, fps, name, now_ns)

        def describe(connection: Connection, first: Frame) -> DeviceInfo:
            assert isinstance(connection, NetworkConnection)
            height, width = first.image.shape[:2]
            check_size(intrinsics, width, height, name)
            late = "time of capture: late by the camera's own delay"
            unknown = ("exposure", late if connection.stamped else "time of capture: stamped on arrival")
            return DeviceInfo(width, height, connection.fps, "rtsp", "monotonic", intrinsics, unknown=unknown)

        super().__init__(name, connect, describe, remedy=_REMEDY, now_ns=now_ns, sleep=sleep)


class NetworkConnection:
    """One open stream. stamped: whether its pictures carry the sender's times. Raises InputError."""

    def __init__(self, url: str, transport: str, fps: float | None, name: str, now_ns: Callable[[], int]) -> None:
        import av
        from av.error import FFmpegError

        kind = url.partition("://")[0].lower()
        options = {"fflags": "nobuffer", "flags": "low_delay", "max_delay": "100000", "reorder_queue_size": "16"}
        if kind == "rtsp":
            options |= {"rtsp_transport": transport, "stimeout": str(round(_READ_S * 1e6))}
        try:
            self._container: Any = av.open(url, options=options, timeout=(_OPEN_S, _READ_S))
            if not self._container.streams.video:
                self._container.close()
                raise InputError(f"{name} has no video", remedy="check the path in its address")
            self._stream = self._container.streams.video[0]
        except FFmpegError as error:
            what = " ".join(str(error.strerror or error).split())[:120]
            raise InputError(f"{name} does not answer: {what}", remedy=_REMEDY) from None
        self._stream.codec_context.thread_count = 1  # frame threads would hold pictures back
        self.stamped = kind in _STAMPED
        rate = self._stream.average_rate or self._stream.guessed_rate
        self.fps = fps or (float(rate) if rate and self.stamped and 0 < rate <= 1000 else 0.0)
        self._now_ns = now_ns
        self._frames: Iterator[Any] = self._container.decode(self._stream)
        self._number = -1
        self._clock = StreamClock()
        self._error = FFmpegError

    def take(self, timeout_s: float) -> Frame | None:
        try:
            picture = next(self._frames)
            arrived = self._now_ns()
            image = np.asarray(picture.to_ndarray(format="bgr24"), dtype=np.uint8)
        except (StopIteration, EOFError, self._error):
            raise Gone from None
        moment, passed = arrived, 1
        if self.stamped and picture.pts is not None and picture.time_base is not None:
            stamp = round(float(picture.pts * picture.time_base) * NANOSECONDS)
            moment, passed = self._clock.place(stamp, arrived, self.fps)
        self._number += passed
        return Frame(image, moment, self._number)

    def close(self) -> None:
        self._container.close()


class StreamClock:
    """Lays a stream's stamps on the host's clock, both ns.

    The map is a constant for a whole connection: taken from the first pictures, it never follows the delay of later
    ones, which would put the network's jitter into the times. The first second's least delay is kept; until then each
    earlier arrival moves it.
    """

    def __init__(self, settle_s: float = 1.0) -> None:
        self._settle_ns = round(settle_s * NANOSECONDS)
        self._shift: int | None = None
        self._first = self._last = self._last_moment = 0

    def place(self, stamp: int, arrived: int, fps: float) -> tuple[int, int]:
        """(host time of a stamp, how many periods after the one before it)."""
        if self._shift is None:
            self._shift, self._first, self._last = arrived - stamp, stamp, stamp
            self._last_moment = arrived
            return arrived, 1
        passed = max(round((stamp - self._last) / NANOSECONDS * fps), 1) if fps > 0.0 else 1
        if stamp <= self._last or stamp - self._last > 60 * NANOSECONDS:  # the sender began anew
            self._shift, self._first, passed = arrived - stamp, stamp, 1
        elif stamp - self._first < self._settle_ns:
            self._shift = min(self._shift, arrived - stamp)
        moment = max(stamp + self._shift, self._last_moment + 1)
        self._last, self._last_moment = stamp, moment
        return moment, passed
