"""STATUSTEXT lines about the target, for the message list of ground stations."""

from __future__ import annotations

import math

from edge.mavlink.dialect import mavlink

_HELD_S = 0.5  # a shorter absence is no news
_PAUSE_S = 2.0  # between texts of a target that comes and goes
_TEXTS = {
    "visible": ("Syncline: target found again", mavlink.MAV_SEVERITY_NOTICE),
    "coasting": ("Syncline: target not seen, position predicted", mavlink.MAV_SEVERITY_NOTICE),
    "lost": ("Syncline: target lost, select it again", mavlink.MAV_SEVERITY_WARNING),
    "idle": ("Syncline: tracking stopped", mavlink.MAV_SEVERITY_NOTICE),
}
_STARTED = ("Syncline: tracking started", mavlink.MAV_SEVERITY_NOTICE)
StatusText = tuple[str, int]
"""At most 50 characters, and a MAV_SEVERITY."""


class StatusTexts:
    """One text for each change of the target's state that lasts."""

    def __init__(self) -> None:
        self._announced = self._state = "idle"
        self._since_s = self._sent_s = -math.inf
        self._operator: int | None = None

    def select(self, station: int) -> StatusText | None:
        """A station has selected a target. The text if it took over from another one."""
        previous, self._operator = self._operator, station
        tracking, self._announced = self._announced != "idle", "idle"
        if previous is None or previous == station or not tracking:
            return None
        return f"Syncline: station {station} took over from {previous}", mavlink.MAV_SEVERITY_NOTICE

    def update(self, state: str, now_s: float) -> StatusText | None:
        """The text that is due. state: as in ``TrackingStatus``."""
        if state != self._state:
            self._state, self._since_s = state, now_s
        if state == self._announced:
            return None
        starts = self._announced == "idle"
        brief = now_s - self._since_s < _HELD_S or now_s - self._sent_s < _PAUSE_S
        if not starts and state not in ("idle", "lost") and brief:
            return None
        self._announced, self._sent_s = state, now_s
        if state == "idle":
            self._operator = None
        return _STARTED if starts and state != "lost" else _TEXTS[state]
