"""A word to end that is raised where exceptions are lost still ends the process."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator

import pytest

from deploy.agents.signals import Interruption, interrupt_on_signals


class Dying:
    """Its deletion is when the signal comes."""

    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):  # the handler runs between two of these
            pass


@pytest.fixture
def told() -> Iterator[Interruption]:
    assert threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)}
    try:
        yield interrupt_on_signals()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_signal_while_something_is_deleted_is_told(told: Interruption) -> None:
    thing = Dying()
    del thing  # the exception is lost here
    assert told.is_set()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)


def begin(told: Interruption, begun: list[str], failing: bool = False) -> None:
    with told.held():
        signal.raise_signal(signal.SIGTERM)
        if failing:
            raise ValueError("its own")
        begun.append("a process")


def test_a_signal_while_a_process_is_begun_waits_until_it_is_known(told: Interruption) -> None:
    begun: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        begin(told, begun)
    assert begun == ["a process"]
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)


def test_what_fails_while_a_signal_waits_is_not_hidden(told: Interruption) -> None:
    with pytest.raises(ValueError, match="its own"):
        begin(told, [], failing=True)
    assert told.is_set()
