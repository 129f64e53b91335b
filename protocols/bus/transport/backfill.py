"""Loss recovery for reliable topics: the history for a late joiner, and messages lost on the way.

Zenoh's advanced subscriber (1.10.2) queries a publisher's cache for missing messages, and gives up in two cases in
which it should not:

* It queries the history twice: once when it is declared, once for each publisher that it detects. If the first query
  ends while replies to the second are arriving, it begins to deliver in the middle of the history and discards
  everything earlier as old: a late joiner then silently misses the beginning. Seen in 6 of 15 joins to four cameras
  on a busy machine.
* It queries a gap once. If the connection breaks meanwhile, as on a link that loses 30 % of its packets, or if the
  reply takes longer than ten seconds, the query ends without a reply; the missing messages then count as lost,
  although the cache has them.

Therefore a publisher whose first message is not number 0 is queried once more for the earlier ones, and a publisher
whose sequence numbers have a gap is queried for it until the cache has confirmed that it has no more of it. Its
messages are held back meanwhile. A witness confirms that the query reached the cache: a message that it must have.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

_Source = TypeVar("_Source", bound=Hashable)

JOIN_TIMEOUT_S = 3.0
"""After this a late joiner's messages are delivered even without a reply of the publisher."""
GAP_TIMEOUT_S = 30.0
"""The same for a gap: the missing messages then count as lost."""
RETRY_S = 0.3
"""Pause between two queries for one gap."""
_MAX_SOURCES = 16_384
_MAX_BYTES = 64 * 1024 * 1024
"""Bytes held back at once, of all publishers together."""
_SEQUENCE_MODULUS = 2**32


@dataclass(frozen=True, slots=True)
class RecoveryQuery(Generic[_Source]):
    """A query to a publisher's cache for its messages low to high (inclusive).

    witness: number of a message that it must have, queried after them; None = not needed. key: the publisher's key.
    number: of the query, to be passed to ``finish`` with the end of its replies."""

    source: _Source
    key: str
    low: int
    high: int
    witness: int | None
    number: int


@dataclass(slots=True)
class _PendingMessages:
    """Messages of one publisher that are held back until its messages low to first - 1 have arrived."""

    key: str
    low: int
    first: int
    joining: bool
    since: float
    question: int
    due: float | None = None
    """When to query again; None while a query is open."""
    early: dict[int, tuple[str, bytes]] = field(default_factory=dict)
    later: deque[tuple[int, str, bytes]] = field(default_factory=deque)
    bytes: int = 0


class Backfill(Generic[_Source]):
    """Reorders and completes the messages in front of an inbox; may be called from any thread.

    push: called with (source, key, payload) of each message in sequence. ask: called with a query; its replies go to
    ``answer``, then ``finish``. lost: called with the number of messages that are lost for good.
    """

    def __init__(
        self,
        push: Callable[[_Source, str, bytes], None],
        ask: Callable[[RecoveryQuery[_Source]], None],
        lost: Callable[[int], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._push = push
        self._ask = ask
        self._lost = lost
        self._clock = clock
        self._next: dict[_Source, int] = {}
        self._held: dict[_Source, _PendingMessages] = {}
        self._questions = 0
        self._bytes = 0
        self._lock = threading.Lock()

    def take(self, source: _Source, number: int, key: str, payload: bytes) -> None:
        """Process a message from the transport; duplicates by sequence number are discarded."""
        with self._lock:
            expected = self._next.get(source)
            if expected == number:  # nearly always the case
                self._next[source] = (number + 1) % _SEQUENCE_MODULUS
                self._push(source, key, payload)
                return
            question = self._out_of_sequence(source, expected, number, key, payload)
        if question is not None:
            self._ask(question)

    def answer(self, source: _Source, number: int, key: str, payload: bytes) -> None:
        """Process one reply to a query."""
        with self._lock:
            held = self._held.get(source)
            if held is not None and held.low <= number < held.first and number not in held.early:
                held.early[number] = (key, payload)
                self._keep(held, len(payload))

    def finish(self, source: _Source, question: int, served: bool) -> None:
        """Process the end of a query's replies. served: its witness was among them."""
        with self._lock:
            held = self._held.get(source)
            if held is None or held.question != question:
                return
            if held.joining or served or len(held.early) == held.first - held.low:
                follow = self._release(source)
            else:
                held.due, follow = self._clock() + RETRY_S, None
        if follow is not None:
            self._ask(follow)

    def poll(self) -> None:
        """Repeat queries that are due, and deliver messages held back for too long; call it several times a second."""
        if not self._held:
            return
        now = self._clock()
        queries: list[RecoveryQuery[_Source]] = []
        with self._lock:
            for source, held in list(self._held.items()):
                if now - held.since > (JOIN_TIMEOUT_S if held.joining else GAP_TIMEOUT_S) or self._bytes > _MAX_BYTES:
                    follow = self._release(source)
                elif held.due is not None and now >= held.due:
                    follow = self._question(source, held)
                else:
                    continue
                if follow is not None:
                    queries.append(follow)
        for question in queries:
            self._ask(question)

    def _out_of_sequence(
        self, source: _Source, expected: int | None, number: int, key: str, payload: bytes
    ) -> RecoveryQuery[_Source] | None:
        held = self._held.get(source)
        if held is not None:
            held.later.append((number, key, payload))
            self._keep(held, len(payload))
            return None
        if expected is None:
            self._forget_some()
            if number == 0:
                self._next[source] = 1
                self._push(source, key, payload)
                return None
            return self._hold(source, 0, number, key, payload, joining=True)
        if (number - expected) % _SEQUENCE_MODULUS >= _SEQUENCE_MODULUS // 2:
            return None
        if number < expected:  # a gap at the wrap-around of the sequence numbers: once in years
            self._lost((number - expected) % _SEQUENCE_MODULUS)
            self._next[source] = number + 1
            self._push(source, key, payload)
            return None
        return self._hold(source, expected, number, key, payload, joining=False)

    def _hold(
        self, source: _Source, low: int, first: int, key: str, payload: bytes, *, joining: bool
    ) -> RecoveryQuery[_Source]:
        held = self._held[source] = _PendingMessages(key, low, first, joining, self._clock(), 0)
        self._next[source] = -1  # no message is in sequence while these are held back
        held.later.append((first, key, payload))
        self._keep(held, len(payload))
        return self._question(source, held)

    def _question(self, source: _Source, held: _PendingMessages) -> RecoveryQuery[_Source]:
        self._questions += 1
        held.question, held.due = self._questions, None
        # The newest one: by the time of the reply the cache may have dropped older ones.
        witness = None if held.joining else held.later[-1][0]
        return RecoveryQuery(source, held.key, held.low, held.first - 1, witness, held.question)

    def _release(self, source: _Source) -> RecoveryQuery[_Source] | None:
        """Deliver everything in order up to the next gap, and return the query for that gap."""
        held = self._held.pop(source)
        self._bytes -= held.bytes
        for _, message in sorted(held.early.items()):
            self._push(source, *message)
        missing = held.first - held.low - len(held.early)
        if missing and not held.joining:
            self._lost(missing)
        expected = held.first
        while held.later:
            number, key, payload = held.later.popleft()
            behind = (number - expected) % _SEQUENCE_MODULUS >= _SEQUENCE_MODULUS // 2
            if number > expected and not behind:
                question = self._hold(source, expected, number, key, payload, joining=False)
                rest = self._held[source]
                rest.later.extend(held.later)
                self._keep(rest, sum(len(one[2]) for one in held.later))
                return question
            if not behind:
                self._push(source, key, payload)
                expected = (number + 1) % _SEQUENCE_MODULUS
        self._next[source] = expected
        return None

    def _keep(self, held: _PendingMessages, size: int) -> None:
        held.bytes += size
        self._bytes += size

    def _forget_some(self) -> None:
        """Forget the oldest of very many publishers; their later messages are treated as a late joiner's."""
        if len(self._next) >= _MAX_SOURCES:
            for source in list(self._next)[: _MAX_SOURCES // 4]:
                if source not in self._held:
                    del self._next[source]
