"""The time by which simulated and recorded sources deliver: real, or as fast as the machine goes.

Time comes in from outside, so that tests run a minute of video in milliseconds, and so that the
processes of a demo agree on what is when.
"""

from __future__ import annotations

import time
from typing import Protocol


class Pace(Protocol):
    """A clock that can be waited on [s]. Its zero is the true time 0 of a simulated world."""

    def now(self) -> float:
        """The time now [s]."""

    def sleep(self, seconds: float) -> None:
        """Return once ``seconds`` have passed on this clock."""


class RealTime:
    """The machine's time, counted from ``epoch_unix_s``.

    epoch_unix_s: Unix time [s] of zero. Processes given the same epoch agree to within what their
    machines' clocks agree; the clock is read once and then counted by the monotonic clock, so that a step of
    the system time does not tear a running world apart.
    """

    def __init__(self, epoch_unix_s: float) -> None:
        self._ahead = time.time() - epoch_unix_s - time.monotonic()

    def now(self) -> float:
        return time.monotonic() + self._ahead

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            time.sleep(seconds)


class AsFastAsPossible:
    """A clock that stands still except while somebody sleeps on it: every wait is over at once.

    start: the time [s] at which it stands first.
    """

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        self._now += max(seconds, 0.0)
