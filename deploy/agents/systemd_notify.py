"""Tells the service manager that data flows: systemd's notify protocol, and a file for a container's health check.

The agents call ``beat`` where a frame was taken or a round of messages was worked off, so that a process which is
alive but does nothing any more is restarted. Without the environment that a service manager sets it is silent.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from edge.devices.base import Device, DeviceInfo, Frame, Returning, Warm

ALIVE_FILE = "SYNCLINE_ALIVE_FILE"
"""Environment variable: a file whose time of change says when data flowed last."""
_FILE_S = 1.0


class Notifier:
    """One process's line to its service manager.

    address: of the datagram socket, ``@`` first for an abstract one; "" = none. watchdog_s: systemd's WatchdogSec;
    0 = none asked for. alive: file to touch. now: a monotonic clock [s].
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
        # Often enough that one datagram that is lost costs nothing, and not once a frame.
        self._every_s = min(watchdog_s / 4.0, 1.0) if watchdog_s > 0.0 else 1.0
        self._alive = alive
        self._now = now
        self._ready = False
        self._next = 0.0
        self._next_file = 0.0
        self._next_waiting = 0.0

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> Notifier:
        """What systemd, or a container's file, has asked of this very process."""
        watchdog = environment.get("WATCHDOG_USEC", "")
        # WATCHDOG_PID names whose watchdog it is: a child that inherited the environment is not meant.
        mine = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        file = environment.get(ALIVE_FILE, "")
        return cls(
            environment.get("NOTIFY_SOCKET", ""),
            int(watchdog) / 1e6 if mine and watchdog.isdecimal() else 0.0,
            Path(file) if file else None,
        )

    def beat(self, ending: bool = False) -> None:
        """Data has flowed: READY=1 the first time, WATCHDOG=1 as often as is asked for.

        ending: the end was ordered, and what is done now belongs to it: it may take a minute more.
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
        """Not ready, for a reason outside this process: the start may take longer."""
        now = self._now()
        if not self._ready and now >= self._next_waiting:
            self._next_waiting = now + 5.0
            self._send(f"STATUS=waiting for {' '.join(what.split())}\nEXTEND_TIMEOUT_USEC=20000000")

    def stopping(self) -> None:
        """The end has begun, in order."""
        self._send("STOPPING=1\nSTATUS=stopping")

    def _send(self, text: str) -> None:
        if not self._address:
            return
        # A manager that is gone must not end a measurement.
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as line:
            line.setblocking(False)
            line.sendto(text.encode(), self._address)


class Watched:
    """A device that beats with every frame it gives: see ``edge.devices.base.Device``.

    It beats also while it seeks a camera that was unplugged: that is told in the agent's status, and to start the
    agent anew would not help, but forget what is known of its clock.
    """

    def __init__(self, device: Device, beat: Callable[[], None]) -> None:
        self._device, self._beat = device, beat

    @property
    def info(self) -> DeviceInfo:
        """The device's."""
        return self._device.info

    @property
    def ended(self) -> bool:
        """The device's."""
        return self._device.ended

    @property
    def away(self) -> bool:
        """The device's; False of one that does not come back by itself."""
        return isinstance(self._device, Returning) and self._device.away

    @property
    def reconnections(self) -> int:
        """The device's."""
        return self._device.reconnections if isinstance(self._device, Returning) else 0

    @property
    def temperature(self) -> float | None:
        """The device's; None of one that does not measure it."""
        return self._device.temperature if isinstance(self._device, Warm) else None

    def open(self) -> None:
        """Open the device."""
        self._device.open()

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame. The one before has been looked at and handed to the bus when this is called again."""
        frame = self._device.read(timeout_s)
        if frame is not None or self.away:
            self._beat()
        return frame

    def close(self) -> None:
        """Close the device."""
        self._device.close()
