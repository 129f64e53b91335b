"""A proxy before a router that changes what clients send."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from contextlib import suppress


def through_a_link(endpoint: str, change: Callable[[bytes], bytes]) -> str:
    """A proxy to a router that changes what clients send; returns its own address."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    listening = socket.create_server(("127.0.0.1", 0))

    def pump(source: socket.socket, sink: socket.socket, changed: Callable[[bytes], bytes]) -> None:
        with suppress(OSError):
            while data := source.recv(65_536):
                sink.sendall(changed(data))
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def serve() -> None:
        with suppress(OSError):
            while True:
                client, _ = listening.accept()
                there = socket.create_connection((host, int(port)))
                threading.Thread(target=pump, args=(client, there, change), daemon=True).start()
                threading.Thread(target=pump, args=(there, client, bytes), daemon=True).start()

    threading.Thread(target=serve, daemon=True).start()
    return f"tcp/127.0.0.1:{listening.getsockname()[1]}"


def poisoned(data: bytes) -> bytes:
    """A harmless key as one with a `?`, as a broken or hostile client would declare it."""
    return data.replace(b"camQ", b"cam?")
