"""Checks of every agent process: certificates and unprotected endpoints at its start, later its surroundings."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from deploy.agents.health import Health, HealthServer
from deploy.config.agents import CameraConfig, HubConfig, RecorderConfig, RouterConfig
from protocols.bus.settings import BusConfig, unprotected_listeners
from protocols.core.clocks import UNSET_CLOCK_UNIX_S, utc_text
from protocols.core.errors import InputError
from protocols.messages import syncline_pb2 as pb

_ROLES: dict[type, str] = {CameraConfig: "camera", HubConfig: "hub", RecorderConfig: "record", RouterConfig: "router"}
_RENEW_DAYS = 3.0  # a tenth of the default validity of 30 days

_CERTIFICATE_S = 30.0
"""Between two readings of the certificate, which may be renewed."""
_CLOCK_STEP_S = 2.0
"""A change of Unix time against the monotonic clock by more is a step: time services slew what is less."""
_CLOCK_STEP_NOTICE_S = 60.0  # for so long a status names the step: long enough for a person to see it
_MEETING_S = 2.0
"""Time in which a peer that has just begun meets the others."""
_MAX_TEXT = 2000  # characters of a status message
_EXPIRY = "certificate_expiry_timestamp_s"


def role_of(settings: Any) -> str:
    """The role of an agent's configuration, as named in its certificate."""
    kind = type(settings)
    return _ROLES.get(kind, kind.__name__.removesuffix("Config").lower())


def check_startup(settings: Any) -> None:
    """Raise InputError if the certificate is not this agent's; warn if it expires soon or a listener is unprotected."""
    tls = settings.bus.tls
    if tls is not None:
        from protocols.bus.security.tls import check_files, check_owner, days_left

        check_files(tls)
        check_owner(tls, role_of(settings), settings.id)
        left = days_left(tls.certificate)
        if left < _RENEW_DAYS:
            _warn(f"{tls.certificate} is valid for {left:.1f} days more; renew it with `syncline keys issue`")
    for endpoint in unprotected_listeners(settings.bus):
        _warn(f"{endpoint} lets everyone on the network in; see `syncline keys`")


def serve_health(settings: Any, health: Health) -> AbstractContextManager[object]:
    """The HTTP server that [health] configures, or a null context."""
    return nullcontext() if settings.health is None else HealthServer(settings.health, health)


def _warn(text: str) -> None:
    print(f"syncline: {text}", file=sys.stderr, flush=True)


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
        where = f" at {', '.join(bus.endpoints()[0])}" if bus.endpoints()[0] else ""
        self._meeting_s = 0.0 if bus.mode == "client" else _MEETING_S
        self._absent = f"no router{where}" if bus.mode == "client" else f"no other agent is reached{where}"
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
        lost_s = self._now() - self._lost_at
        return f"{self._absent} for {lost_s:.0f} s" if lost_s >= self._meeting_s else ""

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
