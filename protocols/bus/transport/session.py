"""Opens Zenoh sessions: every setting that the measurements asked for, and one-line errors."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import zenoh

from protocols.bus.base import BusDead, BusStopped
from protocols.bus.security.access import read_access, tls_settings
from protocols.bus.security.tls import check_files, why_refused
from protocols.bus.settings import BusConfig
from protocols.core.errors import InputError

MAX_MESSAGE_SIZE = 4 * 1024 * 1024
LEASE_MS = 1900
"""A frozen process counts as gone after this, and is told of within 2 s; a killed one at once."""
_ATTEMPTS_MS = (100, 1000, 2000)
"""A client's attempts to reach its router. The first is short, so that who is refused is told of it at once; the later
ones are long enough for a link of 300 ms, over which a handshake takes four times that."""
_OPEN_MS = 4000
"""Of one attempt to connect. TCP doubles its pauses where a first packet is lost, so that an attempt that began while a
link was bad sleeps for seconds after it is good again; a new one does not. Long enough for a link of 800 ms."""
_PAUSE_S = 0.1


@contextmanager
def zenoh_call(what: str) -> Iterator[None]:
    """Turn Zenoh's failures into BusDead.

    A panic in its Rust code arrives as PanicException, which is no Exception and whose class cannot be
    imported; the session is of no use after it.
    """
    try:
        yield
    except zenoh.ZError as error:
        raise BusDead(f"{what}: {one_line(error)}") from error
    except BaseException as error:
        if type(error).__name__ == "PanicException":
            raise BusDead(f"{what}: the transport panicked: {one_line(error)}") from error
        raise


def one_line(error: BaseException) -> str:
    """A Zenoh error without the places in its source code, at most 200 characters."""
    text = re.sub(r"\s*at \S+\.rs:\d+\.?", "", str(error))
    return " ".join(text.split())[:200]


def release(*declared: Any) -> None:
    """Undeclare what was declared; None, or what is gone already, is no error."""
    for thing in declared:
        if thing is not None:
            # RuntimeError: a thread that was given up on still sends on it ("Already borrowed").
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
            refusal = why_refused(endpoint, config.tls)
            if refusal:
                raise InputError(f"bus: the router at {endpoint} refuses: {refusal}", remedy="see `syncline keys`")
        if timeout_s is not None and time.monotonic() - began >= timeout_s:
            raise InputError(
                f"bus: no router answers at {', '.join(connect)} ({reason})",
                remedy="start one there, or correct connect",
            )
        # Zenoh's own endless wait ignores signals: so short attempts, and the stop condition between.
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
        # How long opening waits for others to be found: of use only where they are searched for.
        "scouting/delay": 500 if config.multicast else 0,
        "timestamping/enabled": True,  # the advanced publisher needs it
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": MAX_MESSAGE_SIZE,
        "transport/link/tx/lease": LEASE_MS,
        # Batches of 64 KiB that wait for the link before anything is dropped: a machine that is busy for a moment loses
        # nothing, and a slow link is not a second behind.
        "transport/link/tx/queue/size/data": 4,
        "transport/link/tx/queue/size/data_low": 8,
        # Else idle sockets lock out others for ten seconds.
        "transport/unicast/accept_pending": 2000,
        "transport/unicast/accept_timeout": 2000,
        "transport/unicast/open_timeout": _OPEN_MS,
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
