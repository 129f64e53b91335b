"""`syncline keys`: a site's certificates, and the rules of who may say and hear what."""

from __future__ import annotations

import json as json_module
import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from protocols.core.errors import EXIT_DONE, EXIT_REFUSED

Json = Annotated[bool, Parameter(negative="")]
Many = Annotated[tuple[str, ...], Parameter(negative="")]
Role = Literal["camera", "uav", "hub", "record", "view", "router"]

KEYS = App(
    name="keys",
    help="Certificates: who may say and hear what.\n\n"
    "Example: syncline keys init keys --site yard\n\n"
    "Example: syncline keys issue keys --role router --id r0 --listen tls/192.168.1.5:7447\n\n"
    "Example: syncline keys issue keys --role camera --id cam0\n\n"
    "Example: syncline keys revoke keys --role camera --id cam0\n\n"
    "Example: syncline keys check keys",
    help_format="plaintext",
)


@KEYS.command
def init(folder: Path, /, *, site: str, json: Json = False) -> int:
    """Make the authority of a new site.

    Example: syncline keys init keys --site yard

    Parameters
    ----------
    folder
        Where the authority is kept. Whoever has ca-key.pem of it can be anybody.
    site
        The site's name, as in the agents' configurations.
    json
        Print JSON.
    """
    from deploy.site import keys

    keys.make_site(folder, site)
    if json:
        print(json_module.dumps({"folder": str(folder), "site": site}))
    else:
        print(f"authority of site {site} in {folder}; keep ca-key.pem on this machine only")
    return EXIT_DONE


@KEYS.command
def issue(
    folder: Path,
    /,
    *,
    role: Role,
    id: str,
    days: float = 30.0,
    connect: Many = (),
    listen: Many = (),
    host: Many = (),
    json: Json = False,
) -> int:
    """Make or renew an agent's certificate, and write every router's rules anew.

    Example: syncline keys issue keys --role camera --id cam0 --days 7

    Parameters
    ----------
    folder
        The authority, from `keys init`.
    role
        What the agent is, and with it what it may say and hear.
    id
        The agent's id, as in its configuration.
    days
        How long the certificate is valid.
    connect
        Endpoints of routers to connect to; default: those issued here.
    listen
        Of a router: where it listens; default tls/127.0.0.1:7447.
    host
        Of a router: further names or addresses by which others reach it.
    json
        Print JSON.
    """
    from deploy.site import keys

    issued = keys.issue(folder, role, id, days=days, connect=connect, listen=listen, hosts=host)
    if json:
        print(json_module.dumps({"folder": str(issued.folder), "until": issued.until.isoformat(timespec="seconds")}))
        return EXIT_DONE
    print(f"{role} {id}: {issued.folder}, valid until {issued.until:%Y-%m-%d %H:%M} UTC")
    if role == "router":
        print(f"run it with: syncline router {issued.folder / keys.ROUTER_FILE}")
    else:
        print(f"copy that folder to its machine and begin its configuration with {keys.BUS_FILE} there")
    return EXIT_DONE


@KEYS.command
def revoke(folder: Path, /, *, role: Role, id: str, json: Json = False) -> int:
    """Take an agent's certificates back: routers that have the new rules let them say and hear nothing.

    Zenoh reads no lists of revoked certificates, so a revoked one still opens a connection until it expires: keep
    --days short. Its name is never used again; `keys issue` gives the agent a new one.

    Example: syncline keys revoke keys --role camera --id cam0

    Parameters
    ----------
    folder
        The authority, from `keys init`.
    role
        What the agent is.
    id
        Its id.
    json
        Print JSON.
    """
    from deploy.site import keys

    files = keys.revoke(folder, role, id)
    if json:
        print(json_module.dumps({"revoked": f"{role}.{id}", "rules": [str(file) for file in files]}))
        return EXIT_DONE
    print(f"{role} {id}: revoked")
    for file in files:
        print(f"bring {file} to its router: `syncline router` takes it up by itself, zenohd when it is started again")
    return EXIT_DONE


@KEYS.command
def check(folder: Path, /, *, json: Json = False) -> int:
    """Try, over real connections on this machine, what every certificate may and may not do.

    Also whom the router turns away: no, a wrong, an expired certificate, plain TCP, and what they are told.

    Example: syncline keys check keys

    Parameters
    ----------
    folder
        The authority, from `keys init`, with a router issued.
    json
        Print JSON.
    """
    from deploy.site.keys_check import check_site

    findings = check_site(folder)
    bad = [finding for finding in findings if finding.wanted != finding.found]
    if json:
        rows = [
            {"who": f.who, "what": f.what, "wanted": f.wanted, "found": f.found, "reason": f.reason, "s": f.seconds}
            for f in findings
        ]
        print(json_module.dumps({"ok": not bad, "tried": rows}))
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
