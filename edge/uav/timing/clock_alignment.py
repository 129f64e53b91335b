"""Telemetry onto the camera's clock: the host's clock between them, and what the pictures say of the rest.

The host knows when frames arrive and, by round trips, the vehicle's clock. What is left (delays of exposure, of the
wire, of the autopilot's filter) is constant; it is found from the camera's turning against the attitude.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from edge.uav.timing.telemetry_offset import Offset, find_offset
from edge.uav.timing.visual_rotation import SeenTurning
from edge.uav.tracker import Image, Telemetry
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

_ARRIVALS = 900
_SEARCH_S = 0.7
_WINDOW_S = 24.0
_FIRST_S, _EVERY_S = 6.0, 2.0
_GOOD_STD_S = 0.003  # good enough to stop looking for a while
_REST_S = 60.0
_CAREFUL_S = 0.015  # by more than this the map is not moved under a tracker that works with it
_STEP_S = 0.15  # by more, and what was known is void


class CameraHostClock:
    """The camera's clock against the host's: the quickest arrival of late is the least delayed. Times in ns."""

    def __init__(self) -> None:
        self._delays: deque[int] = deque(maxlen=_ARRIVALS)
        self.steps = 0

    def handle_frame(self, device_ns: int, arrival_ns: int) -> None:
        """Take a frame stamped ``device_ns`` that came at ``arrival_ns``."""
        delay = arrival_ns - device_ns
        if self._delays and delay < min(self._delays) - round(_STEP_S * NANOSECONDS):
            self._delays.clear()  # the camera's clock began anew, ahead
            self.steps += 1
        elif len(self._delays) >= 30 and delay - min(self._delays) > 2 * NANOSECONDS:
            self._delays.clear()
            self.steps += 1
        self._delays.append(delay)

    def camera_ns(self, host_ns: int) -> int | None:
        """The camera's time of a time of the host; None before the first frame."""
        return host_ns - min(self._delays) if self._delays else None


class Aligner:
    """Finds telemetry time − camera time of samples that are on the camera's clock but for a constant.

    size, lens: the camera's. body_from_camera: (3, 3). The answer moves only as it gets better.
    """

    def __init__(self, size: tuple[int, int], lens: Intrinsics, body_from_camera: Floats) -> None:
        self._mounting = np.asarray(body_from_camera, np.float64)
        self._seen = SeenTurning(size, lens, keep=round(_WINDOW_S * 60.0))
        self._samples: deque[Telemetry] = deque(maxlen=round(_WINDOW_S * 100.0))
        self._began: float | None = None
        self._next_s = -float("inf")
        self._rest_until_s = -float("inf")
        self.found: Offset | None = None
        self.why = "not enough was seen yet"

    @property
    def offset_s(self) -> float:
        """The best that is known; 0 at first."""
        return 0.0 if self.found is None else self.found.offset

    def handle_sample(self, sample: Telemetry) -> None:
        """Take a sample as it would be without this offset."""
        if self._samples and sample.time <= self._samples[-1].time:
            return
        self._samples.append(sample)

    def handle_frame(self, image: Image | None, time: float, busy: bool) -> None:
        """Take a picture of camera time ``time`` [s]. busy: a tracker works with the present map."""
        if time < self._rest_until_s or not self._samples:
            return
        tilt = self._mounting.T @ self._samples[-1].ned_from_body.T
        self._seen.update(image, time, tilt)
        if self._began is None:
            self._began = time
        if time - self._began < _FIRST_S or time < self._next_s:
            return
        self._next_s = time + _EVERY_S
        self._solve(time, busy)

    def clear(self) -> None:
        """A clock began anew: nothing of before counts."""
        self._seen.clear()
        self._samples.clear()
        self._began = self.found = None
        self._rest_until_s = self._next_s = -float("inf")
        self.why = "not enough was seen yet"

    def _solve(self, time: float, busy: bool) -> None:
        turning = self._seen.turning()
        recent = turning.begins > time - _WINDOW_S
        turning = type(turning)(turning.begins[recent], turning.ends[recent], turning.turns[recent])
        samples = [sample for sample in self._samples if sample.time > time - _WINDOW_S - 2.0]
        answer = find_offset(turning, samples, self._mounting, (-_SEARCH_S, _SEARCH_S))
        if isinstance(answer, str):
            self.why = answer
            return
        self.why = ""
        old = self.found
        better = old is None or answer.std < 1.2 * old.std or abs(answer.offset - old.offset) > 4.0 * old.std
        moved = 0.0 if old is None else abs(answer.offset - old.offset)
        if better and not (busy and old is not None and moved > _CAREFUL_S):
            self.found = answer
        if answer.std < _GOOD_STD_S and time - (self._began or time) > 0.8 * _WINDOW_S:
            self._rest_until_s = time + _REST_S
            self._began = None
            self._seen.clear()
