"""Notification of systemd over a real datagram socket, and none without its environment variables."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from deploy.agents.systemd_notify import ALIVE_FILE, HeartbeatDevice, Notifier
from edge.devices.base import DeviceInfo, Frame, Reconnecting


class Manager:
    """The socket of the service manager."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self._socket.setblocking(False)

    def received(self) -> list[str]:
        out = []
        while True:
            try:
                out.append(self._socket.recv(4096).decode())
            except BlockingIOError:
                return out

    def close(self) -> None:
        self._socket.close()


@pytest.fixture(params=["file", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    made = Manager(str(tmp_path / "notify") if request.param == "file" else f"@syncline-test-{os.getpid()}")
    yield made
    made.close()


def test_ready_is_sent_with_the_first_data_and_watchdog_at_the_configured_rate(manager: Manager) -> None:
    now = 100.0
    notifier = Notifier(manager.address, watchdog_s=2.0, now=lambda: now)
    assert manager.received() == [], "ready before any data flowed"
    notifier.beat()
    assert manager.received() == ["READY=1\nSTATUS=running\nWATCHDOG=1"]
    for _ in range(100):  # 2 s of frames at 50 Hz
        now += 0.02
        notifier.beat()
    received = manager.received()
    assert set(received) == {"WATCHDOG=1"}
    assert 3 <= len(received) <= 5, "each quarter of the watchdog's time, not each frame"
    now += 60.0
    assert manager.received() == [], "sent without data: the watchdog would never trigger"


def test_a_long_shutdown_extends_its_timeout_while_it_makes_progress(manager: Manager) -> None:
    now = 0.0
    notifier = Notifier(manager.address, watchdog_s=60.0, now=lambda: now)
    notifier.beat()
    manager.received()
    for _ in range(10):
        now += 2.0
        notifier.beat(ending=True)
    assert manager.received() == ["WATCHDOG=1\nEXTEND_TIMEOUT_USEC=60000000"] * 10


def test_waiting_for_a_router_extends_the_start_timeout_until_ready(manager: Manager) -> None:
    now = 0.0
    notifier = Notifier(manager.address, now=lambda: now)
    for _ in range(20):
        notifier.waiting("a router\nREADY=1")
        now += 0.5
    received = manager.received()
    assert len(received) == 2
    assert all("EXTEND_TIMEOUT_USEC=" in text and "\nREADY=1" not in text for text in received)
    notifier.beat()
    manager.received()
    now += 60.0
    notifier.waiting("a router")
    assert manager.received() == []


def test_the_environment_of_systemd_is_understood(manager: Manager) -> None:
    mine = {"NOTIFY_SOCKET": manager.address, "WATCHDOG_USEC": "4000000", "WATCHDOG_PID": str(os.getpid())}
    Notifier.from_environment(mine).beat()
    assert len(manager.received()) == 1
    Notifier.from_environment({}).beat()
    Notifier.from_environment({"NOTIFY_SOCKET": "/no/such/socket"}).beat()  # a manager that is gone ends nothing
    assert manager.received() == []


def test_in_a_container_the_modification_time_of_a_file_is_updated(tmp_path: Path) -> None:
    file = tmp_path / "alive"
    notifier = Notifier.from_environment({ALIVE_FILE: str(file)})
    assert not file.exists()
    notifier.beat()
    assert file.exists()


def test_a_device_sends_a_heartbeat_with_each_frame_only() -> None:
    class Device:
        def __init__(self) -> None:
            self.frames = [Frame(np.zeros((2, 2, 3), np.uint8), 0, 0), None, None]
            self.info = DeviceInfo(2, 2, 1.0, "test", "monotonic")
            self.ended = False

        def open(self) -> None: ...

        def read(self, timeout_s: float) -> Frame | None:
            return self.frames.pop(0)

        def close(self) -> None: ...

    beats: list[int] = []
    watched = HeartbeatDevice(Device(), lambda: beats.append(1))
    watched.open()
    assert watched.read(0.1) is not None
    assert beats == [1]
    assert watched.read(0.1) is None
    assert watched.read(0.1) is None
    assert beats == [1], "a silent camera looks alive"


def test_waiting_for_an_unplugged_camera_keeps_the_watchdog_alive() -> None:
    class Board:
        def __init__(self) -> None:
            self.info = DeviceInfo(2, 2, 1.0, "test", "monotonic")
            self.ended, self.disconnected, self.reconnections, self.temperature = False, False, 3, None

        def open(self) -> None: ...

        def read(self, timeout_s: float) -> Frame | None:
            return None

        def close(self) -> None: ...

    beats: list[int] = []
    board = Board()
    watched = HeartbeatDevice(board, lambda: beats.append(1))
    watched.read(0.1)
    assert beats == [], "plugged in and silent: it hangs"
    board.disconnected = True
    watched.read(0.1)
    assert beats == [1]
    assert isinstance(watched, Reconnecting)
    assert (watched.disconnected, watched.reconnections) == (True, 3)
