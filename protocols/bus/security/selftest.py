"""Tries, over real sessions, what each certificate may say and hear, and whom the router does not let in."""

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
from protocols.bus.transport.session import close_session, open_session, release, zenoh_call
from protocols.core.errors import InputError
from protocols.topics import TOPICS, Topic

STRANGER = "somebody-else"
_SETTLE_S = 0.5
_QUIET_S = 0.6

_PUBLISHERS = {"camera": ("camera",), "uav": ("camera", "uav"), "hub": ("hub", "node"), "view": ("view",)}


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was tried. wanted, found: whether it went through; reason: what the operator is told."""

    who: str
    what: str
    wanted: bool
    found: bool
    reason: str = ""
    seconds: float = 0.0


def should_publish(role: str, agent: str, topic: Topic, as_id: str) -> bool:
    """Whether an agent may publish a topic in the name of ``as_id``: what the rules are there to keep."""
    first = topic.key.partition("/")[0]
    if first == "node":  # pose nodes of any camera may run on any hub
        return role == "hub"
    if first == "agent":
        return agent == as_id
    return agent == as_id and first in _PUBLISHERS.get(role, ())


def try_agents(
    router: BusConfig, site: str, agents: Sequence[tuple[str, str, TlsConfig]], *, revoked: bool = False
) -> list[Finding]:
    """Try every topic with every certificate, in its own name and in another's, and what each hears.

    router: tls and access as the router to be has them; it runs on a free loopback port here. revoked: these may do
    nothing, although they are let in until their certificates expire.
    """
    if not agents:
        return []
    endpoint = free_endpoint().replace("tcp/", "tls/")
    config = msgspec.structs.replace(router, mode="router", listen=(endpoint,), connect=())
    found: list[Finding] = []
    with Router(config=config), ExitStack() as stack:
        own = BusConfig(mode="client", connect=(endpoint,), tls=config.tls)
        watcher = open_session(own, timeout_s=5.0)
        stack.callback(close_session, watcher)
        heard: set[str] = set()
        with zenoh_call("self-test"):
            ear = watcher.declare_subscriber(f"syncline/{site}/**", lambda sample: heard.add(str(sample.key_expr)))
        stack.callback(release, ear)
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
) -> list[Finding]:
    who = f"{role} {agent}" + (" (revoked)" if revoked else "")
    try:
        session = open_session(BusConfig(mode="client", connect=(endpoint,), tls=tls), timeout_s=3.0)
    except InputError as error:
        return [Finding(who, "connects", True, False, str(error))]
    told: set[str] = set()
    try:
        with zenoh_call("self-test"):
            ear = session.declare_subscriber(f"syncline/{site}/**", lambda sample: told.add(str(sample.key_expr)))
            time.sleep(_SETTLE_S)
            heard.clear()
            tried = [(topic, name) for topic in TOPICS for name in (agent, STRANGER)]
            for topic, name in tried:
                session.put(topic.key_for(site, name), b"self-test")
            # A hub hears all cameras, a camera none: the watcher may say what a router may relay.
            probe = f"syncline/{site}/canary/{STRANGER}"
            watcher.put(probe, b"self-test")
            time.sleep(_QUIET_S)
            release(ear)
    except BusDead as error:
        return [Finding(who, "stays connected", True, False, str(error))]
    finally:
        close_session(session)
    out = [Finding(who, "connects", True, True)]
    for topic, name in tried:
        through = topic.key_for(site, name) in heard
        whose = "its own" if name == agent else "another's"
        wanted = not revoked and should_publish(role, agent, topic, name)
        out.append(Finding(who, f"says {whose} {topic.name}", wanted, through))
    hearing = not revoked and role in ("hub", "record", "view", "uav", "router")
    out.append(Finding(who, "hears the others", hearing, probe in told))
    return out


def try_stranger(endpoint: str, what: str, tls: TlsConfig | None) -> Finding:
    """Try to come in with certificates that should not do, or with none."""
    began = time.monotonic()
    where = endpoint if tls is not None else endpoint.replace("tls/", "tcp/")
    try:
        session = open_session(BusConfig(mode="client", connect=(where,), tls=tls), timeout_s=0.0)
    except InputError as error:
        return Finding(what, "connects", False, False, str(error), time.monotonic() - began)
    close_session(session)
    return Finding(what, "connects", False, True, "", time.monotonic() - began)
