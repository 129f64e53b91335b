"""Access rules of a router (publish and subscribe rights), by the common name of each agent's certificate.

Default deny: what is not allowed is denied, and so is every agent that is not named. A rule has each key twice, plain
and with ``@adv``: Zenoh's advanced publishers and subscribers use such keys internally, and ``**`` does not match them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from protocols.bus.settings import TlsConfig
from protocols.core.errors import InputError
from protocols.core.files import MAX_TOML, read_text
from protocols.core.names import check_identifier, key_segment

ROLES = ("camera", "uav", "hub", "record", "view", "router")
"""The roles for which certificates are issued."""

# Keys on which an agent of a role may publish, below syncline/<site>/; every agent also has
# agent/<id>/** and its liveliness tokens.
_PUBLISH_KEYS: Mapping[str, tuple[str, ...]] = {
    "camera": ("camera/{id}/**",),
    "uav": ("uav/{id}/**", "camera/{id}/**"),
    # Pose nodes of any camera may run on any hub.
    "hub": ("hub/{id}/**", "node/**", "alive/nodes/{id}/*", "alive/shard/{id}/*"),
    "record": (),
    "view": ("view/{id}/**",),
    "router": ("canary/**",),
}
_SUBSCRIBE_ALL = frozenset({"hub", "record", "view", "uav"})

_PUBLISH_IN = ["put", "delete", "reply", "declare_queryable", "liveliness_token", "query", "declare_subscriber"]
_PUBLISH_OUT = ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"]
_RECEIVE_IN = ["query", "declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"]
_RECEIVE_OUT = ["put", "delete", "reply", "liveliness_token", "declare_queryable"]


def _keys(*patterns: str) -> list[str]:
    """Each pattern, and the advanced traffic below it."""
    return [key for pattern in patterns for key in (pattern, f"{pattern.removesuffix('/**')}/**/@adv/**")]


def _rule(name: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}


def certificate_name(role: str, agent: str, generation: int = 1) -> str:
    """The common name of an agent's certificate, ``<role>.<key segment of the id>[.<generation>]``; raises InputError.

    generation: 1 + the number of revocations of this agent's certificates. Zenoh 1.10.2 reads no revocation list, but
    its rules use this name: a revoked agent gets a new name, and the rules no longer contain the old one.
    """
    if role not in ROLES:
        raise InputError(f"there is no role {role!r}", remedy=f"use one of {', '.join(ROLES)}")
    name = f"{role}.{key_segment(agent)}" + (f".{generation}" if generation > 1 else "")
    if len(name) > 64:
        raise InputError(
            f"id {agent!r} is too long for a certificate",
            remedy="use at most 55 letters a-z, digits, '-' and '_'; every byte of another character counts as three",
        )
    return name


def certificate_owner(name: str) -> str:
    """``<role>.<key segment>`` of a certificate's common name, without the generation."""
    return ".".join(name.split(".")[:2])


def access_rules(
    site: str, agents: Iterable[tuple[str, str]], generations: Mapping[tuple[str, str], int] | None = None
) -> dict[str, Any]:
    """Zenoh's ``access_control`` for a site's agents, each (role, id). generations: where it is not the first."""
    generations = generations or {}
    base = f"syncline/{check_identifier(site, 'site')}"
    all_keys = _keys(f"{base}/**")
    rules = [
        _rule("be-asked", "egress", _PUBLISH_OUT, all_keys),
        _rule("ask-all", "ingress", _RECEIVE_IN, all_keys),
        _rule("receive-all", "egress", _RECEIVE_OUT, all_keys),
    ]
    subjects, policies = [], []
    for role, agent in sorted(set(agents)):
        name = certificate_name(role, agent, generations.get((role, agent), 1))
        segment = key_segment(agent)
        own = [f"{base}/{key.format(id=segment)}" for key in _PUBLISH_KEYS[role]]
        own += [f"{base}/agent/{segment}/**", f"{base}/alive/{role}/{segment}/*"]
        rules.append(_rule(f"own-{name}", "ingress", _PUBLISH_IN, _keys(*own)))
        allowed = [f"own-{name}", "be-asked"]
        if role == "router":
            # The canary receives its own messages; other routers relay what their own rules admitted.
            allowed += ["ask-all", "receive-all", "relay"]
        elif role in _SUBSCRIBE_ALL:
            allowed += ["ask-all", "receive-all"]
        subjects.append({"id": name, "cert_common_names": [name]})
        policies.append({"subjects": [name], "rules": allowed})
    if any("relay" in policy["rules"] for policy in policies):
        rules.append(_rule("relay", "ingress", _PUBLISH_IN, all_keys))
    allowed_only = {"enabled": True, "default_permission": "deny"}
    return {**allowed_only, "rules": rules, "subjects": subjects, "policies": policies}


def tls_settings(tls: TlsConfig) -> dict[str, Any]:
    """Zenoh's ``transport/link/tls``: mutual authentication; a link is closed when its certificate expires."""
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
    """The ``access_control`` in a generated router file. Raises InputError if they do not deny by default."""
    remedy = "make it again with `syncline keys issue`"
    try:
        document = json.loads(read_text(file, "file of access rules", MAX_TOML))
    except (ValueError, RecursionError) as error:
        line = getattr(error, "lineno", None)
        raise InputError("access rules are not JSON", file=file, line=line, remedy=remedy) from None
    rules = document.get("access_control") if isinstance(document, dict) else None
    if not isinstance(rules, dict):
        raise InputError("has no access_control", file=file, remedy=remedy)
    if rules.get("enabled") is not True or rules.get("default_permission") != "deny":
        raise InputError("access_control does not deny by default", file=file, remedy=remedy)
    return rules
