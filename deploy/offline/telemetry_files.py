"""Telemetry files with a clock of their own (.tlog, Syncline's .mcap), brought onto a video's clock by its pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from deploy.offline.track import TelemetryFile
from deploy.offline.track_log import open_pictures
from edge.uav.tracker import Telemetry
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.topics import TELEMETRY

SUFFIXES = (".tlog", ".mcap")
_LOOKED_AT = 3600  # frames: two minutes are enough to find the offset
_AROUND_S = 3.0  # of samples kept before and after the video


def read_own_clock(file: Path) -> TelemetryFile:
    """The samples of a .tlog or .mcap, on that file's own clock. Raises InputError."""
    if file.suffix.lower() == ".tlog":
        from edge.mavlink.link.tlog import read_tlog

        log = read_tlog(file)
        return TelemetryFile(log.samples, log.left_out)
    from edge.uav.navigation import from_quaternion
    from protocols.log.read.reader import LogReader

    found: dict[str, list[Telemetry]] = {}
    left_out = 0
    for logged in LogReader(file).messages([TELEMETRY]):
        message = logged.message
        assert isinstance(message, pb.VehicleTelemetry)
        samples = found.setdefault(f"{message.agent} {message.boot_id}", [])
        turned = from_quaternion(list(message.ned_from_body))
        time = message.device_time_ns / NANOSECONDS
        if turned is None or (samples and time <= samples[-1].time):
            left_out += 1
            continue
        samples.append(Telemetry(time, turned, np.array(message.position) if message.position else None))
    if not found:
        raise InputError("no telemetry in this log", file=file, remedy="record a UAV agent, or give a telemetry.csv")
    longest = sorted(found.values(), key=len)[-1]
    return TelemetryFile(tuple(longest), left_out)


def onto_video(
    told: TelemetryFile,
    video: Path,
    fps: float | None,
    lens: Intrinsics,
    body_from_camera: Floats,
    tell: Callable[[int], None] | None = None,
) -> tuple[tuple[Telemetry, ...], str]:
    """The samples on the video's clock, 0 = its first frame, and a line for the user.

    No samples where the offset can't be told; then the line says why. tell: called with the index of each frame.
    """
    from edge.uav.timing.telemetry_offset import find_offset
    from edge.uav.timing.visual_rotation import SeenTurning, usual_tilt

    samples = told.samples
    tilt = usual_tilt(samples, body_from_camera)
    recording, _ = open_pictures(video, fps, lens)
    try:
        size = (recording.info.width, recording.info.height)
        seen = SeenTurning(size, lens)
        first: float | None = None
        time, index = 0.0, 0
        for index in range(_LOOKED_AT):
            frame = recording.read(0.0)
            if frame is None:
                break
            moment = frame.device_time_ns / NANOSECONDS
            first = moment if first is None else first
            time = moment - first
            seen.update(frame.image, time, tilt)
            if tell is not None:
                tell(index)
    finally:
        recording.close()
    answer = find_offset(seen.turning(), samples, body_from_camera)
    if isinstance(answer, str):
        return (), f"the telemetry is not used, its clock against the video's can't be told: {answer}"
    # A longer video than was looked at goes on with the rest of the samples.
    end = float("inf") if index + 1 >= _LOOKED_AT else answer.offset + time + _AROUND_S
    shifted = tuple(
        replace(sample, time=sample.time - answer.offset)
        for sample in samples
        if answer.offset - _AROUND_S <= sample.time <= end
    )
    text = f"telemetry's clock reads {answer.offset:.3f} s (+-{1e3 * answer.std:.0f} ms) at the first frame"
    return shifted, text
