"""The router's links: none waits in its close for what a cut link cannot take."""

from __future__ import annotations

import os
import socket
import struct
import sys
from pathlib import Path

import pytest

from protocols.bus.router.zenoh_router import close_without_waiting


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_no_open_socket_lingers_and_each_is_set_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as link:
        lingering = struct.pack("ii", 1, 10)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, lingering)
        files = sorted(path.name for path in Path("/proc/self/fd").iterdir())
        done = close_without_waiting(set())
        assert struct.unpack("ii", link.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8))[0] == 0
        assert {os.fstat(one.fileno()).st_ino for one in (server, link)} <= done
        link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, lingering)
        assert close_without_waiting(done) == done
        assert link.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8) == lingering
        assert sorted(path.name for path in Path("/proc/self/fd").iterdir()) == files, "nothing is left open"
