"""The view server, who has access to it, and its loops between the bus, or a recording, and the browser."""

from __future__ import annotations

import contextlib
import errno
import hmac
import http
import io
import ipaddress
import secrets
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser

from hub.view.page import ACTIONS, ViewPage
from hub.view.player import Player, Recording
from hub.view.scene_renderer import DisplayOptions, SceneRenderer
from hub.view.state import ON_IMAGES, TOPICS, ViewState
from protocols.bus.base import Bus, Subscription
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.messages import syncline_pb2 as pb
from protocols.topics import COMMAND, PICTURE
from protocols.validation.rules import SCHEMA_VERSION

_COOKIE = "syncline-view"
_LOCAL_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
ROLE = "view"
_TICK_S = 0.04  # a cycle while a browser is open: what moves is drawn 25 times a second [s]
_IDLE_TICK_S = 0.1  # without a browser: queues must not run over
_MIN_REST_S = 0.01  # between two cycles of a loop that is late
_DRAW_S = 0.2  # between two drawings of what does not move
_PANEL_S = 0.5  # between two updates of the panels' text
_CONNECTION_S = 1.0  # between two looks whether the router is there
_UNWATCHED_S = 1.0  # redraw interval without an open browser
_ROLE_OF_ACTION = {
    "start_recording": "record",
    "stop_recording": "record",
    "recalibrate": "hub",
    "forget": "hub",
    "export": "hub",
}


class ViewServer:
    """The web server of the view: port, access control, scene and panels.

    host: beyond loopback a token is required; token: "" = a random one there, none on loopback. port: 0 = any free one.
    look_only: buttons are disabled. Raises InputError if the port is not available.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 8080,
        *,
        token: str = "",
        look_only: bool = False,
        player: Player | None = None,
        actions: tuple[str, ...] = tuple(ACTIONS),
    ) -> None:
        _check_port(host, port)
        self._closed = False
        self.access = AccessControl(token or ("" if is_local(host) else secrets.token_urlsafe(18)))
        # Viser prints a banner whose address lacks the token.
        with self.access.guard_new_servers(), contextlib.redirect_stdout(io.StringIO()):
            self.server = viser.ViserServer(host, port, label="Syncline", verbose=False)
        self.host, self.port = host, self.server.get_port()
        self.options = DisplayOptions()
        self.scene = SceneRenderer(self.server, self.options)
        self.page = ViewPage(self.server, self.options, allowed=not look_only, player=player, actions=actions)

    @property
    def address(self) -> str:
        """The address to open in a browser."""
        host = socket.gethostname() if self.host in ("0.0.0.0", "::") else self.host
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/" + (f"?token={self.access.token}" if self.access.token else "")

    @property
    def watched(self) -> bool:
        """Whether any browser is open."""
        return bool(self.server.get_clients())

    def close(self) -> None:
        """Stop serving; may be called twice."""
        if not self._closed:
            self._closed = True
            with contextlib.redirect_stdout(io.StringIO()):
                self.server.stop()


def run_view(
    bus: Bus,
    view: ViewServer,
    stop: threading.Event,
    *,
    each: Callable[[ViewState], None] = lambda state: None,
) -> None:
    """Show the bus until ``stop`` is set; send clicked actions as commands. each: called in every cycle, about 10 times
    a second, and up to 30 while a browser is open."""
    state = ViewState()
    name, boot = f"view-{secrets.token_hex(3)}", uuid.uuid4().hex  # several views may be open on one site
    subscriptions = [bus.subscribe(topic) for topic in (*TOPICS, *ON_IMAGES)]
    commands = bus.publisher(COMMAND, name)
    watch = bus.watch_agents()
    pictures: Subscription | None = None
    sequence = 0
    redraw, cycle = _RedrawTimer(), _Cycle()
    next_look = 0.0
    try:
        with bus.announce(ROLE, name, boot):
            while not stop.wait(cycle.rest(view.watched)):
                now, wall = time.monotonic(), time.time_ns()
                if now >= next_look:
                    next_look = now + _CONNECTION_S
                    state.lost_at = None if bus.connected() else state.lost_at or now
                for event in watch.drain():
                    state.presence(event.role, event.agent, event.alive, event.boot_id)
                # Images are subscribed to only while a browser is open.
                if (view.watched and view.options.pictures) != (pictures is not None):
                    if pictures is None:
                        pictures = bus.subscribe(PICTURE)
                    else:
                        pictures.close()
                        pictures = None
                for subscription in (*subscriptions, *([pictures] if pictures else [])):
                    for received in subscription.drain():
                        state.handle(received.message, now - max(0, wall - received.arrival_ns) / NANOSECONDS)
                while view.page.requested_actions:
                    action = view.page.requested_actions.popleft()
                    for command in commands_for(state, action, name, boot, sequence):
                        commands.put(command)
                        sequence += 1
                    view.page.show_result(action_result(state, action))
                redraw.draw(view, state, now)
                each(state)
    finally:
        commands.close()
        watch.close()
        for subscription in (*subscriptions, *([pictures] if pictures else [])):
            subscription.close()


def run_replay(recording: Recording, serve: Callable[[Player], ViewServer], stop: threading.Event) -> None:
    """Play a recording in the browser until ``stop`` is set; playback pauses while no browser is open."""
    player = Player(recording)
    view = serve(player)
    redraw, cycle = _RedrawTimer(), _Cycle()
    before = time.monotonic()
    try:
        while not stop.wait(cycle.rest(view.watched)):
            now = time.monotonic()
            if player.advance(now - before if view.watched else 0.0):
                view.scene.clear()
            before = now
            redraw.draw(view, player.state, now, at=player.position)
    finally:
        view.close()


def commands_for(state: ViewState, action: str, sender: str, boot: str, sequence: int) -> list[pb.Command]:
    """The commands of one click: one for each agent of the action's role, addressed to its present boot id."""
    return [
        pb.Command(
            schema_version=SCHEMA_VERSION,
            sender=sender,
            boot_id=boot,
            sequence=sequence + number,
            action=action,
            agent=agent.status.agent,
            agent_boot=agent.status.boot_id,
        )
        for number, agent in enumerate(state.of_role(_ROLE_OF_ACTION[action]))
    ]


def action_result(state: ViewState, action: str) -> str:
    """The text shown after a click."""
    names = [agent.status.agent for agent in state.of_role(_ROLE_OF_ACTION[action])]
    action_text = ACTIONS[action].lower()
    agent_name = {"record": "recorder", "hub": "hub"}[_ROLE_OF_ACTION[action]]
    return (
        f"requested from {', '.join(names)}: {action_text}"
        if names
        else f"no {agent_name} on this site: {action_text} was not sent"
    )


class _Cycle:
    """The time of a loop's cycles, which are shorter while a browser is open."""

    def __init__(self) -> None:
        self._next = time.monotonic()

    def rest(self, watched: bool) -> float:
        """How long to wait for the next cycle [s]."""
        now = time.monotonic()
        self._next = max(self._next + (_TICK_S if watched else _IDLE_TICK_S), now + _MIN_REST_S)
        return self._next - now


class _RedrawTimer:
    """Limits the redraw rate, with longer intervals while no browser is open."""

    def __init__(self) -> None:
        self._draw = self._panel = 0.0

    def draw(self, view: ViewServer, state: ViewState, now: float, at: float | None = None) -> None:
        """now: monotonic time [s]; at: the state's own time [s], if different."""
        watched = view.watched
        moment = now if at is None else at
        if now >= self._draw:
            self._draw = now + (_DRAW_S if watched else _UNWATCHED_S)
            view.scene.update(state, moment)
            view.page.update_uavs(state, moment)
        elif watched:
            view.scene.update_tracks(state, moment)
        if now >= self._panel:
            self._panel = now + (_PANEL_S if watched else _UNWATCHED_S)
            view.page.update(state, moment)


def _check_port(host: str, port: int) -> None:
    """Raise InputError if the port is taken: viser would silently use another one."""
    if not 0 <= port <= 65_535:
        raise InputError(f"--port {port} is out of range", remedy="give 1 to 65535, or 0 for any free one")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        taken = error.errno == errno.EADDRINUSE
        what = f"port {port} is taken" if taken else f"cannot listen on {host}:{port}: {error.strerror or error}"
        remedy = "give --port another number, or 0" if taken else "give --listen an address of this machine"
        raise InputError(what, remedy=remedy) from None


class AccessControl:
    """Accepts or refuses requests. token: "" = none is required, which is for loopback only.

    Viser itself serves every client that reaches its port. On loopback every program of this machine has access, but
    no page of another site in the same browser: the request's Host must be this machine, and a WebSocket's Origin must
    equal it. Beyond loopback a token is required once in the address (``?token=…``) and kept as a cookie.
    """

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
