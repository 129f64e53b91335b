"""The bus inside one process: the same guarantees as over Zenoh, without sockets.

A MemoryHub stands for the network; every MemoryBus made on it is one process's connection. Messages
are encoded and decoded on the way, so only messages that would pass over Zenoh pass here.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from google.protobuf.message import Message

from protocols.bus.base import BusDead
from protocols.bus.transport.inbox import InboxSubscription, LivenessTracker, subscription_key
from protocols.core.closing import Closing
from protocols.core.names import check_identifier
from protocols.topics import Topic, cache_size, liveliness_key
from protocols.validation.codec import encode, parse_key


class MemoryHub:
    """The network that several MemoryBus share.

    clock_ns: stamps arrivals (Unix, ns); tests pass their own.
    """

    def __init__(self, clock_ns: Callable[[], int] = time.time_ns) -> None:
        self.clock_ns = clock_ns
        self.lock = threading.RLock()
        self.changed = threading.Condition(self.lock)
        self.publishers: list[MemoryPublisher] = []
        self.subscriptions: list[MemorySubscription] = []
        self.watches: list[MemoryWatch] = []
        self.tokens: list[str] = []

    def mark(self, key: str, alive: bool) -> None:
        """Add or remove one liveliness token and notify the watches of its site."""
        with self.lock:
            if alive:
                self.tokens.append(key)
            elif key in self.tokens:
                self.tokens.remove(key)
            for watch in self.watches:
                watch.mark(key, key in self.tokens)


class MemoryPublisher:
    """See ``protocols.bus.base.Publisher``."""

    def __init__(self, hub: MemoryHub, topic: Topic, key: str, rate_hz: float | None) -> None:
        self.key = key
        self.cache: deque[bytes] = deque(maxlen=cache_size(topic, rate_hz))
        self._hub = hub
        self._message = topic.message
        self._closed = False
        with hub.lock:
            hub.publishers.append(self)

    def put(self, message: Message) -> None:
        """Deliver to every matching subscription at once, and cache it for late ones."""
        if message.DESCRIPTOR.name != self._message:
            raise TypeError(f"{message.DESCRIPTOR.name} on a topic of {self._message}")
        payload = encode(message)
        with self._hub.lock:
            if self._closed:
                raise BusDead("the publisher is closed")
            self.cache.append(payload)
            for subscription in self._hub.subscriptions:
                if subscription.matches(self.key):
                    subscription.inbox.push(self.key, payload)

    def wait_matched(self, timeout_s: float) -> bool:
        with self._hub.changed:
            return self._hub.changed.wait_for(
                lambda: any(subscription.matches(self.key) for subscription in self._hub.subscriptions),
                timeout_s,
            )

    def close(self) -> None:
        with self._hub.lock:
            self._closed = True
            if self in self._hub.publishers:
                self._hub.publishers.remove(self)


class MemorySubscription(InboxSubscription):
    """See ``protocols.bus.base.Subscription``."""

    def __init__(self, hub: MemoryHub, topic: Topic, site: str, agent: str) -> None:
        subscription_key(topic, site, agent)  # raises for a name that Zenoh would reject too
        self._hub = hub
        self._topic = topic
        self._site = site
        self._agent = agent
        super().__init__(topic, hub.clock_ns)
        with hub.changed:
            for publisher in hub.publishers:
                if self.matches(publisher.key):
                    for payload in publisher.cache:
                        self.inbox.push(publisher.key, payload)
            hub.subscriptions.append(self)
            hub.changed.notify_all()

    def matches(self, key: str) -> bool:
        """Whether this subscription receives messages of this key."""
        address = parse_key(key)
        return (
            address is not None
            and address.topic is self._topic
            and address.site == self._site
            and self._agent in ("*", address.agent)
        )

    def close(self) -> None:
        with self._hub.lock:
            if self in self._hub.subscriptions:
                self._hub.subscriptions.remove(self)


class MemoryWatch(LivenessTracker):
    """See ``protocols.bus.base.AgentWatch``."""

    def __init__(self, hub: MemoryHub, site: str) -> None:
        self._hub = hub
        self._prefix = f"syncline/{site}/alive/"
        super().__init__()
        with hub.lock:
            hub.watches.append(self)
            for key in hub.tokens:
                self.mark(key, True)

    def mark(self, key: str, alive: bool) -> None:
        if key.startswith(self._prefix):
            super().mark(key, alive)

    def close(self) -> None:
        with self._hub.lock:
            if self in self._hub.watches:
                self._hub.watches.remove(self)


class MemoryBus(Closing):
    """See ``protocols.bus.base.Bus``."""

    def __init__(self, hub: MemoryHub, site: str = "local") -> None:
        self._hub = hub
        self._site = check_identifier(site, "site")
        self._declared: list[MemoryPublisher | MemorySubscription | MemoryWatch] = []
        self._tokens: list[str] = []
        self._closed = False

    @property
    def site(self) -> str:
        return self._site

    def publisher(
        self, topic: Topic, agent: str, *, rate_hz: float | None = None, block: bool = False
    ) -> MemoryPublisher:
        """Declare a publisher; ``block`` changes nothing here, since memory has no slow link."""
        self._check_open()
        publisher = MemoryPublisher(self._hub, topic, topic.key_for(self._site, agent), rate_hz)
        self._declared.append(publisher)
        return publisher

    def subscribe(self, topic: Topic, agent: str = "*") -> MemorySubscription:
        self._check_open()
        subscription = MemorySubscription(self._hub, topic, self._site, agent)
        self._declared.append(subscription)
        return subscription

    def connected(self) -> bool:
        return not self._closed

    @contextmanager
    def announce(self, role: str, agent: str, boot_id: str) -> Iterator[None]:
        """Hold a liveliness token while the context is open, or until the bus is closed."""
        self._check_open()
        key = liveliness_key(self._site, role, agent, boot_id)
        self._tokens.append(key)
        self._hub.mark(key, True)
        try:
            yield
        finally:
            if key in self._tokens:
                self._tokens.remove(key)
                self._hub.mark(key, False)

    def watch_agents(self) -> MemoryWatch:
        self._check_open()
        watch = MemoryWatch(self._hub, self._site)
        self._declared.append(watch)
        return watch

    def close(self) -> None:
        """Remove everything that was declared, as at the end of a process."""
        self._closed = True
        while self._declared:
            self._declared.pop().close()
        while self._tokens:
            self._hub.mark(self._tokens.pop(), False)

    def _check_open(self) -> None:
        if self._closed:
            raise BusDead("the bus is closed")
