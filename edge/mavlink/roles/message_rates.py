"""How often each message is sent, by what each ground station has asked for.

A message has no addressee, so it is sent at the highest rate that any station present expects: what it asked
for with SET_MESSAGE_INTERVAL, or else the default. One station that slows or stops a message therefore changes
nothing for the others, and what a station asked for ends with it. Who selected the target counts as present,
also where it sends no heartbeats, as scripts do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

Station = tuple[int, int]
"""System and component id."""

_GONE_S = 10.0  # without a heartbeat or command, ten times the period of heartbeats
_MAX_STATIONS = 32  # that have asked for rates of their own
_MAX_RATE_HZ = 60.0  # twice a camera's frame rate


@dataclass(slots=True)
class _Presence:
    heard_s: float
    intervals: dict[str, float] = field(default_factory=dict)


class MessageRates:
    """Rates of the messages in ``defaults`` [Hz]. Times are the host's [s]."""

    def __init__(self, defaults: Mapping[str, float]) -> None:
        self._defaults = {kind: 1.0 / rate for kind, rate in defaults.items()}
        self._stations: dict[Station, _Presence] = {}
        self._sent = dict.fromkeys(defaults, -math.inf)
        self._operator: Station | None = None

    def hear(self, station: Station, now_s: float, *, new: bool = True) -> None:
        """A station has sent a heartbeat or a command. new: also if it was not present before."""
        self._forget(now_s)
        if not new and station not in self._stations:
            return
        presence = self._stations.setdefault(station, _Presence(now_s))
        presence.heard_s = now_s
        if len(self._stations) > _MAX_STATIONS:
            del self._stations[min(self._stations, key=lambda one: self._stations[one].heard_s)]

    def is_present(self, system: int, now_s: float) -> bool:
        """Whether a component of a system was heard lately."""
        self._forget(now_s)
        return any(station[0] == system for station in self._stations)

    def set_interval(self, station: Station, kind: str, interval_us: float) -> None:
        """What a station asks for, as in SET_MESSAGE_INTERVAL: 0 = the default, negative = none."""
        presence = self._stations[station]
        if interval_us == 0:
            presence.intervals.pop(kind, None)
        else:
            presence.intervals[kind] = math.inf if interval_us < 0 else max(1e-6 * interval_us, 1.0 / _MAX_RATE_HZ)
        self._sent[kind] = -math.inf

    def select(self, station: Station) -> None:
        """A station has selected a target, and wants to see it: what it asked for before is forgotten."""
        self._operator = station
        self._stations[station].intervals.clear()

    def interval(self, kind: str, now_s: float) -> float:
        """The present interval of a message [s]; inf = it is not sent."""
        self._forget(now_s)
        default = self._defaults[kind]
        wanted = [presence.intervals.get(kind, default) for presence in self._stations.values()]
        if not wanted or self._operator not in (None, *self._stations):
            wanted.append(default)
        return min(wanted)

    def is_due(self, kind: str, now_s: float) -> bool:
        """Whether a message is due; then it counts as sent."""
        interval = self.interval(kind, now_s)
        due = self._sent[kind] + interval
        if math.isinf(interval) or now_s < due:
            return False
        self._sent[kind] = max(due, now_s - 0.5 * interval)
        return True

    def _forget(self, now_s: float) -> None:
        for station in [one for one, presence in self._stations.items() if now_s - presence.heard_s > _GONE_S]:
            del self._stations[station]
