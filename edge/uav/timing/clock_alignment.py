"""Alignment of telemetry to the camera's clock: host arrival times and the visually observed rotation.

The host knows when frames arrive and, by round trips, the vehicle's clock. The remaining delays (exposure, transfer,
the autopilot's filter) are constant; their sum is estimated from the camera's rotation against the attitude.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from edge.uav.base import Image, Telemetry
from edge.uav.timing.telemetry_offset import OffsetEstimate, find_offset
from edge.uav.timing.visual_rotation import VisualRotationEstimator
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

_DELAY_BUFFER = 900
_SEARCH_HALF_WIDTH_S = 0.7
_WINDOW_S = 24.0
_FIRST_SOLVE_S, _SOLVE_EVERY_S = 6.0, 2.0
_GOOD_STD_S = 0.003  # precise enough to pause the estimation
_PAUSE_S = 60.0
_MAX_CHANGE_WHILE_TRACKING_S = 0.015  # a larger change of the offset is not applied while a tracker uses it
_LATE_NS = 2 * NANOSECONDS  # a frame that is later was stamped by another clock
_CONFIRMING_FRAMES = 8  # a quarter of a second at 30 fps; of frames that queued up, at most five agree
_CLOCK_STEP_S = 0.15  # a larger step invalidates the delays collected so far


class CameraHostClock:
    """The camera's clock against the host's: the minimum of recent arrival delays. Times in ns. steps: clock steps.

    A single frame never moves it: what contradicts the delays so far is left out, until frames in a row agree.
    """

    def __init__(self) -> None:
        self._delays: deque[int] = deque(maxlen=_DELAY_BUFFER)
        self._contradicting: list[int] = []
        self.steps = 0

    def handle_frame(self, device_ns: int, arrival_ns: int) -> None:
        """Add a frame stamped ``device_ns`` that arrived at ``arrival_ns``."""
        delay = arrival_ns - device_ns
        if self._delays:
            step = round(_CLOCK_STEP_S * NANOSECONDS)
            later = delay - min(self._delays)
            if later < -step or later > _LATE_NS:
                if self._contradicting and abs(delay - self._contradicting[0]) > step:
                    self._contradicting.clear()  # also frames that queued up, each less late than the one before
                self._contradicting.append(delay)
                if len(self._contradicting) < _CONFIRMING_FRAMES:
                    return
                self._delays.clear()
                self._delays.extend(self._contradicting)
                self.steps += 1
        self._contradicting.clear()
        self._delays.append(delay)

    def camera_ns(self, host_ns: int) -> int | None:
        """Camera time of a host time; None before the first frame."""
        return host_ns - min(self._delays) if self._delays else None


class ClockAligner:
    """Estimates telemetry time − camera time for samples on the camera's clock up to a constant offset.

    size, lens: of the camera. body_from_camera: (3, 3). The estimate is only replaced by a better one.
    estimate: the current one, or None; reason: why there is none.
    """

    def __init__(self, size: tuple[int, int], lens: Intrinsics, body_from_camera: Floats) -> None:
        self._mounting = np.asarray(body_from_camera, np.float64)
        self._visual = VisualRotationEstimator(size, lens, keep=round(_WINDOW_S * 60.0))
        self._samples: deque[Telemetry] = deque(maxlen=round(_WINDOW_S * 100.0))
        self._collecting_since: float | None = None
        self._next_solve_s = -float("inf")
        self._paused_until_s = -float("inf")
        self.estimate: OffsetEstimate | None = None
        self.reason = "too few images and samples so far"

    @property
    def offset_s(self) -> float:
        """The current offset estimate; 0 at first."""
        return 0.0 if self.estimate is None else self.estimate.offset

    def handle_sample(self, sample: Telemetry) -> None:
        """Add a telemetry sample whose time is not yet corrected by this offset."""
        if self._samples and sample.time <= self._samples[-1].time:
            return
        self._samples.append(sample)

    def handle_frame(self, image: Image | None, time: float, tracking: bool) -> None:
        """Add an image of camera time ``time`` [s]. tracking: a tracker uses the present offset."""
        if time < self._paused_until_s or not self._samples:
            return
        tilt = self._mounting.T @ self._samples[-1].ned_from_body.T
        self._visual.update(image, time, tilt)
        if self._collecting_since is None:
            self._collecting_since = time
        if time - self._collecting_since < _FIRST_SOLVE_S or time < self._next_solve_s:
            return
        self._next_solve_s = time + _SOLVE_EVERY_S
        self._solve(time, tracking)

    def reset(self) -> None:
        """Discard everything: a clock was restarted."""
        self._visual.reset()
        self._samples.clear()
        self._collecting_since = self.estimate = None
        self._paused_until_s = self._next_solve_s = -float("inf")
        self.reason = "too few images and samples so far"

    def _solve(self, time: float, tracking: bool) -> None:
        rotations = self._visual.relative_rotations()
        recent = (rotations.starts > time - _WINDOW_S) & (rotations.ends < time + _WINDOW_S)
        rotations = type(rotations)(rotations.starts[recent], rotations.ends[recent], rotations.vectors[recent])
        samples = [sample for sample in self._samples if abs(sample.time - time) < _WINDOW_S + 2.0]
        result = find_offset(rotations, samples, self._mounting, (-_SEARCH_HALF_WIDTH_S, _SEARCH_HALF_WIDTH_S))
        if isinstance(result, str):
            self.reason = result
            return
        self.reason = ""
        previous = self.estimate
        better = (
            previous is None
            or result.std < 1.2 * previous.std
            or abs(result.offset - previous.offset) > 4.0 * previous.std
        )
        change = 0.0 if previous is None else abs(result.offset - previous.offset)
        if better and not (tracking and previous is not None and change > _MAX_CHANGE_WHILE_TRACKING_S):
            self.estimate = result
        if result.std < _GOOD_STD_S and time - (self._collecting_since or time) > 0.8 * _WINDOW_S:
            self._paused_until_s = time + _PAUSE_S
            self._collecting_since = None
            self._visual.reset()
