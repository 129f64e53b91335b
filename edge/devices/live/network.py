"""Network cameras (RTSP, or MJPEG over HTTP) with the stream's own frame times, through PyAV.

An RTSP camera stamps its frames by its own clock (RTP), so the stamps are free of the jitter of the network delay.
Motion JPEG over HTTP carries no stamps and is stamped on arrival. Without PyAV the stream is read through OpenCV.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np

from edge.devices.base import Device, DeviceInfo, Frame
from edge.devices.live.opencv_capture import OpenCvCamera
from edge.devices.live.reconnecting import Connection, ConnectionLost, ReconnectingCamera, redact_password
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics

_OPEN_S, _READ_S = 5.0, 3.0  # to open; to read, which blocks the agent's loop
_REMEDY = "check address, user and password, and that the camera is on this network"
_TIMESTAMPED_SCHEMES = ("rtsp", "rtp", "srt", "udp")  # URL schemes whose streams carry the sender's time stamps


def open_network(
    url: str,
    *,
    transport: Literal["tcp", "udp"] = "tcp",
    fps: float | None = None,
    intrinsics: Intrinsics | None = None,
    is_installed: Callable[[str], bool] = lambda name: find_spec(name) is not None,
) -> Device:
    """The device for a stream, not yet open: through PyAV, or through OpenCV, which stamps on arrival."""
    if is_installed("av"):
        return NetworkCamera(url, transport=transport, fps=fps, intrinsics=intrinsics)
    return OpenCvCamera(url, fps=fps, intrinsics=intrinsics, driver="rtsp")


class NetworkCamera(ReconnectingCamera):
    """A network stream; see ``edge.devices.base.Device``.

    The stamps of one connection are mapped to the host's clock by the frame with the least delay in its first second,
    so that times continue after a reconnection. The delay of that frame is unknown; the time offset estimated for this
    camera absorbs it, anew after each reconnection. A silent stream blocks ``read`` for at most 3 s.
    """

    def __init__(
        self,
        url: str,
        *,
        transport: Literal["tcp", "udp"] = "tcp",
        fps: float | None = None,
        intrinsics: Intrinsics | None = None,
    ) -> None:
        name = f"camera {redact_password(url)}"

        def connect() -> Connection:
            return NetworkConnection(url, transport, fps, name, time.monotonic_ns)

        def describe(connection: NetworkConnection, width: int, height: int) -> DeviceInfo:
            late = "time of capture: late by the camera's own delay"
            unknown = ("exposure", late if connection.stamped else "time of capture: stamped on arrival")
            return DeviceInfo(width, height, connection.fps, "rtsp", "monotonic", unknown=unknown)

        super().__init__(name, connect, describe, intrinsics, remedy=_REMEDY)


class NetworkConnection:
    """One open stream. stamped: whether its frames carry the sender's time stamps. Raises InputError."""

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
        self._stream.codec_context.thread_count = 1  # frame threads would delay frames
        self.stamped = kind in _TIMESTAMPED_SCHEMES
        rate = self._stream.average_rate or self._stream.guessed_rate
        self.fps = fps or (float(rate) if rate and self.stamped and 0 < rate <= 1000 else 0.0)
        self._now_ns = now_ns
        self._frames: Iterator[Any] = self._container.decode(self._stream)
        self._number = -1
        self._clock = StreamClock()
        self._error = FFmpegError

    def take(self, timeout_s: float) -> Frame | None:
        try:
            decoded = next(self._frames)
            arrived = self._now_ns()
            image = np.asarray(decoded.to_ndarray(format="bgr24"), dtype=np.uint8)
        except (StopIteration, EOFError, self._error):
            raise ConnectionLost from None
        time_ns, periods = arrived, 1
        if self.stamped and decoded.pts is not None and decoded.time_base is not None:
            stamp = round(float(decoded.pts * decoded.time_base) * NANOSECONDS)
            time_ns, periods = self._clock.to_host_time(stamp, arrived, self.fps)
        self._number += periods
        return Frame(image, time_ns, self._number)

    def close(self) -> None:
        self._container.close()


class StreamClock:
    """Maps a stream's time stamps to the host's clock, both in ns, by a constant offset.

    The offset is that of the least delay within the first second of a connection; until then each earlier
    arrival lowers it. It does not follow later delays, which would add the network's jitter to the times.
    """

    def __init__(self) -> None:
        self._offset: int | None = None
        self._first = self._last = self._last_time_ns = 0

    def to_host_time(self, stamp: int, arrived: int, fps: float) -> tuple[int, int]:
        """(host time of a stamp, number of frame periods since the previous one)."""
        if self._offset is None:
            self._offset, self._first, self._last = arrived - stamp, stamp, stamp
            self._last_time_ns = arrived
            return arrived, 1
        periods = max(round((stamp - self._last) / NANOSECONDS * fps), 1) if fps > 0.0 else 1
        if stamp <= self._last or stamp - self._last > 60 * NANOSECONDS:  # the sender has restarted
            self._offset, self._first, periods = arrived - stamp, stamp, 1
        elif stamp - self._first < NANOSECONDS:
            self._offset = min(self._offset, arrived - stamp)
        time_ns = max(stamp + self._offset, self._last_time_ns + 1)
        self._last, self._last_time_ns = stamp, time_ns
        return time_ns, periods
