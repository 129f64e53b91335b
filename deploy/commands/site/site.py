"""`syncline site`: all boards of a site from one file."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from deploy.commands.common import Flag, Json, Names, Role, UnusedSeed, answer, check_range
from deploy.commands.site.board import accept, image, ready, request, restore, update
from protocols.core.errors import EXIT_DONE, EXIT_REFUSED, InputError

if TYPE_CHECKING:
    from deploy.site.boards.operations import Boards
    from deploy.site.boards.site_file import Site


SiteToml = Annotated[Path, Parameter(help="The site.toml.")]

SITE = App(
    name="site",
    help="All boards of a site from one file, site.toml: enrolment, renewal, updates, state.\n\n"
    "Example: syncline site init site.toml --site yard --cameras 50\n\n"
    "Example: syncline site enrol site.toml\n\n"
    "Example: syncline site rollout site.toml --bundle camera-bundle --role camera\n\n"
    "Example: syncline site renew site.toml\n\n"
    "Example: syncline site status site.toml\n\n"
    "On a board: request, accept, update, ready, restore.",
    help_format="markdown",
)


@SITE.command
def init(file: Path, /, *, site: str = "", cameras: int = 4, json: Json = False, seed: UnusedSeed = 0) -> int:
    """Write a site.toml to begin with, unless it is there, and make the site's certificate authority beside it.

    Example: syncline site init site.toml --site yard --cameras 50

    Parameters
    ----------
    file
        The site.toml; one that exists is read and not changed.
    site
        Name of the site, for a new file.
    cameras
        Number of cameras in a new file.
    """
    from deploy.site import keys
    from deploy.site.boards.site_file import read_site_file, template
    from protocols.core.files import write_atomically

    written = not file.exists()
    if written:
        if not site or not 2 <= cameras <= 150:
            raise InputError("a new site needs --site NAME, and 2 to 150 --cameras", file=file)
        write_atomically(file, template(site, cameras))
    found = read_site_file(file)
    made = not (found.keys / keys.SITE_FILE).exists()
    if made:
        keys.make_site(found.keys, found.settings.site)
    lines = (
        f"{file}: {len(found.agents)} agents" + ("; correct hosts and configuration" if written else ""),
        f"authority in {found.keys}" + ("; keep ca-key.pem on this machine only, and a copy of it" if made else ""),
    )
    return answer({"file": str(file), "keys": str(found.keys), "agents": len(found.agents)}, lines, json)


@SITE.command
def enrol(
    file: SiteToml,
    names: Names = None,
    /,
    *,
    stick: Path | None = None,
    again: Flag = False,
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """Enrol boards: each makes its own key, and gets a certificate, its configuration, and its agent installed.

    A private key never leaves its board. Boards that do not answer are named, and enrolled by the next run. Exit status
    3 if any failed. Without names, all that are not enrolled.

    Example: syncline site enrol site.toml

    Parameters
    ----------
    stick
        USB stick for boards without a network: takes the requests in STICK/requests, writes what is for the boards to
        STICK/boards.
    again
        Also those that are enrolled, with new keys.
    """
    from deploy.site.boards import operations

    site = _site(file)
    agents = operations.selected(site, names or ())
    new = {state.agent.name for state in operations.states(site) if state.until is None}
    wanted = [agent for agent in agents if again or names or agent.name in new]
    if stick is not None:
        wanted = [agent for agent in wanted if (stick / "requests" / f"{agent.name}.csr").is_file()]
    elif not names:
        wanted = [agent for agent in wanted if agent.host != "stick"]
    failed = operations.enrol(site, wanted, _boards(site, stick), _reporter(json))
    done = [agent.name for agent in wanted if agent.name not in failed]
    answer({"done": done, "failed": failed}, [f"{len(done)} of {len(wanted)} enrolled"], json)
    return EXIT_REFUSED if failed else EXIT_DONE


@SITE.command
def rollout(
    file: SiteToml,
    names: Names = None,
    /,
    *,
    role: Role | None = None,
    bundle: Path | None = None,
    batch: Annotated[int, Parameter(name="--batch")] = 10,
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """Bring site.toml's configuration, or a new version, to the boards in stages, and back where one is not ready.

    First one board of each role, then --batch at a time. A board that is not ready within 60 s returns to what it had,
    by itself for a version; no further board is touched then, and the exit status is 3.

    Example: syncline site rollout site.toml --role camera --bundle camera-bundle

    Parameters
    ----------
    role
        Only agents of this role.
    bundle
        Folder that `syncline bundle` has made for these boards; without it, their configuration.
    batch
        Boards in a stage after the first.
    """
    from deploy.site.boards import operations

    site = _site(file)
    enrolled = {state.agent.name for state in operations.states(site) if state.until is not None}
    agents = [one for one in operations.selected(site, names or ()) if role in (None, one.role)]
    if bundle is not None and not (bundle / "install.sh").is_file():
        raise InputError("is no bundle", file=bundle, remedy="make one with `syncline bundle`")
    check_range("--batch", batch, 1, 1000)
    agents = [agent for agent in agents if agent.name in enrolled or bundle is not None]
    done, problem = operations.rollout(site, agents, _boards(site), _reporter(json), bundle=bundle, batch=batch)
    answer({"done": done, "problem": problem}, [f"{len(done)} of {len(agents)} done"], json)
    if problem:
        print(f"syncline: rollout stopped: {problem}", file=sys.stderr)
        return EXIT_REFUSED
    return EXIT_DONE


@SITE.command
def renew(
    file: SiteToml,
    names: Names = None,
    /,
    *,
    every: Annotated[bool, Parameter(name="--all", negative="")] = False,
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """Renew the certificates that end within renew_days, each with a new key that its board makes.

    Run it daily; it does nothing where nothing is due. One board after another restarts its agent; one that is not
    ready afterwards gets the old certificate back, and the exit status is 3.

    Example: syncline site renew site.toml

    Parameters
    ----------
    every
        Also those that are not due.
    """
    from deploy.site.boards import operations

    site = _site(file)
    agents = operations.selected(site, names or ())
    done, failed = operations.renew(site, agents, _boards(site), _reporter(json), every=every)
    line = f"{len(done)} renewed" + (f", {failed[0]} failed" if failed else "")
    answer({"done": done, "failed": failed}, [line], json)
    return EXIT_REFUSED if failed else EXIT_DONE


@SITE.command
def revoke(file: SiteToml, name: str, /, *, json: Json = False, seed: UnusedSeed = 0) -> int:
    """Revoke an agent's certificates, and bring the new rules to the routers. `enrol NAME` takes it in again.

    Example: syncline site revoke site.toml cam07

    Parameters
    ----------
    name
        The agent, by id or ROLE-ID.
    """
    from deploy.site.boards import operations

    site = _site(file)
    failed: list[str] = []
    revoked = operations.selected(site, [name])
    for agent in revoked:
        failed += operations.revoke(site, agent, _boards(site), _reporter(json))
    answer({"done": [agent.name for agent in revoked], "failed": failed}, (), json)
    return EXIT_REFUSED if failed else EXIT_DONE


@SITE.command
def status(
    file: SiteToml, names: Names = None, /, *, offline: Flag = False, json: Json = False, seed: UnusedSeed = 0
) -> int:
    """Show every agent: certificate, ready or not, and what it says of itself. Exit status 3 if any is not ready.

    Example: syncline site status site.toml

    Parameters
    ----------
    offline
        Do not ask the boards: only what is known here.
    """
    from datetime import UTC, datetime

    from deploy.site.boards import operations

    site = _site(file)
    agents = operations.selected(site, names or ())
    now = datetime.now(UTC)
    wanted = {agent.name for agent in agents}
    found = [
        state
        for state in (operations.states(site) if offline else operations.status(site, agents, _boards(site)))
        if state.agent.name in wanted
    ]
    rows = [
        {
            "agent": state.agent.name,
            "host": state.agent.host,
            "certificate": "revoked" if state.revoked else "none" if state.until is None else state.until.isoformat(),
            "days": None if state.until is None else round(state.days(now), 2),
            "ready": state.ready,
            "text": state.text,
        }
        for state in found
    ]
    lines = []
    for row in rows:
        days = f"{row['days']} days" if row["days"] is not None else str(row["certificate"])
        ready = "-" if row["ready"] is None else "ready" if row["ready"] else "NOT READY"
        lines.append(f"{row['agent']!s:<24}{days:<16}{ready:<10} {row['text']}".rstrip())
    answer(rows, lines, json)
    bad = [state for state in found if state.ready is False or (state.until is not None and state.days(now) <= 0.0)]
    return EXIT_REFUSED if bad else EXIT_DONE


@SITE.command
def monitoring(file: Path, /, *, out: Path, json: Json = False, seed: UnusedSeed = 0) -> int:
    """Write a Prometheus configuration with a target for each agent, the alert rules, and the Grafana dashboard.

    Example: syncline site monitoring site.toml --out monitoring

    Parameters
    ----------
    file
        The site.toml. An agent whose [health] stays on loopback is scraped on its own machine only.
    out
        Folder to write.
    """
    from deploy.site.boards.site_file import write_monitoring

    written = write_monitoring(_site(file), out)
    return answer({"written": written}, written, json)


for _command in (image, request, accept, restore, update, ready):
    SITE.command(_command)


def _site(file: Path) -> Site:
    from deploy.site.boards.site_file import read_site_file

    return read_site_file(file)


def _boards(site: Site, stick: Path | None = None) -> Boards:
    from deploy.site.boards.transport import board_of

    return lambda agent: board_of(site, agent, stick)


def _reporter(json: bool) -> Callable[[str], None]:
    """Prints what is done, as it is done; beside a result as JSON on stderr."""
    return partial(print, file=sys.stderr if json else sys.stdout, flush=True)
