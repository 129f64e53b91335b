"""Telemetry files with their own clock (.tlog, Syncline's .mcap), aligned to a video's clock by its image motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from deploy.offline.track import TelemetryFile
from deploy.offline.track_log import open_recording
from edge.uav.base import Telemetry
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.topics import TELEMETRY

_MAX_ALIGNMENT_FRAMES = 3600  # two minutes at 30 Hz are enough to estimate the offset
_MARGIN_S = 3.0  # duration of samples kept before and after the video


def read_telemetry_log(file: Path) -> TelemetryFile:
    """Read the samples of a .tlog or .mcap, on that file's own clock. Raises InputError."""
    if file.suffix.lower() == ".tlog":
        from edge.mavlink.link.tlog import read_tlog

        log = read_tlog(file)
        return TelemetryFile(log.samples, log.left_out)
    from edge.uav.navigation import rotation_from_quaternion
    from protocols.log.read.reader import LogReader

    found: dict[str, list[Telemetry]] = {}
    left_out = 0
    for logged in LogReader(file).messages([TELEMETRY]):
        message = logged.message
        assert isinstance(message, pb.VehicleTelemetry)
        samples = found.setdefault(f"{message.agent} {message.boot_id}", [])
        turned = rotation_from_quaternion(list(message.ned_from_body))
        time = message.device_time_ns / NANOSECONDS
        if turned is None or (samples and time <= samples[-1].time):
            left_out += 1
            continue
        samples.append(Telemetry(time, turned, np.array(message.position) if message.position else None))
    if not found:
        raise InputError("no telemetry in this log", file=file, remedy="record a UAV agent, or give a telemetry.csv")
    longest = sorted(found.values(), key=len)[-1]
    return TelemetryFile(tuple(longest), left_out)


def align_to_video(
    recorded: TelemetryFile,
    video: Path,
    fps: float | None,
    lens: Intrinsics,
    body_from_camera: Floats,
    progress: Callable[[int], None] | None = None,
) -> tuple[tuple[Telemetry, ...], str]:
    """The samples on the video's clock, 0 = its first frame, and a message for the user.

    No samples if the offset can't be estimated; the message gives the reason. progress: called with each frame's index.
    """
    from edge.uav.timing.telemetry_offset import find_offset
    from edge.uav.timing.visual_rotation import VisualRotationEstimator, median_tilt_rotation

    samples = recorded.samples
    tilt = median_tilt_rotation(samples, body_from_camera)
    recording, _ = open_recording(video, fps, lens)
    try:
        size = (recording.info.width, recording.info.height)
        rotation_estimator = VisualRotationEstimator(size, lens)
        first: float | None = None
        time, index = 0.0, 0
        for index in range(_MAX_ALIGNMENT_FRAMES):
            frame = recording.read(0.0)
            if frame is None:
                break
            moment = frame.device_time_ns / NANOSECONDS
            first = moment if first is None else first
            time = moment - first
            rotation_estimator.update(frame.image, time, tilt)
            if progress is not None:
                progress(index)
    finally:
        recording.close()
    offset = find_offset(rotation_estimator.relative_rotations(), samples, body_from_camera)
    if isinstance(offset, str):
        return (), f"the telemetry is not used, its clock offset against the video's is not observable: {offset}"
    # If the video is longer than the frames used for alignment, all later samples are kept.
    end = float("inf") if index + 1 >= _MAX_ALIGNMENT_FRAMES else offset.offset + time + _MARGIN_S
    shifted = tuple(
        replace(sample, time=sample.time - offset.offset)
        for sample in samples
        if offset.offset - _MARGIN_S <= sample.time <= end
    )
    text = f"telemetry's clock reads {offset.offset:.3f} s (+-{1e3 * offset.std:.0f} ms) at the first frame"
    return shifted, text
