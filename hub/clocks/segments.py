"""Clock segments: observations labelled by segment, time maps moved to the present segment, and alarms.

A clock whose rate changed is a piecewise-linear map: new time stamps expressed on the clock before the change.
Until there are enough observations to calibrate the new clock segment, the previous one stays in use: new time stamps
are converted to what the previous clock would have shown, by the step and the rate change that arrival times give
(`hub.clocks.change_detector`). The previous time map is then supported by rows up to the present and need not be
extrapolated. The rows between the onset and its detection were stamped by the changed clock; they are corrected too.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from hub.clocks.change_detector import ClockChange, ClockChangeDetector
from protocols.core.clocks import TimeMap
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration

SEGMENT_MIN_ROWS = 600
"""Detections in a new segment from which on it is calibrated by itself; until then the moved map is more precise."""
_MAX_ALARMS = 32  # a status has room for as many
_MAX_CHANGES = 64
"""Changes of one camera's clock; who has more has no clock, and is no longer watched."""

_SECOND_NS = 1_000_000_000  # ns
_TIME_TOLERANCE_S = 1e-5
"""More than rounding, less than a frame interval."""


class ClockSegments:
    """Applies the clock change detector to observations before they reach the solver."""

    def __init__(self) -> None:
        self._detector = ClockChangeDetector()
        self._runs: dict[str, str] = {}
        self._alarms: dict[str, str | ClockChange] = {}
        self._changes: Counter[str] = Counter()

    def assign(
        self, message: pb.Observation, arrival: float | None, *, waited: bool = False
    ) -> tuple[pb.Observation, ClockChange | None]:
        """The observation with its clock segment as boot id, and the clock change that begins with it, if any.

        arrival, waited: as of `ClockChangeDetector.handle`.
        """
        camera, boot = message.camera, message.boot_id
        if self._changes.get(camera, 0) >= _MAX_CHANGES:
            return message, None
        segment, change = self._detector.handle(
            camera, boot, message.sequence, message.frame, message.device_time_ns, arrival, waited=waited
        )
        self._runs[camera] = boot
        if change is not None:
            self._changes[camera] += 1
        if change is not None and len(self._alarms) < _MAX_ALARMS:
            step = f"the clock of {camera} stepped by {change.step_s:+.3f} s"
            self._alarms[camera] = step if change.kind == "step" else change
        if segment == boot:
            return message, change
        relabelled = pb.Observation()
        relabelled.CopyFrom(message)
        relabelled.boot_id = segment
        return relabelled, change

    @property
    def alarms(self) -> dict[str, str]:
        """By camera, its last step or rate change; none for a rate change that the seconds after did not confirm."""
        out = {}
        for camera, alarm in self._alarms.items():
            if isinstance(alarm, str):
                out[camera] = alarm
                continue
            rate = (self._detector.change_into(alarm.segment) or alarm).rate_change
            if rate:
                out[camera] = f"the clock of {camera} drifts {1e6 * rate:+.0f} ppm"
        return out

    def report_step(self, camera: str, size: float) -> None:
        """Raise the alarm for a step [s] that the images show, smaller than one that the stamps would."""
        if camera in self._alarms or len(self._alarms) < _MAX_ALARMS:
            self._alarms[camera] = f"the clock of {camera} stepped by {size:+.3f} s"

    def to_present(
        self, calibration: Calibration, boots: Mapping[str, str], until: Mapping[str, str] | None = None
    ) -> tuple[Calibration, dict[str, str]]:
        """The calibration with every time map moved to its clock's present segment, and the names of these segments.

        boots: segments of the maps that are given. until: segments to stop at, by camera.
        t_old = t_new - step - rate_change * (t_new - detected_at), from the time of detection on; the variance of the
        step is added to the offset's and to the lag's.
        """
        cameras, names = dict(calibration.cameras), dict(boots)
        for name, camera in calibration.cameras.items():
            rate, offset = camera.time_map.clock_rate, camera.time_map.time_offset
            stds, lag_time = (camera.time_offset_std, camera.lag_std), camera.lag_time
            for change in self._detector.changes_since(name, boots.get(name, "")):
                if until is not None and names.get(name) == until.get(name):
                    break
                offset -= rate * (change.step_s - change.rate_change * change.detected_at_s)
                rate *= 1.0 - change.rate_change
                lag_time += change.step_s
                stds = math.hypot(stds[0], change.step_std_s), math.hypot(stds[1], change.step_std_s)
                names[name] = change.segment
            if names.get(name) != boots.get(name):
                time_map = TimeMap(time_offset=offset, clock_rate=rate)
                cameras[name] = replace(
                    camera, time_map=time_map, time_offset_std=stds[0], lag_time=lag_time, lag_std=stds[1]
                )
        return replace(calibration, cameras=cameras), names

    def first_segment(self, segment: str) -> str:
        """The segment in which the run of the camera's agent began that ``segment`` is of."""
        change = self.change_into(segment)
        return segment if change is None else self.first_segment(change.previous_segment)

    def change_into(self, segment: str) -> ClockChange | None:
        """The change that began ``segment``, in its present estimate; None if no change did."""
        return self._detector.change_into(segment)

    def rates_ppm(self) -> dict[str, float]:
        """Rate of the hub's clock relative to each camera's over the last seconds, less 1 [ppm]."""
        rates = {camera: self._detector.relative_rate(camera, boot) for camera, boot in self._runs.items()}
        return {camera: 1e6 * rate for camera, rate in rates.items() if rate is not None}


@dataclass(frozen=True, slots=True)
class RateChange:
    """From ``onset_s`` [s, the clock's own time] on the clock runs ``1 + rate_change`` times as fast.

    previous_segment, segment: names of the clock segments before and after. detected_at_s: time of detection on the
    new clock. first_estimate: ``onset_s`` and ``rate_change`` as first estimated, by which frames are converted to the
    previous clock as they arrive.
    """

    previous_segment: str
    segment: str
    onset_s: float
    rate_change: float
    detected_at_s: float
    first_estimate: tuple[float, float]

    @classmethod
    def of(cls, change: ClockChange) -> RateChange:
        """From a change of kind "drift". Raises ValueError for one that leaves the rate as it is."""
        if change.rate_change == 0.0:
            raise ValueError(f"{change.kind} of {change.camera}: no rate change")
        onset, rate = change.detected_at_s - change.step_s / change.rate_change, change.rate_change
        return cls(change.previous_segment, change.segment, onset, rate, change.detected_at_s, (onset, rate))

    def refined(self, change: ClockChange | None) -> RateChange:
        """The same rate change in its present estimate ``change``; None = nothing new."""
        if change is None:
            return self
        if change.rate_change == 0.0:  # a false alarm
            return replace(self, onset_s=self.detected_at_s, rate_change=0.0)
        onset = change.detected_at_s - change.step_s / change.rate_change
        return replace(self, onset_s=onset, rate_change=change.rate_change)

    def to_previous_clock(self, device_ns: int) -> int:
        """Time [ns] on the previous clock where the new one shows ``device_ns``, a time after the onset."""
        onset_s, rate = self.first_estimate
        return device_ns - round(rate * (device_ns - round(onset_s * _SECOND_NS)))

    def corrected(self, time: Floats) -> Floats:
        """Times (n,) [s] of the previous segment, corrected to the present estimate.

        Those between the onset and ``detected_at_s`` are as the camera stamped them; later ones were converted by the
        first estimate.
        """
        onset, rate = self.first_estimate
        converted = time > self.detected_at_s - rate * (self.detected_at_s - onset) - _TIME_TOLERANCE_S
        unchanged = self.first_estimate == (self.onset_s, self.rate_change)
        final = converted if unchanged else np.zeros(time.shape, dtype=np.bool_)
        shown = np.where(converted, onset + (time - onset) / (1.0 - rate), time)
        corrected = shown - self.rate_change * (shown - self.onset_s)
        return np.asarray(np.where(final | (shown <= self.onset_s), time, corrected))


class RateChanges:
    """The latest rate change of each camera, for as long as the clock segment before it is in use."""

    def __init__(self) -> None:
        self._latest: dict[str, RateChange] = {}

    def handle(self, change: ClockChange) -> None:
        """Add a change; a step ends the conversion that a rate change began."""
        self._latest.pop(change.camera, None)
        if change.kind == "drift":
            self._latest[change.camera] = RateChange.of(change)

    def active(self, camera: str, boot: str) -> RateChange | None:
        """The camera's rate change if ``boot`` is the segment before it; else the change is dropped as obsolete."""
        found = self._latest.get(camera)
        if found is not None and found.previous_segment != boot:
            del self._latest[camera]
            return None
        return found

    def to_previous_clock(self, camera: str, boot: str, device_ns: int) -> tuple[str, int] | None:
        """Previous segment and time [ns] on it of a frame of the new segment ``boot``; None without a rate change."""
        found = self._latest.get(camera)
        if found is None or found.segment != boot:
            return None
        return found.previous_segment, found.to_previous_clock(device_ns)

    @property
    def cameras(self) -> list[str]:
        """Cameras with a recent rate change."""
        return list(self._latest)
