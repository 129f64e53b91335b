"""Reconnection logic shared by all drivers of real cameras.

A driver defines how to connect and how to take a frame from a connection. This module decides when to reconnect and
continues the frame numbers, with a gap for the frames that were missed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from edge.devices.base import DeviceInfo, Frame, check_size
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics

_RETRY_S, _MAX_RETRY_S = 0.5, 5.0  # between attempts: doubled from, up to
_FIRST_FRAME_S = 10.0  # cameras may take seconds to start


class ConnectionLost(Exception):
    """The connection is lost; the camera has to be reconnected."""


class Connection(Protocol):
    """An open camera."""

    def take(self, timeout_s: float) -> Frame | None:
        """The next frame with the source's own number; None if none came. Raises ConnectionLost."""

    def close(self) -> None:
        """Release it; may be called after the connection was lost."""


@dataclass(slots=True)
class ReconnectBackOff:
    """Schedule of reconnection attempts: at once, after 0.5 s, then doubling up to 5 s. Times are in s."""

    due: float = 0.0
    _pause: float = field(default=_RETRY_S)

    def connection_lost(self, now: float) -> None:
        """The connection was lost: the first attempt is due at once."""
        self.due = now

    def attempt_failed(self, started_s: float) -> None:
        """An attempt that started at ``started_s`` has failed."""
        self.due = started_s + self._pause
        self._pause = min(2.0 * self._pause, _MAX_RETRY_S)

    def frame_received(self) -> None:
        """A frame has arrived: reset the pause."""
        self._pause = _RETRY_S


@dataclass(slots=True)
class FrameNumbering:
    """Strictly increasing frame numbers across reconnections and counter resets; missed frames leave a gap."""

    _last: int = -1
    _last_ns: int = 0
    _offset: int = 0
    _first: tuple[int, int] | None = None
    _period_ns: float = 0.0

    def next(self, number: int, time_ns: int, fps: float) -> int:
        """The number of a frame that its source numbers ``number``, taken at ``time_ns``."""
        number += self._offset
        if self._first is None and self._last >= 0:
            period = self._period_ns or (NANOSECONDS / fps if fps > 0.0 else 0.0)
            periods = max(round((time_ns - self._last_ns) / period), 1) if period > 0.0 else 1
            self._offset += self._last + periods - number
            number = self._last + periods
        elif number <= self._last:  # the source's counter was reset without a reconnection
            self._offset += self._last + 1 - number
            number = self._last + 1
        if self._first is None:
            self._first = number, time_ns
        self._last, self._last_ns = number, time_ns
        return number

    def connection_lost(self) -> None:
        """The connection was lost; keep its measured frame period to count the missed frames later."""
        if self._first is not None and self._last > self._first[0]:
            self._period_ns = (self._last_ns - self._first[1]) / (self._last - self._first[0])
        self._first = None


class ReconnectingCamera:
    """A camera behind a connection that may break; see ``edge.devices.base.Device``.

    name: for messages, without passwords. connect: opens the camera; raises InputError where it does not answer.
    describe: the camera's description, given its connection and the image's width and height. intrinsics: of the
    camera; ``open`` raises InputError where they are for another size.
    now_ns: a monotonic clock; sleep: used between reconnection attempts.
    """

    def __init__(
        self,
        name: str,
        connect: Callable[[], Connection],
        describe: Callable[[Any, int, int], DeviceInfo],
        intrinsics: Intrinsics | None = None,
        *,
        remedy: str = "check cable, power and address",
        now_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._name = name
        self._connect = connect
        self._describe, self._intrinsics = describe, intrinsics
        self._remedy = remedy
        self._now_ns, self._sleep = now_ns, sleep
        self._connection: Connection | None = None
        self._info: DeviceInfo | None = None
        self._first: Frame | None = None
        self._numbers = FrameNumbering()
        self._back_off = ReconnectBackOff()
        self._awaiting_frame = False  # reconnected, but no frame has come yet
        self._awaiting_since_s = 0.0
        self.ended = False
        self.reconnections = 0

    @property
    def info(self) -> DeviceInfo:
        """The driver's description, with the size of the first frame."""
        if self._info is None:
            raise RuntimeError("open the camera first")
        return self._info

    @property
    def disconnected(self) -> bool:
        """Whether the connection is lost; every ``read`` then tries to reconnect."""
        return self._info is not None and not self.ended and (self._connection is None or self._awaiting_frame)

    @property
    def temperature(self) -> float | None:
        """Temperature of the sensor or board [°C]; None where it is not available."""
        return getattr(self._connection, "temperature", None)

    def open(self) -> None:
        """Connect and wait for the first frame. Raises InputError if the camera does not answer or gives no frame."""
        self._connection = self._connect()
        self.ended = False
        started_s = self._now_s()
        first: Frame | None = None
        try:
            while first is None and self._now_s() - started_s < _FIRST_FRAME_S:
                first = self._connection.take(0.5)
            if first is None:
                raise InputError(f"{self._name} gives no frame", remedy=self._remedy)
            height, width = first.image.shape[:2]
            check_size(self._intrinsics, width, height, self._name)
            self._info = replace(self._describe(self._connection, width, height), intrinsics=self._intrinsics)
        except ConnectionLost:
            self.close()
            raise InputError(f"{self._name} gives no frame", remedy=self._remedy) from None
        except InputError:
            self.close()
            raise
        self._first = self._numbered(first)

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame; None while the camera is disconnected: then a reconnection is tried when it is due.

        Raises InputError where the reconnected camera has another image size.
        """
        if self.ended or self._info is None:
            return None
        if self._first is not None:
            first, self._first = self._first, None
            return first
        if self._connection is None:
            self._reconnect(timeout_s)
            return None
        try:
            frame = self._connection.take(timeout_s)
        except ConnectionLost:
            self._drop_connection()
            return None
        if frame is None:
            if self._awaiting_frame and self._now_s() - self._awaiting_since_s > _FIRST_FRAME_S:
                self._drop_connection()  # it answers, but gives no frame
                self._back_off.attempt_failed(self._now_s())
            return None
        height, width = frame.image.shape[:2]
        if (width, height) != (self._info.width, self._info.height):
            raise InputError(
                f"{self._name} came back as {width}x{height}, it was {self._info.width}x{self._info.height}",
                remedy="plug the same camera in, or start its agent again",
            )
        if self._awaiting_frame:
            self._awaiting_frame = False
            self.reconnections += 1
        self._back_off.frame_received()
        return self._numbered(frame)

    def close(self) -> None:
        """Release the camera."""
        self._release()
        self.ended = True

    def _numbered(self, frame: Frame) -> Frame:
        fps = 0.0 if self._info is None else self._info.fps
        number = self._numbers.next(frame.frame, frame.device_time_ns, fps)
        return replace(frame, frame=number)

    def _release(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _drop_connection(self) -> None:
        self._release()
        self._numbers.connection_lost()
        self._awaiting_frame = False
        self._back_off.connection_lost(self._now_s())

    def _reconnect(self, timeout_s: float) -> None:
        wait = self._back_off.due - self._now_s()
        if wait > 0.0:
            self._sleep(min(timeout_s, wait))
            return
        started_s = self._now_s()
        try:
            self._connection = self._connect()
        except InputError:
            self._back_off.attempt_failed(started_s)
            return
        self._awaiting_frame, self._awaiting_since_s = True, self._now_s()

    def _now_s(self) -> float:
        return self._now_ns() / NANOSECONDS


def redact_password(source: str | int) -> str:
    """A source without user and password, for error messages and logs."""
    text = str(source)
    if "://" not in text or "@" not in text:
        return text
    scheme, rest = text.split("://", 1)
    return f"{scheme}://…@{rest.rsplit('@', 1)[1]}"
