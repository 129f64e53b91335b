"""Tests access rules over real sessions: what each certificate may publish and receive, and who is refused."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import msgspec
import zenoh

from protocols.bus.base import BusDead
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig, TlsConfig
from protocols.bus.transport.session import close_session, open_session, undeclare_all, zenoh_call
from protocols.core.errors import InputError
from protocols.topics import TOPICS, Topic

OTHER_AGENT = "somebody-else"
_SUBSCRIBE_S = 0.5  # for a subscription to take effect
_COLLECT_S = 0.6  # for messages to arrive

_PUBLISHERS = {"camera": ("camera",), "uav": ("camera", "uav"), "hub": ("hub", "node"), "view": ("view",)}


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
