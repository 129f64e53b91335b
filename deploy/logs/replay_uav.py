"""A recorded flight straight into the UAV agent's estimator, without camera, link or clock: equal bytes every time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.log.read.reader import Logged, LogReader
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, ROAD_MAP, TARGET, TARGET_CLOUD, TARGET_COMMAND, TELEMETRY, UAV_INFO

if TYPE_CHECKING:
    from edge.uav.estimator import Follower

_INPUTS = (FLIGHT_IMAGE, TELEMETRY, TARGET_COMMAND)
_OUTPUTS = {topic.message: topic for topic in (TARGET, TARGET_CLOUD, ROAD_MAP)}
_AHEAD = 256  # inputs that may be recorded out of order


def replay_through_uav(log: Path, out: Path) -> tuple[int, int]:
    """What a UAV agent publishes when it hears a log, as a log; returns how many messages, and how many inputs lack.

    With none missing it is what the agent said when the log was recorded. Every agent and boot in it is replayed.
    ``out`` is whole or not there. Raises InputError.
    """
    import cv2

    cv2.setNumThreads(1)
    reader = LogReader(log)
    if out.exists():
        raise InputError("exists already", file=out, remedy="choose another --out, or move it away")
    infos = _infos(reader)
    temporary = out.with_name(f".{out.name}.{os.getpid()}")
    followers: dict[tuple[str, str], Follower] = {}
    nexts: dict[tuple[str, str], int] = {}
    count = missing = 0
    try:
        with LogWriter(temporary, {"replay": {"through": "uav"}}) as writer:
            for logged in _in_order(reader):
                message: Any = logged.message
                name = (message.agent, message.boot_id)
                info = infos.get(name)
                if info is None:
                    raise InputError(
                        f"no uav_info of {message.agent}", file=log, remedy="record from the agent's start on"
                    )
                if name not in followers:
                    followers[name] = _follower(info)
                    nexts[name] = 0
                missing += message.order - nexts[name]
                nexts[name] = message.order + 1
                for answer in followers[name].handle(message):
                    topic = _OUTPUTS[answer.DESCRIPTOR.name]
                    writer.write(topic, message.agent, logged.site, answer, logged.log_time_ns)
                    count += 1
            if not followers:
                raise InputError(
                    "no flight in this log", file=log, remedy="record a UAV agent with [images] in its configuration"
                )
        temporary.replace(out)
    finally:
        temporary.unlink(missing_ok=True)
    return count, missing


def _infos(reader: LogReader) -> dict[tuple[str, str], pb.UavInfo]:
    infos: dict[tuple[str, str], pb.UavInfo] = {}
    for logged in reader.messages([UAV_INFO]):
        message = logged.message
        assert isinstance(message, pb.UavInfo)
        infos.setdefault((message.agent, message.boot_id), message)
    return infos


def _follower(info: pb.UavInfo) -> Follower:
    from edge.uav.estimator import Follower

    lens = None
    if info.matrix:
        matrix = np.array(info.matrix).reshape(3, 3)
        distortions = np.array(info.distortions) if info.distortions else np.zeros(5)
        lens = Intrinsics(info.width, info.height, matrix, distortions, info.fisheye)
    mounting = np.array(info.body_from_camera).reshape(3, 3) if info.body_from_camera else None
    return Follower(
        info.agent,
        info.boot_id,
        (info.width, info.height),
        lens,
        mounting,
        fps=info.fps,
        seed=info.seed,
        model=info.model,
    )


def _in_order(reader: LogReader) -> Iterator[Logged]:
    """Inputs in the order in which the agent took them; topics may overtake each other on the bus."""
    waiting: dict[tuple[str, str], dict[int, Logged]] = {}
    nexts: dict[tuple[str, str], int] = {}
    for logged in reader.messages(list(_INPUTS)):
        message: Any = logged.message
        name = (message.agent, message.boot_id)
        held = waiting.setdefault(name, {})
        held[message.order] = logged
        due = nexts.setdefault(name, 0)
        while due in held or len(held) > _AHEAD:
            due = due if due in held else min(held)
            yield held.pop(due)
            due += 1
        nexts[name] = due
    for held in waiting.values():
        for order in sorted(held):
            yield held[order]
