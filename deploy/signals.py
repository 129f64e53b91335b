"""Stopping a process in order."""

from __future__ import annotations

import signal
import threading
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


def interrupt_on_signals() -> threading.Event:
    """An event that SIGTERM, SIGHUP and SIGINT set as they raise KeyboardInterrupt; whoever waits long looks at it.

    What is raised while an object is being deleted is lost, and with it the only word that the process should end.
    """
    told = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        told.set()
        raise KeyboardInterrupt

    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(number, handle)
    return told
