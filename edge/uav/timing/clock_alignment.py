"""Alignment of telemetry to the camera's clock: host arrival times and the visually observed rotation.

The host knows when frames arrive and, by round trips, the vehicle's clock. The remaining delays (exposure, transfer,
the autopilot's filter) are constant; their sum is estimated from the camera's rotation against the attitude.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from edge.uav.base import Telemetry
from edge.uav.timing import ground_motion
from edge.uav.timing.telemetry_offset import CONTRADICTION, OUTSIDE, OffsetEstimate, find_offset
from edge.uav.timing.visual_rotation import VisualRotationEstimator
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats, Image

_DELAY_BUFFER = 900  # frames: half a minute at 30 fps, of which one arrives with little delay
_SEARCH_HALF_WIDTH_S = 0.7  # wider than telemetry_track's MAX_OFFSET_S: a maximum at the window's end is refused
_WINDOW_S = 24.0  # of rotation: oscillators drift by at most 2.4 ms in it (1e-4), less than _GOOD_STD_S
_FIRST_SOLVE_S, _SOLVE_EVERY_S = 6.0, 2.0  # three times the least overlap; a solution costs a correlation
_GOOD_STD_S = 0.003  # precise enough to pause the estimation
_PAUSE_S = 60.0  # in which oscillators drift by at most 6 ms
_MAX_CHANGE_WHILE_TRACKING_S = 0.015  # a larger change of the offset is not applied while a tracker uses it
_CONFIRMING_FRAMES = 8  # a quarter of a second at 30 fps
_CLOCK_STEP_NS = 150_000_000  # a smaller step of the clock cannot be distinguished from delays

_CONTRADICTIONS = (CONTRADICTION, ground_motion.CONTRADICTION)


class CameraHostClock:
    """The camera's clock against the host's: the minimum of recent arrival delays. Times in ns.

    Where the camera's clock is set, its time goes on as before, so that no estimator sees it jump; steps: how often. A
    single wrong stamp, or frames that queue up, never move it.
    """

    def __init__(self) -> None:
        self._delays: deque[int] = deque(maxlen=_DELAY_BUFFER)
        self._jumped: list[int] = []
        self._shift = self._newest_arrival = 0
        self._newest = -(2**63)
        self.steps = 0

    def handle_frame(self, device_ns: int, arrival_ns: int) -> int:
        """Add a frame stamped ``device_ns`` that arrived at ``arrival_ns``. Returns its time, later than all before."""
        time = device_ns + self._shift
        delay = arrival_ns - time
        correction = self._correction(time, delay, arrival_ns) if self._delays else 0
        if not correction:
            self._jumped.clear()
            self._delays.append(delay)
        elif len(self._jumped) >= _CONFIRMING_FRAMES:
            self._shift += correction
            self._jumped.clear()
            self.steps += 1
        self._newest = max(time + correction, self._newest + 1)
        self._newest_arrival = arrival_ns
        return self._newest

    def _correction(self, time: int, delay: int, arrival_ns: int) -> int:
        """What a frame's time lacks if the clock was set since the last frame, or the stamp is wrong; 0 if neither."""
        agrees = bool(self._jumped) and abs(delay - self._jumped[0]) <= _CLOCK_STEP_NS
        ahead = time - self._newest - (arrival_ns - self._newest_arrival)
        if abs(delay - min(self._delays)) <= _CLOCK_STEP_NS or not (
            agrees or time <= self._newest or ahead > _CLOCK_STEP_NS
        ):
            return 0
        if not agrees:
            self._jumped.clear()
        self._jumped.append(delay)
        return min(self._jumped) - min(self._delays)

    def camera_ns(self, host_ns: int) -> int | None:
        """Camera time of a host time; None before the first frame."""
        return host_ns - min(self._delays) if self._delays else None


class ClockAligner:
    """Estimates telemetry time − camera time for samples on the camera's clock up to a constant offset.

    size, lens: of the camera. body_from_camera: (3, 3). The estimate is only replaced by a better one.
    estimate: the current one, or None; reason: why there is none.
    """

    def __init__(self, size: tuple[int, int], lens: Intrinsics, body_from_camera: Floats) -> None:
        # For find_offset: its first import takes 2 s, in which no image would be processed in flight.
        import scipy.interpolate
        import scipy.spatial.transform  # noqa: F401

        self._mounting = np.asarray(body_from_camera, np.float64)
        self._visual = VisualRotationEstimator(size, lens, keep=round(_WINDOW_S * 60.0))
        self._samples: deque[Telemetry] = deque(maxlen=round(_WINDOW_S * 100.0))
        self._collecting_since: float | None = None
        self._next_solve_s = -float("inf")
        self._paused_until_s = -float("inf")
        self.estimate: OffsetEstimate | None = None
        self.reason = "too few images and samples so far"

    @property
    def contradicted(self) -> bool:
        """Whether the images show another motion than the telemetry: of another mounting, camera or convention."""
        return self.reason.startswith(_CONTRADICTIONS)

    @property
    def wrong_motion(self) -> str:
        """That heading, or height above the ground, are not those of the images; "" where they are."""
        motion = None if self.estimate is None else self.estimate.motion
        return "" if motion is None else motion.wrong_heading or motion.wrong_height

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
        rotations = rotations.part(recent)
        samples = [sample for sample in self._samples if abs(sample.time - time) < _WINDOW_S + 2.0]
        result = find_offset(rotations, samples, self._mounting, (-_SEARCH_HALF_WIDTH_S, _SEARCH_HALF_WIDTH_S))
        if isinstance(result, str):
            late = f"{CONTRADICTION} at that time: they come more than {_SEARCH_HALF_WIDTH_S} s late"
            reason = late if result == OUTSIDE else result
            if not self.contradicted or reason.startswith(
                _CONTRADICTIONS
            ):  # a hover shows nothing, and takes none back
                self.reason = reason
            return
        moves = result.motion is not None and result.motion.agrees_in_shape
        if self.reason.startswith(ground_motion.CONTRADICTION) and not moves:
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
