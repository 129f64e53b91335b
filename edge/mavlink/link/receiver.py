"""A thread that listens to the vehicle beside the agent's loop."""

from __future__ import annotations

import queue
import threading

from edge.mavlink.link.connection import Heard, Link


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
