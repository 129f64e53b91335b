"""Bytes in and out of a serial port, UDP or TCP, by the addresses that MAVLink tools use.

``udpin:host:port`` waits for a sender, ``udpout:host:port`` and ``tcp:host:port`` call one,
``serial:/dev/ttyAMA0:921600`` is a wire. Nothing here knows messages.
"""

from __future__ import annotations

import re
import select
import socket
from collections import deque
from dataclasses import dataclass
from typing import Any, Protocol

from protocols.core.errors import InputError

Address = tuple[str, int]
"""Who sent bytes: host and port; ("", 0) where a link has only one other end."""
ONLY: Address = ("", 0)

_DATAGRAM = 65_535
_AT_ONCE = 256  # datagrams taken in one go: a flood must not keep the loop from its work
_BAUD = 57_600
_REMEDY = 'write it like "udpin:0.0.0.0:14550", "udpout:192.168.1.10:14550", "tcp:…" or "serial:/dev/ttyAMA0:921600"'
_NETWORK = re.compile(r"(?P<kind>udp|udpin|udpout|tcp):(?P<host>[^:\s]+):(?P<port>\d{1,5})\Z")
_WIRE = re.compile(r"(?:serial:)?(?P<device>/[^:,\s]+|COM\d+)(?:[:,](?P<baud>\d{3,8}))?\Z")


@dataclass(frozen=True, slots=True)
class Url:
    """A parsed address. kind: udpin, udpout, tcp or serial; place: host or device; number: port or baud."""

    kind: str
    place: str
    number: int


def parse(text: str) -> Url:
    """Read an address; raises InputError."""
    network = _NETWORK.match(text)
    if network and 0 <= int(network["port"]) <= 65_535:
        kind = "udpin" if network["kind"] == "udp" else network["kind"]
        if kind != "udpin" and network["port"] == "0":
            raise InputError(f"link {text!r} has no port", remedy=_REMEDY)
        return Url(kind, network["host"], int(network["port"]))
    wire = _WIRE.match(text)
    if wire:
        return Url("serial", wire["device"], int(wire["baud"] or _BAUD))
    raise InputError(f"link {text!r} is not an address", remedy=_REMEDY)


class Transport(Protocol):
    """One way to the other side. OSError from any call means that it is broken and has to be opened again."""

    def wait(self, timeout_s: float) -> bool:
        """Wait until there may be something to receive."""

    def receive(self) -> list[tuple[bytes, Address]]:
        """What has come; never waits."""

    def send(self, data: bytes, address: Address | None) -> None:
        """Send to one sender heard before, None: to the only one there is."""

    def close(self) -> None:
        """Give it back; may be called twice."""


def open_transport(url: Url) -> Transport:
    """Open an address. Raises OSError where that fails now (and may work later)."""
    if url.kind == "udpin":
        return Udp(url, bound=True)
    if url.kind == "udpout":
        return Udp(url, bound=False)
    return Tcp(url) if url.kind == "tcp" else Serial(url)


class Udp:
    """Datagrams. bound: waits at the address; else calls it, and hears nobody else."""

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
        for _ in range(_AT_ONCE):
            try:
                data, sender = self._socket.recvfrom(_DATAGRAM)
            except BlockingIOError:
                break
            except ConnectionRefusedError:
                continue  # nobody listens there yet
            out.append((data, (str(sender[0]), int(sender[1])) if self._bound else ONLY))
        return out

    def send(self, data: bytes, address: Address | None) -> None:
        try:
            if not self._bound:
                self._socket.send(data)
            elif address is not None and address != ONLY:
                self._socket.sendto(data, address)
        except (BlockingIOError, ConnectionRefusedError):
            pass  # as if it were lost on the air

    def close(self) -> None:
        self._socket.close()


class Tcp:
    """A stream to a listener."""

    def __init__(self, url: Url) -> None:
        self._socket = socket.create_connection((url.place, url.number), timeout=2.0)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def wait(self, timeout_s: float) -> bool:
        return bool(select.select([self._socket], [], [], max(timeout_s, 0.0))[0])

    def receive(self) -> list[tuple[bytes, Address]]:
        try:
            data = self._socket.recv(_DATAGRAM)
        except BlockingIOError:
            return []
        if not data:
            raise ConnectionResetError("the other side has closed the connection")
        return [(data, ONLY)]

    def send(self, data: bytes, address: Address | None) -> None:
        try:
            sent = self._socket.send(data)
        except BlockingIOError:
            return  # a full buffer: the message is lost whole
        if sent != len(data):
            raise ConnectionResetError("the link is too slow for what is sent")

    def close(self) -> None:
        self._socket.close()


class Serial:
    """A wire through pyserial."""

    def __init__(self, url: Url) -> None:
        try:
            import serial
        except ImportError:
            raise InputError(
                "a serial link needs the package pyserial", remedy='install the extra: pip install "syncline[uav]"'
            ) from None
        # SerialException is an OSError.
        self._port: Any = serial.Serial(url.place, url.number, timeout=0, write_timeout=0, exclusive=True)

    def wait(self, timeout_s: float) -> bool:
        return bool(select.select([self._port.fileno()], [], [], max(timeout_s, 0.0))[0])

    def receive(self) -> list[tuple[bytes, Address]]:
        data = bytes(self._port.read(4096))
        return [(data, ONLY)] if data else []

    def send(self, data: bytes, address: Address | None) -> None:
        self._port.write(data)

    def close(self) -> None:
        self._port.close()


class Pipe:
    """Two ends in one process: what one sends, the other receives. For simulations that run faster than time."""

    def __init__(self) -> None:
        self._inbox: deque[bytes] = deque()
        self.other: Pipe | None = None

    @classmethod
    def pair(cls) -> tuple[Pipe, Pipe]:
        """Two joined ends."""
        a, b = cls(), cls()
        a.other, b.other = b, a
        return a, b

    def wait(self, timeout_s: float) -> bool:
        return bool(self._inbox)

    def receive(self) -> list[tuple[bytes, Address]]:
        out = [(data, ONLY) for data in self._inbox]
        self._inbox.clear()
        return out

    def send(self, data: bytes, address: Address | None) -> None:
        if self.other is not None:
            self.other._inbox.append(data)

    def close(self) -> None:
        self._inbox.clear()
