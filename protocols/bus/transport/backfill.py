"""Loss recovery for reliable topics: the history for a late joiner, and messages lost on the way.

Zenoh's advanced subscriber (1.10.2) does both as well, and fails in four cases in which it should not:

* It queries the history while it is declared, and delivers it while the caller cannot take anything yet: where it is
  longer than the channel in between, neither ever goes on.
* It queries the history twice: once when it is declared, once for each publisher that it detects. If the first query
  ends while replies to the second are arriving, it begins to deliver in the middle of the history and discards
  everything earlier as old: a late joiner then silently misses the beginning. Seen in 6 of 15 joins to four cameras
  on a busy machine.
* It queries a gap once. If the connection breaks meanwhile, as on a link that loses 30 % of its packets, or if the
  reply takes longer than ten seconds, the query ends without a reply; the missing messages then count as lost,
  although the cache has them.
* A heartbeat of a publisher that is silent makes it query the whole cache, although the history was fetched. On a slow
  link the replies delay everything else, and the router closes it: again and again, every six seconds.

Therefore it is not used: a publisher that appears is queried for what it has, one whose first message is not number 0
for the earlier ones, and one whose sequence numbers have a gap, or stay behind its heartbeats, is queried for it until
the cache has confirmed that it has no more of it. Its messages are held back meanwhile. A witness confirms that the
query reached the cache: a message that it must have. All is fetched in parts, the newest first: a router closes a link
on which more waits than passes within seconds, and where the time is up what was fetched continues in what comes by
itself.

What a sender says of its publisher's identity and numbers is not authenticated, only its right to a key is. So nothing
that is learned on one key has an effect on another, and a number far ahead of all others silences nobody: while a gap
is open, the messages that continue the numbers before it are delivered, and what opened it was not of their publisher.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

_Source = TypeVar("_Source", bound=Hashable)

GAP_TIMEOUT_S = 30.0
"""After this the missing messages of a gap count as lost."""
HISTORY_TIMEOUT_S, SILENCE_S = 10.0, 2.0
"""The same for a history: what comes by itself waits for it. And where messages come by themselves, but no reply, which
a link would bring before them."""
RETRY_S = 0.3
"""Pause between two queries for one gap."""
PATIENCE_S = 0.25
"""For which a message may come later than the heartbeat that announces it: half the period of heartbeats."""
_MAX_SOURCES, _MAX_OF_KEY = 16_384, 16
"""Publishers that are remembered, and of these of one key: an agent that restarts again and again has as many."""
_MAX_BYTES, _MAX_BYTES_OF_KEY = 64 * 1024 * 1024, 8 * 1024 * 1024
"""Bytes held back at once, of all publishers together and of one."""
MOST_PART = 512
"""Messages that are queried at once, at most: 0.2 to 1 MB."""
_SEQUENCE_MODULUS = 2**32  # Zenoh's sequence numbers have 32 bits
NEWEST = _SEQUENCE_MODULUS // 2 - 1
"""As the end of a query: all there is. Zenoh's cache takes a longer range for one that wraps around: empty."""


@dataclass(frozen=True, slots=True)
class RecoveryQuery(Generic[_Source]):
    """A query to a publisher's cache for its messages low to high (inclusive).

    witness: number of a message that it must have, queried after them; None = not known. key: the publisher's key.
    number: of the query, to be passed to ``finish`` with the end of its replies. most: only so many of them, the
    newest; None = all."""

    source: _Source
    key: str
    low: int
    high: int
    witness: int | None
    number: int
    most: int | None = None


@dataclass(slots=True)
class _PendingMessages:
    """Messages of one publisher that are held back until its messages low to first - 1 have arrived."""

    low: int
    first: int
    joining: bool
    since: float
    question: int
    high: int
    """Up to which it is queried: what is not yet fetched."""
    due: float | None = None
    """When to query again; None while a query is open."""
    heard: float = 0.0
    """When the first message came by itself."""
    continued: bool = False
    """Whether messages that continue those before the gap arrived meanwhile."""
    announced: int | None = None
    """Number of a message that its publisher says it has."""
    early: dict[int, bytes] = field(default_factory=dict)
    later: deque[tuple[int, bytes]] = field(default_factory=deque)
    bytes: int = 0

    @property
    def witness(self) -> int | None:
        """The newest message that is known: by the time of the reply the cache may have dropped older ones."""
        return self.later[-1][0] if self.later else max(self.early, default=self.announced)


class Backfill(Generic[_Source]):
    """Reorders and completes the messages in front of an inbox; may be called from any thread.

    push: called with (source, key, payload) of each message in sequence. ask: called with a query; its replies go to
    ``answer``, then ``finish``, which is called also where there are none. lost: called with the number of messages
    that are lost for good.
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
        self._next: dict[tuple[str, _Source], int] = {}
        self._held: dict[tuple[str, _Source], _PendingMessages] = {}
        self._of_key: dict[str, list[_Source]] = {}
        self._behind: dict[tuple[str, _Source], tuple[int, float]] = {}
        """Publishers that have announced more than has arrived: the number that is expected, and since when."""
        self._questions = 0
        self._bytes = 0
        self._lock = threading.Lock()

    def take(self, messages: Iterable[tuple[_Source, int | None, str, bytes]]) -> None:
        """Process messages from the transport: source, number, key, payload; duplicates by number are discarded.

        number: None where messages are not counted.
        """
        questions, push = [], self._push
        with self._lock:
            for source, number, key, payload in messages:
                who = key, source
                expected = self._next.get(who)
                if number is None or expected == number:  # nearly always the case
                    if number is not None:
                        self._next[who] = (number + 1) % _SEQUENCE_MODULUS
                    push(source, key, payload)
                elif (question := self._out_of_sequence(who, expected, number, payload)) is not None:
                    questions.append(question)
        for question in questions:
            self._ask(question)

    def appeared(self, source: _Source, key: str) -> None:
        """A publisher has appeared, or again after an outage: query what it has that was not received."""
        who = key, source
        with self._lock:
            if who in self._held:
                return
            if who not in self._next:
                self._remember(who)
            question = self._hold(who, self._next.get(who, 0), NEWEST + 1, joining=True)
        self._ask(question)

    def heartbeat(self, source: _Source, key: str, number: int) -> None:
        """A publisher has said that ``number`` is its newest message: if that doesn't arrive, query it."""
        who, now = (key, source), self._clock()
        if who not in self._next:  # nothing came of it yet, or its history was empty
            self.appeared(source, key)
            return
        with self._lock:
            expected = self._next.get(who, number + 1)
            if who in self._held:
                return
            if (number - expected) % _SEQUENCE_MODULUS >= _SEQUENCE_MODULUS // 2:
                self._behind.pop(who, None)
                return
            since = self._behind.setdefault(who, (expected, now))
            if since[0] != expected:
                self._behind[who] = (expected, now)
            if since[0] != expected or now - since[1] < PATIENCE_S:
                return
            del self._behind[who]
            question = self._hold(who, expected, number + 1, joining=False, announced=number)
        self._ask(question)

    def answer(self, query: RecoveryQuery[_Source], number: int, key: str, payload: bytes) -> None:
        """Process one reply to a query."""
        with self._lock:
            held = self._held.get((query.key, query.source))
            if held is None or key != query.key:
                return
            if held.low <= number < held.first and number not in held.early:
                held.early[number] = payload
                self._keep(held, len(payload))

    def finish(self, query: RecoveryQuery[_Source], served: bool) -> None:
        """Process the end of a query's replies. served: its witness was among them, or without one no error."""
        who = query.key, query.source
        with self._lock:
            held = self._held.get(who)
            if held is None or held.question != query.number:
                return
            follow: RecoveryQuery[_Source] | None = None
            part = [number for number in held.early if query.low <= number <= query.high]
            missing = max(part, default=query.high)
            while missing in held.early:  # of a larger part, which broke off, there may be more further below
                missing -= 1
            if query.most is not None and served and len(part) >= query.most and query.high > missing >= held.low:
                held.high = missing
                follow = self._question(who, held)
            elif held.joining and served and not part and query.witness is None and held.later:
                follow = self._question(who, held)  # now there is a witness: did the connection break?
            elif served or len(held.early) == held.first - held.low:
                follow = self._release(who)
            else:
                held.due = self._clock() + RETRY_S
        if follow is not None:
            self._ask(follow)

    def poll(self) -> None:
        """Repeat queries that are due, and deliver messages held back for too long; call it several times a second."""
        if not self._held:
            return
        now = self._clock()
        queries: list[RecoveryQuery[_Source]] = []
        with self._lock:
            for who, held in list(self._held.items()):
                too_much = held.bytes > _MAX_BYTES_OF_KEY or self._bytes > _MAX_BYTES
                silent = held.joining and held.later and not held.early and now - held.heard > SILENCE_S
                late = now - held.since > (HISTORY_TIMEOUT_S if held.joining else GAP_TIMEOUT_S)
                if too_much or silent or late:
                    follow = self._release(who)
                elif held.due is not None and now >= held.due:
                    follow = self._question(who, held)
                else:
                    continue
                if follow is not None:
                    queries.append(follow)
        for question in queries:
            self._ask(question)

    def awaits(self, query: RecoveryQuery[_Source]) -> bool:
        """Whether the messages of a query are still waited for."""
        held = self._held.get((query.key, query.source))
        return held is not None and held.question == query.number

    def flush(self) -> None:
        """Deliver all that is held back; what is missing counts as lost."""
        with self._lock:
            for who in list(self._held):
                while who in self._held:
                    self._release(who)

    def _out_of_sequence(
        self, who: tuple[str, _Source], expected: int | None, number: int, payload: bytes
    ) -> RecoveryQuery[_Source] | None:
        key, source = who
        held = self._held.get(who)
        if held is not None:
            if number == held.low and not held.joining:
                self._continue(who, held, payload)
                return self._release(who) if held.low == held.first else None
            behind = (number - held.first) % _SEQUENCE_MODULUS >= _SEQUENCE_MODULUS // 2
            if held.joining and behind and held.later and held.later[0][0] == held.first:
                # A publisher's numbers arrive in order: what came first was another's.
                self._bytes -= self._held.pop(who).bytes
                return self._begin(who, number, payload)
            self._append(held, number, payload)
            return None
        if expected is None:
            self._remember(who)
            return self._begin(who, number, payload)
        if (number - expected) % _SEQUENCE_MODULUS >= _SEQUENCE_MODULUS // 2:
            return None
        if number < expected:  # a gap at the wrap-around of the sequence numbers: once in years
            self._lost((number - expected) % _SEQUENCE_MODULUS)
            self._next[who] = number + 1
            self._push(source, key, payload)
            return None
        return self._hold(who, expected, number, payload, joining=False)

    def _begin(self, who: tuple[str, _Source], number: int, payload: bytes) -> RecoveryQuery[_Source] | None:
        """The first message of a publisher that was not known."""
        if number == 0:
            self._next[who] = 1
            self._push(who[1], who[0], payload)
            return None
        return self._hold(who, 0, number, payload, joining=True)

    def _hold(
        self,
        who: tuple[str, _Source],
        low: int,
        first: int,
        payload: bytes | None = None,
        *,
        joining: bool,
        announced: int | None = None,
    ) -> RecoveryQuery[_Source]:
        """payload: of message ``first``, None where none has arrived."""
        held = self._held[who] = _PendingMessages(low, first, joining, self._clock(), 0, first - 1)
        held.announced = announced
        self._next[who] = -1  # no message is in sequence while these are held back
        if payload is not None:
            self._append(held, first, payload)
        return self._question(who, held)

    def _continue(self, who: tuple[str, _Source], held: _PendingMessages, payload: bytes) -> None:
        """Deliver the message that the gap begins with, and what was fetched of those that follow it."""
        key, source = who
        held.continued = True
        self._push(source, key, payload)
        held.low += 1
        while held.low in held.early:
            early = held.early.pop(held.low)
            self._keep(held, -len(early))
            self._push(source, key, early)
            held.low += 1

    def _question(self, who: tuple[str, _Source], held: _PendingMessages) -> RecoveryQuery[_Source]:
        self._questions += 1
        held.question, held.due = self._questions, None
        return RecoveryQuery(who[1], who[0], held.low, held.high, held.witness, held.question, MOST_PART)

    def _release(self, who: tuple[str, _Source]) -> RecoveryQuery[_Source] | None:
        """Deliver everything in order up to the next gap, and return the query for that gap."""
        key, source = who
        held = self._held.pop(who)
        self._bytes -= held.bytes
        if held.continued and held.low < held.first:
            # The numbers went on where they had been: what was far ahead of them was another's.
            self._next[who] = held.low
            return None
        if held.announced is not None and not held.early and not held.later:
            self._next[who] = held.low  # nobody has what was announced: if it was, what comes next shows it
            return None
        expected = held.first
        if held.joining:
            # In order, and from the first missing one on as after any gap: a cache has no gaps, and what is far ahead
            # is another's. A late joiner begins with the oldest, whoever was known where its messages had ended.
            held.later = deque(sorted((dict(held.later) | held.early).items()))
            if not held.low and not held.later:  # nothing yet: what comes first is a late joiner's still
                self._forget(who)
                return None
            expected = held.low or held.later[0][0]
        else:
            for _, message in sorted(held.early.items()):
                self._push(source, key, message)
            if missing := held.first - held.low - len(held.early):
                self._lost(missing)
        later, size = held.later, held.bytes if held.joining else held.bytes - sum(map(len, held.early.values()))
        while later:
            number, payload = later.popleft()
            behind = (number - expected) % _SEQUENCE_MODULUS >= _SEQUENCE_MODULUS // 2
            if number > expected and not behind:
                question = self._hold(who, expected, number, payload, joining=False)
                # Of many gaps: neither copied nor counted again at each.
                later.appendleft((number, payload))
                self._held[who].later = later
                self._keep(self._held[who], size - len(payload))
                return question
            size -= len(payload)
            if not behind:
                self._push(source, key, payload)
                expected = (number + 1) % _SEQUENCE_MODULUS
        self._next[who] = expected
        return None

    def _append(self, held: _PendingMessages, number: int, payload: bytes) -> None:
        held.heard = held.heard if held.later else self._clock()
        held.later.append((number, payload))
        self._keep(held, len(payload))

    def _keep(self, held: _PendingMessages, size: int) -> None:
        held.bytes += size
        self._bytes += size

    def _remember(self, who: tuple[str, _Source]) -> None:
        """Forget old publishers, of the same key first; their later messages are treated as a late joiner's."""
        key, source = who
        if len(self._next) >= _MAX_SOURCES and key not in self._of_key:
            for one in list(self._next)[: _MAX_SOURCES // 4]:
                self._forget(one)
        sources = self._of_key.setdefault(key, [])
        if len(sources) >= _MAX_OF_KEY:
            self._forget((key, sources[0]))
        self._of_key.setdefault(key, []).append(source)

    def _forget(self, who: tuple[str, _Source]) -> None:
        key, source = who
        if who in self._held:
            self._release(who)
        held = self._held.pop(who, None)  # of a second gap
        self._bytes -= 0 if held is None else held.bytes
        self._next.pop(who, None)
        self._behind.pop(who, None)
        sources = self._of_key.get(key, [])
        if source in sources:
            sources.remove(source)
        if not sources:
            self._of_key.pop(key, None)
