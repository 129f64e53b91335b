"""A bounded queue of outgoing messages with a publishing thread, so that a slow bus cannot delay a capture."""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Self

from google.protobuf.message import Message

from protocols.bus.base import Bus, Publisher
from protocols.topics import Topic

_FLUSH_S = 2.0  # for what is left at the end; a bus that hangs does not hold the process
_POLL_S = 0.2  # between two looks whether the thread is to end
_SUBSCRIBER_CHECK_S = 1.0  # between two checks of which topics have subscribers


class PublishQueue:
    """Publishes the messages of some topics from its own thread; a full queue drops and counts new messages.

    capacity: greatest number of waiting messages. due_messages: called five times a second by the publishing thread for
    messages that are due even while the agent's own thread is blocked. sent, unsent: published and dropped messages by
    topic. subscribed_topics: topics that have a subscriber; None until the first check.
    """

    def __init__(
        self,
        bus: Bus,
        agent: str,
        topics: Iterable[Topic],
        capacity: int,
        due_messages: Callable[[], Iterable[tuple[Topic, Message]]] = lambda: (),
    ) -> None:
        self._bus, self._agent, self._topics, self._due_messages = bus, agent, tuple(topics), due_messages
        self._queue: queue.Queue[tuple[Topic, Message] | None] = queue.Queue(capacity)
        self._thread = threading.Thread(target=self._run, name=f"publisher {agent}", daemon=True)
        self._error: Exception | None = None
        self.sent: Counter[Topic] = Counter()
        self.unsent: Counter[Topic] = Counter()
        self.subscribed_topics: frozenset[Topic] | None = None

    def put(self, topic: Topic, message: Message) -> None:
        """Enqueue without waiting. Re-raises an error of the publishing thread."""
        self.check()
        try:
            self._queue.put_nowait((topic, message))
        except queue.Full:
            self.unsent[topic] += 1

    def check(self) -> None:
        """Re-raise an error of the publishing thread."""
        if self._error is not None:
            raise self._error

    def has_subscriber(self, topic: Topic) -> bool:
        """Whether a topic is known to have a subscriber."""
        return self.subscribed_topics is not None and topic in self.subscribed_topics

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Publish what is left, within 2 s."""
        try:
            self._queue.put(None, timeout=_FLUSH_S)
            self._thread.join(_FLUSH_S)
        except queue.Full:
            pass  # the bus hangs; the thread is a daemon and does not keep the process alive
        if kind is None:
            self.check()

    def _run(self) -> None:
        publishers: dict[Topic, Publisher] = {}
        try:
            for topic in self._topics:
                publishers[topic] = self._bus.publisher(topic, self._agent)
            next_check = 0.0
            while True:
                for topic, message in self._due_messages():
                    publishers[topic].put(message)
                try:
                    item = self._queue.get(timeout=_POLL_S)
                except queue.Empty:
                    continue
                if item is None:
                    break
                topic, message = item
                publishers[topic].put(message)
                self.sent[topic] += 1
                if time.monotonic() >= next_check:
                    next_check = time.monotonic() + _SUBSCRIBER_CHECK_S
                    self.subscribed_topics = frozenset(one for one, out in publishers.items() if out.wait_matched(0.0))
        except Exception as error:  # noqa: BLE001 - re-raised in the thread that runs the agent
            self._error = error
