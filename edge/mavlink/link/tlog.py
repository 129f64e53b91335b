"""Reading of .tlog telemetry logs: MAVLink messages, each preceded by the receiver's time in µs since 1970, big-endian.

The receiver's time is that of arrival over the radio, in bursts. The samples use the vehicle's own time_boot_ms,
whose zero is the vehicle's boot.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edge.mavlink.dialect import AUTOPILOT, mavlink
from edge.mavlink.link.connection import is_autopilot
from edge.mavlink.link.framing import V1, V2, frame_length
from edge.mavlink.roles.telemetry import Attitude, GlobalPosition, LocalFrame, LocalPosition, parse_telemetry
from edge.uav.base import Telemetry
from edge.uav.navigation import interpolate_positions
from protocols.core.errors import InputError
from protocols.core.files import read_bytes
from protocols.geometry.types import Floats

_STAMP = 8  # bytes: Unix time in µs before each frame
_REBOOT_S = 1.0  # by which a boot time goes back: less is reordering
_LATE_S = 5.0  # after which what is older than that is of another boot, and not of a second, slower link
_LATE_MESSAGES = 1000  # the same, at 200 messages a second: of a backlog that comes at once


@dataclass(frozen=True, slots=True)
class _Stamped:
    """A message, the receiver's time [s], and the vehicle's [s] where the message has one, else NaN."""

    message: Any
    received_s: float
    boot_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Tlog:
    """Telemetry of one vehicle's autopilot and one boot, by its clock [s], strictly increasing.

    system: the vehicle's id. left_out: invalid samples. unreadable: bytes of the file that belong to no message.
    """

    samples: tuple[Telemetry, ...]
    system: int
    left_out: int
    unreadable: int


def read_tlog(file: Path) -> list[Tlog]:
    """Read the attitudes and positions of a .tlog, by vehicle and boot, those with the most attitudes first.

    Raises InputError.
    """
    stamped, unreadable = _messages(read_bytes(file, "MAVLink log"))
    if not stamped:
        raise InputError("holds no MAVLink message", file=file, remedy="give a .tlog as ground stations write it")
    systems: dict[int, list[_Stamped]] = {}
    for one in stamped:
        systems.setdefault(one.message.get_srcSystem(), []).append(one)
    heartbeats = [one.message for one in stamped if one.message.get_type() == "HEARTBEAT"]
    autopilots = {beat.get_srcSystem() for beat in heartbeats if is_autopilot(beat, beat.get_srcComponent())}
    found = [
        log
        for system, messages in systems.items()
        if system in autopilots or not autopilots
        for log in _logs(messages, system, unreadable)
    ]
    if not found:
        raise InputError("no usable attitude in this log", file=file, remedy="record ATTITUDE at 20 Hz or more")
    return sorted(found, key=lambda log: -len(log.samples))


def _messages(data: bytes) -> tuple[list[_Stamped], int]:
    """All valid messages of autopilots of the wanted types, and the number of bytes that belong to no message."""
    codec: Any = mavlink.MAVLink(None)
    wanted = {"HEARTBEAT", "ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"}
    out: list[_Stamped] = []
    at = unreadable = 0
    while at + _STAMP + 8 <= len(data):
        position = at + _STAMP
        length = frame_length(data[position : position + 3])
        if data[position] not in (V1, V2) or length is None:
            at, unreadable = at + 1, unreadable + 1
            continue
        frame = data[position : position + length]
        end = position + length
        try:
            message = codec.decode(bytearray(frame)) if len(frame) == length else None
        except mavlink.MAVError:
            message = None
        follows = end + _STAMP >= len(data) or data[end + _STAMP] in (V1, V2)
        if message is None or (isinstance(message, mavlink.MAVLink_unknown) and not follows):
            at, unreadable = at + 1, unreadable + 1
            continue
        if message.get_type() in wanted and message.get_srcComponent() == AUTOPILOT:
            received_s = 1e-6 * int.from_bytes(data[at:position], "big")
            out.append(_Stamped(message, received_s, 1e-3 * getattr(message, "time_boot_ms", math.nan)))
        at = end
    return out, unreadable


def _logs(stamped: list[_Stamped], system: int, unreadable: int) -> list[Tlog]:
    """A vehicle's telemetry, by boot."""
    # Of two kinds that say the same, the more frequent: both would duplicate it. A station asks for one now and then.
    counts = Counter(one.message.get_type() for one in stamped)
    kind = max("ATTITUDE_QUATERNION", "ATTITUDE", key=lambda name: counts[name])
    local = counts["LOCAL_POSITION_NED"] >= counts["GLOBAL_POSITION_INT"]
    out = []
    for boot in _boots(stamped):
        samples, left_out = _samples(boot, kind, local)
        if len(samples) >= 2:
            out.append(Tlog(samples, system, left_out, unreadable))
    return out


def _boots(stamped: list[_Stamped]) -> list[list[tuple[float, Any]]]:
    """A vehicle's messages with its time [s], by boot, in the order of that time; each once, as of several links."""
    boots: list[dict[tuple[float, str], Any]] = [{}]
    newest = -1.0
    for k, one in enumerate(stamped):
        key = one.boot_s if math.isfinite(one.boot_s) else newest, one.message.get_type()
        if key[0] < newest - _REBOOT_S and key not in boots[-1] and not _goes_on(stamped, k, newest):
            boots.append({})
            newest = -1.0
        newest = max(newest, key[0])
        boots[-1].setdefault(key, one.message)
    return [[(time, boot[time, kind]) for time, kind in sorted(boot)] for boot in boots]


def _goes_on(stamped: list[_Stamped], k: int, newest: float) -> bool:
    """Whether what is later than ``newest`` [s] comes soon after message k; not known of a log without stamps."""
    if stamped[0].received_s == stamped[-1].received_s:
        return False
    for j in range(k, min(k + _LATE_MESSAGES, len(stamped))):
        if stamped[j].boot_s > newest or stamped[j].received_s > stamped[k].received_s + _LATE_S:
            return stamped[j].boot_s > newest
    return False


def _samples(boot: list[tuple[float, Any]], kind: str, local: bool) -> tuple[tuple[Telemetry, ...], int]:
    """The attitudes of one kind, by time, with interpolated positions; the number of those left out."""
    attitudes: list[Attitude] = []
    positions: list[tuple[float, Floats]] = []
    frame, left_out = LocalFrame(), 0
    for time, message in boot:
        if message.get_type() == "HEARTBEAT":
            frame.set_armed(bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED), time)
        telemetry = parse_telemetry(message)
        if isinstance(telemetry, Attitude) and message.get_type() == kind:
            finite = bool(np.isfinite(telemetry.ned_from_body).all())
            left_out += not finite
            attitudes += [telemetry] * finite
        elif isinstance(telemetry, LocalPosition | GlobalPosition):
            if isinstance(telemetry, GlobalPosition):
                frame.take_global(telemetry, time)
            elif local and np.isfinite(telemetry.position).all():
                frame.take_local(telemetry, time)
            if frame.position is not None and isinstance(telemetry, LocalPosition) == local:
                positions.append((time, frame.position[1]))
    places, stds = interpolate_positions(positions, np.array([attitude.boot_s for attitude in attitudes]))
    samples = tuple(
        Telemetry(attitude.boot_s, attitude.ned_from_body, None if np.isnan(place).any() else place, float(std))
        for attitude, place, std in zip(attitudes, places, stds, strict=True)
    )
    return samples, left_out
