"""The base of all recordings that are played as devices."""

from __future__ import annotations

from collections.abc import Iterator

from edge.devices.base import DeviceInfo, Frame
from edge.devices.playback.playback_clock import PlaybackClock, wait_until
from protocols.core.clocks import NANOSECONDS


class Playback:
    """A recording as a device: its ``_frames`` in order, each once it is due on the clock.

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
