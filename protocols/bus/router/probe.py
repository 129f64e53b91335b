"""Probes a router's data path as an agent: round-trip time by message size, and received traffic of others."""

from __future__ import annotations

import threading
import time
import uuid

import zenoh

from protocols.bus.base import AgentEvent
from protocols.bus.settings import BusConfig
from protocols.bus.transport.session import close_session, open_session, undeclare_all, zenoh_call
from protocols.core.names import name_of_segment

_FIRST_RETRY_S = 0.2  # doubled each time


def round_trip(config: BusConfig, prefix: str, size: int = 0, timeout_s: float = 3.0) -> float | None:
    """Seconds that ``size`` bytes take from one session to another; None if nothing arrives complete.

    prefix: a key below which this identity may publish and subscribe. The first message of two sessions may be lost
    before the route is known, so it is repeated until it arrives. Raises InputError where no session can be opened,
    BusDead.
    """
    key = f"{prefix}/{uuid.uuid4().hex[:12]}"
    payload = uuid.uuid4().bytes * (size // 16)
    arrived_event = threading.Event()
    sent = arrived = 0.0

    def take(sample: zenoh.Sample) -> None:
        nonlocal arrived
        if bytes(sample.payload) == payload:
            arrived = time.monotonic()
            arrived_event.set()

    sessions = [open_session(config, timeout_s=timeout_s)]
    try:
        sessions.append(open_session(config, timeout_s=timeout_s))
        with zenoh_call("probe"):
            ear = sessions[0].declare_subscriber(key, take)
        began = time.monotonic()
        # A slow message must not be taken for a lost one: the pause doubles.
        pause = _FIRST_RETRY_S
        while not arrived_event.is_set() and time.monotonic() - began < timeout_s:
            sent = time.monotonic()
            with zenoh_call("probe"):
                sessions[1].put(key, payload)
            arrived_event.wait(pause)
            pause *= 2.0
        undeclare_all(ear)
    finally:
        for session in sessions:
            close_session(session)
    return max(arrived - sent, 0.0) if arrived_event.is_set() else None


def agents_alive(config: BusConfig, timeout_s: float = 2.0) -> dict[str, list[AgentEvent]]:
    """Every run of an agent that announces itself, by site; what access rules hide is missing.

    Raises InputError where no session can be opened, BusDead.
    """
    found: dict[str, list[AgentEvent]] = {}
    session = open_session(config, timeout_s=timeout_s)
    try:
        with zenoh_call("probe"):
            for reply in session.liveliness().get("syncline/*/alive/*/*/*", timeout=timeout_s):
                if reply.ok is not None:
                    _, site, _, role, agent, boot = str(reply.ok.key_expr).split("/")
                    found.setdefault(site, []).append(AgentEvent(role, name_of_segment(agent) or agent, boot, True))
    finally:
        close_session(session)
    return dict(sorted(found.items()))


def count_received(config: BusConfig, expression: str, seconds: float, own: str = "\0") -> int:
    """Number of others' messages that reach this identity within ``seconds``; own: keys with this part are not counted.

    Raises InputError where no session can be opened, BusDead.
    """
    count = 0

    def take(sample: zenoh.Sample) -> None:
        nonlocal count
        count += own not in str(sample.key_expr)

    session = open_session(config, timeout_s=3.0)
    try:
        with zenoh_call("probe"):
            ear = session.declare_subscriber(expression, take)
        deadline = time.monotonic() + seconds
        while count == 0 and time.monotonic() < deadline:
            time.sleep(0.05)
        undeclare_all(ear)
    finally:
        close_session(session)
    return count
