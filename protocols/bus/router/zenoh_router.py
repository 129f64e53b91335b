"""A Zenoh router inside this process, so that a demo or a rig needs no separate program.

A process that is alive may have stopped routing: a canary monitors the data path. Two sessions connect to the router as
agents do; one publishes on a key that was never declared, so that the router must resolve the route anew, the other
receives it through a wildcard subscription.
"""

from __future__ import annotations

import os
import socket
import stat
import struct
import threading
import time
import uuid
from collections.abc import Callable, Set
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

import msgspec
import zenoh

from protocols.bus.base import BusDead, agent_status
from protocols.bus.settings import LOOPBACK_ROUTER, BusConfig, split_endpoint
from protocols.bus.transport.session import close_session, open_session, undeclare_all, zenoh_call
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.closing import Closing
from protocols.core.names import key_segment
from protocols.messages import syncline_pb2 as pb
from protocols.topics import STATUS

ROLE = "router"
_TICK_S = 0.1  # several looks at the canary in DEAD_AFTER_S
_STATUS_S = 1.0  # as all agents: health counts 5 s without a status as dead

PERIOD_S = 0.25  # a quarter of DEAD_AFTER_S
DEAD_AFTER_S = 0.9  # so that with a restart and reconnection an outage stays below two seconds
_LATE_S = 0.4  # after which the caller itself was stopped, and not the router


class RulesChanged(Exception):
    """The router's access rules have changed: it must be reopened to apply them."""


class Router(Closing):
    """Relays between connected clients while the context is open.

    listen: endpoints. config: a complete configuration instead, with certificates and access rules. Raises InputError
    if an address is taken.
    """

    def __init__(self, *listen: str, config: BusConfig | None = None) -> None:
        config = config or BusConfig(mode="router", listen=listen or (LOOPBACK_ROUTER,))
        self.listen = config.endpoints()[1]
        self._session = open_session(config)

    def sessions(self) -> int:
        """How many others are connected."""
        with zenoh_call("info"):
            return len(self._session.info.transports())

    def close(self) -> None:
        close_session(self._session)


def run_router(
    config: BusConfig,
    site: str,
    agent: str,
    stop: threading.Event,
    *,
    died: Callable[[str], NoReturn],
    restarts: int = 0,
    ready: Callable[[tuple[str, ...]], None] = lambda listen: None,
    beat: Callable[[], None] = lambda: None,
    seen: Callable[[pb.AgentStatus], None] = lambda status: None,
) -> None:
    """Relay until ``stop`` is set, monitor the data path with a canary, and publish the router's status.

    restarts: number of restarts so far, for the status. ready: called with the endpoints once messages pass; beat:
    called in every round from then on; seen: called with every status before it is published; may add to it. died:
    called when no message has passed for DEAD_AFTER_S although the process is alive; it must replace the process and
    not return, because closing a router in that state may hang. Raises RulesChanged where the router must be reopened.
    """
    boot = uuid.uuid4().hex
    config = msgspec.structs.replace(config, listen=tuple(map(_with_port, config.endpoints()[1])))
    router = Router(config=config)
    inside = BusConfig(mode="client", connect=(own_endpoint(router.listen),), tls=config.tls)
    written = _changed(config.access)
    canary = Canary(inside, f"syncline/{site}/canary/{key_segment(agent)}")
    with open_bus(site, inside, timeout_s=5.0) as bus, bus.announce(ROLE, agent, boot):
        publisher = bus.publisher(STATUS, agent)
        passing, next_status, sockets = False, 0.0, set[int]()
        while not stop.wait(_TICK_S):
            sockets = close_without_waiting(sockets)
            silent = canary.silent_s()
            if silent > DEAD_AFTER_S:
                died(f"nothing has passed through this router for {silent:.1f} s, although it is alive")
            if canary.heard and not passing:
                passing = True
                ready(router.listen)
            if passing:
                beat()
            if _changed(config.access) != written:
                break
            now = time.monotonic()
            if now >= next_status:
                next_status = now + _STATUS_S
                state, text = "running" if passing else "starting", f"relays, {canary.delay_s * 1e3:.1f} ms"
                counters = {"restarts": restarts, "canary": canary.heard}
                gauges = {"canary_s": canary.delay_s, "sessions": router.sessions()}
                status = agent_status(ROLE, agent, boot, 0, state, text, counters, gauges)
                seen(status)
                publisher.put(status)
        publisher.close()
    canary.close()
    router.close()
    if not stop.is_set():
        raise RulesChanged


def close_without_waiting(done: Set[int]) -> set[int]:
    """Have no open socket of this process wait, when it is closed, for what it could not send; on Linux.

    Zenoh 1.10.2 sets SO_LINGER to 10 s, so that of a link that is cut, or given up while it is made, the close holds up
    one of its few threads, and with it, often, all links of the router. done: inodes, as the last call returned them.
    """
    sockets = set[int]()
    with suppress(OSError):
        for file in os.scandir("/proc/self/fd"):
            with suppress(OSError):
                status = os.fstat(int(file.name))
                if stat.S_ISSOCK(status.st_mode) and status.st_ino not in done:
                    with socket.socket(fileno=os.dup(int(file.name))) as one:
                        one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 0, 0))
                sockets.add(status.st_ino)
    return sockets


def _changed(file: Path | None) -> int:
    try:
        return 0 if file is None else file.stat().st_mtime_ns
    except OSError:
        return 0


def _with_port(endpoint: str) -> str:
    """The endpoint with a free port in place of port 0, which the canary could not connect to."""
    _, host, port = split_endpoint(endpoint)
    if port:
        return endpoint
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.bind((host, 0))
        return f"{endpoint.removesuffix(':0')}:{probe.getsockname()[1]}"


def own_endpoint(listen: tuple[str, ...]) -> str:
    """The endpoint by which this machine reaches a router that listens on ``listen``."""
    protocol, host, port = split_endpoint(listen[0])
    if host in ("0.0.0.0", "::"):
        host = "127.0.0.1"
    return f"{protocol}/[{host}]:{port}" if ":" in host else f"{protocol}/{host}:{port}"


def free_endpoint() -> str:
    """A loopback endpoint that is free at this moment, for demos and tests."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class Canary:
    """Two sessions through one router. config: how a client reaches it; prefix: keys to use, ``…/canary/<router>``.

    Raises BusDead or InputError where the router refuses them.
    """

    def __init__(self, config: BusConfig, prefix: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._prefix = f"{prefix}/{uuid.uuid4().hex[:12]}"
        self._sent: dict[str, float] = {}
        self._stop = threading.Event()
        self.delay_s = 0.0
        self.heard = 0
        self._sessions = [open_session(config, timeout_s=5.0)]
        try:
            self._sessions.append(open_session(config, timeout_s=5.0))
            with zenoh_call("canary"):
                self._subscriber: zenoh.Subscriber[None] = self._sessions[0].declare_subscriber(
                    f"{self._prefix}/*", self._receive
                )
        except BaseException:
            for session in self._sessions:
                close_session(session)
            raise
        self._last = self._looked = clock()
        # Its own thread: a put to a router that hangs may hang too.
        self._thread = threading.Thread(target=self._publish, name="canary", daemon=True)
        self._thread.start()

    def _publish(self) -> None:
        number = 0
        # Fast until the first message arrives: a new subscription takes a moment to become effective.
        while not self._stop.wait(PERIOD_S if self.heard else 0.05):
            key = f"{self._prefix}/{number}"
            self._sent = {**self._sent, key: self._clock()} if len(self._sent) < 16 else {key: self._clock()}
            with suppress(BusDead), zenoh_call("canary"):
                self._sessions[1].put(key, b"")
            number += 1

    def _receive(self, sample: zenoh.Sample) -> None:
        self._last = self._clock()
        self.heard += 1
        self.delay_s = self._last - self._sent.get(str(sample.key_expr), self._last)

    def silent_s(self) -> float:
        """Seconds since the last message came through; call it several times a second.

        If the caller itself was delayed (the machine slept, the process was stopped) the count restarts.
        """
        now = self._clock()
        if now - self._looked > _LATE_S:
            self._last = now
        self._looked = now
        return now - self._last

    def close(self) -> None:
        """End both sessions."""
        self._stop.set()
        undeclare_all(self._subscriber)
        for session in self._sessions:
            close_session(session)
