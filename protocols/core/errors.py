"""The errors that a user sees: bad input and refusal, with their exit statuses.

    SynclineError
    ├── InputError   bad use, configuration or input     exit status 2
    └── Refused      well-formed, but not solvable       exit status 3

Anything else that escapes is a bug: exit status 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from protocols.core.acceptance import AcceptanceTest, PairReport

EXIT_DONE = 0  # the result is there
EXIT_BUG = 1  # a traceback or a dead process: a supervisor starts it again
EXIT_INPUT = 2  # wrong usage or input
EXIT_REFUSED = 3  # the data allow no answer


def printable(text: str) -> str:
    """``text`` with what a terminal would obey (escape sequences, directions of writing) written as an escape."""
    if text.isprintable():
        return text
    return "".join(
        one if one.isprintable() or one == "\u200d" else one.encode("unicode_escape").decode() for one in text
    )


class SynclineError(Exception):
    """Base of the errors that are reported to a user as one line."""

    exit_status = EXIT_BUG


class InputError(SynclineError):
    """Bad use, configuration or input: where it is, what is wrong, and what to do about it.

    str() is one line: ``file:line: what: remedy``.
    """

    exit_status = EXIT_INPUT

    def __init__(self, what: str, *, file: Path | str | None = None, line: int | None = None, remedy: str = "") -> None:
        self.what = what
        self.file = None if file is None else Path(file)
        self.line = line
        self.remedy = remedy
        place = "" if file is None else f"{file}:{line}: " if line is not None else f"{file}: "
        text = f"{place}{what}; {remedy}" if remedy else f"{place}{what}"
        super().__init__(printable(" ".join(text.split())))


class Refused(SynclineError):
    """The input is well-formed, but no reliable result can be estimated from it; ``reason`` says why.

    cameras: reasons by camera, where they concern single cameras. pairs: results of camera pairs that are known
    nevertheless. warnings: further warnings for the user. acceptance: the cameras' acceptance tests. cpu_seconds: spent
    by the solver before it refused.
    """

    exit_status = EXIT_REFUSED
    cpu_seconds: float = 0.0
    permanent: bool = False
    """Whether more observations of the same kind cannot help."""

    def __init__(
        self,
        reason: str,
        cameras: dict[str, str] | None = None,
        pairs: tuple[PairReport, ...] = (),
        warnings: tuple[str, ...] = (),
        acceptance: Mapping[str, Sequence[AcceptanceTest]] | None = None,
    ) -> None:
        self.pairs, self.warnings, self.acceptance = pairs, warnings, dict(acceptance or {})
        self.reason = printable(" ".join(reason.split()))
        self.cameras = dict(cameras or {})
        super().__init__(self.reason)

    def __str__(self) -> str:
        """The reason, as it may have been completed since."""
        return self.reason
