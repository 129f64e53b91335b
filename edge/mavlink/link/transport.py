"""Byte transports for MAVLink: serial port, UDP and TCP, with the address syntax of MAVLink tools.

``udpin:host:port`` binds and waits for a sender, ``udpout:host:port`` and ``tcp:host:port`` connect to one,
``serial:/dev/ttyAMA0:921600`` is a serial port.
"""

from __future__ import annotations

import errno
import os
import re
import select
import socket
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from protocols.core.errors import InputError

Address = tuple[str, int]
"""The sender of bytes: host and port; ("", 0) for a point-to-point transport."""
ONLY: Address = ("", 0)

_MAX_DATAGRAM = 65_535  # bytes: UDP's limit
_MAX_DATAGRAMS = 256  # datagrams read per call, so that a flood cannot block the caller
_DEFAULT_BAUD = 57_600  # of ArduPilot's and PX4's telemetry ports
_LOST = {
    errno.EAGAIN,
    errno.ECONNREFUSED,
    errno.EHOSTUNREACH,
    errno.ENETUNREACH,
    errno.ENETDOWN,
    errno.ENOBUFS,
    errno.EPERM,
}
"""Errors of a send that cost the datagram only: a network that is away comes back, and the socket still receives."""
_REMEDY = 'write it like "udpin:0.0.0.0:14550", "udpout:192.168.1.10:14550", "tcp:…" or "serial:/dev/ttyAMA0:921600"'
_NETWORK = re.compile(r"(?P<kind>udp|udpin|udpout|tcp):(?P<host>[^:/\s]+):(?P<port>\d{1,5})\Z")
_SERIAL = re.compile(r"(?:serial:)?(?P<device>/[^:,\s]+|COM\d+)(?:[:,](?P<baud>\d{3,8}))?\Z")


@dataclass(frozen=True, slots=True)
class Url:
    """A parsed address. kind: udpin, udpout, tcp or serial; place: host or device; number: port or baud."""

    kind: str
    place: str
    number: int


def parse_url(text: str) -> Url:
    """Parse an address; raises InputError."""
    network = _NETWORK.match(text)
    if network and 0 <= int(network["port"]) <= 65_535:
        kind = "udpin" if network["kind"] == "udp" else network["kind"]
        if kind != "udpin" and network["port"] == "0":
            raise InputError(f"link {text!r} has no port", remedy=_REMEDY)
        return Url(kind, network["host"], int(network["port"]))
    wire = _SERIAL.match(text)
    if wire:
        return Url("serial", wire["device"], int(wire["baud"] or _DEFAULT_BAUD))
    raise InputError(f"link {text!r} is not an address", remedy=_REMEDY)


class Transport(Protocol):
    """A bidirectional byte transport. An OSError from any call means that it is broken and has to be reopened."""

    def wait(self, timeout_s: float) -> bool:
        """Wait until there may be something to receive."""

    def receive(self) -> list[tuple[bytes, Address]]:
        """The bytes received so far, by sender; never waits."""

    def send(self, data: bytes, address: Address | None) -> bool:
        """Send to an address received from before; None: to the only peer. False if there is no room at present."""

    def close(self) -> None:
        """Release it; may be called twice."""


def capacity(url: Url | None) -> float | None:
    """What the link carries [bytes/s], of which a serial port takes ten bits for each; None: unlimited."""
    return url.number / 10.0 if url is not None and url.kind == "serial" else None


def open_transport(url: Url) -> Transport:
    """Open the transport of an address. Raises OSError where that fails now (and may work later)."""
    if url.kind == "udpin":
        return Udp(url, bound=True)
    if url.kind == "udpout":
        return Udp(url, bound=False)
    return Tcp(url) if url.kind == "tcp" else Serial(url)


class Udp:
    """UDP. bound: binds to the address; otherwise connects to it and receives from it only."""

    def __init__(self, url: Url, *, bound: bool) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._bound = bound
        try:
            self._socket.setblocking(False)
            if bound:
                self._socket.bind((url.place, url.number))
            else:
                self._socket.connect((url.place, url.number))
        except BaseException:
            self._socket.close()
            raise

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._socket.getsockname()[1])

    def wait(self, timeout_s: float) -> bool:
        return bool(select.select([self._socket], [], [], max(timeout_s, 0.0))[0])

    def receive(self) -> list[tuple[bytes, Address]]:
        out: list[tuple[bytes, Address]] = []
        for _ in range(_MAX_DATAGRAMS):
            try:
                data, sender = self._socket.recvfrom(_MAX_DATAGRAM)
            except BlockingIOError:
                break
            except ConnectionRefusedError:
                continue  # no process listens there yet
            out.append((data, (str(sender[0]), int(sender[1])) if self._bound else ONLY))
        return out

    def send(self, data: bytes, address: Address | None) -> bool:
        try:
            if not self._bound:
                self._socket.send(data)
            elif address is not None and address != ONLY:
                self._socket.sendto(data, address)
        except OSError as error:
            if error.errno not in _LOST:
                raise
        return True

    def close(self) -> None:
        self._socket.close()


class _Rest:
    """Sends on a byte stream that may take only a part: the rest goes before the next message, so that none is torn."""

    def __init__(self, write: Callable[[bytes], int]) -> None:
        self._write = write
        self._waiting = b""

    def send(self, data: bytes) -> bool:
        """Send a message; False if an earlier one is not through yet."""
        try:
            if self._waiting:
                self._waiting = self._waiting[self._write(self._waiting) :]
                if self._waiting:
                    return False
            self._waiting = data[self._write(data) :]
        except BlockingIOError:
            return False
        return True


class Tcp:
    """A TCP connection to a server."""

    def __init__(self, url: Url) -> None:
        self._socket = socket.create_connection((url.place, url.number), timeout=2.0)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._rest = _Rest(self._socket.send)

    def wait(self, timeout_s: float) -> bool:
        return bool(select.select([self._socket], [], [], max(timeout_s, 0.0))[0])

    def receive(self) -> list[tuple[bytes, Address]]:
        try:
            data = self._socket.recv(_MAX_DATAGRAM)
        except BlockingIOError:
            return []
        if not data:
            raise ConnectionResetError("the other side has closed the connection")
        return [(data, ONLY)]

    def send(self, data: bytes, address: Address | None) -> bool:
        return self._rest.send(data)

    def close(self) -> None:
        self._socket.close()


class Serial:
    """A serial port through pyserial."""

    def __init__(self, url: Url) -> None:
        try:
            import serial
        except ImportError:
            raise InputError(
                "a serial link needs the package pyserial", remedy='install the extra: pip install "syncline[uav]"'
            ) from None
        # SerialException is an OSError.
        self._port: Any = serial.Serial(url.place, url.number, timeout=0, write_timeout=0, exclusive=True)
        # Not by pyserial, whose write without timeout waits in a busy loop while the port's buffer is full.
        self._rest = _Rest(lambda data: os.write(self._port.fileno(), data))

    def wait(self, timeout_s: float) -> bool:
        return bool(select.select([self._port.fileno()], [], [], max(timeout_s, 0.0))[0])

    def receive(self) -> list[tuple[bytes, Address]]:
        data = bytes(self._port.read(4096))
        return [(data, ONLY)] if data else []

    def send(self, data: bytes, address: Address | None) -> bool:
        return self._rest.send(data)

    def close(self) -> None:
        self._port.close()
