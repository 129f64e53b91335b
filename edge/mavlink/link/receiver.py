"""A receiving thread for a MAVLink link."""

from __future__ import annotations

import queue
import threading

from edge.mavlink.link.connection import Link, ReceivedMessage


class Receiver:
    """Polls a link in its own thread, so that slow image processing does not delay the arrival times of messages."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._messages: queue.Queue[ReceivedMessage] = queue.Queue(4096)
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)

    def drain(self) -> list[ReceivedMessage]:
        """Messages received since the last call. Re-raises an error of the thread."""
        if self._error is not None:
            raise self._error
        out = []
        while True:
            try:
                out.append(self._messages.get_nowait())
            except queue.Empty:
                return out

    def __enter__(self) -> Receiver:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(2.0)

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._link.wait(0.05)
                for received in self._link.poll():
                    if not self._messages.full():
                        self._messages.put(received)
        except Exception as error:  # noqa: BLE001 - re-raised in the thread that runs the agent
            self._error = error
