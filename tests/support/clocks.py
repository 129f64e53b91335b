"""Clocks of tests."""

from __future__ import annotations


class AsFastAsPossible:
    """A playback clock that advances only by ``sleep``, which returns at once. start: its initial time [s]."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        self._now += max(seconds, 0.0)
