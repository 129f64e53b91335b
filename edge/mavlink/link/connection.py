"""A MAVLink connection to one vehicle: validates received messages and counts rejections by reason."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from edge.mavlink.dialect import mavlink
from edge.mavlink.link.framing import Framer
from edge.mavlink.link.signing import Signing
from edge.mavlink.link.transport import Address, Transport, Url, open_transport
from protocols.core.clocks import NANOSECONDS

_DEFAULT_SYSTEM = 1
_MAX_SENDERS = 8  # senders whose bytes are parsed while no vehicle is locked
_SILENT_NS = 10 * NANOSECONDS  # silence after which the vehicle may use another address
_MIN_RETRY_S, _MAX_RETRY_S = 0.2, 10.0
_NAN_ALLOWED = frozenset({"COMMAND_LONG", "COMMAND_INT", "GIMBAL_MANAGER_SET_PITCHYAW", "CAMERA_TRACKING_IMAGE_STATUS",
                          "CAMERA_TRACKING_GEO_STATUS", "CAMERA_FOV_STATUS", "VIDEO_STREAM_INFORMATION",
                          "CAMERA_INFORMATION"})  # fmt: skip
"""Message types in which NaN means "not available"; their readers check each field."""


@dataclass(frozen=True, slots=True)
class ReceivedMessage:
    """An accepted message. kind: its type. received_ns: the host's monotonic clock when its bytes were read."""

    message: Any
    kind: str
    system: int
    component: int
    received_ns: int


class Link:
    """A MAVLink connection, opened by ``poll`` and reopened whenever it breaks.

    url: address. system, component: own ids; system None: that of the vehicle, of which this is a component.
    allowed: names of the message types that are accepted. signing: rejects unsigned messages; None: no signing in
    either direction. vehicle: system id of the only accepted vehicle; None: the first autopilot whose heartbeat is
    received. transport: an open one instead of ``url``. now_ns: the host's monotonic clock; unix_s: its wall clock,
    used only for signing.

    Messages of the locked vehicle and, over its address, of any other system (ground stations behind it) are accepted;
    the reader checks ``ReceivedMessage.system``. counters: by event, in dotted names ("refused.replayed").
    """

    def __init__(
        self,
        url: Url | None,
        *,
        system: int | None,
        component: int,
        allowed: Iterable[str],
        signing: Signing | None = None,
        vehicle: int | None = None,
        transport: Transport | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        unix_s: Callable[[], float] = time.time,
    ) -> None:
        self._url, self._transport = url, transport
        self._allowed = frozenset(allowed)
        self._datagrams = url is None or url.kind.startswith("udp")
        self._signing = signing
        self._now_ns, self._unix_s = now_ns, unix_s
        self._codec: Any = mavlink.MAVLink(None, system or vehicle or _DEFAULT_SYSTEM, component)
        self._as_vehicle = system is None
        if signing is not None:
            self._codec.signing.secret_key = signing.key
            self._codec.signing.link_id = signing.link
            self._codec.signing.sign_outgoing = True
        self._lock = threading.RLock()  # one thread receives, another sends
        self._framers: dict[Address, Framer] = {}
        self._retry_s = _MIN_RETRY_S
        self._next_try_ns = 0
        self._address: Address | None = None
        self._address_ns = 0
        self.vehicle = vehicle
        self.last_received_ns = 0
        self.counters: Counter[str] = Counter()
        self.problem = ""

    @property
    def open(self) -> bool:
        """Whether the transport is open at present."""
        return self._transport is not None

    def wait(self, timeout_s: float) -> None:
        """Wait until there may be something to receive, or the timeout has passed."""
        transport = self._transport
        if transport is None:
            time.sleep(min(max(timeout_s, 0.0), 0.05))
            return
        try:
            transport.wait(timeout_s)
        except (OSError, ValueError) as error:  # ValueError: closed by the other thread meanwhile
            with self._lock:
                if transport is self._transport:
                    self._handle_failure(error)

    def poll(self) -> list[ReceivedMessage]:
        """The messages accepted since the last call; (re)opens the transport if that is due."""
        with self._lock:
            if self._transport is None and not self._try_open():
                return []
            assert self._transport is not None
            try:
                pieces = self._transport.receive()
            except OSError as error:
                self._handle_failure(error)
                return []
            now = self._now_ns()
            out: list[ReceivedMessage] = []
            for data, address in pieces:
                out += self._process(data, address, now)
            return out

    def send(self, message: Any) -> bool:
        """Send a message; False where the link is down. A loss on the way is not detected."""
        with self._lock:
            if self._transport is None:
                return False
            if self._signing is not None:
                self._codec.signing.timestamp = self._signing.next_time(self._unix_s())
            if self._as_vehicle and self.vehicle is not None:
                self._codec.srcSystem = self.vehicle
            data = message.pack(self._codec)
            self._codec.seq = (self._codec.seq + 1) % 256
            try:
                self._transport.send(bytes(data), self._address)
            except OSError as error:
                self._handle_failure(error)
                return False
            self.counters["sent"] += 1
            return True

    def close(self) -> None:
        """Close for good, and save the signing timestamps."""
        with self._lock:
            if self._transport is not None:
                self._transport.close()
                self._transport = None
            self._url = None  # prevents reopening
            if self._signing is not None:
                self._signing.save()

    def _process(self, data: bytes, address: Address, now: int) -> list[ReceivedMessage]:
        self.counters["bytes"] += len(data)
        silent = now - self._address_ns > _SILENT_NS
        if self._address is not None and address != self._address and not silent:
            self.counters["refused.address"] += 1
            return []
        framer = self._framers.get(address)
        if framer is None:
            if len(self._framers) >= _MAX_SENDERS:
                self._framers.pop(next(key for key in self._framers if key != self._address))
            framer = self._framers[address] = Framer()
        garbage, unknown = framer.unreadable, framer.unknown
        out = []
        for message, frame in framer.feed(data, whole=self._datagrams):
            received = self._accept(message, frame, address, now)
            if received is not None:
                out.append(received)
        self.counters["garbled_bytes"] += framer.unreadable - garbage
        self.counters["unknown"] += framer.unknown - unknown
        return out

    def _accept(self, message: Any, frame: bytes, address: Address, now: int) -> ReceivedMessage | None:
        system, component = int(message.get_srcSystem()), int(message.get_srcComponent())
        kind = str(message.get_type())
        if self._signing is not None:
            reason = self._signing.rejection_reason(frame, system, component, self._unix_s())
            if reason is not None:
                self.counters[f"refused.{reason}"] += 1
                return None
        if kind not in self._allowed:
            self.counters["not_needed"] += 1
            return None
        if kind not in _NAN_ALLOWED and not _all_finite(message):
            self.counters["refused.not_finite"] += 1
            return None
        is_vehicle = kind == "HEARTBEAT" and is_autopilot(message, component)
        if is_vehicle and self.vehicle is None:
            self.vehicle = system
        if is_vehicle and system == self.vehicle and (self._address is None or address != self._address):
            self._address = address
            self.counters["locked"] += 1
        if self._address is None or address != self._address:
            self.counters["refused.unlocked"] += 1
            return None
        if is_vehicle and system != self.vehicle:
            self.counters["refused.other_vehicle"] += 1
            return None
        if system == self.vehicle:
            self._address_ns = self.last_received_ns = now
        self.counters["received"] += 1
        return ReceivedMessage(message, kind, system, component, now)

    def _try_open(self) -> bool:
        now = self._now_ns()
        if self._url is None or now < self._next_try_ns:
            return False
        try:
            self._transport = open_transport(self._url)
        except OSError as error:
            self._handle_failure(error)
            return False
        self.counters["opened"] += 1
        self._retry_s, self.problem = _MIN_RETRY_S, ""
        return True

    def _handle_failure(self, error: OSError | ValueError) -> None:
        """Close the transport and schedule the next attempt with exponential back-off."""
        if self._transport is not None:
            self._transport.close()
            self._transport = None
        self._framers.clear()
        self.problem = str(getattr(error, "strerror", None) or error)
        self.counters["broken"] += 1
        self._next_try_ns = self._now_ns() + round(self._retry_s * NANOSECONDS)
        self._retry_s = min(2.0 * self._retry_s, _MAX_RETRY_S)


def is_autopilot(message: Any, component: int) -> bool:
    """Whether a heartbeat comes from an autopilot rather than a station, a camera or a gimbal."""
    return component == 1 and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID


def _all_finite(message: Any) -> bool:
    for name in message.get_fieldnames():
        value = getattr(message, name)
        values = value if isinstance(value, list) else (value,)
        if any(isinstance(part, float) and not math.isfinite(part) for part in values):
            return False
    return True
