"""Clean termination of a process on SIGTERM, SIGINT and SIGHUP."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


def stop_on_signals() -> threading.Event:
    """An event that SIGTERM and SIGINT set; a second signal terminates the process immediately.

    Call it on the main thread.
    """
    stop = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        stop.set()
        signal.signal(number, signal.SIG_DFL)

    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)
    return stop


class Interruption:
    """A termination request, and sections of code in which it is deferred."""

    def __init__(self) -> None:
        self._requested, self._deferring = False, False

    def is_set(self) -> bool:
        """Whether termination was requested."""
        return self._requested

    def request(self) -> None:
        """Record the request, and raise KeyboardInterrupt unless it is deferred."""
        self._requested = True
        if not self._deferring:
            raise KeyboardInterrupt

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Defer a request to the end of the block, so that a child process started in it is not orphaned."""
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False
        if self._requested:
            raise KeyboardInterrupt


def interrupt_on_signals() -> Interruption:
    """The interruption that SIGTERM, SIGHUP and SIGINT request as they raise KeyboardInterrupt; long waits poll it.

    Python discards an exception that is raised while an object is deleted, so the exception alone could be lost.
    """
    interruption = Interruption()

    def handle(number: int, frame: FrameType | None) -> None:
        interruption.request()

    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(number, handle)
    return interruption
