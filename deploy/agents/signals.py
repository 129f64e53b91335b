"""Stopping a process in order."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


def stop_on_signals() -> threading.Event:
    """An event that SIGTERM and SIGINT set; a second signal ends the process at once.

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
    """Whether the process was told to end, and stretches in which that must wait."""

    def __init__(self) -> None:
        self._told, self._holding = False, False

    def is_set(self) -> bool:
        """Whether it was told to end."""
        return self._told

    def tell(self) -> None:
        """Note it, and raise KeyboardInterrupt unless that must wait."""
        self._told = True
        if not self._holding:
            raise KeyboardInterrupt

    @contextmanager
    def held(self) -> Iterator[None]:
        """Let a word to end wait until the block is through: a process begun in it would else be nobody's."""
        self._holding = True
        try:
            yield
        finally:
            self._holding = False
        if self._told:
            raise KeyboardInterrupt


def interrupt_on_signals() -> Interruption:
    """What SIGTERM, SIGHUP and SIGINT tell as they raise KeyboardInterrupt; whoever waits long looks at it.

    What is raised while an object is being deleted is lost, and with it the only word that the process should end.
    """
    told = Interruption()

    def handle(number: int, frame: FrameType | None) -> None:
        told.tell()

    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(number, handle)
    return told
