"""What runs beside a test until the test ends."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def running(*works: Callable[[threading.Event], object]) -> Iterator[threading.Event]:
    """Each in a thread of its own until the event that it is given, which is set at the end of the context."""
    stop = threading.Event()
    threads = [threading.Thread(target=work, args=(stop,)) for work in works]
    for thread in threads:
        thread.start()
    try:
        yield stop
    finally:
        stop.set()
        for thread in threads:
            thread.join(60.0)
        assert not any(thread.is_alive() for thread in threads)


@contextmanager
def looping(step: Callable[[], object], pause_s: float = 0.005) -> Iterator[None]:
    """Call ``step`` again and again beside the test."""

    def run(stop: threading.Event) -> None:
        while not stop.wait(pause_s):
            step()

    with running(run):
        yield
