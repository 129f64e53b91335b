"""Reading of .tlog telemetry logs: MAVLink messages, each preceded by the receiver's time in µs since 1970, big-endian.

The receiver's time is that of arrival over the radio, in bursts. The samples use the vehicle's own time_boot_ms,
whose zero is the vehicle's boot.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edge.mavlink.dialect import AUTOPILOT, mavlink
from edge.mavlink.link.connection import is_autopilot
from edge.mavlink.link.framing import V1, V2, frame_length
from edge.mavlink.roles.local_frame import LocalFrame
from edge.mavlink.roles.telemetry import Attitude, GlobalPosition, LocalPosition, parse_telemetry
from edge.uav.base import Telemetry
from edge.uav.navigation import interpolate_positions
from protocols.core.errors import InputError
from protocols.core.files import read_bytes
from protocols.geometry.types import Floats

_STAMP = 8  # bytes: Unix time in µs before each frame
_REBOOT_S = 1.0  # by which a boot time goes back: less is reordering


@dataclass(frozen=True, slots=True, eq=False)
class Tlog:
    """Telemetry from a .tlog. samples: of one vehicle's autopilot and one boot, by its clock [s], strictly increasing.

    system: the vehicle's id. left_out: invalid or out-of-order samples. unreadable: bytes that belong to no message.
    boots: number of boots in the log.
    """

    samples: tuple[Telemetry, ...]
    system: int
    left_out: int
    unreadable: int
    boots: int


def read_tlog(file: Path) -> Tlog:
    """Read the attitudes and positions of a .tlog. Raises InputError."""
    messages, unreadable = _messages(read_bytes(file, "MAVLink log"))
    if not messages:
        raise InputError("holds no MAVLink message", file=file, remedy="give a .tlog as ground stations write it")
    kinds = ("ATTITUDE", "ATTITUDE_QUATERNION")
    attitude_counts = Counter(m.get_srcSystem() for m in messages if m.get_type() in kinds)
    heartbeats = [m for m in messages if m.get_type() == "HEARTBEAT"]
    autopilots = {m.get_srcSystem() for m in heartbeats if is_autopilot(m, m.get_srcComponent())}
    vehicles = {system: count for system, count in attitude_counts.items() if not autopilots or system in autopilots}
    if not vehicles:
        raise InputError("no attitude in this log", file=file, remedy="record ATTITUDE at 20 Hz or more")
    system = max(vehicles, key=lambda name: vehicles[name])
    return _samples([m for m in messages if m.get_srcSystem() == system], system, unreadable, file)


def _messages(data: bytes) -> tuple[list[Any], int]:
    """All valid messages of autopilots of the wanted types, and the number of bytes that belong to no message."""
    codec: Any = mavlink.MAVLink(None)
    wanted = {"HEARTBEAT", "ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"}
    out: list[Any] = []
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
            out.append(message)
        at = end
    return out, unreadable


def _samples(messages: list[Any], system: int, unreadable: int, file: Path) -> Tlog:
    """Attitudes with interpolated positions, of the boot with the most attitudes."""
    boots: list[tuple[list[Attitude], list[tuple[float, Floats]]]] = [([], [])]
    # Of two kinds that say the same, the more frequent: both would duplicate it. A station asks for one now and then.
    counts = Counter(message.get_type() for message in messages)
    kind = max("ATTITUDE_QUATERNION", "ATTITUDE", key=lambda name: counts[name])
    local = counts["LOCAL_POSITION_NED"] >= counts["GLOBAL_POSITION_INT"]
    frame = LocalFrame()
    newest, left_out = -1.0, 0
    for message in messages:
        if message.get_type() == "HEARTBEAT":
            frame.set_armed(bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED), newest)
        telemetry = parse_telemetry(message)
        if telemetry is None or (isinstance(telemetry, Attitude) and message.get_type() != kind):
            continue
        if telemetry.boot_s < newest - _REBOOT_S:
            boots.append(([], []))
            frame, newest = LocalFrame(), -1.0
        newest = max(newest, telemetry.boot_s)
        attitudes, positions = boots[-1]
        if isinstance(telemetry, Attitude):
            if np.isfinite(telemetry.ned_from_body).all() and (
                not attitudes or telemetry.boot_s > attitudes[-1].boot_s
            ):
                attitudes.append(telemetry)
            else:
                left_out += 1
        elif isinstance(telemetry, LocalPosition | GlobalPosition):
            if isinstance(telemetry, GlobalPosition):
                frame.take_global(telemetry, telemetry.boot_s)
            elif local and np.isfinite(telemetry.position).all():
                frame.take_local(telemetry, telemetry.boot_s)
            if frame.position is not None and isinstance(telemetry, LocalPosition) == local:
                positions.append((telemetry.boot_s, frame.position[1]))
    attitudes, positions = max(boots, key=lambda boot: len(boot[0]))
    if len(attitudes) < 2:
        raise InputError("no usable attitude in this log", file=file, remedy="record ATTITUDE at 20 Hz or more")
    positions_at = interpolate_positions(positions, np.array([attitude.boot_s for attitude in attitudes]))
    samples = tuple(
        Telemetry(attitude.boot_s, attitude.ned_from_body, None if np.isnan(position).any() else position)
        for attitude, position in zip(attitudes, positions_at, strict=True)
    )
    return Tlog(samples, system, left_out, unreadable, len(boots))
