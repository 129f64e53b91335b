"""The playback clock of simulated and recorded sources, real time or as fast as possible.

The clock is passed in, so that tests run a minute of video in milliseconds, and so that the processes of a demo share
one time.
"""

from __future__ import annotations

import time
from typing import Protocol


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
