"""Bus configuration: the ``[bus]`` table of every agent's configuration file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from protocols.core.errors import InputError

LOOPBACK_ROUTER = "tcp/127.0.0.1:7447"
"""Default endpoint on which a router listens and to which others connect."""
LOOPBACK_ANY_PORT = "tcp/127.0.0.1:0"
ANY_INTERFACE = "tcp/[::]:0"

_ENDPOINT = re.compile(r"(?P<protocol>tcp|tls)/(?P<host>\[[0-9a-fA-F:.%]+\]|[A-Za-z0-9._-]+):(?P<port>[0-9]{1,5})\Z")


class TlsConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[bus.tls]``: files that `syncline keys` makes. ca: trusted authority; certificate, key: own identity."""

    ca: Path
    certificate: Path
    key: Path


class BusConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Mode and endpoints of one Zenoh session.

    mode: "peer" connects to others directly, "client" through a router only, "router" relays.
    connect, listen: endpoints such as "tcp/192.168.1.5:7447". With neither, a peer or a client looks
        for a router at LOOPBACK_ROUTER, and a router listens there.
    multicast: find other peers on the local network by multicast; then a peer that names no listen
        endpoint listens on every interface.
    outage_s: the longest link outage without message loss: publishers cache half as much again.
    max_sessions: upper bound of simultaneous connections to this process.
    tls: certificates for "tls/" endpoints. access: a router's access rules and TLS settings, as `syncline keys`
        writes them; agents not named there are denied everything.
    """

    mode: Literal["peer", "client", "router"] = "peer"
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    multicast: bool = False
    outage_s: Annotated[float, Meta(ge=1.0, le=3600.0)] = 60.0
    max_sessions: Annotated[int, Meta(ge=1, le=100_000)] = 1000
    tls: TlsConfig | None = None
    access: Path | None = None

    def endpoints(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """(connect, listen) with the defaults filled in; raises InputError for a bad combination."""
        for endpoint in self.connect:
            _check(endpoint, lowest_port=1)
        for endpoint in self.listen:
            _check(endpoint, lowest_port=0)
        secure = [endpoint for endpoint in (*self.connect, *self.listen) if endpoint.startswith("tls/")]
        if secure and self.tls is None:
            raise InputError(
                f"bus: {secure[0]} needs certificates",
                remedy="add [bus.tls] with ca, certificate and key; `syncline keys` makes them",
            )
        if self.access is not None and self.mode != "router":
            raise InputError("bus: access is for a router", remedy='remove it, or set mode = "router"')
        if self.tls is not None and self.mode == "peer":
            # The router enforces the access rules; between two peers nothing would enforce them.
            raise InputError(
                "bus: a peer with certificates would go past the router's access rules", remedy='set mode = "client"'
            )
        if self.mode == "client":
            if self.listen:
                raise InputError("bus: a client cannot listen", remedy='use mode = "peer", or remove listen')
            return self.connect or (LOOPBACK_ROUTER,), ()
        if self.mode == "router":
            return self.connect, self.listen or (LOOPBACK_ROUTER,)
        if self.listen:
            return self.connect, self.listen
        if self.multicast:
            return self.connect, (ANY_INTERFACE,)
        connect = self.connect or (LOOPBACK_ROUTER,)
        if not all(is_loopback(endpoint) for endpoint in connect):
            # Zenoh 1.10 routers do not relay between two peers: without an address of its own this
            # process would connect, look healthy and receive nothing.
            raise InputError(
                "bus: a peer that connects beyond this machine needs an address that others can reach",
                remedy='set listen, e.g. ["tcp/192.168.1.20:7447"], or mode = "client"',
            )
        return connect, (LOOPBACK_ANY_PORT,)


def split_endpoint(endpoint: str) -> tuple[str, str, int]:
    """(protocol, host, port) of a checked endpoint; an IPv6 host without its brackets."""
    found = _ENDPOINT.match(endpoint)
    assert found is not None
    return found["protocol"], found["host"].strip("[]"), int(found["port"])


def is_loopback(endpoint: str) -> bool:
    """Whether an endpoint stays on this machine."""
    found = _ENDPOINT.match(endpoint)
    host = found["host"] if found else ""
    return host in ("localhost", "[::1]") or host.startswith("127.")


def _check(endpoint: str, *, lowest_port: int) -> None:
    """Reject an endpoint that Zenoh would accept and then retry silently for ever."""
    found = _ENDPOINT.match(endpoint)
    if not found or not lowest_port <= int(found["port"]) <= 65_535:
        raise InputError(f"bus: {endpoint!r} is not an endpoint", remedy='write it like "tcp/127.0.0.1:7447"')


def unprotected_listeners(config: BusConfig) -> tuple[str, ...]:
    """Endpoints reachable from other machines on which this process would listen without certificates."""
    _, listen = config.endpoints()
    return tuple(one for one in listen if not is_loopback(one) and not one.startswith("tls/"))
