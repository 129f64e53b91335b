"""Whether a sender at another address, or with another system id, is the vehicle that has fallen silent.

Without signing anyone can claim a system id. What a stranger does not know is the vehicle's boot time and position; a
sender that continues neither is reported and not followed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from protocols.core.clocks import NANOSECONDS

_SAME_CLOCK_NS = NANOSECONDS  # two readings of one clock: delays of the link, and its drift over a silence
_POSITION_WAIT_NS = 3 * NANOSECONDS  # for a position, which comes at 5 Hz; without satellites there is none
_NEAR_M = 200.0  # from the last position: its error, and that of the flight until the silence
_MAX_SPEED_M_S = 50.0  # of the vehicle: a faster one is another
_METRES_PER_DEGREE = 111_320.0  # of latitude


@dataclass(slots=True)
class Evidence:
    """What is known of one autopilot. since_ns, heard_ns: host time of its first and last message.

    offset_ns: its clock minus the host's. place: latitude, longitude [degrees].
    """

    since_ns: int | None = None
    heard_ns: int = 0
    offset_ns: int | None = None
    place: tuple[float, float] | None = None

    def add(self, message: Any, now_ns: int) -> None:
        """Add one of its messages."""
        self.heard_ns = now_ns
        self.since_ns = now_ns if self.since_ns is None else self.since_ns
        boot_ms = getattr(message, "time_boot_ms", None)
        if boot_ms:
            self.offset_ns = int(boot_ms) * 1_000_000 - now_ns
        if message.get_type() == "GLOBAL_POSITION_INT" and (message.lat or message.lon):
            self.place = (1e-7 * message.lat, 1e-7 * message.lon)

    def objection(self, other: Evidence, now_ns: int, *, same_system: bool) -> str:
        """Why another sender is not this vehicle, which fell silent; "" if it continues it."""
        silent_ns = now_ns - self.heard_ns
        near = None
        if self.place is not None and other.place is not None:
            near = _distance(self.place, other.place) < _NEAR_M + _MAX_SPEED_M_S * silent_ns / NANOSECONDS
            if not near:
                return "it is somewhere else"
        if other.offset_ns is None or self.offset_ns is None:
            return "it has not sent its boot time"
        if abs(other.offset_ns - self.offset_ns) < _SAME_CLOCK_NS:
            waited_ns = now_ns - (other.since_ns or now_ns)
            return "" if near or self.place is None or waited_ns > _POSITION_WAIT_NS else "it has not sent its position"
        booted_since = other.offset_ns + now_ns < silent_ns + _SAME_CLOCK_NS
        if booted_since and (same_system or near):
            return ""
        return "its boot time is another one"


def _distance(a: tuple[float, float], b: tuple[float, float]) -> float:
    east = ((a[1] - b[1] + 180.0) % 360.0 - 180.0) * math.cos(math.radians(a[0]))
    return _METRES_PER_DEGREE * math.hypot(a[0] - b[0], east)
