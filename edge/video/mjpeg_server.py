"""Motion JPEG over HTTP, as browsers, GStreamer, VLC and FFmpeg play it.

Only the newest image is served, and it is compressed only while there are viewers. Requests must name this machine by
an address, as ``localhost`` or by its host name: a page of a foreign name that resolves to this machine (DNS rebinding)
would otherwise read the video in a browser here. Of more than ``_MAX_CONNECTIONS`` connections the oldest that does not
stream is closed.
"""

from __future__ import annotations

import ipaddress
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Self
from urllib.parse import urlsplit

from protocols.core.errors import InputError

PATH = "/stream.mjpg"
_BOUNDARY = "frame"
_MAX_VIEWERS = 4  # of the operator's video
_MAX_CONNECTIONS = 16  # with those that are turned away
_SEND_TIMEOUT_S = 5.0  # for a request's bytes, and for an image to a slow reader
_PAGE = (
    b"<!doctype html><title>Syncline</title><style>body{margin:0;background:#111}img{width:100%}</style>"
    b"<img src=stream.mjpg>"
)


class _LimitedServer(ThreadingHTTPServer):
    """Closes the oldest connection that does not stream where there are too many."""

    request_queue_size = 64  # with five, a burst of connections makes the next one wait for seconds

    def __init__(self, *arguments: Any) -> None:
        self._open: dict[Any, bool] = {}
        self._lock = threading.Lock()
        super().__init__(*arguments)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Take a connection."""
        with self._lock:
            idle = [one for one, streams in self._open.items() if not streams]
            if len(self._open) >= _MAX_CONNECTIONS and idle:
                del self._open[idle[0]]
                with suppress(OSError):
                    idle[0].shutdown(socket.SHUT_RDWR)  # its thread ends and closes it
            self._open[request] = False
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def keep(self, request: Any) -> None:
        """Note that a connection streams."""
        with self._lock:
            self._open[request] = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Whatever a client sends ends its own connection."""


def names_this_machine(host: str) -> bool:
    """Whether a Host header is an address, ``localhost``, this machine's host name, or empty (HTTP/1.0)."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        ipaddress.ip_address(name)
    except ValueError:
        own = socket.gethostname().lower()
        name = "?" if "[" in host else name.rstrip(".")
        return name in ("", "localhost", own, f"{own.partition('.')[0]}.local")
    return True


class MjpegServer:
    """Serves ``PATH``, an HTML page with it at /, and /snapshot.jpg.

    host, port: listening address; port 0: any free one. compress: gives the newest image as JPEG, called in a viewer's
    thread; None while there is none.
    """

    def __init__(self, host: str, port: int, compress: Callable[[], bytes | None]) -> None:
        self._new_frame = threading.Condition()
        self._number = 0
        self._closed = False
        self.viewers = 0
        self._compress = compress
        self._jpeg: tuple[int, bytes | None] = (-1, None)
        try:
            self._server = _LimitedServer((host, port), self._handler())
        except OSError as error:
            raise InputError(
                f"the video cannot be served at {host}:{port}: {error.strerror}",
                remedy="choose another [video_out] listen",
            ) from None
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, name="video", daemon=True)

    @property
    def port(self) -> int:
        """The listening port."""
        return int(self._server.server_address[1])

    def notify_frame(self) -> None:
        """Notify the viewers of a new image."""
        with self._new_frame:
            self._number += 1
            self._new_frame.notify_all()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._new_frame:
            self._closed = True
            self._new_frame.notify_all()
        self._server.shutdown()
        self._server.server_close()

    def _next_jpeg(self, seen: int) -> tuple[int, bytes | None]:
        """The first image after number ``seen``; waits for it for up to a second."""
        with self._new_frame:
            self._new_frame.wait_for(lambda: self._number != seen or self._closed, 1.0)
            number = self._number
            if self._closed or number == seen:
                return seen, None
            if self._jpeg[0] != number:
                self._jpeg = (number, self._compress())
            return self._jpeg

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        server = self

        class Handler(BaseHTTPRequestHandler):
            timeout = _SEND_TIMEOUT_S

            def do_GET(self) -> None:
                try:
                    self._serve()
                except OSError:
                    self.close_connection = True  # the viewer has disconnected

            def _serve(self) -> None:
                path = self.path.partition("?")[0]
                if not names_this_machine(self.headers.get("Host", "")):
                    self.send_error(403, "this host is not served")
                elif path == "/":
                    self._send_body("text/html", _PAGE)
                elif path == "/snapshot.jpg":
                    _, data = server._next_jpeg(-1)
                    self._send_body("image/jpeg", data) if data else self.send_error(503, "no image yet")
                elif path == PATH:
                    self._stream()
                else:
                    self.send_error(404)

            def _send_body(self, kind: str, data: bytes) -> None:
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            def _stream(self) -> None:
                with server._new_frame:
                    full = server.viewers >= _MAX_VIEWERS
                    server.viewers += not full
                if full:
                    self.send_error(503, f"{_MAX_VIEWERS} viewers are the limit")
                    return
                try:
                    self.send_response(200)
                    self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
                    self.send_header("Cache-Control", "no-store")
                    self.end_headers()
                    seen = -1
                    server._server.keep(self.connection)
                    while not server._closed:
                        seen, data = server._next_jpeg(seen)
                        if data is None:
                            continue
                        head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                        self.wfile.write(head.encode() + data + b"\r\n")
                finally:
                    with server._new_frame:
                        server.viewers -= 1

            def log_message(self, format: str, *args: object) -> None:
                pass

        return Handler
