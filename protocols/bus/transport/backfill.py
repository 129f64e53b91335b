"""Makes what a publisher said whole: a late joiner's history, and what was lost on the way.

Zenoh's advanced subscriber (1.10.2) asks a publisher's cache for what is missing, and gives up in two cases in which
it should not:

* It asks for history twice: once when it is declared, once for each publisher that it detects. If the first of these
  ends while answers to the second are coming in, it begins to deliver in the middle of the history and takes
  everything earlier for old: a late joiner then misses the beginning, in silence. Seen in 6 of 15 joins to four
  cameras on a busy machine.
* It asks for a gap once. If the connection breaks while it waits, as on a link that loses 30 % of its packets, or if
  the answer takes longer than ten seconds, the question ends without an answer; what was missing then counts as lost,
  although the cache has it.

So whoever's first message is not number 0 is asked once more for what came before it, and whoever's numbers have a gap
is asked for that until the cache has been heard to have nothing more of it. Its messages are held meanwhile. That the
cache was asked, and not only a connection that broke, is known by a witness: a message that it must have.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

_Source = TypeVar("_Source", bound=Hashable)

PATIENCE_S = 3.0
"""After this a late joiner's messages are let through even if the publisher has not answered."""
GAP_PATIENCE_S = 30.0
"""The same of a gap: then what is missing counts as lost."""
AGAIN_S = 0.3
"""Between two questions for one gap."""
_MOST_SOURCES = 16_384
_MOST_BYTES = 64 * 1024 * 1024
"""Held at once, of all publishers together."""
_WRAP = 2**32


@dataclass(frozen=True, slots=True)
class Question(Generic[_Source]):
    """What to ask a publisher's cache for: its messages low to high. witness: one that it must have, asked after them;
    None = not needed. key: of the publisher; number: of the question, to be told with the end of the answers."""

    source: _Source
    key: str
    low: int
    high: int
    witness: int | None
    number: int


@dataclass(slots=True)
class _Held:
    """Messages of one publisher that wait for what came before them, which is numbers low to first - 1."""

    key: str
    low: int
    first: int
    joining: bool
    since: float
    question: int
    due: float | None = None
    """When to ask again; None while a question is open."""
    early: dict[int, tuple[str, bytes]] = field(default_factory=dict)
    later: deque[tuple[int, str, bytes]] = field(default_factory=deque)
    bytes: int = 0


class Backfill(Generic[_Source]):
    """Stands before an inbox; may be called from any thread.

    push: takes (source, key, payload) of a message in its turn. ask: called with a question; the answers go to
    ``answer``, then ``finish``. lost: called with the number of messages that will never come.
    """

    def __init__(
        self,
        push: Callable[[_Source, str, bytes], None],
        ask: Callable[[Question[_Source]], None],
        lost: Callable[[int], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._push = push
        self._ask = ask
        self._lost = lost
        self._clock = clock
        self._next: dict[_Source, int] = {}
        self._held: dict[_Source, _Held] = {}
        self._questions = 0
        self._bytes = 0
        self._lock = threading.Lock()

    def take(self, source: _Source, number: int, key: str, payload: bytes) -> None:
        """A message as the transport delivers it; one with a number that was there already is left out."""
        with self._lock:
            expected = self._next.get(source)
            if expected == number:  # nearly always
                self._next[source] = (number + 1) % _WRAP
                self._push(source, key, payload)
                return
            question = self._out_of_turn(source, expected, number, key, payload)
        if question is not None:
            self._ask(question)

    def answer(self, source: _Source, number: int, key: str, payload: bytes) -> None:
        """One of the messages that were asked for."""
        with self._lock:
            held = self._held.get(source)
            if held is not None and held.low <= number < held.first and number not in held.early:
                held.early[number] = (key, payload)
                self._keep(held, len(payload))

    def finish(self, source: _Source, question: int, served: bool) -> None:
        """There are no more answers to a question. served: its witness was among them."""
        with self._lock:
            held = self._held.get(source)
            if held is None or held.question != question:
                return
            if held.joining or served or len(held.early) == held.first - held.low:
                follow = self._release(source)
            else:
                held.due, follow = self._clock() + AGAIN_S, None
        if follow is not None:
            self._ask(follow)

    def tend(self) -> None:
        """Ask again where that is due, and let through what has waited for too long; call it several times a second."""
        if not self._held:
            return
        now = self._clock()
        questions: list[Question[_Source]] = []
        with self._lock:
            for source, held in list(self._held.items()):
                if now - held.since > (PATIENCE_S if held.joining else GAP_PATIENCE_S) or self._bytes > _MOST_BYTES:
                    follow = self._release(source)
                elif held.due is not None and now >= held.due:
                    follow = self._question(source, held)
                else:
                    continue
                if follow is not None:
                    questions.append(follow)
        for question in questions:
            self._ask(question)

    def _out_of_turn(
        self, source: _Source, expected: int | None, number: int, key: str, payload: bytes
    ) -> Question[_Source] | None:
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
        if (number - expected) % _WRAP >= _WRAP // 2:
            return None
        if number < expected:  # a gap at the turn of the numbers: once in years
            self._lost((number - expected) % _WRAP)
            self._next[source] = number + 1
            self._push(source, key, payload)
            return None
        return self._hold(source, expected, number, key, payload, joining=False)

    def _hold(
        self, source: _Source, low: int, first: int, key: str, payload: bytes, *, joining: bool
    ) -> Question[_Source]:
        held = self._held[source] = _Held(key, low, first, joining, self._clock(), 0)
        self._next[source] = -1  # nothing is in its turn while this waits
        held.later.append((first, key, payload))
        self._keep(held, len(payload))
        return self._question(source, held)

    def _question(self, source: _Source, held: _Held) -> Question[_Source]:
        self._questions += 1
        held.question, held.due = self._questions, None
        # The newest one: by the time of the answer the cache may have forgotten older ones.
        witness = None if held.joining else held.later[-1][0]
        return Question(source, held.key, held.low, held.first - 1, witness, held.question)

    def _release(self, source: _Source) -> Question[_Source] | None:
        """Everything goes on, in order, up to the next gap, for which this returns the question."""
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
            behind = (number - expected) % _WRAP >= _WRAP // 2
            if number > expected and not behind:
                question = self._hold(source, expected, number, key, payload, joining=False)
                rest = self._held[source]
                rest.later.extend(held.later)
                self._keep(rest, sum(len(one[2]) for one in held.later))
                return question
            if not behind:
                self._push(source, key, payload)
                expected = (number + 1) % _WRAP
        self._next[source] = expected
        return None

    def _keep(self, held: _Held, size: int) -> None:
        held.bytes += size
        self._bytes += size

    def _forget_some(self) -> None:
        """Of very many publishers those that were met first; what they still say counts as a late joiner's."""
        if len(self._next) >= _MOST_SOURCES:
            for source in list(self._next)[: _MOST_SOURCES // 4]:
                if source not in self._held:
                    del self._next[source]
