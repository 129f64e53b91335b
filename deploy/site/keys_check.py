"""Self-test of a site's certificates: what each agent may do, and which clients are refused with which reason."""

from __future__ import annotations

import tempfile
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import msgspec

from deploy.site import keys
from protocols.bus.router.selftest import PermissionCheck, try_agents, try_untrusted_client
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.security.access import certificate_name
from protocols.bus.settings import BusConfig, TlsConfig
from protocols.core.errors import InputError


def tls_of(folder: Path) -> TlsConfig:
    """The certificate files in an agent's folder."""
    return TlsConfig(ca=folder / keys.CA_FILE, certificate=folder / keys.CERTIFICATE_FILE, key=folder / keys.KEY_FILE)


def check_site(folder: Path) -> list[PermissionCheck]:
    """Test every agent that has its folder here, and untrusted clients. Raises InputError if no router is issued."""
    site, agents = keys.read_site(folder)
    here = {name: folder / f"{a['role']}-{a['id']}" for name, a in agents.items()}
    here = {name: place for name, place in here.items() if (place / keys.CERTIFICATE_FILE).is_file()}
    routers = [name for name in here if agents[name]["role"] == "router"]
    if not routers:
        raise InputError(
            "no router has a certificate here", file=folder, remedy="`syncline keys issue DIR --role router --id r0`"
        )
    place = here[routers[0]]
    config = BusConfig(mode="router", tls=tls_of(place), access=place / keys.ZENOH_FILE)
    tried = [(agents[n]["role"], agents[n]["id"], tls_of(p)) for n, p in here.items() if n not in routers]
    found = try_agents(config, site, tried)
    with tempfile.TemporaryDirectory() as made:
        found += try_agents(config, site, revoked(folder, agents, Path(made)), revoked=True)
    endpoint = free_endpoint().replace("tcp/", "tls/")
    with Router(config=msgspec.structs.replace(config, listen=(endpoint,))), tempfile.TemporaryDirectory() as made:
        for what, tls in untrusted_clients(folder, Path(made)).items():
            found.append(try_untrusted_client(endpoint, what, tls))
    return found


def revoked(folder: Path, agents: dict[str, dict[str, Any]], made: Path) -> list[tuple[str, str, TlsConfig]]:
    """The last certificate that was revoked of each agent, as (role, id, files): made again in ``made``."""
    out = []
    now = datetime.now(UTC)
    for name, entry in sorted(agents.items()):
        generation = keys.generation_of(entry) - 1
        if generation:
            own = made / name
            own.mkdir()
            old = certificate_name(entry["role"], entry["id"], generation)
            keys.sign(folder, own, old, now - timedelta(minutes=5), now + timedelta(hours=1), ())
            out.append((entry["role"], entry["id"], tls_of(own)))
    return out


def untrusted_clients(folder: Path, made: Path) -> dict[str, TlsConfig | None]:
    """Certificates that no router of the site may accept, made in ``made``; None = plain TCP."""
    out: dict[str, TlsConfig | None] = {"plain TCP": None}
    now = datetime.now(UTC)
    other = made / "other"
    keys.make_site(other, "elsewhere")
    wrong = keys.issue(other, "camera", "cam0").folder
    # A client that has the site's CA certificate, but a certificate of another authority.
    (wrong / keys.CA_FILE).write_bytes((folder / keys.CA_FILE).read_bytes())
    out["a certificate of another authority"] = tls_of(wrong)
    expired = made / "expired"
    expired.mkdir()
    keys.sign(folder, expired, "camera.cam0", now - timedelta(days=2), now - timedelta(days=1), ())
    out["an expired certificate"] = tls_of(expired)
    return out
