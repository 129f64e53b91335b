"""Opens Zenoh sessions, with the measured transport settings and one-line errors."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Any

import zenoh

from protocols.bus.base import BusDead, BusStopped
from protocols.bus.security.access import read_access, tls_settings
from protocols.bus.security.tls import check_files, refusal_reason
from protocols.bus.settings import BusConfig
from protocols.core.errors import InputError

MAX_MESSAGE_SIZE = 4 * 1024 * 1024  # bytes: eight of the largest pictures
LEASE_MS = 1900
"""A frozen process counts as gone after this and is reported within 2 s; a killed one at once."""
_ATTEMPTS_MS = (100, 1000, 2000, 4000)
"""Timeouts of a client's attempts to reach its router. The first is short, so that a refusal is reported at once; the
later ones are long enough for a link of 300 ms there and back, over which a handshake takes four times that, and the
last for one of 800 ms."""
_OPEN_TIMEOUT_MS = 4000
"""Timeout of one connection attempt. TCP doubles its retransmission pause where a first packet is lost, so an attempt
that began on a bad link waits for seconds after the link has recovered; a new one does not. Long enough for 800 ms."""
_PAUSE_S = 0.1  # between two attempts to connect


class zenoh_call:
    """Context in which Zenoh's failures become BusDead. what: the call, for the message.

    A class, since a context of ``contextlib`` costs 1 us a message.

    A panic in its Rust code arrives as PanicException, which is no Exception and whose class cannot be
    imported; the session is unusable after it.
    """

    __slots__ = ("_what",)

    def __init__(self, what: str) -> None:
        self._what = what

    def __enter__(self) -> None:
        pass

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, zenoh.ZError):
            raise BusDead(f"{self._what}: {one_line(error)}") from error
        if error is not None and type(error).__name__ == "PanicException":
            raise BusDead(f"{self._what}: the transport panicked: {one_line(error)}") from error


def one_line(error: BaseException) -> str:
    """A Zenoh error without source code locations, at most 200 characters."""
    text = re.sub(r"\s*at \S+\.rs:\d+\.?", "", str(error))
    return " ".join(text.split())[:200]


def undeclare_all(*declared: Any) -> None:
    """Undeclare publishers, subscribers or tokens; None, or one that is already undeclared, is no error."""
    for thing in declared:
        if thing is not None:
            # RuntimeError: an abandoned thread still sends on it ("Already borrowed").
            with suppress(BusDead, RuntimeError), zenoh_call("undeclare"):
                thing.undeclare()


def close_session(session: Any) -> None:
    """Close a session; one that is closed or dead already is no error."""
    with suppress(BusDead), zenoh_call("close"):
        session.close()


def open_session(
    config: BusConfig, *, stop: Callable[[], bool] | None = None, timeout_s: float | None = None
) -> zenoh.Session:
    """Open one session.

    A peer opens at once and keeps looking for the others; a client needs its router, so this waits for
    it until ``stop()`` (raises BusStopped) or ``timeout_s`` (raises InputError). Raises InputError for
    endpoints that cannot be used, and for a router that can be reached but refuses this process, with its reason.
    """
    connect, listen = config.endpoints()
    if config.tls is not None:
        check_files(config.tls)
    began, attempt = time.monotonic(), 0
    while True:
        settings = _settings(config, connect, listen, _ATTEMPTS_MS[min(attempt, len(_ATTEMPTS_MS) - 1)])
        attempt += 1
        if stop is not None and stop():
            raise BusStopped("stopped before the bus was open")
        try:
            with zenoh_call("open"):
                return zenoh.open(settings)
        except BusDead as error:
            reason = str(error).removeprefix("open: ")
            if config.mode != "client":
                raise InputError(
                    f"bus: {reason}", remedy=f"check connect = {list(connect)} and listen = {list(listen)}"
                ) from None
        for endpoint in connect:
            refusal = refusal_reason(endpoint, config.tls)
            if refusal:
                raise InputError(f"bus: the router at {endpoint} refuses: {refusal}", remedy="see `syncline keys`")
        if timeout_s is not None and time.monotonic() - began >= timeout_s:
            raise InputError(
                f"bus: no router answers at {', '.join(connect)} ({reason})",
                remedy="start one there, or correct connect",
            )
        # Zenoh's own endless wait ignores signals: hence short attempts, with the stop condition between them.
        time.sleep(_PAUSE_S)


def _settings(config: BusConfig, connect: tuple[str, ...], listen: tuple[str, ...], attempt_ms: int) -> zenoh.Config:
    client = config.mode == "client"
    values: dict[str, Any] = {
        "mode": config.mode,
        "connect/endpoints": list(connect),
        "connect/timeout_ms": attempt_ms if client else -1,
        "connect/exit_on_failure": client,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
        "listen/endpoints": list(listen),
        "scouting/multicast/enabled": config.multicast,
        # How long opening waits for peers to be discovered: useful only with discovery.
        "scouting/delay": 500 if config.multicast else 0,
        "timestamping/enabled": True,  # the advanced publisher needs it
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": MAX_MESSAGE_SIZE,
        "transport/link/tx/lease": LEASE_MS,
        # Batches of 64 KiB that are queued for the link before messages are dropped: a machine that is busy for a
        # moment loses nothing, and a slow link is less than a second behind.
        "transport/link/tx/queue/size/data": 4,
        "transport/link/tx/queue/size/data_low": 8,
        # Otherwise idle sockets block new connections for ten seconds.
        "transport/unicast/accept_pending": 2000,
        "transport/unicast/accept_timeout": 2000,
        "transport/unicast/open_timeout": _OPEN_TIMEOUT_MS,
        "transport/unicast/max_sessions": config.max_sessions,
    }
    if config.tls is not None:
        values["transport/link/tls"] = tls_settings(config.tls)
    if config.access is not None:
        values["access_control"] = read_access(config.access)
    settings = zenoh.Config()
    for key, value in values.items():
        settings.insert_json5(key, json.dumps(value))
    return settings
