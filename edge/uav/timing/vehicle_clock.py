"""Where the vehicle's clock stands against the host's: from round trips, or else from the quickest messages.

there = here + offset. A round trip bounds the offset to half its duration; a one-way message only from one side, and
the quickest of many is late by an unknown constant.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from protocols.core.clocks import NANOSECONDS

_WINDOW_NS = 20 * NANOSECONDS
_MEMORY = 512
_DRIFT = 1e-4  # by which two oscillators may part
_STEP_NS = 100_000_000
_REBOOT_NS = NANOSECONDS  # by which a clock must go back to have begun anew
_LONGEST_TRIP_NS = NANOSECONDS
_ONE_WAY_STD_NS = 20_000_000


@dataclass(frozen=True, slots=True)
class _Bound:
    here: int
    offset: int
    half: int


class VehicleClock:
    """One vehicle's clock. Times are integer ns. reboots, steps: how often it began anew, or jumped."""

    def __init__(self) -> None:
        self._trips: deque[_Bound] = deque(maxlen=_MEMORY)
        self._one_way: deque[_Bound] = deque(maxlen=_MEMORY)
        self._newest = -1
        self.reboots = 0
        self.steps = 0
        self.rejected = 0

    @property
    def known(self) -> bool:
        """Whether anything is known."""
        return bool(self._trips or self._one_way)

    def handle_time(self, there: int, here: int) -> bool:
        """Take a message stamped ``there`` that came at ``here``. False where the vehicle's clock began anew."""
        went_on = True
        if there < self._newest - _REBOOT_NS:
            self._forget()
            self.reboots += 1
            went_on = False
        elif self._one_way and abs((there - here) - self._one_way[-1].offset) > NANOSECONDS + _STEP_NS:
            # Held up for a second is no step, but then the next ones come at the old offset.
            quick = self._best(self._one_way, here)
            if quick is not None and (there - here) - quick.offset > _STEP_NS:
                self._forget()
                self.steps += 1
                went_on = False
        self._newest = max(self._newest, there)
        self._one_way.append(_Bound(here, there - here, _ONE_WAY_STD_NS))
        return went_on

    def handle_trip(self, sent: int, there: int, received: int) -> bool:
        """Take a round trip: asked at ``sent``, stamped ``there``, answered at ``received``. False: it jumped."""
        if not 0 <= received - sent <= _LONGEST_TRIP_NS:
            self.rejected += 1
            return True
        bound = _Bound(received, there - (sent + received) // 2, (received - sent) // 2 + 1)
        known = self._best(self._trips, received)
        stepped = known is not None and abs(bound.offset - known.offset) > bound.half + known.half + _STEP_NS
        if stepped:
            self._forget()
            self.steps += 1
        self._trips.append(bound)
        return not stepped

    def here(self, there: int) -> int:
        """The host's time of a time on the vehicle's clock."""
        best = self._estimate()
        if best is None:
            raise RuntimeError("nothing is known of this clock")
        return there - best.offset

    @property
    def std_s(self) -> float:
        """Of the offset; inf where nothing is known."""
        best = self._estimate()
        return float("inf") if best is None else best.half / NANOSECONDS

    @property
    def offset_ns(self) -> int:
        """there − here; 0 where nothing is known."""
        best = self._estimate()
        return 0 if best is None else best.offset

    def _estimate(self) -> _Bound | None:
        if self._trips:
            return self._best(self._trips, self._trips[-1].here)
        return self._best(self._one_way, self._one_way[-1].here) if self._one_way else None

    def _best(self, bounds: deque[_Bound], here: int) -> _Bound | None:
        """The tightest of the last seconds; older ones count less, since clocks drift."""
        if not bounds:
            return None
        recent = [bound for bound in bounds if here - bound.here <= _WINDOW_NS] or [bounds[-1]]
        if bounds is self._one_way:
            return max(recent, key=lambda bound: bound.offset)
        return min(recent, key=lambda bound: bound.half + _DRIFT * (here - bound.here))

    def _forget(self) -> None:
        self._trips.clear()
        self._one_way.clear()
        self._newest = -1
