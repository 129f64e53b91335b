"""Start-up of every agent process: certificate checks, warnings on unprotected endpoints, and the health server."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from deploy.agents.health import Health, HealthServer
from deploy.config.agents import CameraConfig, HubConfig, RecorderConfig, RouterConfig
from protocols.bus.settings import unprotected_listeners

_ROLES: dict[type, str] = {CameraConfig: "camera", HubConfig: "hub", RecorderConfig: "record", RouterConfig: "router"}
_RENEW_DAYS = 3.0  # a tenth of the default validity of 30 days


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
