"""What around an agent keeps it from doing its whole job: the router, the machine's clock, its certificate.

Each status says so before it is published: every agent reports these the same way.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from deploy.agents.startup_checks import role_of
from protocols.bus.settings import BusConfig
from protocols.core.clocks import UNSET_CLOCK_UNIX_S, utc_text
from protocols.core.errors import InputError
from protocols.messages import syncline_pb2 as pb

_CERTIFICATE_S = 30.0
"""Between two readings of the certificate, which may be renewed."""
_CLOCK_STEP_S = 2.0
"""A change of Unix time against the monotonic clock by more is a step: time services slew what is less."""
_CLOCK_STEP_NOTICE_S = 60.0  # for so long a status names the step: long enough for a person to see it
_MAX_TEXT = 2000  # characters of a status message
_EXPIRY = "certificate_expiry_timestamp_s"


class Conditions:
    """Adds to a status what impairs the agent.

    connected: whether the agent can reach others. now: a monotonic clock [s]; unix: the machine's clock [s].
    """

    def __init__(
        self,
        settings: Any,
        connected: Callable[[], bool],
        *,
        now: Callable[[], float] = time.monotonic,
        unix: Callable[[], float] = time.time,
    ) -> None:
        bus: BusConfig = settings.bus
        self._records = role_of(settings) == "record"
        self._router = ", ".join(bus.endpoints()[0])
        self._certificate: Path | None = None if bus.tls is None else bus.tls.certificate
        self._connected, self._now, self._unix = connected, now, unix
        self._lost_at: float | None = None
        self._validity: tuple[float, float] | None = None
        self._validity_at = -_CERTIFICATE_S
        self._unix_minus_now = unix() - now()
        self._step_s, self._step_at = 0.0, -_CLOCK_STEP_NOTICE_S

    def amend(self, status: pb.AgentStatus) -> None:
        """Put the reasons into the status's state and message, and what is measured into its gauges."""
        reasons = [text for text in (self._without_router(), self._bad_clock(), self._bad_certificate()) if text]
        if self._validity is not None:
            status.gauges[_EXPIRY] = self._validity[1]
        if reasons and status.state != "stopping":
            status.state = "degraded"
            status.message = "; ".join([*reasons, status.message]).rstrip("; ")[:_MAX_TEXT]

    def _without_router(self) -> str:
        if self._connected():
            self._lost_at = None
            return ""
        if self._lost_at is None:
            self._lost_at = self._now()
        return f"no router at {self._router} for {self._now() - self._lost_at:.0f} s"

    def _bad_clock(self) -> str:
        """Of a recorder, whose log is dated by this machine's clock; timing between cameras does not need it."""
        if not self._records:
            return ""
        unix, now = self._unix(), self._now()
        step = unix - now - self._unix_minus_now
        self._unix_minus_now += step
        if abs(step) > _CLOCK_STEP_S:
            self._step_s, self._step_at = step, now
        if unix < UNSET_CLOCK_UNIX_S:
            return f"this machine's clock was never set: it says {utc_text(unix)}"
        if now - self._step_at < _CLOCK_STEP_NOTICE_S:
            way = "forward" if self._step_s > 0.0 else "back"
            return f"this machine's clock was set {way} by {abs(self._step_s):.0f} s: the log's times jump"
        return ""

    def _bad_certificate(self) -> str:
        if self._certificate is None:
            return ""
        from protocols.bus.security.tls import validity, validity_problem

        now = self._now()
        if now - self._validity_at >= _CERTIFICATE_S:
            self._validity_at = now
            try:
                self._validity = validity(self._certificate)
            except InputError as error:
                self._validity = None
                return str(error)
        return "" if self._validity is None else validity_problem(self._validity, self._unix())
