"""Makes a late joiner's history whole.

Zenoh's advanced subscriber (1.10.2) asks for history twice: once when it is declared, once for each
publisher that it detects. If the first of these ends while answers to the second are coming in, it
begins to deliver in the middle of the history and takes everything earlier for old: a late joiner then
misses the beginning, in silence. Seen in 6 of 15 joins to four cameras on a busy machine.

So whoever's first message is not number 0 is asked once more for what came before it; its messages
are held until the answer is there. Usually there is none, because the cache does not reach back further.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

_Source = TypeVar("_Source", bound=Hashable)

PATIENCE_S = 3.0
"""After this a publisher's messages are let through even if it has not answered."""


@dataclass(slots=True)
class _Held:
    """Messages of one publisher that wait for what came before them."""

    first: int
    since: float
    early: dict[int, tuple[str, bytes]] = field(default_factory=dict)
    later: list[tuple[str, bytes]] = field(default_factory=list)


class Backfill(Generic[_Source]):
    """Stands before an inbox; may be called from any thread.

    push: takes (source, key, payload) of a message in its turn. fetch: called once for a publisher whose first
    message has a number above 0, with that message's key; the answers go to ``answer``, then ``finish``.
    """

    def __init__(
        self,
        push: Callable[[_Source, str, bytes], None],
        fetch: Callable[[str, _Source, int], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._push = push
        self._fetch = fetch
        self._clock = clock
        self._known: set[_Source] = set()
        self._held: dict[_Source, _Held] = {}
        self._lock = threading.Lock()

    def take(self, source: _Source, number: int, key: str, payload: bytes) -> None:
        """A message as the transport delivers it: in order from its publisher's first one on."""
        with self._lock:
            held = self._held.get(source)
            if held is not None:
                held.later.append((key, payload))
                return
            if source in self._known or number == 0:
                self._known.add(source)
                self._push(source, key, payload)
                return
            self._known.add(source)
            self._held[source] = _Held(number, self._clock(), later=[(key, payload)])
        self._fetch(key, source, number)

    def answer(self, source: _Source, number: int, key: str, payload: bytes) -> None:
        """One of the earlier messages."""
        with self._lock:
            held = self._held.get(source)
            if held is not None and number < held.first:
                held.early[number] = (key, payload)

    def finish(self, source: _Source) -> None:
        """There are no more answers: everything goes on, in order."""
        with self._lock:
            held = self._held.pop(source, None)
            if held is not None:
                for _, message in sorted(held.early.items()):
                    self._push(source, *message)
                for message in held.later:
                    self._push(source, *message)

    def release_overdue(self) -> None:
        """Let through what has waited longer than PATIENCE_S."""
        now = self._clock()
        with self._lock:
            overdue = [source for source, held in self._held.items() if now - held.since > PATIENCE_S]
        for source in overdue:
            self.finish(source)
