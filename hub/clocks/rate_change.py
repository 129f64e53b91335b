"""A clock whose rate changed, as a piecewise-linear map: new time stamps expressed on the clock before the change.

Until there are enough observations to calibrate the new clock segment, the previous one stays in use: new time stamps
are converted to what the previous clock would have shown, by the step and the rate change that arrival times give
(`hub.clocks.change_detector`). The previous time map is then supported by rows up to the present and need not be
extrapolated. The rows between the onset and its detection were stamped by the changed clock; they are corrected too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hub.clocks.change_detector import ClockChange
from protocols.geometry.types import Floats

_SECOND_NS = 1_000_000_000  # ns
_TIME_TOLERANCE_S = 1e-5
"""More than rounding, less than a frame interval."""


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
        if change is None or change.rate_change == 0.0:
            return self
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
