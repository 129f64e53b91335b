"""Shares the hub's time between cameras: who sends more than its share waits, and the others do not.

What a hub leaves out while it is behind its messages is in a fixed order, counted, and stated in its status: first
predictions, which are for the moment only; then smoothed tracks, which are for the log; observations last, and of these
the oldest of whoever has most of them waiting (`Inbox`, `FairShare`), so that estimates lose as little as may be.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable
from heapq import heapify, heappop, heapreplace
from statistics import median_high

from protocols.bus.base import Received
from protocols.messages import syncline_pb2 as pb

_MAX_WAITING_ROWS, _MAX_WAITING_IN_ALL = 40_000, 100_000
"""Messages and detections of one sender that wait, and of all, 180 bytes each; the oldest are dropped, of who has
most of them where all together have too many."""
_LEAST_SHARE_S = 0.01  # s of CPU a second that every sender has

PREDICTIONS_S = 0.25
"""How late [s] a hub leaves out predictions: half of the 0.5 s after which a camera uses none of them."""
SMOOTHED_S = 1.0
"""How late [s] it leaves out smoothed tracks too: its status is a second old by then."""
_STATED_S = 2.0
"""How long a status says so afterwards: two statuses."""


class FairShare:
    """Passes messages on in the order of their arrival, as long as their senders take no more than their share.

    handle: takes one message. clock: [s], any. round_s: what all messages of a round may take together; a message of a
    sender that has used up its share of that waits for the rounds after it.
    """

    def __init__(self, handle: Callable[[Received], None], clock: Callable[[], float], round_s: float) -> None:
        self._handle, self._clock, self._round_s = handle, clock, round_s
        self._waiting: dict[str, deque[Received]] = {}
        self._rows: Counter[str] = Counter()
        self._in_all = 0
        self._taken_ns: dict[str, int] = {}
        self.dropped: Counter[str] = Counter()

    @property
    def behind(self) -> list[str]:
        """Senders whose messages wait."""
        return sorted(self._waiting)

    def age_s(self, now_ns: int) -> float:
        """Age [s] of the oldest message of the median sender, of what was taken last and of what waits.

        Not of the oldest of all: one who sends too much waits for itself, and costs the others nothing.
        """
        oldest = self._taken_ns | {sender: queue[0].arrival_ns for sender, queue in self._waiting.items()}
        return max(0.0, 1e-9 * (now_ns - median_high(oldest.values()))) if oldest else 0.0

    def take(self, received: Iterable[Received]) -> None:
        """Pass on what has arrived, and of what waits as much as there is time for."""
        arrived = deque(received)
        begin = self._clock()
        self._taken_ns = {one.agent: one.arrival_ns for one in reversed(arrived)}
        share = max(self._round_s / max(len(self._taken_ns.keys() | self._waiting.keys()), 1), _LEAST_SHARE_S)
        used: Counter[str] = Counter()
        while arrived:  # none is held longer than it waits
            one = arrived.popleft()
            if one.agent in self._waiting or used[one.agent] > share or self._clock() - begin > self._round_s:
                self._put(one)
            else:
                used[one.agent] += self._timed(one)  # type: ignore[assignment]
        # However long it took to put messages aside: else a hub that is far behind does nothing else any more.
        until = max(begin + self._round_s, self._clock() + 0.5 * self._round_s)
        while self._waiting and self._clock() < until:
            for sender in list(self._waiting):
                self._timed(self._next(sender))

    def _timed(self, one: Received) -> float:
        before = self._clock()
        self._handle(one)
        return self._clock() - before

    def _put(self, one: Received) -> None:
        waiting = self._waiting.setdefault(one.agent, deque())
        waiting.append(one)
        self._rows[one.agent] += _rows(one)
        self._in_all += _rows(one)
        while self._rows[one.agent] > _MAX_WAITING_ROWS:
            self._drop(one.agent)
        if self._in_all > _MAX_WAITING_IN_ALL:
            self._trim()

    def _trim(self) -> None:
        """Drop a tenth of all that waits, each time of who has most: to find out among a thousand takes 50 µs."""
        most = [(-rows, sender) for sender, rows in self._rows.items()]
        heapify(most)
        while self._in_all > 0.9 * _MAX_WAITING_IN_ALL:
            sender = most[0][1]
            self._drop(sender)
            heapreplace(most, (-self._rows[sender], sender)) if sender in self._rows else heappop(most)

    def _drop(self, sender: str) -> None:
        self._next(sender)
        self.dropped[sender] += 1

    def _next(self, sender: str) -> Received:
        one = self._waiting[sender].popleft()
        self._rows[sender] -= _rows(one)
        self._in_all -= _rows(one)
        if not self._waiting[sender]:
            del self._waiting[sender], self._rows[sender]
        return one


def _rows(one: Received) -> int:
    return 2 + len(one.message.detections) if isinstance(one.message, pb.Observation) else 2


class Shedding:
    """How late a hub is, by the messages of its last round. now: any monotonic clock [s]."""

    def __init__(self) -> None:
        self.behind_s = 0.0
        self._worst, self._last = 0.0, -float("inf")

    def see(self, behind_s: float, now: float) -> None:
        """The median sender's oldest message was ``behind_s`` old when the round's messages had been processed."""
        self.behind_s = behind_s
        if self.sheds_predictions:
            self._worst = max(self._worst, behind_s) if now - self._last < _STATED_S else behind_s
            self._last = now

    @property
    def sheds_predictions(self) -> bool:
        """Whether predictions are left out now."""
        return self.behind_s > PREDICTIONS_S

    @property
    def sheds_smoothed(self) -> bool:
        """Whether smoothed tracks are left out now."""
        return self.behind_s > SMOOTHED_S

    def text(self, now: float) -> str:
        """One clause for the status; "" while the hub keeps up."""
        if now - self._last >= _STATED_S:
            return ""
        what = "predictions and smoothed tracks" if self._worst > SMOOTHED_S else "predictions"
        return f"up to {self._worst:.1f} s behind its messages: {what} are left out"
