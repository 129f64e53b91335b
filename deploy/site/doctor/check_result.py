"""Result of a check, and the exit status that follows from all results."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from protocols.core.errors import EXIT_DONE, EXIT_INPUT, EXIT_REFUSED

CheckStatus = Literal["ok", "warn", "fail", "skip"]


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of one check. check: its name. text: what was found. remedy: never empty for warn and fail.

    exit_status: for a failure: 2 = the machine or a configuration is wrong, 3 = the configuration is correct, but a
    device or service does not respond (no frame, no router, no heartbeat).
    """

    check: str
    verdict: CheckStatus
    text: str
    remedy: str = ""
    exit_status: int = EXIT_DONE


def ok(check: str, text: str) -> CheckResult:
    """The check passed."""
    return CheckResult(check, "ok", text)


def skip(check: str, text: str) -> CheckResult:
    """The check was skipped; text: the reason."""
    return CheckResult(check, "skip", text)


def warn(check: str, text: str, remedy: str) -> CheckResult:
    """The check passed with a warning."""
    return CheckResult(check, "warn", _line(text), _line(remedy))


def misconfigured(check: str, text: str, remedy: str) -> CheckResult:
    """The check failed because of a wrong configuration: status 2."""
    return CheckResult(check, "fail", _line(text), _line(remedy), EXIT_INPUT)


def unavailable(check: str, text: str, remedy: str) -> CheckResult:
    """The check failed because something does not respond: status 3."""
    return CheckResult(check, "fail", _line(text), _line(remedy), EXIT_REFUSED)


def exit_status(results: Iterable[CheckResult]) -> int:
    """0 if nothing failed; otherwise the smallest status, so that a wrong configuration (2) precedes 3."""
    statuses = {result.exit_status for result in results if result.verdict == "fail"}
    return min(statuses, default=EXIT_DONE)


def _line(text: str) -> str:
    return " ".join(text.split())
