"""A termination request raised where Python discards exceptions still ends the process."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator

import pytest

from deploy.agents.processes import Interruption, interrupt_on_signals


class Dying:
    """The signal arrives while this object is deleted."""

    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):  # the handler runs between two of these
            pass


@pytest.fixture
def interruption() -> Iterator[Interruption]:
    assert threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)}
    try:
        yield interrupt_on_signals()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_signal_during_a_deletion_is_recorded(interruption: Interruption) -> None:
    thing = Dying()
    del thing  # the exception is lost here
    assert interruption.is_set()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)


def begin(interruption: Interruption, begun: list[str], failing: bool = False) -> None:
    with interruption.deferred():
        signal.raise_signal(signal.SIGTERM)
        if failing:
            raise ValueError("its own")
        begun.append("a process")


def test_a_signal_while_a_process_starts_is_deferred(interruption: Interruption) -> None:
    begun: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        begin(interruption, begun)
    assert begun == ["a process"]
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)


def test_an_error_while_a_signal_is_deferred_is_not_hidden(interruption: Interruption) -> None:
    with pytest.raises(ValueError, match="its own"):
        begin(interruption, [], failing=True)
    assert interruption.is_set()
