"""The threads beside the UAV agent's loop: one listens to the vehicle, one speaks to the bus."""

from __future__ import annotations

import queue
import threading
from collections.abc import Mapping

from google.protobuf.message import Message

from edge.mavlink.link import Heard, Link
from protocols.bus.base import Bus, Publisher
from protocols.catalogue import Topic

_OUTBOX = 2048
_FLUSH_S = 2.0


class Ear:
    """Listens on a link in a thread of its own, so that a slow picture does not make messages late."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._heard: queue.Queue[Heard] = queue.Queue(4096)
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)

    def drain(self) -> list[Heard]:
        """What came since the last call. Raises what the thread has raised."""
        if self._error is not None:
            raise self._error
        out = []
        while True:
            try:
                out.append(self._heard.get_nowait())
            except queue.Empty:
                return out

    def __enter__(self) -> Ear:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(2.0)

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._link.wait(0.05)
                for heard in self._link.poll():
                    if not self._heard.full():
                        self._heard.put(heard)
        except Exception as error:  # noqa: BLE001 - it belongs to the thread that runs the agent
            self._error = error


class Outbox:
    """Hands messages to the bus in a thread of its own; when full it loses the newest, and counts it in ``lost``.

    topics: by the name of their message.
    """

    def __init__(self, bus: Bus, agent: str, topics: Mapping[str, Topic]) -> None:
        self._bus, self._agent, self._topics = bus, agent, topics
        self._queue: queue.Queue[Message | None] = queue.Queue(_OUTBOX)
        self._thread = threading.Thread(target=self._run, name=f"outbox {agent}", daemon=True)
        self._error: Exception | None = None
        self.lost = 0

    def put(self, message: Message) -> None:
        """Never waits. Raises what the bus has raised."""
        if self._error is not None:
            raise self._error
        try:
            self._queue.put_nowait(message)
        except queue.Full:
            self.lost += 1

    def __enter__(self) -> Outbox:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Send what is left, within 2 s."""
        try:
            self._queue.put(None, timeout=_FLUSH_S)
            self._thread.join(_FLUSH_S)
        except queue.Full:
            pass  # the bus hangs; the thread is a daemon and the process may end
        if kind is None and self._error is not None:
            raise self._error

    def _run(self) -> None:
        publishers: dict[str, Publisher] = {}
        try:
            for name, topic in self._topics.items():
                publishers[name] = self._bus.publisher(topic, self._agent)
            while (message := self._queue.get()) is not None:
                publishers[message.DESCRIPTOR.name].put(message)
        except Exception as error:  # noqa: BLE001 - it belongs to the thread that runs the agent
            self._error = error
