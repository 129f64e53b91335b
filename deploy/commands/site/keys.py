"""`syncline keys`: certificates of a site, and access rules for publishing and subscribing."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from deploy.commands.common import Json, UnusedSeed, answer
from protocols.core.errors import EXIT_DONE, EXIT_REFUSED

Many = Annotated[tuple[str, ...], Parameter(negative="")]
Role = Annotated[
    Literal["camera", "uav", "hub", "record", "view", "router"],
    Parameter(help="Role of the agent, which determines what it may publish and subscribe to."),
]

Authority = Annotated[Path, Parameter(help="The authority, from `keys init`.")]
OfId = Annotated[str, Parameter(help="The agent's id.")]

KEYS = App(
    name="keys",
    help="Certificates of a site, and access rules for publishing and subscribing.\n\n"
    "Example: syncline keys init keys --site yard\n\n"
    "Example: syncline keys issue keys --role router --id r0 --listen tls/192.168.1.5:7447\n\n"
    "Example: syncline keys issue keys --role camera --id cam0\n\n"
    "Example: syncline keys revoke keys --role camera --id cam0\n\n"
    "Example: syncline keys check keys",
    help_format="markdown",
)


@KEYS.command
def init(folder: Path, /, *, site: str, json: Json = False, seed: UnusedSeed = 0) -> int:
    """Create the certificate authority of a new site.

    Example: syncline keys init keys --site yard

    Parameters
    ----------
    folder
        Folder of the authority. Whoever has its ca-key.pem can impersonate any agent.
    site
        Name of the site, as in the agents' configurations.
    """
    from deploy.site import keys

    keys.make_site(folder, site)
    line = f"authority of site {site} in {folder}; keep ca-key.pem on this machine only"
    return answer({"folder": str(folder), "site": site}, [line], json)


@KEYS.command
def issue(
    folder: Authority,
    /,
    *,
    role: Role,
    id: str,
    days: float = 30.0,
    connect: Many = (),
    listen: Many = (),
    host: Many = (),
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """Issue or renew an agent's certificate, and rewrite the access rules of all routers.

    Example: syncline keys issue keys --role camera --id cam0 --days 7

    Parameters
    ----------
    id
        The agent's id, as in its configuration.
    days
        Validity of the certificate in days.
    connect
        Endpoints of routers to connect to; default: the routers issued here.
    listen
        For a router: endpoints to listen on; default tls/127.0.0.1:7447.
    host
        For a router: additional host names or addresses for its certificate.
    """
    from deploy.site import keys

    issued = keys.issue(folder, role, id, days=days, connect=connect, listen=listen, hosts=host)
    lines = [
        f"{role} {id}: {issued.folder}, valid until {issued.until:%Y-%m-%d %H:%M} UTC",
        f"run it with: syncline router {issued.folder / keys.ROUTER_FILE}"
        if role == "router"
        else f"copy that folder to its machine and begin its configuration with {keys.BUS_FILE} there",
    ]
    until = issued.until.isoformat(timespec="seconds")
    return answer({"folder": str(issued.folder), "until": until}, lines, json)


@KEYS.command
def revoke(folder: Authority, /, *, role: Role, id: OfId, json: Json = False, seed: UnusedSeed = 0) -> int:
    """Revoke an agent's certificates: routers with the new rules let them neither publish nor subscribe.

    Zenoh does not read certificate revocation lists, so a revoked certificate can still open a connection until it
    expires: keep --days short. Its name is never used again; `keys issue` gives the agent a new one.

    Example: syncline keys revoke keys --role camera --id cam0
    """
    from deploy.site import keys

    files = keys.revoke(folder, role, id)
    reloads = "`syncline router` reloads it automatically, zenohd must be restarted"
    lines = [f"{role} {id}: revoked", *(f"copy {file} to its router: {reloads}" for file in files)]
    return answer({"revoked": f"{role}.{id}", "rules": [str(file) for file in files]}, lines, json)


@KEYS.command
def check(folder: Authority, /, *, json: Json = False, seed: UnusedSeed = 0) -> int:
    """Test, over real connections on this machine, what every certificate may and may not do.

    It also tests which clients the router refuses, and with which message: a missing, wrong or expired certificate, and
    plain TCP.

    Example: syncline keys check keys

    Parameters
    ----------
    folder
        The authority, from `keys init`, with a router issued.
    """
    from deploy.site.keys_check import check_site

    findings = check_site(folder)
    bad = [finding for finding in findings if finding.wanted != finding.found]
    if json:
        rows = [
            {"who": f.who, "what": f.what, "wanted": f.wanted, "found": f.found, "reason": f.reason, "s": f.seconds}
            for f in findings
        ]
        answer({"ok": not bad, "tried": rows}, (), json)
        return EXIT_REFUSED if bad else EXIT_DONE
    for who in dict.fromkeys(finding.who for finding in findings):
        own = [finding for finding in findings if finding.who == who]
        may = [finding.what for finding in own if finding.found]
        may_not = [finding for finding in own if not finding.found]
        if may:
            print(f"{who}: {', '.join(may)}")
        for finding in may_not:
            if finding.reason:
                print(f"{who}: turned away after {finding.seconds:.2f} s: {finding.reason}")
        silent = [finding.what for finding in may_not if not finding.reason]
        if silent:
            print(f"{who}: may not: {', '.join(silent)}")
    for finding in bad:
        verb = "goes through and should not" if finding.found else "should go through and does not"
        print(f"syncline: {finding.who}: {finding.what}: {verb}", file=sys.stderr)
    print(f"{len(findings)} tried, {len(bad)} wrong")
    return EXIT_REFUSED if bad else EXIT_DONE
