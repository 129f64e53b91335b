"""Enrolment, renewal, rollout and state of all boards of a site, from the operator's machine."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from deploy.site import keys
from deploy.site.boards.board import CONFIG_FILE, READY_S
from deploy.site.boards.site_file import Site, SiteAgent, configuration
from deploy.site.boards.transport import Board
from protocols.bus.security.access import certificate_name
from protocols.core.errors import InputError, Refused, SynclineError

Boards = Callable[[SiteAgent], Board]
Report = Callable[[str], None]
_AT_ONCE = 8
"""Boards that are spoken to at the same time."""


@dataclass(frozen=True, slots=True)
class AgentState:
    """Of one agent: the certificate's end, None without one; ready and what it says; None where it was not asked."""

    agent: SiteAgent
    until: datetime | None
    revoked: bool = False
    ready: bool | None = None
    text: str = ""

    def days(self, now: datetime) -> float:
        """Days that the certificate is valid for; -inf without one."""
        return float("-inf") if self.until is None else (self.until - now).total_seconds() / 86_400.0


def selected(site: Site, names: Iterable[str]) -> list[SiteAgent]:
    """The agents with these ids or names (camera-cam0); all without. Raises InputError for an unknown one."""
    wanted = list(names)
    known = {name for agent in site.agents for name in (agent.id, agent.name)}
    if unknown := [name for name in wanted if name not in known]:
        raise InputError(f"no agent {', '.join(unknown)}", file=site.file, remedy="names as in site.toml, or ROLE-ID")
    return [agent for agent in site.agents if not wanted or agent.id in wanted or agent.name in wanted]


def states(site: Site) -> list[AgentState]:
    """What the authority knows of every agent, without asking the boards."""
    entries = keys.read_site(site.keys)[1]
    out = []
    for agent in site.agents:
        entry = entries.get(certificate_name(agent.certificate_role, agent.id), {})
        revoked = bool(entry.get("revoked"))
        until = None if revoked or "until" not in entry else datetime.fromisoformat(entry["until"])
        out.append(AgentState(agent, until, revoked))
    return out


def enrol(site: Site, agents: Sequence[SiteAgent], boards: Boards, report: Report) -> list[str]:
    """Have each board make a key, sign its request, and install its agent; returns the names of those that failed.

    Certificates are issued for the boards that answer, all together; then the routers get their files first, also those
    that are enrolled already, because their rules name every agent.
    """
    for agent in agents:  # a configuration that would be refused ends this before any key is made
        configuration(site, agent, {"mode": "router"} if agent.role == "router" else {"mode": "client"})
    requests: dict[str, str] = {}
    failed = _each(agents, lambda agent: requests.__setitem__(agent.name, boards(agent).request()), report)
    answered = [agent for agent in agents if agent.name in requests]
    orders = [
        keys.Order(agent.certificate_role, agent.id, listen=agent.listen, request=requests[agent.name])
        for agent in answered
    ]
    if orders:
        keys.issue_all(site.keys, orders, site.settings.days)
    send = [
        agent
        for agent in site.agents
        if agent in answered or (agent.role == "router" and _has_certificate(site, agent))
    ]
    for group in ([agent for agent in send if agent.role == "router"], [a for a in send if a.role != "router"]):
        failed += _each(group, lambda agent: _send(site, agent, boards(agent), report), report)
    return failed


def renew(
    site: Site, agents: Sequence[SiteAgent], boards: Boards, report: Report, *, every: bool, now: datetime | None = None
) -> tuple[list[str], list[str]]:
    """Renew what ends within renew_days, or every certificate, with new keys; returns (renewed, failed) names.

    One board after another: an agent restarts with its new certificate, and one that is not ready with it gets the old
    one back, and ends the renewal.
    """
    moment = now or datetime.now(UTC)
    known = {state.agent.name: state for state in states(site)}
    due = []
    for agent in agents:
        state = known[agent.name]
        if state.until is not None and (every or state.days(moment) < site.settings.renew_days):
            due.append(agent)
    done: list[str] = []
    for agent in due:
        board = boards(agent)
        try:
            order = keys.Order(agent.certificate_role, agent.id, listen=agent.listen, request=board.request())
            keys.issue_all(site.keys, [order], site.settings.days)
            _send(site, agent, board, report)
            _ready_or_restored(agent, board)
        except SynclineError as error:
            report(f"{agent.name}: not renewed: {error}")
            return done, [agent.name]
        done.append(agent.name)
    return done, []


def rollout(
    site: Site,
    agents: Sequence[SiteAgent],
    boards: Boards,
    report: Report,
    *,
    bundle: Path | None = None,
    batch: int = 10,
) -> tuple[list[str], str]:
    """Bring the configuration of site.toml, or a new version, to boards in stages; returns (done, what failed or "").

    The first stage is one board of each role, then ``batch`` boards at a time. A board that is not ready within a
    minute returns to what it had, and no further board is touched.
    """
    done: list[str] = []
    for number, stage in enumerate(_stages(agents, batch), 1):
        report(f"stage {number}: {', '.join(agent.name for agent in stage)}")
        problems: list[str] = []

        def bring(agent: SiteAgent) -> None:
            board = boards(agent)
            if bundle is not None:
                report(f"{agent.name}: {board.update(bundle)}")
                return
            _send(site, agent, board, report)
            _ready_or_restored(agent, board)

        failed = _each(stage, bring, problems.append)
        done += [agent.name for agent in stage if agent.name not in failed]
        if failed:
            return done, "; ".join(problems)
    return done, ""


def status(site: Site, agents: Sequence[SiteAgent], boards: Boards) -> list[AgentState]:
    """Every agent's certificate and what it says of itself now."""
    known = {state.agent.name: state for state in states(site)}

    def ask(agent: SiteAgent) -> AgentState:
        state = known[agent.name]
        if state.until is None or agent.host == "stick":
            return state
        try:
            ready, text = boards(agent).ready(0.0)
        except SynclineError as error:
            ready, text = False, str(error)
        return AgentState(agent, state.until, state.revoked, ready, text)

    with ThreadPoolExecutor(_AT_ONCE) as pool:
        return list(pool.map(ask, agents))


def revoke(site: Site, agent: SiteAgent, boards: Boards, report: Report) -> list[str]:
    """Revoke an agent's certificates, and bring the new rules to the routers; returns the routers that failed."""
    keys.revoke(site.keys, agent.certificate_role, agent.id)
    report(f"{agent.name}: revoked")
    routers = [one for one in site.agents if one.role == "router" and _has_certificate(site, one)]
    return _each(routers, lambda router: _send(site, router, boards(router), report), report)


def _stages(agents: Sequence[SiteAgent], batch: int) -> list[list[SiteAgent]]:
    first = {agent.role: agent for agent in reversed(agents)}
    canaries = [agent for agent in agents if agent in first.values()]
    rest = [agent for agent in agents if agent not in canaries]
    return [canaries, *(rest[start : start + batch] for start in range(0, len(rest), batch))] if canaries else []


def _each(agents: Sequence[SiteAgent], act: Callable[[SiteAgent], object], report: Report) -> list[str]:
    """Do it for all, some at a time; what fails is reported and does not keep the others. Returns the failed names."""

    def attempt(agent: SiteAgent) -> str:
        try:
            act(agent)
        except SynclineError as error:
            report(str(error) if agent.name in str(error) else f"{agent.name}: {error}")
            return agent.name
        return ""

    with ThreadPoolExecutor(_AT_ONCE) as pool:
        return [name for name in pool.map(attempt, agents) if name]


def _has_certificate(site: Site, agent: SiteAgent) -> bool:
    return (_own(site, agent) / keys.CERTIFICATE_FILE).is_file()


def _own(site: Site, agent: SiteAgent) -> Path:
    return site.keys / f"{agent.certificate_role}-{agent.id}"


def _send(site: Site, agent: SiteAgent, board: Board, report: Report) -> None:
    """Bring an agent's certificate and configuration to its board. Raises InputError where it has no certificate."""
    own = _own(site, agent)
    table = own / (keys.ROUTER_FILE if agent.role == "router" else keys.BUS_FILE)
    if not _has_certificate(site, agent):
        raise InputError(f"{agent.name} is not enrolled", remedy=f"syncline site enrol {site.file} {agent.name}")
    bus = tomllib.loads(table.read_text(encoding="utf-8"))["bus"]
    files = {CONFIG_FILE: configuration(site, agent, bus).encode()}
    sent = [keys.CERTIFICATE_FILE, keys.CA_FILE, *([keys.ZENOH_FILE] if agent.role == "router" else [])]
    files |= {name: (own / name).read_bytes() for name in sent}
    for file in agent.files:
        try:
            files[file.name] = file.read_bytes()
        except OSError as error:
            raise InputError(f"cannot be read: {error.strerror}", file=file, remedy="correct files") from None
    changes = board.accept(files)
    report(f"{agent.name}: {changes[-1] if changes else 'nothing to change'}")


def _ready_or_restored(agent: SiteAgent, board: Board) -> None:
    """Raises Refused, after the board got back what it had, where the agent is not ready within a minute."""
    good, text = board.ready(READY_S)
    if not good:
        board.restore()
        raise Refused(f"{agent.name} was not ready within {READY_S:.0f} s ({text}) and has again what it had")
