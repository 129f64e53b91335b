"""Checks of one agent: configuration, camera, bus, certificates, access rules and vehicle.

Why a router cannot be reached follows from what the connection ends with.
"""

from __future__ import annotations

import errno
import json
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from deploy.site.doctor.check_result import CheckResult, misconfigured, ok, skip, unavailable, warn
from edge.devices.base import Device
from protocols.bus.settings import BusConfig, is_loopback, split_endpoint, unprotected_listeners
from protocols.core.errors import InputError
from protocols.core.names import key_segment

_SMALL, _LARGE = 1024, 1_000_000  # sizes of test messages [bytes]
_EXPIRES_SOON_DAYS = 7.0  # a week, in which somebody looks
_SUBSCRIBES_TO_ALL = ("hub", "recorder", "uav")
_SHOWN_ROLES = ("camera", "hub", "record", "router", "uav", "view")
CERTIFICATE_ROLES = {"recorder": "record"}

_PATIENCE_S = 3.0  # in which TCP sends its first packet three times
_UNREACHABLE = {
    errno.ECONNREFUSED: (
        "{host} answers, but nothing listens at port {port}",
        "start one there (`systemctl status 'syncline-router-*'`), or correct the port in connect",
    ),
    errno.EHOSTUNREACH: (
        "{host} does not answer in its own network",
        "is that machine on, its cable in, its address right (`ip address` there)?",
    ),
    errno.ENETUNREACH: (
        "this machine has no route to {host}",
        "connect its network (`ip address`, `ip route` here): cable, Wi-Fi, DHCP",
    ),
}


def camera(
    device: Device, *, patience_s: float = 5.0, measure_s: float = 1.0, now: Callable[[], float] = time.monotonic
) -> CheckResult:
    """Open the camera, and measure its frame rate and mean brightness."""
    try:
        device.open()
    except InputError as error:
        return unavailable("camera", error.what, error.remedy or "check that it is plugged in")
    try:
        info = device.info
        began, first, frames, image = now(), 0.0, 0, None
        while now() - began < patience_s and (image is None or now() - first < measure_s) and not device.ended:
            frame = device.read(0.2)
            if frame is not None:
                image, frames = frame.image, frames + 1
                first = first or now()
        if image is None:
            return unavailable(
                "camera",
                f"{info.driver} opens, but delivers no frame within {patience_s:g} s",
                "unplug it and plug it in again; if it goes on, another cable, socket or a smaller size",
            )
        rate = (frames - 1) / max(now() - first, 1e-9)
    finally:
        device.close()
    text = f"{info.width}x{info.height}, {frames} frames, {rate:.1f} of {info.fps:g} fps"
    level = float(np.mean(image))
    if level < 8.0:
        return warn("camera", f"{text}, all dark", "take off the lens cap, give it light, or lengthen the exposure")
    if level > 247.0:
        return warn("camera", f"{text}, all white", "shorten the exposure, or turn it away from the light")
    if info.fps > 0.0 and frames > 5 and rate < 0.7 * info.fps:
        return warn(
            "camera", text, "more light (auto exposure slows cameras down), a smaller size, or a socket of its own"
        )
    return ok("camera", text)


def certificates(bus: BusConfig, role: str, agent: str) -> CheckResult:
    """Check validity period and names of the certificates in [bus.tls]."""
    if bus.tls is None:
        beyond = [end for end in bus.connect if not is_loopback(end)] + list(unprotected_listeners(bus))
        if beyond:
            return warn(
                "certificates",
                f"none, and {beyond[0]} is beyond this machine",
                "make some with `syncline keys`: anybody in that network can publish anything",
            )
        return skip("certificates", "none: everything stays on this machine")
    from protocols.bus.security.tls import check_files, check_owner, days_left

    try:
        check_files(bus.tls)
        check_owner(bus.tls, CERTIFICATE_ROLES.get(role, role), agent)
    except InputError as error:
        place = "" if error.file is None else f"{error.file}: "
        return misconfigured("certificates", place + error.what, error.remedy)
    left = days_left(bus.tls.certificate)
    if left < _EXPIRES_SOON_DAYS:
        return warn(
            "certificates", f"valid for {left:.1f} days more", "renew with `syncline keys issue`, and install again"
        )
    return ok("certificates", f"valid for {left:.0f} days, names {role} {agent}")


def bus_path(bus: BusConfig, site: str, role: str, agent: str, patience_s: float = 10.0) -> CheckResult:
    """Round trip of a small and a large test message through the router; if the agent may not subscribe, a subscriber.

    patience_s: timeout of the large message [s].
    """
    from protocols.bus.base import BusDead

    if role == "router":
        return skip("bus", "a router watches its own data path: see its status")
    config = _as_client(bus)
    if config is None:
        return skip("bus", "a peer that waits for others: nothing to connect to")
    where = ", ".join(config.endpoints()[0])
    try:
        if bus.tls is not None and role not in _SUBSCRIBES_TO_ALL:
            return _check_subscriber(config, site, agent, where)
        from protocols.bus.router.selftest import round_trip

        prefix = f"syncline/{site}/{'canary' if bus.tls is None else f'agent/{key_segment(agent)}'}/doctor"
        small = round_trip(config, prefix, _SMALL)
        if small is None:
            return unavailable(
                "bus",
                f"{where} accepts the connection, but relays no messages",
                "restart the router (`systemctl restart syncline-router-…`)"
                + (
                    ""
                    if bus.tls is None
                    else "; its rules may lack this agent: issue again, and copy zenoh.json5 to it"
                ),
            )
        large = round_trip(config, prefix, _LARGE, timeout_s=patience_s)
    except (InputError, BusDead) as error:
        what, remedy = getattr(error, "what", str(error)), getattr(error, "remedy", "") or "restart the router"
        if "no router answers" in what:
            for endpoint in config.connect:
                if (unreachable := reach(endpoint)) is not None:
                    return unreachable
            what = f"{where} accepts connections, but does not speak as a router: it hangs, or is another program"
            remedy = "restart the router; `ss -ltnp` there says what listens"
        return unavailable("bus", what, remedy)
    if large is None:
        return unavailable(
            "bus",
            f"{where}: {_SMALL} bytes pass, {_LARGE} don't",
            "packets beyond the path's MTU vanish: one MTU on all links (`ip link`), and let ICMP through firewalls",
        )
    if small > 0.1:
        return warn(
            "bus",
            f"{where}: {1e3 * small:.0f} ms there and back",
            "a busy or weak link: a cable, or fewer on this Wi-Fi",
        )
    return ok("bus", f"{where}: {1e3 * small:.1f} ms, 1 MB in {1e3 * large:.0f} ms")


def _check_subscriber(config: BusConfig, site: str, agent: str, where: str) -> CheckResult:
    from protocols.bus.transport.zenoh_bus import open_bus
    from protocols.topics import OBSERVATION

    with open_bus(site, config, timeout_s=5.0) as bus:
        if bus.publisher(OBSERVATION, agent).wait_matched(3.0):
            return ok("bus", f"{where}: {agent} has a subscriber")
    return unavailable(
        "bus",
        f"{where} accepts the connection, but {agent} has no subscriber",
        "start a hub or recorder; if one runs, the router's rules lack this agent: `syncline keys issue`, and "
        "copy zenoh.json5 to it",
    )


def access_rights(bus: BusConfig, site: str, role: str, agent: str, seconds: float = 2.5) -> CheckResult:
    """Check that the router restricts this certificate to its own keys."""
    from protocols.bus.base import BusDead
    from protocols.bus.router.selftest import count_received, round_trip

    config = _as_client(bus)
    if bus.tls is None or config is None:
        return skip("access rules", "no certificates: everyone may publish everything")
    if role == "router":
        return skip("access rules", "the router's own certificate may do everything")
    remedy = "give the router `access` = the zenoh.json5 that `syncline keys` wrote, and restart it"
    try:
        if role in _SUBSCRIBES_TO_ALL:
            foreign = round_trip(
                config, f"syncline/{site}/camera/not-{key_segment(agent)[:50]}/doctor", _SMALL, timeout_s=1.5
            )
            if foreign is not None:
                return misconfigured("access rules", f"{agent} may publish for others", remedy)
            return ok("access rules", f"{agent} cannot publish for others")
        if count_received(config, f"syncline/{site}/agent/*/status", seconds, own=f"/{key_segment(agent)}/"):
            return misconfigured("access rules", f"{agent} receives messages that it may not receive", remedy)
    except (InputError, BusDead) as error:
        return skip("access rules", f"not tried: {getattr(error, 'what', error)}")
    return ok("access rules", f"{agent} receives no messages of others")


def others(bus: BusConfig, site: str, role: str) -> CheckResult:
    """Which agents of the site can be seen: a name in use twice, hubs that do not share it, a site without a hub."""
    from protocols.bus.base import BusDead
    from protocols.bus.router.selftest import agents_alive
    from protocols.bus.security.sender_identity import SenderValidator

    config = _as_client(bus)
    if config is None:
        return skip("agents", "a peer that waits for others: nothing to connect to")
    if bus.tls is not None and role not in _SUBSCRIBES_TO_ALL:
        return skip("agents", "this certificate may not see others")
    try:
        sites = agents_alive(config)
    except (InputError, BusDead) as error:
        return skip("agents", f"not tried: {getattr(error, 'what', error)}")
    guard, here = SenderValidator(), sites.get(site, [])
    for one in here:
        guard.handle(one)
    if alarms := guard.alarms():
        return warn("agents", "; ".join(alarms), "then run this again")
    elsewhere = [name for name, agents in sites.items() if name != site and any(one.role == "hub" for one in agents)]
    if elsewhere and not any(one.role == "hub" for one in here):
        named = ", ".join(f'"{name}"' for name in elsewhere[:4])
        return warn(
            "agents",
            f'no hub of site "{site}" runs here, but one of site {named}: agents hear only their own site',
            f'site = "{elsewhere[0]}" in the file, if this is an agent of it; otherwise start a hub',
        )
    named = ", ".join(sorted(f"{one.role} {one.agent}" for one in here if one.role in _SHOWN_ROLES))
    return ok("agents", f"site {site}: {named or 'nobody yet'}")


def configuration(file: Path, role: str) -> tuple[CheckResult, Any]:
    """Read the configuration as the agent would."""
    from deploy.config.file import load
    from deploy.site.install.plan import config_type

    try:
        config = load(file, config_type(role))
    except InputError as error:
        place = f"{error.file or file}" + (f":{error.line}" if error.line else "")
        return misconfigured("configuration", f"{place}: {error.what}", error.remedy or "correct it"), None
    return ok("configuration", f"{role} {getattr(config, 'id', '')} of site {getattr(config, 'site', '')}"), config


def _as_client(bus: BusConfig) -> BusConfig | None:
    """Client settings for the router that this agent uses; None for a peer that only listens."""
    connect, _ = bus.endpoints()
    if not connect:
        return None
    return BusConfig(mode="client", connect=connect, tls=bus.tls)


def reach(endpoint: str, patience_s: float = _PATIENCE_S) -> CheckResult | None:
    """The failure of a TCP connection to a router's endpoint, with its kind; None where it is accepted."""
    _, host, port = split_endpoint(endpoint)
    try:
        socket.create_connection((host, port), timeout=patience_s).close()
    except socket.gaierror as error:
        return unavailable(
            "bus",
            f"{endpoint}: the name {host} is not known here: {error.strerror}",
            f"write its address, or add it to /etc/hosts or the DNS (`getent hosts {host}`)",
        )
    except TimeoutError:
        return unavailable(
            "bus",
            f"{endpoint}: no answer from {host} port {port} within {patience_s:g} s",
            "a firewall drops the packets (`nft list ruleset` there), or the address belongs to nobody",
        )
    except OSError as error:
        text, remedy = _UNREACHABLE.get(error.errno or 0, (error.strerror or str(error), "check the network"))
        return unavailable("bus", f"{endpoint}: {text.format(host=host, port=port)}", remedy)
    return None


def running_agent(config: Any, patience_s: float = 2.0) -> CheckResult:
    """What the running agent says of its own health, where [health] lets it be asked."""
    if config.health is None:
        return skip("health", "not asked: no [health] in the configuration")
    where = config.health.listen
    try:
        with urllib.request.urlopen(f"http://{where}/status", timeout=patience_s) as answer:
            report = json.loads(answer.read(1_000_000))
        state, message = str(report["state"]), str(report["message"])
        who, live, ready = str(report["agent"]), bool(report["live"]), bool(report["ready"])
    except (OSError, ValueError, KeyError, TypeError):
        return unavailable(
            "health",
            f"no agent answers at {where}",
            "start it (`systemctl start 'syncline-*'`), or see why it does not run: `journalctl -u 'syncline-*' -n 20`",
        )
    if who != config.id:
        return misconfigured("health", f"{who} answers at {where}", "give each agent of a machine a port of its own")
    text = f"{state}: {message}".rstrip(": ")
    if not live:
        return unavailable("health", text, "it hangs: systemd's watchdog restarts it; else restart it")
    return ok("health", text) if ready else warn("health", text, "see what it names; it goes on by itself then")


def guarded(name: str, error: Exception) -> CheckResult:
    """The result of a check that could not be made."""
    if isinstance(error, InputError):
        return misconfigured(name, str(error), error.remedy or "correct it")
    if isinstance(error, PermissionError):
        place = error.filename or "a file"
        return misconfigured(name, f"{place} may not be read by this user", "run doctor as root (sudo), or give rights")
    return misconfigured(name, f"could not be checked: {error}", "correct what it names, and ask again")
