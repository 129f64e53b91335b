"""The bounded queue between a transport's threads and the agent's loop, with its counters."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping

from protocols.bus.base import AgentEvent, Received, Refusal
from protocols.topics import Topic, valid_id
from protocols.validation.codec import MAX_PAYLOAD, Reason, Rejected, admit, parse_key

MOST_BYTES = 64 * 1024 * 1024
"""What one inbox holds at most, however few messages that is: a reader that stands still fills no machine."""
_TOLD = 256
"""Refusals that are kept for telling; all of them are counted."""


class Inbox:
    """Raw samples in, gated messages out. push and lose may be called from any thread.

    Decoding happens in ``drain``, on the consumer's thread: a transport's callback must only enqueue,
    since a slow one starves every subscription of the session.
    """

    def __init__(self, topic: Topic, clock_ns: Callable[[], int] = time.time_ns) -> None:
        self._clock_ns = clock_ns
        self._capacity = topic.queue
        self._queue: deque[tuple[str, bytes, int, str]] = deque()
        self._bytes = 0
        self._refusals: list[Refusal] = []
        self._ready = threading.Condition()
        self._counts: Counter[str] = Counter(received=0, dropped=0, lost=0)

    def push(self, key: str, payload: bytes, source: str = "") -> None:
        """Queue one sample; the oldest is dropped and counted when the queue is full."""
        if len(payload) > MAX_PAYLOAD:
            self.refuse(Rejected(Reason.OVERSIZED, f"{len(payload)} bytes, at most {MAX_PAYLOAD}"), key)
            return
        now = self._clock_ns()
        with self._ready:
            self._bytes += len(payload)
            while self._queue and (len(self._queue) >= self._capacity or self._bytes > MOST_BYTES):
                self._bytes -= len(self._queue.popleft()[1])
                self._counts["dropped"] += 1
            self._queue.append((key, payload, now, source))
            self._ready.notify_all()

    def refuse(self, error: Rejected, key: str, sequence: int | None = None) -> None:
        """Count, and keep for telling, one message that is not let in."""
        address = parse_key(key)
        refusal = Refusal(error.reason.value, address.agent if address else "", key[:200], error.detail, sequence)
        with self._ready:
            self._counts[f"rejected.{refusal.reason}"] += 1
            if len(self._refusals) < _TOLD:
                self._refusals.append(refusal)

    def refusals(self) -> list[Refusal]:
        """What was refused since the last call."""
        with self._ready:
            told, self._refusals = self._refusals, []
        return told

    def lose(self, count: int) -> None:
        """Count messages that the transport knows will never come."""
        with self._ready:
            self._counts["lost"] += count

    def skip(self, count: int) -> None:
        """Count messages that never came of a topic of which the newest is enough."""
        with self._ready:
            self._counts["skipped"] += count

    def drain(self) -> list[Received]:
        """Take everything that is queued and let it through the gate."""
        with self._ready:
            queue, self._queue, self._bytes = self._queue, deque(), 0
        messages: list[Received] = []
        for key, payload, arrival_ns, source in queue:
            try:
                address, message = admit(key, payload)
            except Rejected as error:
                self.refuse(error, key, error.sequence)
                continue
            messages.append(Received(address.topic, address.agent, message, arrival_ns, source))
        with self._ready:
            self._counts["received"] += len(messages)
        return messages

    def wait(self, timeout_s: float) -> bool:
        """Wait until something is queued."""
        with self._ready:
            return self._ready.wait_for(lambda: bool(self._queue), timeout_s)

    @property
    def counters(self) -> Mapping[str, int]:
        """A copy of the counts."""
        with self._ready:
            return dict(self._counts)


class Roll:
    """Who is alive, as changes. A token seen twice, as after a reconnect, is one change."""

    def __init__(self) -> None:
        self._alive: set[tuple[str, str, str]] = set()
        self._events: list[AgentEvent] = []
        self._lock = threading.Lock()

    def mark(self, key: str, alive: bool) -> None:
        """Take note of a key ``syncline/<site>/alive/<role>/<agent>/<boot>``; others are ignored."""
        parts = key.split("/")
        if len(parts) != 6 or parts[2] != "alive":
            return
        who = (parts[3], parts[4], parts[5])
        with self._lock:
            if alive == (who in self._alive):
                return
            if alive:
                self._alive.add(who)
            else:
                self._alive.discard(who)
            self._events.append(AgentEvent(*who, alive))

    def drain(self) -> list[AgentEvent]:
        """The changes since the last call."""
        with self._lock:
            events, self._events = self._events, []
        return events


def subscription_key(topic: Topic, site: str, agent: str) -> str:
    """The key expression of a subscription to one agent, or to all with ``*``."""
    return topic.key_expression(site) if agent == "*" else topic.key_for(site, valid_id(agent, "id"))
