"""Deterministic replay of a log through the hub's estimator, without bus, processes or wall clock."""

from __future__ import annotations

from pathlib import Path

from hub.calibration.resection.unconnected import listed
from hub.live.live_hub import KnownCalibration, LiveHub, LiveSettings
from hub.live.scheduled_hub import ScheduledHub
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.core.files import completed_file
from protocols.log.read.reader import LogReader
from protocols.log.write.writer import LogWriter
from protocols.session.calibration import read_calibration
from protocols.topics import (
    CALIBRATION,
    CAMERA_INFO,
    OBSERVATION,
    PREDICTION,
    RIG_INFO,
    SOLVER_EVENT,
    TRACK,
    TRACK_SMOOTHED,
)

_TOPICS = {topic.message: topic for topic in (CALIBRATION, TRACK, PREDICTION, SOLVER_EVENT)}
_INPUTS = [OBSERVATION, CAMERA_INFO, RIG_INFO]


def replay_through_hub(
    log: Path, out: Path, settings: LiveSettings | None = None, calibration: Path | None = None
) -> int:
    """Write the messages that a hub publishes for the input of a log to a new log; returns their number.

    calibration: a calibration.toml to track with instead of calibrating. Where the log holds what a hub's solver was
    given and when its answers took effect, these answers are repeated bit for bit; otherwise the hub solves on log
    time, after the same messages on every machine. ``out`` is written atomically. Raises InputError.
    """
    reader = LogReader(log)
    known = None if calibration is None else KnownCalibration(*read_calibration(calibration))
    recorded = next(reader.messages([SOLVER_EVENT]), None) if known is None and settings is None else None
    hub = ScheduledHub() if recorded is not None else LiveHub(settings, known=known)
    count, first_ns, now_ns, site = 0, None, 0, ""
    with completed_file(out, new=True) as temporary, LogWriter(temporary, {"replay": {"through": "hub"}}) as writer:
        if next(reader.messages([OBSERVATION]), None) is None:
            raise InputError("no observation in this log", file=log, remedy="record cameras that see what moves")

        def publish(final: bool = False) -> int:
            published = hub.tick((now_ns - (first_ns or 0)) / NANOSECONDS, final=final)
            for message in published:
                writer.write(_TOPICS[message.DESCRIPTOR.name], "hub", site, message, now_ns)
            smoothed = [] if hub.tracking is None else hub.tracking.smoothed()
            for track in smoothed:
                writer.write(TRACK_SMOOTHED, "hub", site, track, now_ns)
            return len(published) + len(smoothed)

        for logged in reader.messages(_INPUTS if recorded is None else [*_INPUTS, SOLVER_EVENT]):
            if logged.topic is SOLVER_EVENT and recorded is not None and logged.agent != recorded.agent:
                continue  # of another hub
            first_ns = logged.log_time_ns if first_ns is None else first_ns
            now_ns, site = max(now_ns, logged.log_time_ns), logged.site
            hub.handle(logged.message)
            count += publish()
        if known is not None and calibration is not None and not known.cameras.keys() & hub.links.last_frame.keys():
            heard = f"none of its cameras is in the log, which has {listed(sorted(hub.links.last_frame))}"
            raise InputError(heard, file=calibration, remedy="give the calibration of the log's cameras")
        count += publish(final=True)
    return count
