"""A MAVLink connection to one vehicle: validates received messages and counts rejections by reason."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from edge.mavlink.dialect import AUTOPILOT, mavlink
from edge.mavlink.link.framing import SIGNED, V2, Framer
from edge.mavlink.link.identity import Evidence
from edge.mavlink.link.outbox import Outbox
from edge.mavlink.link.signing import Signing
from edge.mavlink.link.transport import Address, Transport, Url, capacity, open_transport
from protocols.core.clocks import NANOSECONDS

_DEFAULT_SYSTEM = 1  # the first vehicle of a network
_MAX_SENDERS = 8  # senders whose bytes are parsed while no vehicle is locked
_SILENT_NS = 1_500_000_000  # of an autopilot, which sends a heartbeat each second and here 30 attitudes
_UNKNOWN_SILENT_NS = 10 * NANOSECONDS  # … of one of which only heartbeats are known, before another host is followed
_TCP_SILENT_NS = 10 * NANOSECONDS  # ten heartbeats, after which a connection whose other side is gone is made anew
_LEAST_GARBLED = 1000  # bytes without a message, a second of a slow port: not the start of one in the middle
_MIN_RETRY_S, _MAX_RETRY_S = 0.2, 1.0  # doubled up to, until the device or address is there
_CONFLICT_SHOWN_NS = 10 * NANOSECONDS
_NO_VEHICLES = frozenset({mavlink.MAV_TYPE_ANTENNA_TRACKER, mavlink.MAV_TYPE_GCS, mavlink.MAV_TYPE_ADSB})
"""Types of what may send as an autopilot's component, with an autopilot's name."""
_GARBLED = "bytes arrive, but no MAVLink messages: check the baud rate, and what the port speaks"
_NAN_ALLOWED = frozenset({"COMMAND_LONG", "COMMAND_INT", "GIMBAL_MANAGER_SET_PITCHYAW", "CAMERA_TRACKING_IMAGE_STATUS",
                          "CAMERA_TRACKING_GEO_STATUS", "CAMERA_FOV_STATUS", "VIDEO_STREAM_INFORMATION",
                          "CAMERA_INFORMATION"})  # fmt: skip
"""Message types in which NaN means "not available"; their readers check each field."""
_USED = {"GIMBAL_DEVICE_ATTITUDE_STATUS": ("q",), "ATTITUDE_QUATERNION": ("q1", "q2", "q3", "q4")}
"""The fields that are read of messages in whose others NaN means "not available"."""


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
    used only for signing. beacon: system id that FOLLOW_TARGET is sent from.

    Messages of the locked vehicle and, over its address, of any other system (ground stations behind it) are accepted;
    the reader checks ``ReceivedMessage.system``. Another address or system id is followed only after the vehicle has
    fallen silent, and if it is signed or continues the vehicle (``identity``). counters: by event, in dotted names
    ("refused.replayed"). last_received_ns: of the autopilot itself. problem: why nothing is received.
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
        beacon: int = 200,
    ) -> None:
        self._url, self._transport = url, transport
        self._allowed = frozenset(allowed)
        self._datagrams = url is None or url.kind.startswith("udp")
        self._signing = signing
        self._now_ns, self._unix_s = now_ns, unix_s
        self._codec: Any = mavlink.MAVLink(None, system or vehicle or _DEFAULT_SYSTEM, component)
        self._beacon: Any = mavlink.MAVLink(None, beacon, component)  # with a sequence of its own
        self._as_vehicle = system is None
        if signing is not None:
            for codec in (self._codec, self._beacon):
                codec.signing.secret_key = signing.key
                codec.signing.link_id = signing.link
                codec.signing.sign_outgoing = True
        self._lock = threading.RLock()  # one thread receives, another sends
        self._framers: dict[Address, Framer] = {}
        self._retry_s = _MIN_RETRY_S
        self._next_try_ns = 0
        self._bytes_ns = 0
        self._address: Address | None = None
        self._reply_address: Address | None = None
        self._fixed = vehicle is not None
        self._identity = Evidence()
        self._first: tuple[Address, int, Evidence] | None = None
        self._candidates: dict[tuple[Address, int], Evidence] = {}
        self._conflict = self._second = (-_CONFLICT_SHOWN_NS, "")
        self.vehicle = vehicle
        self.last_received_ns = 0
        self.counters: Counter[str] = Counter()
        self._beat_sequences: deque[int] = deque(maxlen=16)  # an echo over a satellite takes seconds
        self._outbox = Outbox(capacity(url), self.counters)
        self.problem = ""

    @property
    def system(self) -> int | None:
        """The own system id; None while it is that of a vehicle that is not known yet."""
        return self.vehicle if self._as_vehicle else int(self._codec.srcSystem)

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
        if self._transport is None:
            self._try_open()
        with self._lock:
            if self._transport is None:
                return []
            try:
                pieces = self._transport.receive()
            except OSError as error:
                self._handle_failure(error)
                return []
            now = self._now_ns()
            if pieces:
                self._bytes_ns = now
            elif self._url is not None and self._url.kind == "tcp" and now - self._bytes_ns > _TCP_SILENT_NS:
                # A peer that was switched off closes nothing, and the kernel waits for it for a quarter of an hour.
                self._handle_failure(TimeoutError(f"nothing received for {_TCP_SILENT_NS // NANOSECONDS} s"))
                return []
            out: list[ReceivedMessage] = []
            for data, address in pieces:
                out += self._process(data, address, now)
            self._flush(now)
            unsaved = None if self._signing is None else self._signing.unsaved()
        if unsaved is not None and self._signing is not None:
            self._signing.write(unsaved)  # without the lock: a slow disk must not hold up the sender
        return out

    def send(self, message: Any) -> bool:
        """Send a message, or let it wait for room; False where the link is down. A loss on the way is not detected."""
        if self._transport is None:
            return False  # without the lock, which is held while a link is opened
        with self._lock:
            self._outbox.put(message)
            self._flush(self._now_ns())
            return self._transport is not None

    def close(self) -> None:
        """Close for good, and save the signing timestamps."""
        with self._lock:
            if self._transport is not None:
                self._transport.close()
                self._transport = None
            self._url = None  # prevents reopening
            if self._signing is not None:
                self._signing.save()

    def report(self, now_ns: int) -> str:
        """Who else claims to be the vehicle, or why the signing times are not stored; "" if there is nothing."""
        since, text = self._conflict
        if now_ns - since < _CONFLICT_SHOWN_NS:
            return text
        return "" if self._signing is None else self._signing.problem

    def second_sender(self, now_ns: int) -> str:
        """Who else has this component's ids, or which other vehicle is there, where ``vehicle`` is not set; or ""."""
        since, text = self._second
        return text if now_ns - since < _CONFLICT_SHOWN_NS else ""

    def _flush(self, now: int) -> None:
        """Send what the link has room for."""
        while self._transport is not None and (message := self._outbox.next(now)) is not None:
            codec = self._beacon if message.get_type() == "FOLLOW_TARGET" else self._codec
            if self._signing is not None:
                codec.signing.timestamp = self._signing.next_time(self._unix_s())
            if self._as_vehicle and self.vehicle is not None:
                self._codec.srcSystem = self.vehicle
            if message.get_type() == "HEARTBEAT":
                self._beat_sequences.append(codec.seq)
            data = bytes(message.pack(codec))
            try:
                if not self._transport.send(data, self._reply_address or self._address):
                    return
            except OSError as error:
                self._handle_failure(error)
                return
            codec.seq = (codec.seq + 1) % 256
            self._outbox.sent(len(data))
            self.counters["sent"] += 1

    def _process(self, data: bytes, address: Address, now: int) -> list[ReceivedMessage]:
        self.counters["bytes"] += len(data)
        silent = now - self.last_received_ns > _SILENT_NS
        if self._address not in (None, address) and not silent and (self._first is None or address != self._first[0]):
            self.counters["refused.address"] += 1
            self._conflict = (now, f"{address[0]}:{address[1]} sends as well, and is not followed")
            return []
        framer = self._framers.get(address)
        if framer is None:
            if len(self._framers) >= _MAX_SENDERS:
                self._framers.pop(next(key for key in self._framers if key != self._address))
            framer = self._framers[address] = Framer()
        garbage, unknown = framer.unreadable, framer.unknown
        out, readable = [], False
        for message, frame in framer.feed(data, whole=self._datagrams):
            readable = True
            received = self._accept(message, frame, address, now)
            if received is not None:
                out.append(received)
        self.counters["garbled_bytes"] += framer.unreadable - garbage
        self.counters["unknown"] += framer.unknown - unknown
        if self.vehicle is None and self._signing is None and (readable or framer.unreadable > _LEAST_GARBLED):
            self.problem = "messages arrive, but no autopilot's heartbeat" if readable else _GARBLED
        return out

    def _accept(self, message: Any, frame: bytes, address: Address, now: int) -> ReceivedMessage | None:
        system, component = int(message.get_srcSystem()), int(message.get_srcComponent())
        kind = str(message.get_type())
        if self._signing is not None:
            reason = self._signing.rejection_reason(frame, system, component, self._unix_s())
            if reason is not None:
                self._reject(reason, address, component, now)
                return None
        if kind not in self._allowed:
            self.counters["not_needed"] += 1
            return None
        if kind not in _NAN_ALLOWED and not _all_finite(message):
            self.counters["refused.not_finite"] += 1
            return None
        beats = kind == "HEARTBEAT" and is_autopilot(message, component)
        if component == AUTOPILOT and (self._address != address or self.vehicle != system):
            self._consider(message, address, system, beats=beats, now=now)
        if self._address is None or address != self._address:
            self.counters["refused.unlocked"] += 1
            return None
        if beats and system != self.vehicle:
            self.counters["refused.other_vehicle"] += 1
            return None
        if system == self.vehicle and component == AUTOPILOT:
            self.last_received_ns, self._reply_address, self.problem = now, None, ""
            self._identity.add(message, now)
            if self._signing is None and frame[0] == V2 and frame[2] & SIGNED:
                self.counters["signed"] += 1  # which cannot be verified
        own_ids = (system, component) == (self.system, self._codec.srcComponent)
        if kind == "HEARTBEAT" and own_ids and message.get_seq() not in self._beat_sequences:  # no echo
            text = f"another component {component} of system {system} is on this link: stations reach both as one"
            self._second = (now, f"{text}; set system in [mavlink], or the other one's component id")
        self.counters["received"] += 1
        return ReceivedMessage(message, kind, system, component, now)

    def _reject(self, reason: str, address: Address, component: int, now: int) -> None:
        """Count a message that the signing rejects, and say why the vehicle cannot be heard."""
        self.counters[f"refused.{reason}"] += 1
        heard = self._address is not None and now - self.last_received_ns <= _SILENT_NS
        if heard or component != AUTOPILOT or self._signing is None:
            return
        if reason in ("late", "future", "replayed"):
            behind = self._signing.behind_s
            self.problem = f"the autopilot signs with the key, but its clock is {abs(behind):.0f} s " + (
                "behind" if behind > 0.0 else "ahead of this machine's"
            )
            # It takes over the time of what it receives: it needs an answer, though nothing it says is accepted yet.
            self._reply_address = address
        elif reason in ("unsigned", "wrong_key"):
            self.problem = "the autopilot " + ("does not sign" if reason == "unsigned" else "signs with another key")

    def _consider(self, message: Any, address: Address, system: int, *, beats: bool, now: int) -> None:
        """Follow an autopilot at another address or with another system id, if it is the vehicle."""
        if self.vehicle is None or (self._address is None and system == self.vehicle):
            if beats:
                self._lock_to(address, system, Evidence())
            return
        key = (address, system)
        candidate = self._candidates.setdefault(key, Evidence())
        candidate.add(message, now)
        if len(self._candidates) > _MAX_SENDERS:
            del self._candidates[min(self._candidates, key=lambda one: self._candidates[one].heard_ns)]
        silent_ns = now - self.last_received_ns
        returned = self._is_first(key, candidate, now)
        if silent_ns <= _SILENT_NS and not returned:
            if beats and not self._fixed:  # another vehicle behind the same router
                text = f"system {system} is on this link too, and is not followed (vehicle in [mavlink] chooses)"
                self._second = (now, text)
            return
        if returned:
            objection = ""
        elif self._fixed and system != self.vehicle:
            objection = "vehicle is set in the configuration"
        elif self._signing is not None:
            objection = "" if beats or system == self.vehicle else "no heartbeat yet"
        elif self._identity.offset_ns is None and system == self.vehicle:
            same_host = self._address is not None and address[0] == self._address[0]
            known = beats and (same_host or silent_ns > _UNKNOWN_SILENT_NS)
            objection = "" if known else "nothing identifies it"
        else:
            objection = self._identity.objection(candidate, now, same_system=system == self.vehicle)
        if objection:
            where = f" at {address[0]}:{address[1]}" if address[0] else ""
            self._conflict = (now, f"system {system}{where} is not followed: {objection}")
            self.counters["refused.identity"] += 1
            return
        self._lock_to(address, system, candidate)
        self.last_received_ns = now
        self.counters["handed_over"] += 1

    def _is_first(self, key: tuple[Address, int], candidate: Evidence, now: int) -> bool:
        """Whether the vehicle is back where it was first: who was followed meanwhile only resembled it."""
        if self._first is None or key != self._first[:2] or key == (self._address, self.vehicle):
            return False
        known = self._first[2]
        return known.offset_ns is None or not known.objection(candidate, now, same_system=True)

    def _lock_to(self, address: Address, system: int, identity: Evidence) -> None:
        if self._first is None or (address, system) == self._first[:2]:
            self._first = (address, system, identity)
        self._address, self.vehicle, self._identity = address, system, identity
        self._candidates.clear()
        self._conflict = self._second = (-_CONFLICT_SHOWN_NS, "")
        self.problem = ""
        self.counters["locked"] += 1

    def _try_open(self) -> None:
        if self._url is None or self._now_ns() < self._next_try_ns:
            return
        try:
            transport = open_transport(self._url)
        except OSError as error:
            with self._lock:
                self._handle_failure(error)
            return
        with self._lock:
            if self._url is None:  # closed meanwhile
                transport.close()
                return
            self._transport, self._bytes_ns = transport, self._now_ns()
            self.counters["opened"] += 1
            self._retry_s, self.problem = _MIN_RETRY_S, ""

    def _handle_failure(self, error: OSError | ValueError) -> None:
        """Close the transport and schedule the next attempt with exponential back-off."""
        if self._transport is not None:
            with suppress(OSError):  # a device that was pulled out
                self._transport.close()
            self._transport = None
        self._framers.clear()
        self._outbox.clear()
        self.problem = str(getattr(error, "strerror", None) or error)
        self.counters["broken"] += 1
        self._next_try_ns = self._now_ns() + round(self._retry_s * NANOSECONDS)
        self._retry_s = min(2.0 * self._retry_s, _MAX_RETRY_S)


def is_autopilot(message: Any, component: int) -> bool:
    """Whether a heartbeat comes from a vehicle's autopilot rather than a station, a camera or a gimbal."""
    flies = message.autopilot != mavlink.MAV_AUTOPILOT_INVALID and message.type not in _NO_VEHICLES
    return component == AUTOPILOT and flies


def _all_finite(message: Any) -> bool:
    for name in _USED.get(message.get_type(), message.get_fieldnames()):
        value = getattr(message, name)
        values = value if isinstance(value, list) else (value,)
        if any(isinstance(part, float) and not math.isfinite(part) for part in values):
            return False
    return True
