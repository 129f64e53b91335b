"""The answer of one check."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from protocols.core.errors import EXIT_DONE, EXIT_INPUT, EXIT_REFUSED

Verdict = Literal["ok", "warn", "fail", "skip"]


@dataclass(frozen=True, slots=True)
class Finding:
    """check: its name. text: what is. remedy: what to do; never empty for warn and fail.

    exit_status: what a failure of this kind ends with: 2 = the machine or a configuration is not as it must be,
    3 = all is set up, but there is nothing to measure with now (no frame, no router, no heartbeat).
    """

    check: str
    verdict: Verdict
    text: str
    remedy: str = ""
    exit_status: int = EXIT_DONE


def ok(check: str, text: str) -> Finding:
    """Nothing to do."""
    return Finding(check, "ok", text)


def skip(check: str, text: str) -> Finding:
    """Not looked at, and why."""
    return Finding(check, "skip", text)


def warn(check: str, text: str, remedy: str) -> Finding:
    """It will work, but."""
    return Finding(check, "warn", _line(text), _line(remedy))


def wrong(check: str, text: str, remedy: str) -> Finding:
    """Set up wrongly: status 2."""
    return Finding(check, "fail", _line(text), _line(remedy), EXIT_INPUT)


def missing(check: str, text: str, remedy: str) -> Finding:
    """Set up well, but it does not answer: status 3."""
    return Finding(check, "fail", _line(text), _line(remedy), EXIT_REFUSED)


def exit_status(findings: Iterable[Finding]) -> int:
    """0 if nothing failed; 2 before 3: what is set up wrongly comes first."""
    found = {finding.exit_status for finding in findings if finding.verdict == "fail"}
    return min(found, default=EXIT_DONE)


def _line(text: str) -> str:
    return " ".join(text.split())
