"""Who may say and hear what: the access rules of a router, by the name in each agent's certificate.

Denied is what is not allowed, and who is not named may do nothing. A rule names a key twice, plain and with
``@adv``: Zenoh's advanced publishers and subscribers keep their own traffic there, and ``**`` does not reach it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from protocols.bus.settings import TlsConfig
from protocols.core.errors import InputError
from protocols.topics import valid_id

ROLES = ("camera", "uav", "hub", "record", "view", "router")
"""What a certificate can be for."""

# What an agent of a role may publish, below syncline/<site>/; every agent also has agent/<id>/** and its tokens.
_SAYS: Mapping[str, tuple[str, ...]] = {
    "camera": ("camera/{id}/**",),
    "uav": ("uav/{id}/**", "camera/{id}/**"),
    # Pose nodes of any camera may run on any hub.
    "hub": ("hub/{id}/**", "node/**", "alive/nodes/{id}/*"),
    "record": (),
    "view": ("view/{id}/**",),
    "router": ("canary/**",),
}
_HEARS_ALL = frozenset({"hub", "record", "view", "uav"})

_SPEAK = ["put", "delete", "reply", "declare_queryable", "liveliness_token", "query", "declare_subscriber"]
_BE_ASKED = ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"]
_ASK = ["query", "declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"]
_BE_TOLD = ["put", "delete", "reply", "liveliness_token", "declare_queryable"]


def _keys(*patterns: str) -> list[str]:
    """Each pattern, and the advanced traffic below it."""
    return [key for pattern in patterns for key in (pattern, f"{pattern.removesuffix('/**')}/**/@adv/**")]


def certificate_name(role: str, agent: str, generation: int = 1) -> str:
    """The common name of an agent's certificate; raises InputError where it cannot be one.

    generation: one more than how often certificates of this agent were revoked. Zenoh 1.10.2 reads no list of revoked
    certificates, but its rules go by this name: so whoever was revoked gets a new one, and the rules forget the old.
    """
    if role not in ROLES:
        raise InputError(f"there is no role {role!r}", remedy=f"use one of {', '.join(ROLES)}")
    name = f"{role}.{valid_id(agent)}" + (f".{generation}" if generation > 1 else "")
    if len(name) > 64:
        raise InputError(f"id {agent!r} is too long for a certificate", remedy="use at most 55 characters")
    return name


def owner_of(name: str) -> str:
    """``<role>.<id>`` of a certificate's common name, whatever its generation."""
    return ".".join(name.split(".")[:2])


def access_rules(
    site: str, agents: Iterable[tuple[str, str]], generations: Mapping[tuple[str, str], int] | None = None
) -> dict[str, Any]:
    """Zenoh's ``access_control`` for a site's agents, each (role, id). generations: where it is not the first."""
    generations = generations or {}
    base = f"syncline/{valid_id(site, 'site')}"
    everything = _keys(f"{base}/**")
    rules: list[dict[str, Any]] = [
        {"id": "be-asked", "permission": "allow", "flows": ["egress"], "messages": _BE_ASKED, "key_exprs": everything},
        {"id": "ask-all", "permission": "allow", "flows": ["ingress"], "messages": _ASK, "key_exprs": everything},
        {
            "id": "be-told-all",
            "permission": "allow",
            "flows": ["egress"],
            "messages": _BE_TOLD,
            "key_exprs": everything,
        },
    ]
    subjects, policies = [], []
    for role, agent in sorted(set(agents)):
        name = certificate_name(role, agent, generations.get((role, agent), 1))
        own = [f"{base}/{key.format(id=agent)}" for key in _SAYS[role]]
        own += [f"{base}/agent/{agent}/**", f"{base}/alive/{role}/{agent}/*"]
        rules.append(
            {
                "id": f"own-{name}",
                "permission": "allow",
                "flows": ["ingress"],
                "messages": _SPEAK,
                "key_exprs": _keys(*own),
            }
        )
        allowed = [f"own-{name}", "be-asked"]
        if role == "router":
            # The canary hears itself; other routers pass on what their own rules have let in.
            allowed += ["ask-all", "be-told-all", "relay"]
        elif role in _HEARS_ALL:
            allowed += ["ask-all", "be-told-all"]
        subjects.append({"id": name, "cert_common_names": [name]})
        policies.append({"subjects": [name], "rules": allowed})
    if any("relay" in policy["rules"] for policy in policies):
        rules.append(
            {"id": "relay", "permission": "allow", "flows": ["ingress"], "messages": _SPEAK, "key_exprs": everything}
        )
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def tls_settings(tls: TlsConfig) -> dict[str, Any]:
    """Zenoh's ``transport/link/tls``: both sides show certificates, and a link ends with them."""
    return {
        "root_ca_certificate": str(tls.ca),
        "listen_private_key": str(tls.key),
        "listen_certificate": str(tls.certificate),
        "connect_private_key": str(tls.key),
        "connect_certificate": str(tls.certificate),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }


def read_access(file: Path) -> dict[str, Any]:
    """The ``access_control`` in a generated router file. Raises InputError where it would let everybody in."""
    remedy = "make it again with `syncline keys issue`"
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"access rules cannot be read: {error.strerror}", file=file, remedy=remedy) from None
    except (ValueError, RecursionError) as error:
        line = getattr(error, "lineno", None)
        raise InputError("access rules are not JSON", file=file, line=line, remedy=remedy) from None
    rules = document.get("access_control") if isinstance(document, dict) else None
    if not isinstance(rules, dict):
        raise InputError("has no access_control", file=file, remedy=remedy)
    if rules.get("enabled") is not True or rules.get("default_permission") != "deny":
        raise InputError("access_control does not deny by default", file=file, remedy=remedy)
    return rules
