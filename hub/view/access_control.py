"""Access control of the view's HTTP and WebSocket server: Host and Origin checks, and a token beyond loopback.

Viser itself serves every client that reaches its port. On loopback every program of this machine has access, but
no page of another site in the same browser: the request's Host must be this machine, and a WebSocket's Origin must
equal it. Beyond loopback a token is required once in the address (``?token=…``) and kept as a cookie.
"""

from __future__ import annotations

import hmac
import http
import ipaddress
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

_COOKIE = "syncline-view"
_LOCAL_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})


class AccessControl:
    """Accepts or refuses requests. token: "" = none is required, which is for loopback only."""

    def __init__(self, token: str = "") -> None:
        self.token = token
        self.refused = 0

    def allows(self, path: str, headers: Any) -> bool:
        """Whether a request is accepted. path: with its query; headers: a mapping with ``get``."""
        host, origin = headers.get("Host") or "", headers.get("Origin")
        try:
            site = None if origin is None else urlsplit(origin).netloc.lower()
            name, query = urlsplit(f"//{host}").hostname or "", urlsplit(path).query
        except ValueError:
            return False  # malformed
        if site is not None and site != host.lower():
            return False  # a page of another site
        if not self.token:
            # DNS rebinding: a foreign name that resolves to this machine has another Host.
            return is_local(name)
        given = parse_qs(query).get("token", [""])[0] or _cookie(headers.get("Cookie") or "")
        return hmac.compare_digest(given.encode(), self.token.encode())

    def wrap(self, inner: Callable[[Any, Any], Any] | None) -> Callable[[Any, Any], Any]:
        """A ``process_request`` of websockets' server that checks access before ``inner``."""

        def process(connection: Any, request: Any) -> Any:
            if not self.allows(request.path, request.headers):
                self.refused += 1
                text = "This view requires its token: open the address that `syncline view` printed.\n"
                return connection.respond(http.HTTPStatus.FORBIDDEN, text)
            response = None if inner is None else inner(connection, request)
            if response is not None:
                # The page is private: no framing, no leaking of the token in the Referer.
                response.headers["Referrer-Policy"] = "no-referrer"
                response.headers["X-Frame-Options"] = "DENY"
                if self.token:
                    cookie = f"{_COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
                    response.headers["Set-Cookie"] = cookie
            return response

        return process

    @contextmanager
    def guard_new_servers(self) -> Iterator[None]:
        """While open, servers that websockets starts use this access control: viser has no other hook."""
        import websockets.asyncio.server as server

        original = server.serve

        def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
            return original(*arguments, process_request=self.wrap(process_request), **options)

        server.serve = serve  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            server.serve = original  # type: ignore[misc]


def is_local(host: str) -> bool:
    """Whether a host name or address is loopback."""
    if host.lower() in _LOCAL_NAMES:
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _cookie(text: str) -> str:
    try:
        found = SimpleCookie(text).get(_COOKIE)
    except CookieError:
        return ""
    return "" if found is None else found.value
