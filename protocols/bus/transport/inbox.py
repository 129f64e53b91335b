"""Bounded receive queue between the transport's threads and the agent's loop, and tracking of live agents."""

from __future__ import annotations

import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping, Set
from itertools import chain
from typing import TypeAlias

from google.protobuf.message import Message

from protocols.bus.base import AgentEvent, Received, Refusal
from protocols.core.names import name_of_segment
from protocols.topics import Topic
from protocols.validation.codec import MAX_PAYLOAD, admit_all, parse_key
from protocols.validation.rules import Rejected, RejectionReason

MAX_BYTES = 32 * 1024 * 1024
"""Upper bound of one inbox in bytes, so that a reader that has stopped does not exhaust the memory; half of it of
anything but images, which is five seconds of a thousand cameras at 30 Hz."""
MAX_BYTES_OF_KEY = MAX_BYTES // 8
"""The same of one sender, four times as much of images: who floods pays, not the others."""
BYTES_PER_S = 8 * 1024 * 1024
"""What one sender of anything but images may send; to validate that takes a quarter of a core. A hundred people with
all their fields at 30 Hz are 0.6 MB/s, and a log that is replayed as fast as it goes 2 MB/s."""
_BYTES_PER_NS, _BURST_BYTES = BYTES_PER_S * 1e-9, 4.0 * BYTES_PER_S
_MAX_DRAIN, _LEAST_DRAIN = 4096, 16
"""Messages that are decoded at once, which takes 0.2 s, and of each sender, where there are so many."""
_MAX_DRAIN_BYTES = 1024 * 1024
"""The same in bytes: frames of hundreds of detections take 50 ms a megabyte."""
_MAX_NUMBERED = 4096
"""Boots of plain publishers whose last number is remembered."""
_MAX_ALIVE = 16_384
"""Runs of agents that are alive at once."""
_MAX_REFUSALS = 256
"""Rejections that are kept for reports; all of them are counted."""

Arrived: TypeAlias = tuple[str, bytes, int, str, bool]
"""Key, payload, arrival [ns], source, whether the transport counts its publisher's messages."""
_Queued: TypeAlias = tuple[int, str, bytes, int, str, bool]
"""The order before that."""


class Inbox:
    """Queues raw samples and returns validated messages. push and count_lost may be called from any thread.

    Decoding happens in ``drain``, on the consumer's thread: a transport's thread must only enqueue,
    since a slow one starves every subscription of the session.
    """

    def __init__(self, topic: Topic, clock_ns: Callable[[], int] = time.time_ns) -> None:
        self._clock_ns = clock_ns
        self._capacity = topic.queue
        self._most_of_key = MAX_BYTES_OF_KEY * (4 if topic.bulky else 1)
        self._most = MAX_BYTES if topic.bulky else MAX_BYTES // 2
        self._queues: dict[str, deque[_Queued]] = {}
        self._sizes: Counter[str] = Counter()
        self._length = self._bytes = self._order = 0
        self._credit: dict[str, tuple[float, int]] = {}
        self._bulky = topic.bulky
        self._newest: dict[tuple[str, str], int] = {}
        self._refusals: list[Refusal] = []
        self._ignored: Set[str] = frozenset()
        self._ready = threading.Condition()  # its lock is re-entrant
        self._counts: Counter[str] = Counter(received=0, dropped=0, lost=0)

    def push(self, key: str, payload: bytes, source: str = "", *, numbered: bool = True) -> None:
        """Queue one sample; where the queue is full, the oldest of who has most in it is dropped and counted.

        numbered: whether the transport counts its publisher's messages; otherwise losses show in their own numbers.
        """
        self.push_all(deque([(key, payload, self._clock_ns(), source, numbered)]))

    def push_all(self, arrived: deque[Arrived]) -> None:
        """The same of several, which are removed from ``arrived``: whoever calls it, they are queued in its order."""
        with self._ready:
            was_empty = self._length == 0
            groups: defaultdict[str, list[_Queued]] = defaultdict(list)
            first, self._order = self._order, self._order + len(arrived)
            for order in range(first, self._order):
                one = arrived.popleft()
                groups[one[0]].append((order, *one))
            for key, queued in groups.items():
                if not self._is_ignored(key):
                    self._queue(key, queued)
            while self._length > self._capacity or self._bytes > self._most:
                by_count = self._length > self._capacity
                self._drop(max(self._queues, key=lambda one: len(self._queues[one]) if by_count else self._sizes[one]))
            if was_empty and self._length:  # nobody waits while there is more
                self._ready.notify_all()

    def ignore(self, agents: Set[str]) -> None:
        """Queue nothing that these agents send."""
        self._ignored = agents

    def _is_ignored(self, key: str) -> bool:
        address = parse_key(key) if self._ignored else None
        return address is not None and address.agent in self._ignored

    def _queue(self, key: str, queued: list[_Queued]) -> None:
        sizes = [len(one[2]) for one in queued]
        if max(sizes) > MAX_PAYLOAD or not self._affords(key, sum(sizes), queued[0][3]):
            queued = [one for one in queued if self._passes(key, len(one[2]), one[3])]
            sizes = [len(one[2]) for one in queued]
        if queued:
            self._queues.setdefault(key, deque()).extend(queued)
            self._add(key, len(queued), sum(sizes))
        while self._sizes[key] > self._most_of_key:
            self._drop(key)

    def _passes(self, key: str, size: int, now: int) -> bool:
        """Whether one message is queued; counted if not."""
        if size > MAX_PAYLOAD:
            self.refuse(Rejected(RejectionReason.OVERSIZED, f"{size} bytes, at most {MAX_PAYLOAD}"), key)
            return False
        good = self._affords(key, size, now)
        self._counts["dropped"] += not good
        return good

    def _affords(self, key: str, size: int, now: int) -> bool:
        """Whether a sender has not sent too many bytes lately."""
        if self._bulky:
            return True
        known = self._credit.get(key)
        if known is None:
            if len(self._credit) >= _MAX_ALIVE:
                del self._credit[next(iter(self._credit))]
            credit = _BURST_BYTES
        else:
            credit = known[0]
            if now > known[1]:
                credit = min(_BURST_BYTES, credit + (now - known[1]) * _BYTES_PER_NS)
        good = credit >= size
        self._credit[key] = (credit - size if good else credit, now)
        return good

    def _add(self, key: str, count: int, size: int) -> None:
        self._length += count
        self._bytes += size
        self._sizes[key] += size

    def _drop(self, key: str) -> None:
        self._add(key, -1, -len(self._queues[key].popleft()[2]))
        if not self._queues[key]:
            del self._queues[key], self._sizes[key]
        self._counts["dropped"] += 1

    def refuse(self, error: Rejected, key: str, sequence: int | None = None) -> None:
        """Count one rejected message, and keep it for ``refusals``."""
        address = parse_key(key)
        refusal = Refusal(error.reason.value, address.agent if address else "", key[:200], error.detail, sequence)
        with self._ready:
            self._counts[f"rejected.{refusal.reason}"] += 1
            if len(self._refusals) < _MAX_REFUSALS:
                self._refusals.append(refusal)

    def refusals(self) -> list[Refusal]:
        """The messages rejected since the last call."""
        with self._ready:
            refusals, self._refusals = self._refusals, []
        return refusals

    def count_lost(self, count: int) -> None:
        """Count messages that the transport knows to be lost."""
        with self._ready:
            self._counts["lost"] += count

    def count_skipped(self, count: int) -> None:
        """Count lost messages of a topic with Delivery.LATEST."""
        with self._ready:
            self._counts["skipped"] += count

    def drain(self) -> list[Received]:
        """Decode and validate what is queued: all of it or, of who sends very much, a share."""
        with self._ready:
            queues = self._taken()
        messages: list[Received] = []
        # Sorting joins the queues, each of them in order, faster than a heap that is merged in Python.
        merged = sorted(chain.from_iterable(queues.values())) if len(queues) > 1 else [*chain(*queues.values())]
        new = tuple.__new__  # half of what Received's own takes
        admitted = admit_all([one[1] for one in merged], [one[2] for one in merged])
        for (_, key, _, arrival_ns, source, numbered), found in zip(merged, admitted, strict=True):
            if isinstance(found, Rejected):
                self.refuse(found, key, found.sequence)
                continue
            address, message = found
            if not numbered:
                self._count_gap(key, message)
            messages.append(new(Received, (address.topic, address.agent, message, arrival_ns, source)))
        with self._ready:
            self._counts["received"] += len(messages)
        return messages

    def _taken(self) -> dict[str, list[_Queued]]:
        """What is decoded now, by key, removed from the queues."""
        if self._length <= _MAX_DRAIN and (self._bulky or self._bytes <= _MAX_DRAIN_BYTES):
            queues = {key: list(queue) for key, queue in self._queues.items()}
            self._queues = {}
            self._sizes.clear()
            self._length = self._bytes = 0
            return queues
        share = max(_MAX_DRAIN // len(self._queues), _LEAST_DRAIN)
        share_bytes = _MAX_DRAIN_BYTES // len(self._queues)
        queues, total = {}, 0
        # Those with little first; of the others who was served last comes last.
        for key in sorted(self._queues, key=lambda one: self._sizes[one] > share_bytes):
            queue = self._queues[key]
            taken, size = [queue.popleft()], 0
            while queue and len(taken) < share and (size := size + len(taken[-1][2])) < share_bytes:
                taken.append(queue.popleft())
            queues[key] = taken
            self._add(key, -len(taken), -sum(len(item[2]) for item in taken))
            del self._queues[key]
            if queue:
                self._queues[key] = queue
            else:
                del self._sizes[key]
            total += sum(len(item[2]) for item in taken)
            if total >= _MAX_DRAIN_BYTES and not self._bulky:
                break
        return queues

    def _count_gap(self, key: str, message: Message) -> None:
        """Count the losses of a plain publisher by the numbers in its messages."""
        number, boot = getattr(message, "sequence", None), getattr(message, "boot_id", "")
        if number is None:
            return
        newest = self._newest.pop((key, boot), number - 1)
        if len(self._newest) >= _MAX_NUMBERED:
            del self._newest[next(iter(self._newest))]
        self._newest[key, boot] = max(newest, number)
        if number > newest + 1:
            self.count_lost(number - newest - 1)

    def wait(self, timeout_s: float) -> bool:
        """Wait until something is queued."""
        with self._ready:
            return self._ready.wait_for(lambda: self._length > 0, timeout_s)

    @property
    def counters(self) -> Mapping[str, int]:
        """A copy of the counts."""
        with self._ready:
            return dict(self._counts)


class InboxSubscription:
    """What subscriptions of all transports share; see ``protocols.bus.base.Subscription``."""

    def __init__(self, topic: Topic, clock_ns: Callable[[], int]) -> None:
        self.inbox = Inbox(topic, clock_ns)

    def drain(self) -> list[Received]:
        """Everything since the last call."""
        return self.inbox.drain()

    def wait(self, timeout_s: float) -> bool:
        """Wait for something to drain."""
        return self.inbox.wait(timeout_s)

    @property
    def counters(self) -> Mapping[str, int]:
        """See the contract."""
        return self.inbox.counters

    def flush(self) -> None:
        """Nothing is held back, unless the transport recovers what is missing."""

    def ignore(self, agents: Set[str]) -> None:
        """Drop what these agents send."""
        self.inbox.ignore(agents)

    def refusals(self) -> list[Refusal]:
        """The messages rejected since the last call."""
        return self.inbox.refusals()


class LivenessTracker:
    """Tracks which agents are alive, as a list of changes. A token seen twice, as after a reconnect, is one change."""

    def __init__(self) -> None:
        self._alive: set[tuple[str, str, str]] = set()
        self._events: list[AgentEvent] = []
        self._lock = threading.Lock()

    def mark(self, key: str, alive: bool) -> None:
        """Process a liveliness token's key ``syncline/<site>/alive/<role>/<agent>/<boot>``; others are ignored."""
        parts = key.split("/")
        if len(parts) != 6 or parts[2] != "alive":
            return
        agent = name_of_segment(parts[4])
        if agent is None:
            return
        who = (parts[3], agent, parts[5])
        with self._lock:
            if alive == (who in self._alive) or (alive and len(self._alive) >= _MAX_ALIVE):
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
    return topic.key_expression(site) if agent == "*" else topic.key_for(site, agent)
