"""The playback clock of simulated and recorded sources, real time or as fast as possible; recordings played by it.

The clock is passed in, so that tests run a minute of video in milliseconds, and so that the processes of a demo share
one time.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Protocol

from edge.devices.base import DeviceInfo, Frame
from protocols.core.clocks import NANOSECONDS


class PlaybackClock(Protocol):
    """A clock that can be waited on [s]. Its zero is the true time 0 of a simulated scene."""

    def now(self) -> float:
        """The present time [s]."""

    def sleep(self, seconds: float) -> None:
        """Return once ``seconds`` have passed on this clock."""


def wait_until(clock: PlaybackClock, moment: float, timeout_s: float) -> bool:
    """Sleep until a moment of the clock [s], at most ``timeout_s``; whether it has come."""
    wait = moment - clock.now()
    clock.sleep(min(wait, timeout_s))
    return wait <= timeout_s


class RealTime:
    """The machine's time, counted from ``epoch_unix_s``.

    epoch_unix_s: Unix time [s] of zero. Processes with the same epoch agree as well as their machines' clocks do. The
    system clock is read once and then extrapolated by the monotonic clock, so that a step of the system time has no
    effect on a running simulation.
    """

    def __init__(self, epoch_unix_s: float) -> None:
        self._ahead = time.time() - epoch_unix_s - time.monotonic()

    def now(self) -> float:
        return time.monotonic() + self._ahead

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            time.sleep(seconds)


class Playback:
    """A recording as a device: its ``_frames`` in order, each once it is due on the clock; base of all recordings.

    playback_clock: the clock for playback in real time; None = as fast as possible.
    """

    def __init__(self, playback_clock: PlaybackClock | None = None) -> None:
        self._playback_clock = playback_clock
        self._info: DeviceInfo | None = None
        self._frames: Iterator[Frame] = iter(())
        self._pending: Frame | None = None
        self._start_s: float | None = None  # playback clock time of device time 0
        self.ended = False

    @property
    def info(self) -> DeviceInfo:
        """Description with the size of the first image; the exposure is not known."""
        if self._info is None:
            raise RuntimeError("open the recording first")
        return self._info

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, once it is due on the playback clock."""
        if self.ended or self._info is None:
            return None
        frame = self._pending = self._pending or next(self._frames, None)
        if frame is None:
            self.ended = True
        elif self._playback_clock is not None:
            time_s = frame.device_time_ns / NANOSECONDS
            if self._start_s is None:
                self._start_s = self._playback_clock.now() - time_s
            if not wait_until(self._playback_clock, self._start_s + time_s, timeout_s):
                return None
        self._pending = None
        return frame

    def close(self) -> None:
        """Release the file. May be called twice."""
        self._frames = iter(())
        self.ended = True
