"""site.toml: every agent of a site, where it runs, what agents of a role share; files for its monitoring."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import tomli_w
from msgspec import Meta

from deploy.config.agents import StrictConfig
from deploy.config.file import convert, load
from deploy.site.install.plan import config_type
from protocols.core.errors import InputError
from protocols.core.files import write_together
from protocols.core.names import check_identifier

SHIPPED = Path(__file__).parents[1] / "monitoring"
RULES, DASHBOARD, PROMETHEUS = "alerts.yaml", "dashboard.json", "prometheus.yaml"
RoleName = Literal["router", "recorder", "hub", "camera", "uav"]
_RANGE = re.compile(r"\{(\d{1,4})\.\.(\d{1,4})\}")
_MOST = 1024  # agents: bounds what a range stands for
_HEALTH_PORT = 9100  # the default of [health]
Days = Annotated[float, Meta(gt=0.0, le=825.0)]


class AgentTable(StrictConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """[[agent]]: one agent, or as many as a range {00..49} in ``id`` and ``host`` gives.

    host: where it runs: "user@address" for ssh, "root:FOLDER" for a system image, "stick" for a board that is reached
    by a USB stick only. listen: of a router, its endpoints for the site. config: more of its configuration. files: that
    the configuration refers to, by their names; they are sent along.
    """

    role: RoleName
    id: str
    host: str = "stick"
    listen: tuple[str, ...] = ()
    config: dict[str, Any] = msgspec.field(default_factory=dict)
    files: tuple[Path, ...] = ()


class SiteFile(StrictConfig, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Schema of site.toml.

    days: validity of certificates; renew_days: what is left of it when `site renew` renews one. keys: folder of the
    authority. program, sudo: path of `syncline` on the boards, and whether it is run with sudo there. time_servers: NTP
    servers for boards, such as the router's machine. defaults: configuration of all agents of a role.
    """

    site: str
    days: Days = 30.0
    renew_days: Days = 10.0
    keys: Path = Path("keys")
    program: str = "/opt/syncline/current/bin/syncline"
    sudo: bool = False
    time_servers: tuple[str, ...] = ()
    defaults: dict[RoleName, dict[str, Any]] = msgspec.field(default_factory=dict)
    agent: tuple[AgentTable, ...] = ()

    def __post_init__(self) -> None:
        if self.renew_days >= self.days:
            raise ValueError("renew_days is not less than days; certificates would be renewed each time")


@dataclass(frozen=True, slots=True)
class SiteAgent:
    """One agent. config: its configuration without [bus] and identity. files: that it refers to."""

    role: str
    id: str
    host: str
    listen: tuple[str, ...]
    config: Mapping[str, Any]
    files: tuple[Path, ...] = ()

    @property
    def name(self) -> str:
        """``camera-cam0``, as folders and units are named."""
        return f"{self.role}-{self.id}"

    @property
    def certificate_role(self) -> str:
        """The role's name in certificates."""
        return "record" if self.role == "recorder" else self.role


@dataclass(frozen=True, slots=True)
class Site:
    """A site with all its agents, ranges expanded; routers first."""

    file: Path
    settings: SiteFile
    agents: tuple[SiteAgent, ...]

    @property
    def keys(self) -> Path:
        """The folder of the authority; like all paths, relative to site.toml."""
        return self.file.parent / self.settings.keys


def read_site_file(file: Path) -> Site:
    """Read and check site.toml. Raises InputError for the first error, also of the configurations that come of it."""
    settings = load(file, SiteFile)
    check_identifier(settings.site, "site")
    agents: dict[str, SiteAgent] = {}
    for table in settings.agent:
        for agent in _expanded(table, settings.defaults, file):
            if agent.name in agents:
                raise InputError(f"{agent.role} {agent.id!r} stands there twice", file=file, remedy="rename one")
            agents[agent.name] = agent
    if len(agents) > _MOST:
        raise InputError(f"{len(agents)} agents, at most {_MOST}", file=file, remedy="make several sites")
    order = ("router", "recorder", "hub", "uav", "camera")
    return Site(file, settings, tuple(sorted(agents.values(), key=lambda one: (order.index(one.role), one.id))))


def _expanded(table: AgentTable, defaults: Mapping[Any, dict[str, Any]], file: Path) -> Iterator[SiteAgent]:
    ids, hosts = _texts(table.id, file), _texts(table.host, file)
    if len(hosts) == 1 and len(ids) > 1:
        hosts = hosts * len(ids)
    if len(hosts) != len(ids):
        raise InputError(
            f"{table.id!r} are {len(ids)} agents, and {table.host!r} are {len(hosts)} hosts",
            file=file,
            remedy="ranges of equal length",
        )
    config = _merged(defaults.get(table.role, {}), table.config)
    for number, (name, host) in enumerate(zip(ids, hosts, strict=True)):
        own = {"health": {"listen": f"127.0.0.1:{_HEALTH_PORT}"}, **config}
        yield SiteAgent(table.role, name, host, table.listen, _numbered(own, number), table.files)


def _numbered(value: Any, number: int) -> Any:
    """The configuration with the elements of its ranges that belong to an agent."""
    if isinstance(value, dict):
        return {key: _numbered(inner, number) for key, inner in value.items()}
    if isinstance(value, str) and (found := _RANGE.search(value)):
        return _RANGE.sub(f"{int(found[1]) + number:0{len(found[1])}d}", value)
    return value


def _texts(text: str, file: Path) -> list[str]:
    """All texts that a range {00..49} stands for; one text without a range."""
    found = _RANGE.search(text)
    if found is None:
        return [text]
    first, last = int(found[1]), int(found[2])
    if not first <= last < first + _MOST:
        raise InputError(f"{found[0]} is no range", file=file, remedy="write it like {00..49}")
    return [_RANGE.sub(f"{number:0{len(found[1])}d}", text) for number in range(first, last + 1)]


def _merged(base: Mapping[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in more.items():
        out[key] = _merged(out[key], value) if isinstance(value, dict) and isinstance(out.get(key), dict) else value
    return out


def configuration(site: Site, agent: SiteAgent, bus: Mapping[str, Any]) -> str:
    """The complete configuration of an agent as TOML, with the [bus] table that its certificate goes with.

    Raises InputError where the agent would refuse it; relative files in it are those of the board.
    """
    identity = {"id": agent.id, "site": site.settings.site}
    text = tomli_w.dumps({**agent.config, **identity, "bus": dict(bus)})
    try:
        convert(text, config_type(agent.role), Path("/"))
    except InputError as error:
        raise InputError(f"{agent.name}: {error.what}", file=site.file, remedy=error.remedy) from None
    return text


TEMPLATE = """\
# A site: every agent, where it runs, and its configuration. `syncline site enrol` has keys made on the boards, makes
# certificates for them and installs the agents; `syncline site rollout` brings changes of this file and new versions.
site = "{site}"
days = 30.0          # certificates are valid for so long
renew_days = 10.0    # `syncline site renew`, run daily, renews them when this is left

# Every {{00..49}} is a number for each board: cam00 on 192.168.1.100, cam01 on 192.168.1.101, ...
[[agent]]
role = "router"
id = "r0"
host = "root@192.168.1.5"
listen = ["tls/192.168.1.5:7447"]

[[agent]]
role = "hub"
id = "hub"
host = "root@192.168.1.5"
config = {{ health = {{ listen = "127.0.0.1:9101" }}, known = "last" }}

[[agent]]
role = "recorder"
id = "recorder"
host = "root@192.168.1.5"
config = {{ part_mb = 100.0, keep_free_mb = 20000.0, health = {{ listen = "127.0.0.1:9102" }} }}

[[agent]]
role = "camera"
id = "cam{{00..{last:02d}}}"
host = "root@192.168.1.{{100..{address}}}"

[defaults.camera]
driver = "usb"
usb = {{ device = "/dev/video0", fps = 30.0 }}
"""


def template(site: str, cameras: int) -> str:
    """A site.toml to begin with."""
    check_identifier(site, "site")
    return TEMPLATE.format(site=site, last=cameras - 1, address=99 + cameras)


def write_monitoring(site: Site, out: Path) -> list[str]:
    """Write the files; returns a line for each, and one for agents that only their own machine can ask."""
    targets, hidden = [], []
    for agent in site.agents:
        health = agent.config.get("health", {})
        host, _, port = str(health.get("listen", "")).rpartition(":")
        if not port:
            continue
        address = agent.host.rpartition("@")[2]
        if host in ("0.0.0.0", "[::]"):
            host = address
        elif host in ("127.0.0.1", "localhost", "[::1]"):
            hidden.append(agent.name)
        targets.append({"targets": [f"{host}:{port}"], "labels": {"board": address}})
    jobs = {
        "global": {"scrape_interval": "5s"},
        "rule_files": [RULES],
        "scrape_configs": [{"job_name": "syncline", "static_configs": targets}],
    }
    files = {name: (SHIPPED / name).read_text(encoding="utf-8") for name in (RULES, DASHBOARD)}
    # JSON is YAML: no writer of its own is needed.
    files[PROMETHEUS] = "# Written by `syncline site monitoring`.\n" + json.dumps(jobs, indent=1) + "\n"
    write_together({out / name: text for name, text in files.items()})
    lines = [f"{out / name}" for name in files]
    if hidden:
        lines.append(
            f"on loopback, for their own machine or a tunnel only: {', '.join(hidden[:8])}"
            + (f" and {len(hidden) - 8} more" if len(hidden) > 8 else "")
            + '; listen = "0.0.0.0:9100" and beyond_loopback = true in [health] let others ask'
        )
    return lines
