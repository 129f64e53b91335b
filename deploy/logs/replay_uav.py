"""Deterministic replay of a recorded flight through the UAV agent's estimator, without camera, link or wall clock."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from protocols.core.errors import InputError
from protocols.core.files import completed_file
from protocols.geometry.camera import Intrinsics
from protocols.log.read.reader import LogMessage, LogReader
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, ROAD_MAP, TARGET, TARGET_CLOUD, TARGET_COMMAND, TELEMETRY, UAV_INFO

if TYPE_CHECKING:
    from edge.uav.estimator import TargetEstimator

_INPUTS = (FLIGHT_IMAGE, TELEMETRY, TARGET_COMMAND)
_OUTPUTS = {topic.message: topic for topic in (TARGET, TARGET_CLOUD, ROAD_MAP)}
_MAX_REORDERED = 256  # inputs that may be recorded out of order


def replay_through_uav(log: Path, out: Path) -> tuple[int, int]:
    """Write the messages that a UAV agent publishes for the input of a log to a new log.

    Returns the number of messages and of missing inputs; with none missing, the output equals what the agent published
    during the recording. Every agent and boot in the log is replayed. ``out`` is written atomically. Raises InputError.
    """
    import cv2

    cv2.setNumThreads(1)
    reader = LogReader(log)
    infos = _infos(reader)
    estimators: dict[tuple[str, str], TargetEstimator] = {}
    next_order: dict[tuple[str, str], int] = {}
    count = missing = 0
    with completed_file(out, new=True) as temporary, LogWriter(temporary, {"replay": {"through": "uav"}}) as writer:
        for logged in _in_order(reader):
            message: Any = logged.message
            name = (message.agent, message.boot_id)
            info = infos.get(name)
            if info is None:
                raise InputError(f"no uav_info of {message.agent}", file=log, remedy="record from the agent's start on")
            if name not in estimators:
                estimators[name] = _estimator(info)
                next_order[name] = 0
            missing += message.order - next_order[name]
            next_order[name] = message.order + 1
            for output in estimators[name].handle(message):
                topic = _OUTPUTS[output.DESCRIPTOR.name]
                writer.write(topic, message.agent, logged.site, output, logged.log_time_ns)
                count += 1
        if not estimators:
            raise InputError(
                "no flight in this log", file=log, remedy="record a UAV agent with [images] in its configuration"
            )
    return count, missing


def _infos(reader: LogReader) -> dict[tuple[str, str], pb.UavInfo]:
    infos: dict[tuple[str, str], pb.UavInfo] = {}
    for logged in reader.messages([UAV_INFO]):
        message = logged.message
        assert isinstance(message, pb.UavInfo)
        infos.setdefault((message.agent, message.boot_id), message)
    return infos


def _estimator(info: pb.UavInfo) -> TargetEstimator:
    from edge.uav.estimator import TargetEstimator

    lens = Intrinsics.of_message(info)
    mounting = np.array(info.body_from_camera).reshape(3, 3) if info.body_from_camera else None
    return TargetEstimator(
        info.agent,
        info.boot_id,
        (info.width, info.height),
        lens,
        mounting,
        fps=info.fps,
        seed=info.seed,
        model=info.model,
    )


def _in_order(reader: LogReader) -> Iterator[LogMessage]:
    """Inputs in the order in which the agent processed them; the bus may reorder messages of different topics."""
    waiting: dict[tuple[str, str], dict[int, LogMessage]] = {}
    next_order: dict[tuple[str, str], int] = {}
    for logged in reader.messages(list(_INPUTS)):
        message: Any = logged.message
        name = (message.agent, message.boot_id)
        held = waiting.setdefault(name, {})
        held[message.order] = logged
        due = next_order.setdefault(name, 0)
        while due in held or len(held) > _MAX_REORDERED:
            due = due if due in held else min(held)
            yield held.pop(due)
            due += 1
        next_order[name] = due
    for held in waiting.values():
        for order in sorted(held):
            yield held[order]
