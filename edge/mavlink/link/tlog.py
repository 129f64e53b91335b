"""Reads a .tlog: MAVLink messages, each after the receiver's time in µs since 1970, big-endian.

The receiver's time says when a message came over the radio, in bursts. What is used is the vehicle's own
time_boot_ms, whose zero is the vehicle's start.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edge.mavlink.dialect import mavlink
from edge.mavlink.link.connection import is_autopilot
from edge.mavlink.roles.telemetry import Attitude, GlobalPosition, LocalPosition, report
from edge.uav.navigation import Origin
from edge.uav.tracker import Telemetry
from protocols.core.errors import InputError
from protocols.geometry.types import Floats

_STAMP = 8
_LONGEST = 280 + 13
_POSITION_GAP_S = 3.0  # between two positions that are still interpolated
_REBOOT_S = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Tlog:
    """samples: of one vehicle and one boot, by its clock [s], strictly increasing. system: the vehicle's.

    left_out: samples that made no sense. unreadable: bytes that belong to no message. boots: how many the log holds.
    """

    samples: tuple[Telemetry, ...]
    system: int
    left_out: int
    unreadable: int
    boots: int


def read_tlog(file: Path) -> Tlog:
    """The attitudes and positions in a .tlog. Raises InputError."""
    try:
        data = file.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", file=file, remedy="check the path") from None
    messages, unreadable = _messages(data)
    if not messages:
        raise InputError("holds no MAVLink message", file=file, remedy="give a .tlog as ground stations write it")
    kinds = ("ATTITUDE", "ATTITUDE_QUATERNION")
    told = Counter(m.get_srcSystem() for m in messages if m.get_type() in kinds)
    beats = [m for m in messages if m.get_type() == "HEARTBEAT"]
    pilots = {m.get_srcSystem() for m in beats if is_autopilot(m, m.get_srcComponent())}
    vehicles = {system: count for system, count in told.items() if not pilots or system in pilots}
    if not vehicles:
        raise InputError("no attitude in this log", file=file, remedy="record ATTITUDE at 20 Hz or more")
    system = max(vehicles, key=lambda name: vehicles[name])
    # The quaternion is the finer one; both together would be two samplings of one thing.
    quaternion = any(m.get_type() == kinds[1] and m.get_srcSystem() == system for m in messages)
    return _samples([m for m in messages if m.get_srcSystem() == system], kinds[quaternion], system, unreadable, file)


def _messages(data: bytes) -> tuple[list[Any], int]:
    """All whole messages of the autopilots' kinds, and the bytes that are none."""
    codec: Any = mavlink.MAVLink(None)
    wanted = {"HEARTBEAT", "ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"}
    out: list[Any] = []
    at = unreadable = 0
    while at + _STAMP + 8 <= len(data):
        place = at + _STAMP
        marker = data[place]
        if marker not in (0xFE, 0xFD):
            at, unreadable = at + 1, unreadable + 1
            continue
        length = 8 + data[place + 1] if marker == 0xFE else 12 + data[place + 1] + (13 if data[place + 2] & 1 else 0)
        frame = data[place : place + length]
        end = place + length
        try:
            message = codec.decode(bytearray(frame)) if len(frame) == length else None
        except mavlink.MAVError:
            message = None
        follows = end + _STAMP >= len(data) or data[end + _STAMP] in (0xFE, 0xFD)
        if message is None or (isinstance(message, mavlink.MAVLink_unknown) and not follows):
            at, unreadable = at + 1, unreadable + 1
            continue
        if message.get_type() in wanted:
            out.append(message)
        at = end
    return out, unreadable


def _samples(messages: list[Any], kind: str, system: int, unreadable: int, file: Path) -> Tlog:
    """Attitudes with the positions between which they lie; of the boot that has most of them."""
    boots: list[tuple[list[Attitude], list[tuple[float, Floats]]]] = [([], [])]
    local = any(m.get_type() == "LOCAL_POSITION_NED" for m in messages)
    origin: Origin | None = None
    newest, left_out = -1.0, 0
    for message in messages:
        told = report(message)
        if told is None or (isinstance(told, Attitude) and message.get_type() != kind):
            continue
        if told.boot_s < newest - _REBOOT_S:
            boots.append(([], []))
            newest = -1.0
        newest = max(newest, told.boot_s)
        attitudes, positions = boots[-1]
        if isinstance(told, Attitude):
            if np.isfinite(told.ned_from_body).all() and (not attitudes or told.boot_s > attitudes[-1].boot_s):
                attitudes.append(told)
            else:
                left_out += 1
        elif isinstance(told, LocalPosition) and np.isfinite(told.position).all():
            positions.append((told.boot_s, told.position))
        elif isinstance(told, GlobalPosition) and not local:
            if origin is None:  # where home is at height 0
                origin = Origin(told.latitude, told.longitude, told.altitude - told.relative_altitude)
            positions.append((told.boot_s, origin.local(told.latitude, told.longitude, told.altitude)))
    attitudes, positions = max(boots, key=lambda boot: len(boot[0]))
    if len(attitudes) < 2:
        raise InputError("no usable attitude in this log", file=file, remedy="record ATTITUDE at 20 Hz or more")
    places = _at(positions, np.array([attitude.boot_s for attitude in attitudes]))
    samples = tuple(
        Telemetry(attitude.boot_s, attitude.ned_from_body, None if np.isnan(place).any() else place)
        for attitude, place in zip(attitudes, places, strict=True)
    )
    return Tlog(samples, system, left_out, unreadable, len(boots))


def _at(positions: list[tuple[float, Floats]], times: Floats) -> Floats:
    """Positions (n, 3) at ``times`` (n,); NaN where none are near."""
    out = np.full((len(times), 3), np.nan)
    ordered = sorted(positions, key=lambda entry: entry[0])
    if len(ordered) < 2:
        return out
    known = np.array([moment for moment, _ in ordered])
    table = np.array([place for _, place in ordered])
    index = np.clip(np.searchsorted(known, times) - 1, 0, len(known) - 2)
    near = (known[index + 1] - known[index] <= _POSITION_GAP_S) & (times >= known[0] - 0.5) & (times <= known[-1] + 0.5)
    for axis in range(3):
        out[near, axis] = np.interp(times[near], known, table[:, axis])
    return out
