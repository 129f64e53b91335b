"""Why a router cannot be reached, by what the connection ends with; and what a running agent says of its health."""

from __future__ import annotations

import errno
import json
import socket
import urllib.error
import urllib.request
from typing import Any

from deploy.site.doctor.check_result import CheckResult, misconfigured, ok, skip, unavailable, warn
from protocols.bus.settings import split_endpoint
from protocols.core.errors import InputError

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
