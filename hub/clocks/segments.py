"""Clock segments: observations labelled by segment, time maps moved to the present segment, and alarms."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

from hub.clocks.change_detector import ClockChange, ClockChangeDetector
from protocols.core.clocks import TimeMap
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration

SEGMENT_MIN_ROWS = 600
"""Detections in a new segment from which on it is calibrated by itself; until then the moved map is more precise."""
_MAX_ALARMS = 32  # a status has room for as many
_MAX_CHANGES = 64
"""Changes of one camera's clock; who has more has no clock, and is no longer watched."""


class ClockSegments:
    """Applies the clock change detector to observations before they reach the solver."""

    def __init__(self) -> None:
        self._detector = ClockChangeDetector()
        self._runs: dict[str, str] = {}
        self.alarms: dict[str, str] = {}
        self._changes: Counter[str] = Counter()

    def assign(self, message: pb.Observation, arrival: float | None) -> tuple[pb.Observation, ClockChange | None]:
        """The observation with its clock segment as boot id, and the clock change that begins with it, if any."""
        camera, boot = message.camera, message.boot_id
        if self._changes.get(camera, 0) >= _MAX_CHANGES:
            return message, None
        segment, change = self._detector.handle(
            camera, boot, message.sequence, message.frame, message.device_time_ns, arrival
        )
        self._runs[camera] = boot
        if change is not None:
            self._changes[camera] += 1
        if change is not None and len(self.alarms) < _MAX_ALARMS:
            step, ppm = f"stepped by {change.step_s:+.3f} s", f"drifts {1e6 * change.rate_change:+.0f} ppm"
            text = step if change.kind == "step" else ppm
            self.alarms[change.camera] = f"the clock of {change.camera} {text}"
        if segment == boot:
            return message, change
        relabelled = pb.Observation()
        relabelled.CopyFrom(message)
        relabelled.boot_id = segment
        return relabelled, change

    def report_step(self, camera: str, size: float) -> None:
        """Raise the alarm for a step [s] that the images show, smaller than one that the stamps would."""
        if camera in self.alarms or len(self.alarms) < _MAX_ALARMS:
            self.alarms[camera] = f"the clock of {camera} stepped by {size:+.3f} s"

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

    def change_into(self, segment: str) -> ClockChange | None:
        """The change that began ``segment``, in its present estimate; None if no change did."""
        return self._detector.change_into(segment)

    def rates_ppm(self) -> dict[str, float]:
        """Rate of the hub's clock relative to each camera's over the last seconds, less 1 [ppm]."""
        rates = {camera: self._detector.relative_rate(camera, boot) for camera, boot in self._runs.items()}
        return {camera: 1e6 * rate for camera, rate in rates.items() if rate is not None}
