"""Clock maps and time types. Camera time and reference time are different types, so that mypy rejects mixing them.

``t_reference = clock_rate * t_camera + time_offset`` (seconds). A camera's epoch is arbitrary: uptime,
Unix time or 0; only differences on one camera mean anything.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import NewType

CameraTime = NewType("CameraTime", float)
"""Seconds on one camera's own clock."""
ReferenceTime = NewType("ReferenceTime", float)
"""Seconds on the clock of the reference camera."""

NANOSECONDS = 1_000_000_000  # in a second
UNSET_CLOCK_UNIX_S = 1_735_689_600.0
"""2025: a machine whose Unix time is before that has a clock that was never set."""


def utc_text(unix_s: float) -> str:
    """A Unix time for a person: 2026-11-24 06:40:00 UTC."""
    return f"{datetime.fromtimestamp(unix_s, UTC):%Y-%m-%d %H:%M:%S} UTC"


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
