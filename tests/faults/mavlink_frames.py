"""Real MAVLink bytes, signed or not, and a link that receives them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from edge.mavlink.dialect import mavlink
from edge.mavlink.link.connection import Link, ReceivedMessage
from edge.mavlink.link.signing import Signing, ticks
from edge.mavlink.link.transport import Address

VEHICLE: Address = ("127.0.0.1", 14550)
UNIX_S = 1_800_000_000.0
ALLOWED = ("HEARTBEAT", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED")


class Wire:
    """A transport whose other end is the test."""

    def __init__(self) -> None:
        self.waiting: list[tuple[bytes, Address]] = []

    def wait(self, timeout_s: float) -> bool:
        return bool(self.waiting)

    def receive(self) -> list[tuple[bytes, Address]]:
        came, self.waiting = self.waiting, []
        return came

    def send(self, data: bytes, address: Address | None) -> bool:
        return True

    def close(self) -> None:
        pass


class Vehicle:
    """Makes frames as an autopilot does. key: signs them; None = unsigned."""

    def __init__(self, key: bytes | None = None) -> None:
        self._codec: Any = mavlink.MAVLink(None, 1, 1)
        self._key = key
        self._sent = ticks(UNIX_S)

    def frame(self, message: Any, at: int | None = None) -> bytes:
        """One frame. at: its signing time; None = the next."""
        if self._key is not None:
            self._sent += 1
            self._codec.signing.secret_key, self._codec.signing.sign_outgoing = self._key, True
            self._codec.signing.timestamp = self._sent if at is None else at
        data = bytes(message.pack(self._codec))
        self._codec.seq = (self._codec.seq + 1) % 256
        return data

    def heartbeat(self) -> bytes:
        return self.frame(mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3))

    def attitude(self, w: float = 1.0, at: int | None = None) -> bytes:
        return self.frame(mavlink.MAVLink_attitude_quaternion_message(1000, w, 0.0, 0.0, 0.0, 0.1, 0.1, 0.1), at)


def frames() -> list[bytes]:
    """Valid frames to damage."""
    vehicle = Vehicle()
    place = mavlink.MAVLink_local_position_ned_message(1000, 1.0, 2.0, -3.0, 0.1, 0.2, 0.3)
    return [vehicle.heartbeat(), vehicle.attitude(), vehicle.frame(place)]


def link(wire: Wire, signing: Signing | None = None) -> Link:
    """A link on a test transport, at a fixed time."""
    return Link(
        None, system=None, component=100, allowed=ALLOWED, signing=signing, transport=wire,
        now_ns=lambda: 1_000_000_000, unix_s=lambda: UNIX_S,
    )  # fmt: skip


def message_receiver() -> Callable[[bytes], list[ReceivedMessage]]:
    """Feeds bytes to one unsigned link that keeps its state between inputs."""
    wire = Wire()
    listening = link(wire)

    def received_from(data: bytes) -> list[ReceivedMessage]:
        wire.waiting.append((data, VEHICLE))
        return listening.poll()

    return received_from
