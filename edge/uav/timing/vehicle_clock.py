"""Offset of the vehicle's clock to the host's, from round trips or else from the least delayed messages.

vehicle time = host time + offset. A round trip bounds the offset to half its duration. A one-way message bounds it from
one side only, and the least delayed of many still has an unknown constant delay.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from protocols.core.clocks import NANOSECONDS

_WINDOW_NS = 20 * NANOSECONDS
_BUFFER = 512
_MAX_DRIFT = 1e-4  # relative rate of two oscillators
_STEP_NS = 100_000_000
_REBOOT_NS = NANOSECONDS  # a clock that goes back by more has been restarted
_MAX_ROUND_TRIP_NS = NANOSECONDS
_ONE_WAY_STD_NS = 20_000_000


@dataclass(frozen=True, slots=True)
class _OffsetBound:
    host_ns: int
    offset: int
    half_width: int


class VehicleClock:
    """One vehicle's clock. Times are integer ns. reboots, steps: how often it was restarted, or stepped."""

    def __init__(self) -> None:
        self._round_trips: deque[_OffsetBound] = deque(maxlen=_BUFFER)
        self._one_way: deque[_OffsetBound] = deque(maxlen=_BUFFER)
        self._newest_ns = -1
        self.reboots = 0
        self.steps = 0
        self.rejected = 0

    @property
    def known(self) -> bool:
        """Whether there is an estimate."""
        return bool(self._round_trips or self._one_way)

    def handle_message(self, vehicle_ns: int, host_ns: int) -> bool:
        """Add a message stamped ``vehicle_ns`` that arrived at ``host_ns``. False if the clock restarted or stepped."""
        continuous = True
        if vehicle_ns < self._newest_ns - _REBOOT_NS:
            self._reset()
            self.reboots += 1
            continuous = False
        elif self._one_way and abs((vehicle_ns - host_ns) - self._one_way[-1].offset) > NANOSECONDS + _STEP_NS:
            # A message delayed by a second is no step: later ones return to the old offset.
            least_delayed = self._best(self._one_way, host_ns)
            if least_delayed is not None and (vehicle_ns - host_ns) - least_delayed.offset > _STEP_NS:
                self._reset()
                self.steps += 1
                continuous = False
        self._newest_ns = max(self._newest_ns, vehicle_ns)
        self._one_way.append(_OffsetBound(host_ns, vehicle_ns - host_ns, _ONE_WAY_STD_NS))
        return continuous

    def handle_round_trip(self, sent_ns: int, vehicle_ns: int, received_ns: int) -> bool:
        """Add a round trip: sent, stamped by the vehicle, and received. False if the clock stepped."""
        if not 0 <= received_ns - sent_ns <= _MAX_ROUND_TRIP_NS:
            self.rejected += 1
            return True
        bound = _OffsetBound(received_ns, vehicle_ns - (sent_ns + received_ns) // 2, (received_ns - sent_ns) // 2 + 1)
        known = self._best(self._round_trips, received_ns)
        stepped = (
            known is not None and abs(bound.offset - known.offset) > bound.half_width + known.half_width + _STEP_NS
        )
        if stepped:
            self._reset()
            self.steps += 1
        self._round_trips.append(bound)
        return not stepped

    def host_time(self, vehicle_ns: int) -> int:
        """Host time of a time on the vehicle's clock. Raises RuntimeError without an estimate."""
        best = self._estimate()
        if best is None:
            raise RuntimeError("no estimate of this clock yet")
        return vehicle_ns - best.offset

    @property
    def std_s(self) -> float:
        """Std of the offset; inf without an estimate."""
        best = self._estimate()
        return float("inf") if best is None else best.half_width / NANOSECONDS

    @property
    def offset_ns(self) -> int:
        """vehicle − host; 0 without an estimate."""
        best = self._estimate()
        return 0 if best is None else best.offset

    def _estimate(self) -> _OffsetBound | None:
        if self._round_trips:
            return self._best(self._round_trips, self._round_trips[-1].host_ns)
        return self._best(self._one_way, self._one_way[-1].host_ns) if self._one_way else None

    def _best(self, bounds: deque[_OffsetBound], host_ns: int) -> _OffsetBound | None:
        """The tightest recent bound; older ones are widened by the possible drift."""
        if not bounds:
            return None
        recent = [bound for bound in bounds if host_ns - bound.host_ns <= _WINDOW_NS] or [bounds[-1]]
        if bounds is self._one_way:
            return max(recent, key=lambda bound: bound.offset)
        return min(recent, key=lambda bound: bound.half_width + _MAX_DRIFT * (host_ns - bound.host_ns))

    def _reset(self) -> None:
        self._round_trips.clear()
        self._one_way.clear()
        self._newest_ns = -1
