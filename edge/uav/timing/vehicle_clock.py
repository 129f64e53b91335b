"""Offset of one telemetry source's clock to the host's, from round trips or else from the least delayed messages.

source time = host time + offset. A round trip bounds the offset to half its duration. A one-way message bounds it from
one side only, and the least delayed of many still has an unknown constant delay. A single message never moves the
clock: what contradicts the estimate is refused, and only several in a row that agree with each other replace it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from protocols.core.clocks import NANOSECONDS

MAX_DELAY_NS = 5 * NANOSECONDS
"""Longest delay from measurement to arrival: an older attitude or position is of no use."""
_WINDOW_NS = 20 * NANOSECONDS
_BUFFER = 512  # bounds: the window at 25 Hz
_MAX_DRIFT = 1e-4  # relative rate of two oscillators
_STEP_NS = 100_000_000  # smaller steps of the clock are not told from delays
_REORDER_NS = NANOSECONDS  # a clock that goes back by more has been restarted, or the message is not from that clock
_MAX_ROUND_TRIP_NS = NANOSECONDS
_ONE_WAY_STD_NS = 20_000_000  # taken as the half width of a single message's bound: its least delay is unknown
_CONFIRMATIONS = 3  # agreeing messages in a row that replace the estimate …
_CONFIRM_NS = 500_000_000  # … over at least this time, in which an autopilot at its default 4 Hz contradicts them
_AGREE_NS = 500_000_000  # jitter of the delays of messages that agree
_SET_BACK_NS = 2 * NANOSECONDS  # after stamps went back by little: nothing earlier than the midway delay in this time


@dataclass(frozen=True, slots=True)
class _OffsetBound:
    host_ns: int
    offset: int
    half_width: int


@dataclass(slots=True)
class _Candidate:
    """Consecutive measurements that contradict the estimate and agree with each other."""

    since_ns: int
    vehicle_ns: int
    offset: int
    count: int = 1

    def confirms(self, vehicle_ns: int, host_ns: int) -> bool:
        """Add one more; whether they replace the estimate. A repeated message does not count."""
        if vehicle_ns > self.vehicle_ns:
            self.count += 1
        self.vehicle_ns, self.offset = vehicle_ns, vehicle_ns - host_ns
        return self.count >= _CONFIRMATIONS and host_ns - self.since_ns >= _CONFIRM_NS


class VehicleClock:
    """The clock of one source. Times are integer ns. reboots, steps: how often it was restarted, or stepped.

    rejected: round trips that were not used. answered: whether one was ever used. reason: why the last message or round
    trip was refused; "" = it was not.
    """

    def __init__(self) -> None:
        self._round_trips: deque[_OffsetBound] = deque(maxlen=_BUFFER)
        self._one_way: deque[_OffsetBound] = deque(maxlen=_BUFFER)
        self._newest_ns = -1
        self._candidate: _Candidate | None = None
        self._trip_candidate: _Candidate | None = None
        self._set_back: _Candidate | None = None
        self.reboots = 0
        self.steps = 0
        self.rejected = 0
        self.answered = False
        self.reason = ""

    @property
    def known(self) -> bool:
        """Whether there is an estimate."""
        return bool(self._round_trips or self._one_way)

    @property
    def stamped(self) -> bool:
        """Whether a stamped message was accepted."""
        return self._newest_ns >= 0

    def handle_message(self, vehicle_ns: int, host_ns: int) -> bool:
        """Add a message stamped ``vehicle_ns`` that arrived at ``host_ns``. False if it is refused; see ``reason``."""
        offset = vehicle_ns - host_ns
        reason, restarted = self._contradiction(vehicle_ns, host_ns)
        if reason:
            candidate = self._candidate
            if candidate is None or abs(offset - candidate.offset) > _AGREE_NS:
                candidate = self._candidate = _Candidate(host_ns, vehicle_ns, offset)
            if not candidate.confirms(vehicle_ns, host_ns):
                self.reason = reason
                return False
            self._reset()
            self.reboots += restarted
            self.steps += not restarted
        elif self._is_set_back(vehicle_ns, host_ns):
            self._reset()
            self.steps += 1
        self.reason = ""
        self._candidate = None
        self._newest_ns = max(self._newest_ns, vehicle_ns)
        self._one_way.append(_OffsetBound(host_ns, offset, _ONE_WAY_STD_NS))
        return True

    def handle_round_trip(self, sent_ns: int, vehicle_ns: int, received_ns: int) -> bool:
        """Add a round trip: sent, stamped by the source, and received. False if it is refused."""
        if not 0 <= received_ns - sent_ns <= _MAX_ROUND_TRIP_NS:
            self.rejected += 1
            return False
        bound = _OffsetBound(received_ns, vehicle_ns - (sent_ns + received_ns) // 2, (received_ns - sent_ns) // 2 + 1)
        if self._one_way and received_ns - self._one_way[-1].host_ns < _WINDOW_NS:
            # The message was stamped before it arrived, and not long before.
            early = self._one_way[-1].offset - bound.offset
            if not -MAX_DELAY_NS <= early <= bound.half_width + _STEP_NS:
                self.rejected += 1
                self.reason = "TIMESYNC is answered by another clock than the one that stamps the messages"
                return False
        known = self._best(self._round_trips, received_ns)
        if known is not None and abs(bound.offset - known.offset) > bound.half_width + known.half_width + _STEP_NS:
            candidate = self._trip_candidate
            if candidate is None or abs(bound.offset - candidate.offset) > _STEP_NS + bound.half_width:
                candidate = self._trip_candidate = _Candidate(vehicle_ns - bound.offset, vehicle_ns, bound.offset)
            if not candidate.confirms(vehicle_ns, vehicle_ns - bound.offset):
                self.rejected += 1
                return False
            self._reset()
            self.steps += 1
        self._trip_candidate = None
        self._round_trips.append(bound)
        self.answered = True
        return True

    def host_time(self, vehicle_ns: int) -> int:
        """Host time of a time on the source's clock. Raises RuntimeError without an estimate."""
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
        """source − host; 0 without an estimate."""
        best = self._estimate()
        return 0 if best is None else best.offset

    def _contradiction(self, vehicle_ns: int, host_ns: int) -> tuple[str, bool]:
        """How a message contradicts the clock ("" = it does not), and whether that would be a restart."""
        best = self._best(self._round_trips, host_ns) if self._round_trips else self._best(self._one_way, host_ns)
        if best is None:
            return "", False
        ahead = vehicle_ns - host_ns - best.offset
        drift = round(_MAX_DRIFT * max(host_ns - best.host_ns, 0))
        # Without round trips the estimate itself contains a delay, which later messages may not have.
        allowed = (best.half_width if self._round_trips else _REORDER_NS) + _STEP_NS + drift
        if ahead > allowed:
            return f"stamped {ahead / NANOSECONDS:.1f} s in the future", False
        if vehicle_ns < self._newest_ns - _REORDER_NS:
            return f"its clock went back by {(self._newest_ns - vehicle_ns) / NANOSECONDS:.1f} s", True
        if -ahead > MAX_DELAY_NS + drift:
            return f"stamped {-ahead / NANOSECONDS:.1f} s in the past", False
        return "", False

    def _is_set_back(self, vehicle_ns: int, host_ns: int) -> bool:
        """Whether the clock was set back by less than ``_contradiction`` notices.

        Out of order alone is no proof: it would make every later message later as well.
        """
        # Of messages alone: on a link that delays all of them, none comes earlier than by their least delay.
        offset, best = vehicle_ns - host_ns, self._best(self._one_way, host_ns)
        if self._set_back is None and vehicle_ns < self._newest_ns - _STEP_NS:
            self._set_back = _Candidate(host_ns, vehicle_ns, offset)
        candidate = self._set_back
        if candidate is None or best is None:
            return False
        if 2 * offset > candidate.offset + best.offset:
            self._set_back = None
            return False
        return host_ns - candidate.since_ns >= _SET_BACK_NS

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
        self._candidate = self._trip_candidate = self._set_back = None
