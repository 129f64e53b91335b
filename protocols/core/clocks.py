"""Clock maps and time types. Camera time and reference time are different types, so that mypy rejects mixing them.

``t_reference = clock_rate * t_camera + time_offset`` (seconds). A camera's epoch is arbitrary: uptime,
Unix time or 0; only differences on one camera mean anything.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NewType

CameraTime = NewType("CameraTime", float)
"""Seconds on one camera's own clock."""
ReferenceTime = NewType("ReferenceTime", float)
"""Seconds on the clock of the reference camera."""
BusTime = NewType("BusTime", int)
"""Nanoseconds on the recorder's clock (log time); never used as a capture time."""

NANOSECONDS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class TimeMap:
    """``reference = clock_rate * camera + time_offset`` of one camera."""

    clock_rate: float = 1.0
    time_offset: float = 0.0

    def reference_from_camera(self, time: CameraTime) -> ReferenceTime:
        """The reference time [s] of a time on the camera's clock."""
        return ReferenceTime(self.clock_rate * time + self.time_offset)

    def camera_from_reference(self, time: ReferenceTime) -> CameraTime:
        """The time on the camera's clock of a reference time [s]."""
        return CameraTime((time - self.time_offset) / self.clock_rate)
