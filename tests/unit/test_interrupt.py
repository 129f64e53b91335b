"""A word to end that is raised where exceptions are lost still ends the process."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from deploy.signals import interrupt_on_signals


class Dying:
    """Its deletion is when the signal comes."""

    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):  # the handler runs between two of these
            pass


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_signal_while_something_is_deleted_is_told() -> None:
    assert threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)}
    try:
        told = interrupt_on_signals()
        thing = Dying()
        del thing  # the exception is lost here
        assert told.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
