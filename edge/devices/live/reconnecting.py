"""A live camera that comes back by itself after it was unplugged: what all drivers of real cameras share.

A driver says how to connect and how to take a picture from a connection; this says when to try again, how frame
numbers go on, and what of it is a gap.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

from edge.devices.base import DeviceInfo, Frame
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError

_RETRY_S, _SLOWEST_RETRY_S = 0.5, 5.0
_FIRST_FRAME_S = 10.0


class Gone(Exception):
    """The connection is lost, and is to be made anew."""


class Connection(Protocol):
    """An open camera."""

    def take(self, timeout_s: float) -> Frame | None:
        """The next picture, numbered as the source counts; None where none came. Raises Gone."""

    def close(self) -> None:
        """Release it; may be called of a camera that is gone."""


@dataclass(slots=True)
class BackOff:
    """When to try again: at once, after 0.5 s, and then ever more slowly, at last each 5 s. Times are s."""

    due: float = 0.0
    _pause: float = field(default=_RETRY_S)

    def lost(self, now: float) -> None:
        """The connection is gone: try at once."""
        self.due = now

    def failed(self, began: float) -> None:
        """A try that began then was in vain."""
        self.due = began + self._pause
        self._pause = min(2.0 * self._pause, _SLOWEST_RETRY_S)

    def good(self) -> None:
        """A picture has come."""
        self._pause = _RETRY_S


@dataclass(slots=True)
class FrameNumbers:
    """Numbers that only rise, also where a camera counts anew after a reconnection; what it missed is a gap."""

    _last: int = -1
    _last_ns: int = 0
    _shift: int = 0
    _first: tuple[int, int] | None = None
    _period_ns: float = 0.0

    def next(self, number: int, moment_ns: int, fps: float) -> int:
        """The number of a picture that its source calls ``number``, taken at ``moment_ns``."""
        number += self._shift
        if self._first is None and self._last >= 0:
            period = self._period_ns or (NANOSECONDS / fps if fps > 0.0 else 0.0)
            passed = max(round((moment_ns - self._last_ns) / period), 1) if period > 0.0 else 1
            self._shift += self._last + passed - number
            number = self._last + passed
        elif number <= self._last:  # a source that counts anew without having been away
            self._shift += self._last + 1 - number
            number = self._last + 1
        if self._first is None:
            self._first = number, moment_ns
        self._last, self._last_ns = number, moment_ns
        return number

    def broken(self) -> None:
        """The connection is gone; the rate that it had tells later how much was missed."""
        if self._first is not None and self._last > self._first[0]:
            self._period_ns = (self._last_ns - self._first[1]) / (self._last - self._first[0])
        self._first = None


class ReturningCamera:
    """A camera behind a connection that may break; see ``edge.devices.base.Device``.

    name: for a person, without passwords. connect: opens the camera; raises InputError where it does not answer.
    describe: what the driver knows once the first picture is there; raises InputError where that does not fit.
    now_ns: a monotonic clock; sleep: for trying again.
    """

    def __init__(
        self,
        name: str,
        connect: Callable[[], Connection],
        describe: Callable[[Connection, Frame], DeviceInfo],
        *,
        remedy: str = "check cable, power and address",
        now_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._name = name
        self._connect = connect
        self._describe = describe
        self._remedy = remedy
        self._now_ns, self._sleep = now_ns, sleep
        self._connection: Connection | None = None
        self._info: DeviceInfo | None = None
        self._first: Frame | None = None
        self._numbers = FrameNumbers()
        self._back_off = BackOff()
        self._fresh = False  # reconnected, and no picture has come yet
        self._fresh_s = 0.0
        self._ended = False
        self.reconnections = 0

    @property
    def info(self) -> DeviceInfo:
        """What the driver knows; size as the first picture has it."""
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
        return self._info is not None and not self._ended and (self._connection is None or self._fresh)

    @property
    def temperature(self) -> float | None:
        """Of sensor or board [°C]; None where it does not tell."""
        return getattr(self._connection, "temperature", None)

    def open(self) -> None:
        """Raises InputError where the camera does not answer, or gives no picture."""
        self._connection = self._connect()
        self._ended = False
        began = self._now_s()
        first: Frame | None = None
        try:
            while first is None and self._now_s() - began < _FIRST_FRAME_S:
                first = self._connection.take(0.5)
            if first is None:
                raise InputError(f"{self._name} gives no picture", remedy=self._remedy)
            self._info = self._describe(self._connection, first)
        except Gone:
            self.close()
            raise InputError(f"{self._name} gives no picture", remedy=self._remedy) from None
        except InputError:
            self.close()
            raise
        self._first = self._numbered(first)

    def read(self, timeout_s: float) -> Frame | None:
        """The next picture; None while the camera is away, which is then tried again.

        Raises InputError where it comes back with another picture size.
        """
        if self._ended or self._info is None:
            return None
        if self._first is not None:
            first, self._first = self._first, None
            return first
        if self._connection is None:
            self._reconnect(timeout_s)
            return None
        try:
            frame = self._connection.take(timeout_s)
        except Gone:
            self._lose()
            return None
        if frame is None:
            if self._fresh and self._now_s() - self._fresh_s > _FIRST_FRAME_S:
                self._lose()  # it answers, but shows nothing
                self._back_off.failed(self._now_s())
            return None
        height, width = frame.image.shape[:2]
        if (width, height) != (self._info.width, self._info.height):
            raise InputError(
                f"{self._name} came back as {width}x{height}, it was {self._info.width}x{self._info.height}",
                remedy="plug the same camera in, or start its agent again",
            )
        if self._fresh:
            self._fresh = False
            self.reconnections += 1
        self._back_off.good()
        return self._numbered(frame)

    def close(self) -> None:
        """Release the camera."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()
        self._ended = True

    def _numbered(self, frame: Frame) -> Frame:
        fps = 0.0 if self._info is None else self._info.fps
        number = self._numbers.next(frame.frame, frame.device_time_ns, fps)
        return replace(frame, frame=number)

    def _lose(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()
        self._numbers.broken()
        self._fresh = False
        self._back_off.lost(self._now_s())

    def _reconnect(self, timeout_s: float) -> None:
        wait = self._back_off.due - self._now_s()
        if wait > 0.0:
            self._sleep(min(timeout_s, wait))
            return
        began = self._now_s()
        try:
            self._connection = self._connect()
        except InputError:
            self._back_off.failed(began)
            return
        self._fresh, self._fresh_s = True, self._now_s()

    def _now_s(self) -> float:
        return self._now_ns() / NANOSECONDS


def without_password(source: str | int) -> str:
    """A source as it may stand in an error or a log."""
    text = str(source)
    if "://" not in text or "@" not in text:
        return text
    scheme, rest = text.split("://", 1)
    return f"{scheme}://…@{rest.rsplit('@', 1)[1]}"
