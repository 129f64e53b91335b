"""Commands that are refused."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from deploy.cli import run


def refusal(capsys: pytest.CaptureFixture[str], words: Sequence[str], status: int = 2) -> str:
    """What a command says on stderr that ends with a status: one line."""
    assert run(words) == status
    error = capsys.readouterr().err
    assert error.count("\n") == 1, error
    return error
