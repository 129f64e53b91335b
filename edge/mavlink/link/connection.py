"""A link to one vehicle: only messages that may be believed come through, and why others did not is counted."""

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

_USUAL_VEHICLE = 1
_SENDERS = 8  # addresses whose bytes are looked at while nobody is locked
_SILENT_NS = 10 * NANOSECONDS  # after which the vehicle may speak from another address
_FIRST_RETRY_S, _LAST_RETRY_S = 0.2, 10.0
_NAN_ALLOWED = frozenset({"COMMAND_LONG", "COMMAND_INT", "GIMBAL_MANAGER_SET_PITCHYAW", "CAMERA_TRACKING_IMAGE_STATUS",
                          "CAMERA_TRACKING_GEO_STATUS", "CAMERA_FOV_STATUS", "VIDEO_STREAM_INFORMATION",
                          "CAMERA_INFORMATION"})  # fmt: skip
"""Kinds in which NaN means "not told"; who reads them looks at each field."""


@dataclass(frozen=True, slots=True)
class Heard:
    """A message that was let in. received_ns: the host's monotonic clock when its bytes were taken."""

    message: Any
    kind: str
    system: int
    component: int
    received_ns: int


class Link:
    """One link, opened by ``poll`` and opened again whenever it breaks.

    url: where to. system, component: what this side calls itself; system None: as the vehicle, whose part it is.
    allowed: names of the messages that are let in. signing: refuses what is not signed; None: anything goes, and
    nothing is signed. vehicle: system id of the only vehicle that is heard; None: the first autopilot whose heartbeat
    comes. transport: an open one instead of ``url``.
    now_ns: the host's monotonic clock; unix_s: its wall clock, which only signing asks.

    Messages of the locked vehicle and, over its address, of any other system (ground stations behind it) are let in;
    the receiver looks at ``Heard.system``. counters: by what happened; see the README of the folder above.
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
        self._whole = url is None or url.kind.startswith("udp")
        self._signing = signing
        self._now_ns, self._unix_s = now_ns, unix_s
        self._codec: Any = mavlink.MAVLink(None, system or vehicle or _USUAL_VEHICLE, component)
        self._as_vehicle = system is None
        if signing is not None:
            self._codec.signing.secret_key = signing.key
            self._codec.signing.link_id = signing.link
            self._codec.signing.sign_outgoing = True
        self._lock = threading.RLock()  # one thread listens, another speaks
        self._framers: dict[Address, Framer] = {}
        self._retry_s = _FIRST_RETRY_S
        self._next_try_ns = 0
        self._address: Address | None = None
        self._address_ns = 0
        self.vehicle = vehicle
        self.heard_ns = 0
        self.counters: Counter[str] = Counter()
        self.problem = ""

    @property
    def open(self) -> bool:
        """Whether the link can be used at the moment."""
        return self._transport is not None

    def wait(self, timeout_s: float) -> None:
        """Return when something may have come, or the time is up."""
        transport = self._transport
        if transport is None:
            time.sleep(min(max(timeout_s, 0.0), 0.05))
            return
        try:
            transport.wait(timeout_s)
        except (OSError, ValueError) as error:  # ValueError: closed by the other thread meanwhile
            with self._lock:
                if transport is self._transport:
                    self._broken(error)

    def poll(self) -> list[Heard]:
        """What came since the last call."""
        with self._lock:
            if self._transport is None and not self._try_open():
                return []
            assert self._transport is not None
            try:
                pieces = self._transport.receive()
            except OSError as error:
                self._broken(error)
                return []
            now = self._now_ns()
            out: list[Heard] = []
            for data, address in pieces:
                out += self._from(data, address, now)
            return out

    def send(self, message: Any) -> bool:
        """Send a message; False where the link is down. Lost on the way is as on the air: nobody tells."""
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
                self._broken(error)
                return False
            self.counters["sent"] += 1
            return True

    def close(self) -> None:
        """Close, and keep the last times of signing."""
        with self._lock:
            if self._transport is not None:
                self._transport.close()
                self._transport = None
            self._url = None  # it is not opened again
            if self._signing is not None:
                self._signing.save()

    def _from(self, data: bytes, address: Address, now: int) -> list[Heard]:
        self.counters["bytes"] += len(data)
        silent = now - self._address_ns > _SILENT_NS
        if self._address is not None and address != self._address and not silent:
            self.counters["refused.address"] += 1
            return []
        framer = self._framers.get(address)
        if framer is None:
            if len(self._framers) >= _SENDERS:
                self._framers.pop(next(key for key in self._framers if key != self._address))
            framer = self._framers[address] = Framer()
        garbage, unknown = framer.unreadable, framer.unknown
        out = []
        for message, frame in framer.feed(data, whole=self._whole):
            heard = self._admit(message, frame, address, now)
            if heard is not None:
                out.append(heard)
        self.counters["garbled_bytes"] += framer.unreadable - garbage
        self.counters["unknown"] += framer.unknown - unknown
        return out

    def _admit(self, message: Any, frame: bytes, address: Address, now: int) -> Heard | None:
        system, component = int(message.get_srcSystem()), int(message.get_srcComponent())
        kind = str(message.get_type())
        if self._signing is not None:
            reason = self._signing.refused(frame, system, component, self._unix_s())
            if reason is not None:
                self.counters[f"refused.{reason}"] += 1
                return None
        if kind not in self._allowed:
            self.counters["not_needed"] += 1
            return None
        if kind not in _NAN_ALLOWED and not _finite(message):
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
            self._address_ns = self.heard_ns = now
        self.counters["received"] += 1
        return Heard(message, kind, system, component, now)

    def _try_open(self) -> bool:
        now = self._now_ns()
        if self._url is None or now < self._next_try_ns:
            return False
        try:
            self._transport = open_transport(self._url)
        except OSError as error:
            self._broken(error)
            return False
        self.counters["opened"] += 1
        self._retry_s, self.problem = _FIRST_RETRY_S, ""
        return True

    def _broken(self, error: OSError | ValueError) -> None:
        """Close and try again later, each time later."""
        if self._transport is not None:
            self._transport.close()
            self._transport = None
        self._framers.clear()
        self.problem = str(getattr(error, "strerror", None) or error)
        self.counters["broken"] += 1
        self._next_try_ns = self._now_ns() + round(self._retry_s * NANOSECONDS)
        self._retry_s = min(2.0 * self._retry_s, _LAST_RETRY_S)


def is_autopilot(message: Any, component: int) -> bool:
    """Whether a heartbeat is an autopilot's, not a station's, a camera's or a gimbal's."""
    return component == 1 and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID


def _finite(message: Any) -> bool:
    for name in message.get_fieldnames():
        value = getattr(message, name)
        values = value if isinstance(value, list) else (value,)
        if any(isinstance(part, float) and not math.isfinite(part) for part in values):
            return False
    return True
