"""What an agent says, handed to the bus in a thread of its own, so that nothing the bus does holds up a capture."""

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

_FLUSH_S = 2.0
_IDLE_S = 0.2
_LOOK_S = 1.0  # how often it is asked who listens


class Outbox:
    """Hands on the messages of some topics; when full it loses the newest, and counts it.

    most: how many may wait. beat: asked five times a second for messages that are due whatever the agent's own thread
    is doing. sent, lost: messages by topic that went out, and that did not. wanted: the topics that somebody is
    subscribed to; None until it has been asked.
    """

    def __init__(
        self,
        bus: Bus,
        agent: str,
        topics: Iterable[Topic],
        most: int,
        beat: Callable[[], Iterable[tuple[Topic, Message]]] = lambda: (),
    ) -> None:
        self._bus, self._agent, self._topics, self._beat = bus, agent, tuple(topics), beat
        self._queue: queue.Queue[tuple[Topic, Message] | None] = queue.Queue(most)
        self._thread = threading.Thread(target=self._run, name=f"outbox {agent}", daemon=True)
        self._error: Exception | None = None
        self.sent: Counter[Topic] = Counter()
        self.lost: Counter[Topic] = Counter()
        self.wanted: frozenset[Topic] | None = None

    def put(self, topic: Topic, message: Message) -> None:
        """Never waits. Raises what the bus has raised."""
        self.check()
        try:
            self._queue.put_nowait((topic, message))
        except queue.Full:
            self.lost[topic] += 1

    def check(self) -> None:
        """Raises what the bus has raised."""
        if self._error is not None:
            raise self._error

    def wants(self, topic: Topic) -> bool:
        """Whether somebody is known to be subscribed to a topic."""
        return self.wanted is not None and topic in self.wanted

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Send what is left, within 2 s."""
        try:
            self._queue.put(None, timeout=_FLUSH_S)
            self._thread.join(_FLUSH_S)
        except queue.Full:
            pass  # the bus hangs; the thread is a daemon and the process may end
        if kind is None:
            self.check()

    def _run(self) -> None:
        publishers: dict[Topic, Publisher] = {}
        try:
            for topic in self._topics:
                publishers[topic] = self._bus.publisher(topic, self._agent)
            look = 0.0
            while True:
                for topic, message in self._beat():
                    publishers[topic].put(message)
                try:
                    item = self._queue.get(timeout=_IDLE_S)
                except queue.Empty:
                    continue
                if item is None:
                    break
                topic, message = item
                publishers[topic].put(message)
                self.sent[topic] += 1
                if time.monotonic() >= look:
                    look = time.monotonic() + _LOOK_S
                    self.wanted = frozenset(one for one, out in publishers.items() if out.wait_matched(0.0))
        except Exception as error:  # noqa: BLE001 - it belongs to the thread that runs the agent
            self._error = error
