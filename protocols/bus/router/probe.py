"""Tries a router's data path from where an agent stands: does a message come through, of which size, and whose."""

from __future__ import annotations

import threading
import time
import uuid

import zenoh

from protocols.bus.settings import BusConfig
from protocols.bus.transport.session import close_session, open_session, release, zenoh_call

_AGAIN_S = 0.2


def round_trip(config: BusConfig, prefix: str, size: int = 0, timeout_s: float = 3.0) -> float | None:
    """Seconds that ``size`` bytes take from one session to another; None where none come through whole.

    prefix: a key below which this identity may speak and hear. The first message of two sessions may be lost before
    the way is known, so it is sent until it is heard. Raises InputError where no session can be opened, BusDead.
    """
    key = f"{prefix}/{uuid.uuid4().hex[:12]}"
    payload = uuid.uuid4().bytes * (size // 16)
    heard = threading.Event()
    sent = arrived = 0.0

    def take(sample: zenoh.Sample) -> None:
        nonlocal arrived
        if bytes(sample.payload) == payload:
            arrived = time.monotonic()
            heard.set()

    sessions = [open_session(config, timeout_s=timeout_s)]
    try:
        sessions.append(open_session(config, timeout_s=timeout_s))
        with zenoh_call("probe"):
            ear = sessions[0].declare_subscriber(key, take)
        began = time.monotonic()
        # What is slow must not be mistaken for lost: the pause grows.
        pause = _AGAIN_S
        while not heard.is_set() and time.monotonic() - began < timeout_s:
            sent = time.monotonic()
            with zenoh_call("probe"):
                sessions[1].put(key, payload)
            heard.wait(pause)
            pause *= 2.0
        release(ear)
    finally:
        for session in sessions:
            close_session(session)
    return max(arrived - sent, 0.0) if heard.is_set() else None


def hears(config: BusConfig, expression: str, seconds: float, own: str = "\0") -> int:
    """How many messages of others reach this identity within ``seconds``; own: a part of keys that don't count.

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
        release(ear)
    finally:
        close_session(session)
    return count
