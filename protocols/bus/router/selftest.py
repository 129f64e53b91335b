"""Tests a router over real sessions: access rules of each certificate, and the data path as an agent meets it."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import msgspec
import zenoh

from protocols.bus.base import AgentEvent, BusDead
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig, TlsConfig
from protocols.bus.transport.session import close_session, open_session, undeclare_all, zenoh_call
from protocols.core.errors import InputError
from protocols.core.names import name_of_segment
from protocols.topics import TOPICS, Topic

OTHER_AGENT = "somebody-else"
_SUBSCRIBE_S = 0.5  # for a subscription to take effect
_COLLECT_S = 0.6  # for messages to arrive

_PUBLISHERS = {"camera": ("camera",), "uav": ("camera", "uav"), "hub": ("hub", "node"), "view": ("view",)}
_FIRST_RETRY_S = 0.2  # doubled each time


@dataclass(frozen=True, slots=True)
class PermissionCheck:
    """One tested permission. wanted, found: whether it is and was allowed; reason: message for the operator."""

    who: str
    what: str
    wanted: bool
    found: bool
    reason: str = ""
    seconds: float = 0.0


def may_publish(role: str, agent: str, topic: Topic, as_id: str) -> bool:
    """Whether an agent may publish a topic in the name of ``as_id``: the policy that the rules implement."""
    first = topic.key.partition("/")[0]
    if first == "node":  # pose nodes of any camera may run on any hub
        return role == "hub"
    if first == "agent":
        return agent == as_id
    return agent == as_id and first in _PUBLISHERS.get(role, ())


def try_agents(
    router: BusConfig, site: str, agents: Sequence[tuple[str, str, TlsConfig]], *, revoked: bool = False
) -> list[PermissionCheck]:
    """Test every topic with every certificate, in its own name and in another's, and what each receives.

    router: tls and access as the site's router has them; here it runs on a free loopback port. revoked: these have no
    rights, although they may connect until their certificates expire.
    """
    if not agents:
        return []
    endpoint = free_endpoint().replace("tcp/", "tls/")
    config = msgspec.structs.replace(router, mode="router", listen=(endpoint,), connect=())
    found: list[PermissionCheck] = []
    with Router(config=config), ExitStack() as stack:
        own = BusConfig(mode="client", connect=(endpoint,), tls=config.tls)
        watcher = open_session(own, timeout_s=5.0)
        stack.callback(close_session, watcher)
        heard: set[str] = set()
        with zenoh_call("self-test"):
            ear = watcher.declare_subscriber(f"syncline/{site}/**", lambda sample: heard.add(str(sample.key_expr)))
        stack.callback(undeclare_all, ear)
        for role, agent, tls in agents:
            found += _try_one(endpoint, site, role, agent, tls, watcher, heard, revoked)
    return found


def _try_one(
    endpoint: str,
    site: str,
    role: str,
    agent: str,
    tls: TlsConfig,
    watcher: zenoh.Session,
    heard: set[str],
    revoked: bool,
) -> list[PermissionCheck]:
    who = f"{role} {agent}" + (" (revoked)" if revoked else "")
    try:
        session = open_session(BusConfig(mode="client", connect=(endpoint,), tls=tls), timeout_s=3.0)
    except InputError as error:
        return [PermissionCheck(who, "connects", True, False, str(error))]
    received: set[str] = set()
    try:
        with zenoh_call("self-test"):
            ear = session.declare_subscriber(f"syncline/{site}/**", lambda sample: received.add(str(sample.key_expr)))
            time.sleep(_SUBSCRIBE_S)
            heard.clear()
            tried = [(topic, name) for topic in TOPICS for name in (agent, OTHER_AGENT)]
            for topic, name in tried:
                session.put(topic.key_for(site, name), b"self-test")
            # A hub receives all cameras' messages, a camera none: the watcher may publish what a router may relay.
            probe = f"syncline/{site}/canary/{OTHER_AGENT}"
            watcher.put(probe, b"self-test")
            time.sleep(_COLLECT_S)
            undeclare_all(ear)
    except BusDead as error:
        return [PermissionCheck(who, "stays connected", True, False, str(error))]
    finally:
        close_session(session)
    out = [PermissionCheck(who, "connects", True, True)]
    for topic, name in tried:
        through = topic.key_for(site, name) in heard
        whose = "its own" if name == agent else "another's"
        wanted = not revoked and may_publish(role, agent, topic, name)
        out.append(PermissionCheck(who, f"says {whose} {topic.name}", wanted, through))
    hearing = not revoked and role in ("hub", "record", "view", "uav", "router")
    out.append(PermissionCheck(who, "hears the others", hearing, probe in received))
    return out


def try_untrusted_client(endpoint: str, what: str, tls: TlsConfig | None) -> PermissionCheck:
    """Try to connect with untrusted certificates, or with none."""
    began = time.monotonic()
    where = endpoint if tls is not None else endpoint.replace("tls/", "tcp/")
    try:
        session = open_session(BusConfig(mode="client", connect=(where,), tls=tls), timeout_s=0.0)
    except InputError as error:
        return PermissionCheck(what, "connects", False, False, str(error), time.monotonic() - began)
    close_session(session)
    return PermissionCheck(what, "connects", False, True, "", time.monotonic() - began)


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
