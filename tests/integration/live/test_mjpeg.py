"""The operator's video as motion JPEG: whom it serves, and for how long it waits."""

from __future__ import annotations

import socket
from contextlib import ExitStack

import pytest

from edge.video import mjpeg_server
from edge.video.mjpeg_server import MjpegServer, names_this_machine
from tests.support.samples import eventually

JPEG = b"\xff\xd8 a picture of 200 kB" + bytes(200_000) + b"\xff\xd9"


def exchange(server: MjpegServer, host: str, path: str = "/") -> bytes:
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as link:
        link.sendall(f"GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
        return link.recv(4096)


@pytest.mark.parametrize(
    ("host", "good"),
    [
        ("127.0.0.1:8560", True),
        ("[::1]:8560", True),
        ("10.0.0.7", True),
        ("localhost:8560", True),
        (socket.gethostname(), True),
        ("", True),
        ("evil.example", False),
        ("evil.example:8560", False),
        ("127.0.0.1.evil.example", False),
        ("[", False),
        ("a@evil.example", False),
    ],
)
def test_a_foreign_name_is_not_served(host: str, good: bool) -> None:
    """DNS rebinding: any Host was answered, so that any page could read the video."""
    assert names_this_machine(host) is good


def test_the_host_is_checked_for_every_path() -> None:
    with MjpegServer("127.0.0.1", 0, lambda: JPEG) as server:
        server.notify_frame()
        for path in ("/", "/snapshot.jpg", "/stream.mjpg"):
            assert exchange(server, "evil.example", path).split()[1] == b"403"
            assert exchange(server, f"127.0.0.1:{server.port}", path).split()[1] == b"200"


def test_silent_connections_do_not_lock_others_out() -> None:
    with MjpegServer("127.0.0.1", 0, lambda: JPEG) as server, ExitStack() as stack:
        for _ in range(60):
            stack.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=10))
        assert exchange(server, "localhost").split()[1] == b"200"
        assert eventually(lambda: len(server._server._open) <= mjpeg_server._MAX_CONNECTIONS + 1)


def test_a_viewer_that_does_not_read_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mjpeg_server, "_SEND_TIMEOUT_S", 0.2)
    with (
        MjpegServer("127.0.0.1", 0, lambda: JPEG) as server,
        socket.create_connection(("127.0.0.1", server.port), timeout=10) as link,
    ):
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        link.sendall(b"GET /stream.mjpg HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert eventually(lambda: server.viewers == 1)

        def dropped() -> bool:
            server.notify_frame()
            return server.viewers == 0

        assert eventually(dropped)
