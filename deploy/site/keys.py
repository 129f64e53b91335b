"""Certificates of a site: a certificate authority, one short-lived certificate per agent, and the router's rules.

::

    DIR/site.json              the site's name and its certificates
    DIR/ca.pem, ca-key.pem     the authority; whoever has ca-key.pem can impersonate anyone: keep it on one machine
    DIR/<role>-<id>/           files of one agent, to be copied to its machine: certificate.pem, key.pem (0600),
                               ca.pem and bus.toml, the beginning of its configuration (paths from that folder)
    DIR/router-<id>/           additionally zenoh.json5, TLS and access rules for `syncline router` and zenohd,
                               and router.toml, a complete configuration
"""

from __future__ import annotations

import ipaddress
import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomli_w

from protocols.bus.security.access import access_rules, certificate_name, tls_settings
from protocols.bus.settings import BusConfig, TlsConfig
from protocols.core.errors import InputError
from protocols.core.files import write_atomically, write_private
from protocols.core.names import check_identifier

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

SITE_FILE = "site.json"
CA_FILE, CA_KEY_FILE = "ca.pem", "ca-key.pem"
CERTIFICATE_FILE, KEY_FILE, BUS_FILE = "certificate.pem", "key.pem", "bus.toml"
ZENOH_FILE, ROUTER_FILE = "zenoh.json5", "router.toml"
_CA_DAYS = 3650  # ten years: the authority outlives its boards
_BACKDATE = timedelta(minutes=5)
"""Certificates are valid from this long before their issue, for machines whose clock is behind."""


@dataclass(frozen=True, slots=True)
class Issued:
    """An issued certificate: the agent's folder, and the end of its validity (UTC)."""

    role: str
    agent: str
    folder: Path
    until: datetime


def make_site(folder: Path, site: str) -> None:
    """Create the authority of a new site. Raises InputError if the folder already has one."""
    check_identifier(site, "site")
    need_cryptography()
    if (folder / SITE_FILE).exists() or (folder / CA_KEY_FILE).exists():
        raise InputError(
            "there is an authority here already", file=folder, remedy="take another folder; a new one voids the old"
        )
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(0o700)
    key = ec.generate_private_key(ec.SECP256R1())
    name = subject_name(f"syncline {site}"[:64])
    now = datetime.now(UTC)
    usage = x509.KeyUsage(False, False, False, False, False, True, True, False, False)
    certificate = (
        _builder(name, name, key.public_key(), now - _BACKDATE, now + timedelta(days=_CA_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
    )
    write_key(folder / CA_KEY_FILE, key)
    write_atomically(folder / CA_FILE, _pem(certificate, key))
    _write_site(folder, site, {})


def issue(
    folder: Path,
    role: str,
    agent: str,
    *,
    days: float = 30.0,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    hosts: Sequence[str] = (),
) -> Issued:
    """Issue or renew one agent's certificate, and rewrite the routers' rules.

    connect: endpoints of the site's routers, stored with the agent. listen, hosts: for a router: its endpoints, and
    the host names and addresses in its certificate. Raises InputError.
    """
    return issue_all(folder, [Order(role, agent, tuple(connect), tuple(listen), tuple(hosts))], days)[0]


@dataclass(frozen=True, slots=True)
class Order:
    """A certificate to issue; fields as for ``issue``. request: PEM of a signing request with the agent's public key.

    Without a request a key is made here.
    """

    role: str
    agent: str
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    hosts: tuple[str, ...] = ()
    request: str = ""


def issue_all(folder: Path, orders: Sequence[Order], days: float = 30.0) -> list[Issued]:
    """Issue or renew certificates, and rewrite the routers' rules once. Raises InputError."""
    if not 0.0 < days <= 825.0:
        raise InputError(f"{days:g} days is no lifetime for a certificate", remedy="use 1 to 825 days")
    need_cryptography()
    site, agents = read_site(folder)
    issued = [_issue(folder, agents, order, days) for order in orders]
    _write_site(folder, site, agents)
    _write_configurations(folder, site, agents)
    return issued


def _issue(folder: Path, agents: dict[str, dict[str, Any]], order: Order, days: float) -> Issued:
    role, agent, connect, listen, hosts = order.role, order.agent, order.connect, order.listen, order.hosts
    name = certificate_name(role, agent)
    entry = dict(agents.get(name, {"role": role, "id": agent}))
    if role == "router":
        entry["listen"] = list(listen) or entry.get("listen") or ["tls/127.0.0.1:7447"]
        entry["hosts"] = sorted({*hosts, *entry.get("hosts", []), *_hosts_of(entry["listen"])})
    entry["connect"] = list(connect) or entry.get("connect", [])
    # Raises InputError for invalid endpoints before anything is written.
    tls = TlsConfig(ca=Path(CA_FILE), certificate=Path(CERTIFICATE_FILE), key=Path(KEY_FILE))
    mode: Any = "router" if role == "router" else "client"
    BusConfig(mode=mode, connect=tuple(entry["connect"]), listen=tuple(entry.get("listen", ())), tls=tls).endpoints()
    now = datetime.now(UTC)
    until = now + timedelta(days=days)
    entry.pop("revoked", None)
    common = certificate_name(role, agent, generation_of(entry))
    own = folder / f"{role}-{agent}"
    own.mkdir(exist_ok=True)
    own.chmod(0o700)
    sign(folder, own, common, now - _BACKDATE, until, entry.get("hosts", []), order.request)
    entry["until"] = until.isoformat(timespec="seconds")
    agents[name] = entry
    return Issued(role, agent, own, until)


def revoke(folder: Path, role: str, agent: str) -> list[Path]:
    """Revoke an agent's certificates: their name is removed from the rules, and the next certificate gets a new name.

    Returns the routers' rule files, which must be copied to the routers; until then the agent keeps its access.
    Idempotent: a repeated call rewrites the rules, in case the first was interrupted. Raises InputError for an unknown
    agent.
    """
    name = certificate_name(role, agent)
    site, agents = read_site(folder)
    entry = agents.get(name)
    if entry is None:
        raise InputError(
            f"{role} {agent!r} has no certificate",
            file=folder / SITE_FILE,
            remedy=f"those that have one: {', '.join(sorted(agents)) or 'none yet'}",
        )
    if not entry.get("revoked"):
        entry["generation"] = generation_of(entry) + 1
        entry["revoked"] = True
        _write_site(folder, site, agents)
    own = folder / f"{role}-{agent}"
    for file in (own / CERTIFICATE_FILE, own / KEY_FILE):
        file.unlink(missing_ok=True)
    _write_configurations(folder, site, agents)
    routers = [a for a in agents.values() if a["role"] == "router" and not a.get("revoked")]
    files = [folder / f"router-{a['id']}" / ZENOH_FILE for a in routers]
    return [file for file in files if file.is_file()]


def generation_of(entry: dict[str, Any]) -> int:
    """The generation of an agent's certificate, from 1; if ``revoked`` is set, none of this generation is issued yet.

    Raises ValueError for an invalid entry.
    """
    generation = entry.get("generation", 1)
    if not isinstance(generation, int) or not 1 <= generation < 10**6:
        raise ValueError(generation)
    return generation


def read_site(folder: Path) -> tuple[str, dict[str, dict[str, Any]]]:
    """(site, agents by certificate name). Raises InputError if ``folder`` contains no authority."""
    file = folder / SITE_FILE
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        agents = {certificate_name(a["role"], a["id"]): dict(a) for a in document["agents"]}
        for entry in agents.values():
            generation_of(entry)
        return check_identifier(document["site"], "site"), agents
    except OSError:
        raise InputError("holds no authority", file=folder, remedy="make one with `syncline keys init`") from None
    except (ValueError, KeyError, TypeError):
        raise InputError("is not what `syncline keys` writes", file=file, remedy="restore it from a copy") from None


def _write_site(folder: Path, site: str, agents: dict[str, dict[str, Any]]) -> None:
    document = {"site": site, "agents": [agents[name] for name in sorted(agents)]}
    write_atomically(folder / SITE_FILE, json.dumps(document, indent=1) + "\n")


def _write_configurations(folder: Path, site: str, agents: dict[str, dict[str, Any]]) -> None:
    """Write every agent's [bus] table and every router's rules, which must list all agents."""
    valid = [a for a in agents.values() if not a.get("revoked")]
    named = {(a["role"], a["id"]): generation_of(a) for a in valid}
    rules = access_rules(site, named, named)
    listening = [end for a in valid if a["role"] == "router" for end in _reachable_endpoints(a)]
    for entry in valid:
        own = folder / f"{entry['role']}-{entry['id']}"
        if not own.is_dir():
            continue  # moved to its machine and deleted here
        files = {"ca": CA_FILE, "certificate": CERTIFICATE_FILE, "key": KEY_FILE}
        if entry["role"] == "router":
            bus = {"mode": "router", "listen": entry["listen"], "connect": entry["connect"], "access": ZENOH_FILE}
            table = {"id": entry["id"], "site": site, "bus": {**bus, "tls": files}}
            _write_changed(own / ROUTER_FILE, tomli_w.dumps(table))
            _write_changed(own / ZENOH_FILE, _zenoh_file(entry, rules))
        else:
            table = {"id": entry["id"], "site": site}
            connect = entry["connect"] or listening
            bus = {"mode": "client", "connect": connect}
            _write_changed(own / BUS_FILE, tomli_w.dumps({**table, "bus": {**bus, "tls": files}}))


def _write_changed(file: Path, text: str) -> None:
    """Write a file that differs: of fifty boards one certificate changes the files of a few."""
    if not (file.is_file() and file.read_text(encoding="utf-8") == text):
        write_atomically(file, text)


def _zenoh_file(entry: dict[str, Any], rules: dict[str, Any]) -> str:
    """A complete configuration for zenohd, to be started in this folder.

    `syncline router` uses only its access rules and sets the rest itself.
    """
    tls = TlsConfig(ca=Path(CA_FILE), certificate=Path(CERTIFICATE_FILE), key=Path(KEY_FILE))
    document = {
        "mode": "router",
        "listen": {"endpoints": entry["listen"]},
        "connect": {"endpoints": entry["connect"]},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {
            "unicast": {"accept_pending": 2000, "accept_timeout": 2000},
            "link": {"tls": tls_settings(tls), "rx": {"max_message_size": 4 * 1024 * 1024}, "tx": {"lease": 1900}},
            "shared_memory": {"enabled": False},
        },
        "access_control": rules,
    }
    return json.dumps(document, indent=1) + "\n"


def _reachable_endpoints(router: dict[str, Any]) -> list[str]:
    """Endpoints by which agents reach a router that may listen on every interface."""
    out = []
    for endpoint in router["listen"]:
        protocol, _, place = endpoint.partition("/")
        host, _, port = place.rpartition(":")
        named = [one for one in router["hosts"] if one not in ("localhost", "127.0.0.1", "::1")]
        if host in ("0.0.0.0", "[::]"):
            host = named[0] if named else "127.0.0.1"
        out.append(f"{protocol}/{host}:{port}")
    return out


def _hosts_of(endpoints: Sequence[str]) -> set[str]:
    hosts = {endpoint.partition("/")[2].rpartition(":")[0].strip("[]") for endpoint in endpoints}
    return (hosts - {"0.0.0.0", "::"}) | {"localhost", "127.0.0.1"}


def sign(
    folder: Path, own: Path, name: str, begin: datetime, end: datetime, hosts: Sequence[str], request: str = ""
) -> None:
    """Create a key and a certificate for ``name``, signed by the authority in ``folder``, in the folder ``own``.

    hosts: host names and addresses of a server certificate; empty for a client. request: a signing request, of which
    the public key is taken and nothing else: its key stays where it was made. Raises InputError.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID

    try:
        authority = x509.load_pem_x509_certificate((folder / CA_FILE).read_bytes())
        signer = serialization.load_pem_private_key((folder / CA_KEY_FILE).read_bytes(), None)
    except (OSError, ValueError) as error:
        raise InputError(f"the authority cannot be read: {error}", file=folder, remedy="restore its files") from None
    if not isinstance(signer, ec.EllipticCurvePrivateKey):
        raise InputError("the authority's key is of another kind", file=folder / CA_KEY_FILE, remedy="restore it")
    key = None if request else ec.generate_private_key(ec.SECP256R1())
    public = _public_key(request) if key is None else key.public_key()
    names: list[x509.GeneralName] = [_general_name(host) for host in hosts]
    usage = [ExtendedKeyUsageOID.CLIENT_AUTH] + ([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])
    builder = (
        _builder(subject_name(name), authority.subject, public, begin, end)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usage), critical=False)
    )
    # rustls requires a subject alternative name in every certificate.
    builder = builder.add_extension(x509.SubjectAlternativeName(names or [x509.DNSName(name)]), critical=False)
    if key is None:
        (own / KEY_FILE).unlink(missing_ok=True)  # of an earlier certificate that was made here
    else:
        write_key(own / KEY_FILE, key)
    write_atomically(own / CERTIFICATE_FILE, _pem(builder, signer))
    write_atomically(own / CA_FILE, (folder / CA_FILE).read_text(encoding="ascii"))


def _public_key(request: str) -> ec.EllipticCurvePublicKey:
    """The public key of a signing request. Raises InputError."""
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

    try:
        found = x509.load_pem_x509_csr(request.encode("ascii"))
        public = found.public_key()
        if not found.is_signature_valid or not isinstance(public, ec.EllipticCurvePublicKey):
            raise ValueError("it is not signed by its own key, or of another kind")
    except ValueError as error:
        raise InputError(f"no signing request: {error}", remedy="make it with `syncline site request`") from None
    return public


def _general_name(host: str) -> x509.GeneralName:
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        try:
            return x509.DNSName(host)
        except ValueError:
            raise InputError(f"{host!r} is no host", remedy="give a name or an address") from None


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, begin: datetime, end: datetime
) -> x509.CertificateBuilder:
    from cryptography import x509

    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin)
        .not_valid_after(end)
    )


def subject_name(text: str) -> x509.Name:
    """The subject of a certificate: a common name."""
    from cryptography import x509
    from cryptography.x509.oid import NameOID

    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _pem(builder: x509.CertificateBuilder, signer: ec.EllipticCurvePrivateKey) -> str:
    from cryptography.hazmat.primitives import hashes, serialization

    return builder.sign(signer, hashes.SHA256()).public_bytes(serialization.Encoding.PEM).decode("ascii")


def write_key(file: Path, key: ec.EllipticCurvePrivateKey) -> None:
    """Write a private key, which is at no time readable by others."""
    from cryptography.hazmat.primitives import serialization

    text = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    write_private(file, text)


def need_cryptography() -> None:
    try:
        import cryptography  # noqa: F401
    except ImportError:
        raise InputError(
            "this needs the package cryptography", remedy='pip install "syncline[keys]"; bundles have it'
        ) from None
