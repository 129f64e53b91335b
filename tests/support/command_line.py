"""Commands and files that are refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from deploy.cli import run
from protocols.core.errors import EXIT_INPUT, InputError


def refusal(capsys: pytest.CaptureFixture[str], words: Sequence[str], status: int = 2) -> str:
    """What a command says on stderr that ends with a status: one line."""
    assert run(words) == status
    error = capsys.readouterr().err
    assert error.count("\n") == 1, error
    return error


def assert_reported(read: Callable[[], object], file: Path, line: int | None, *words: str) -> None:
    """Reading a file fails with exit status 2 and one line that names file, line, what and a remedy."""
    with pytest.raises(InputError) as caught:
        read()
    error, message = caught.value, str(caught.value)
    assert error.exit_status == EXIT_INPUT
    assert message.startswith(f"{file}:" if line is None else f"{file}:{line}: "), message
    assert error.remedy
    assert error.remedy in message
    assert "\n" not in message
    assert message.encode(), "it can be printed"
    for word in words:
        assert word in message, message
