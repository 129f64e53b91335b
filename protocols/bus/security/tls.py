"""Diagnosis of TLS problems: checks of certificate files, and the reason why a router refuses a connection.

Zenoh reports only that it could not connect. The standard library's TLS makes the same handshake with the same
files and gives the reason.
"""

from __future__ import annotations

import re
import socket
import ssl
import stat
import time
from pathlib import Path
from typing import Any

from protocols.bus.security.access import certificate_owner
from protocols.bus.settings import TlsConfig, split_endpoint
from protocols.core.clocks import utc_text
from protocols.core.errors import InputError
from protocols.core.names import key_segment

_TIMEOUT_S = 0.6  # of a handshake in a local network
_PLAIN = "it speaks plain TCP, and this connection wants TLS: write tcp/, or give the router certificates"


def check_files(tls: TlsConfig) -> None:
    """Raise InputError where a file is missing, is no PEM, has expired, or where others may read the key."""
    for what, file in (("ca", tls.ca), ("certificate", tls.certificate), ("key", tls.key)):
        try:
            text = file.read_text(encoding="ascii")
        except OSError as error:
            raise InputError(
                f"bus.tls: {what} cannot be read: {error.strerror}", file=file, remedy="see `syncline keys issue`"
            ) from None
        except UnicodeDecodeError:
            text = ""
        if "-----BEGIN" not in text:
            raise InputError(f"bus.tls: {what} is not a PEM file", file=file, remedy="see `syncline keys issue`")
    if tls.key.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise InputError("bus.tls: others may read this key", file=tls.key, remedy=f"chmod 600 {tls.key}")
    try:
        ssl.create_default_context(cafile=tls.ca).load_cert_chain(tls.certificate, tls.key)
    except (ssl.SSLError, ValueError) as error:
        raise InputError(
            f"bus.tls: certificate and key do not match: {_message_of(error)}",
            file=tls.certificate,
            remedy="issue them again with `syncline keys issue`",
        ) from None
    problem = validity_problem(period := validity(tls.certificate), time.time())
    if problem:
        behind = time.time() < period[0]
        raise InputError(
            f"bus.tls: {problem}",
            file=tls.certificate,
            remedy="set this machine's clock (`syncline doctor` says where it takes the time from)"
            if behind
            else "renew it: `syncline site renew`, or `syncline keys issue`",
        )


def _decoded(certificate: Path) -> dict[str, Any]:
    # The only reader of certificate fields in the standard library; a board need not have `cryptography`.
    decode = getattr(ssl, "_ssl")._test_decode_cert  # noqa: B009 - not in the stubs
    return dict(decode(str(certificate)))


def validity(certificate: Path) -> tuple[float, float]:
    """(begin, end) of a PEM certificate's validity, Unix [s]. Raises InputError where it cannot be read."""
    try:
        fields = _decoded(certificate)
    except (OSError, ssl.SSLError) as error:
        raise InputError(
            f"bus.tls: the certificate cannot be read: {_message_of(error)}",
            file=certificate,
            remedy="see `syncline keys issue`",
        ) from None
    begin, end = (float(ssl.cert_time_to_seconds(fields[name])) for name in ("notBefore", "notAfter"))
    return begin, end


def validity_problem(period: tuple[float, float], now: float) -> str:
    """Why a certificate with this validity is not valid at ``now`` [Unix, s]; "" if it is.

    A certificate that is not valid yet is a clock that is behind, as that of a board without a battery after a start.
    """
    begin, end = period
    if now < begin:
        return (
            f"the certificate is not valid yet: it begins at {utc_text(begin)}, "
            f"and this machine's clock says {utc_text(now)}: the clock is behind"
        )
    if now > end:
        return f"the certificate expired {(now - end) / 86_400.0:.1f} days ago, at {utc_text(end)}"
    return ""


def days_left(certificate: Path) -> float:
    """Days until a PEM certificate expires; negative if it has."""
    return (validity(certificate)[1] - time.time()) / 86_400.0


def common_name(certificate: Path) -> str:
    """The certificate's common name, ``<role>.<id>`` or ``<role>.<id>.<generation>`` where `syncline keys` made it."""
    for pairs in _decoded(certificate).get("subject", ()):
        for name, value in pairs:
            if name == "commonName":
                return str(value)
    return ""


def check_owner(tls: TlsConfig, role: str, agent: str) -> None:
    """Raise InputError where the certificate is another agent's: the router would silently drop all its messages."""
    name = common_name(tls.certificate)
    if certificate_owner(name) != f"{role}.{key_segment(agent)}":
        raise InputError(
            f"bus.tls: the certificate is {name!r}'s, this is {role} {agent!r}",
            file=tls.certificate,
            remedy=f"issue one with `syncline keys issue DIR --role {role} --id {agent}`, or correct id",
        )


def refusal_reason(endpoint: str, tls: TlsConfig | None, timeout_s: float = _TIMEOUT_S) -> str:
    """Why a reachable router refuses this process; "" where the reason is unknown.

    endpoint: as in ``connect``. Takes up to ``timeout_s``.
    """
    protocol, host, port = split_endpoint(endpoint)
    deadline = time.monotonic() + timeout_s
    try:
        with socket.create_connection((host, port), timeout=timeout_s) as raw:
            if protocol == "tcp":
                return _plain(raw, deadline)
            assert tls is not None
            context = ssl.create_default_context(cafile=tls.ca)
            context.load_cert_chain(tls.certificate, tls.key)
            with context.wrap_socket(raw, server_hostname=host) as secure:
                # In TLS 1.3 the server accepts or rejects the client's certificate after the handshake.
                secure.settimeout(max(0.05, min(0.3, deadline - time.monotonic())))
                secure.recv(1)
    except ssl.SSLCertVerificationError as error:
        clock = f"; this machine's clock says {utc_text(time.time())}" if "valid" in error.verify_message else ""
        return f"the router's certificate is refused here: {error.verify_message}{clock}"
    except ssl.SSLError as error:
        return _alert(error)
    except (OSError, ValueError):
        return ""
    return ""


def _plain(raw: socket.socket, deadline: float) -> str:
    """The reason if the server that answers a plain connection expects TLS; otherwise ""."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    raw.settimeout(max(0.05, deadline - time.monotonic()))
    try:
        context.wrap_socket(raw).close()
    except ssl.SSLError as error:
        if "ALERT" not in str(error.reason):
            return ""
    except (OSError, ValueError):
        return ""
    return "it wants certificates, and this connection is plain TCP: write tls/ for tcp/ and add [bus.tls]"


def _alert(error: ssl.SSLError) -> str:
    reason = str(error.reason or "")
    reasons = {
        "CERTIFICATE_REQUIRED": "it wants a certificate",
        # rustls says so of one that is not valid yet, too.
        "CERTIFICATE_EXPIRED": "it says that this certificate has expired or is not valid yet; "
        f"this machine's clock says {utc_text(time.time())}",
        "UNKNOWN_CA": "it does not know who signed this certificate",
        "BAD_CERTIFICATE": "it does not accept this certificate",
        "CERTIFICATE_UNKNOWN": "it does not accept this certificate",
        "DECRYPT_ERROR": "it does not accept who signed this certificate",
        "HANDSHAKE_FAILURE": "it refuses the handshake",
        "WRONG_VERSION_NUMBER": _PLAIN,
        "RECORD_LAYER_FAILURE": _PLAIN,
    }
    return next((text for word, text in reasons.items() if word in reason), "" if not reason else _message_of(error))


def _message_of(error: Exception) -> str:
    text = str(getattr(error, "reason", None) or error)
    return re.sub(r"\s+", " ", text.replace("_", " ").lower())[:120]
