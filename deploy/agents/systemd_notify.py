"""Watchdog notification to the service manager: systemd's sd_notify protocol, and a file for container health checks.

The agents call ``beat`` after each frame or batch of messages, so that a process that is alive but no longer makes
progress is restarted. Without the environment variables of a service manager nothing is sent.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from edge.devices.base import Device, Frame, WrappedDevice

ALIVE_FILE = "SYNCLINE_ALIVE_FILE"
"""Environment variable: a file whose modification time is that of the last data flow."""
_FILE_S = 1.0  # between two touches: container checks ask every few seconds


class Notifier:
    """The connection of one process to its service manager.

    address: of the datagram socket, with a leading ``@`` for an abstract one; "" = none. watchdog_s: systemd's
    WatchdogSec; 0 = no watchdog. alive: file to touch. now: a monotonic clock [s].
    """

    def __init__(
        self,
        address: str = "",
        watchdog_s: float = 0.0,
        alive: Path | None = None,
        *,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._address = "\0" + address[1:] if address.startswith("@") else address
        # Four times per watchdog period, so that one lost datagram does no harm; not once per frame.
        self._every_s = min(watchdog_s / 4.0, 1.0) if watchdog_s > 0.0 else 1.0
        self._alive = alive
        self._now = now
        self._ready = False
        self._next = 0.0
        self._next_file = 0.0
        self._next_waiting = 0.0

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> Notifier:
        """The notifier that systemd or a container has configured for this process."""
        watchdog = environment.get("WATCHDOG_USEC", "")
        # WATCHDOG_PID is the process that the watchdog is for: a child that inherited the environment is not meant.
        mine = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        file = environment.get(ALIVE_FILE, "")
        return cls(
            environment.get("NOTIFY_SOCKET", ""),
            int(watchdog) / 1e6 if mine and watchdog.isdecimal() else 0.0,
            Path(file) if file else None,
        )

    def beat(self, ending: bool = False) -> None:
        """Report that data has flowed: READY=1 the first time, then WATCHDOG=1 at the configured interval.

        ending: the process is shutting down and still working; the stop timeout is extended by a minute.
        """
        now = self._now()
        if not self._ready:
            self._ready = True
            self._send("READY=1\nSTATUS=running\nWATCHDOG=1")
            self._next = now + self._every_s
        elif now >= self._next:
            self._next = now + self._every_s
            self._send("WATCHDOG=1" + ("\nEXTEND_TIMEOUT_USEC=60000000" if ending else ""))
        if self._alive is not None and now >= self._next_file:
            self._next_file = now + _FILE_S
            with suppress(OSError):
                self._alive.touch()

    def waiting(self, what: str) -> None:
        """Report that the start waits for something outside this process; extends the start timeout."""
        now = self._now()
        if not self._ready and now >= self._next_waiting:
            self._next_waiting = now + 5.0
            self._send(f"STATUS=waiting for {' '.join(what.split())}\nEXTEND_TIMEOUT_USEC=20000000")

    def stopping(self) -> None:
        """Report that a clean shutdown has begun."""
        self._send("STOPPING=1\nSTATUS=stopping")

    def _send(self, text: str) -> None:
        if not self._address:
            return
        # A service manager that has gone must not end a measurement.
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as line:
            line.setblocking(False)
            line.sendto(text.encode(), self._address)


class HeartbeatDevice(WrappedDevice):
    """A device that sends a heartbeat with every frame: see ``edge.devices.base.Device``.

    It also sends heartbeats while it waits for an unplugged camera to return: the agent's status reports that, and a
    restart of the agent would not help, but would lose its clock model.
    """

    def __init__(self, device: Device, beat: Callable[[], None]) -> None:
        super().__init__(device)
        self._beat = beat

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame. When this is called again, the previous one has been processed and published."""
        frame = super().read(timeout_s)
        if frame is not None or self.disconnected:
            self._beat()
        return frame
