"""Deterministic replay of a log through the hub's estimator, without bus, processes or wall clock."""

from __future__ import annotations

import os
from pathlib import Path

from hub.live.live_hub import KnownCalibration, LiveHub, LiveSettings
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.log.read.reader import LogReader
from protocols.log.write.writer import LogWriter
from protocols.session.calibration import read_calibration
from protocols.topics import CALIBRATION, CAMERA_INFO, OBSERVATION, PREDICTION, RIG_INFO, TRACK

_TOPICS = {topic.message: topic for topic in (CALIBRATION, TRACK, PREDICTION)}


def replay_through_hub(
    log: Path,
    out: Path,
    settings: LiveSettings | None = None,
    agent: str = "hub",
    calibration: Path | None = None,
) -> int:
    """Write the messages that a hub publishes for the input of a log to a new log; returns their number.

    calibration: a calibration.toml to track with instead of calibrating. The hub runs on log time, so it solves after
    the same messages on every machine and the output is identical. ``out`` is written atomically. Raises InputError.
    """
    reader = LogReader(log)
    if out.exists():
        raise InputError("exists already", file=out, remedy="choose another --out, or move it away")
    temporary = out.with_name(f".{out.name}.{os.getpid()}")
    known = None if calibration is None else KnownCalibration(*read_calibration(calibration))
    hub = LiveHub(settings, known=known)
    count, first_ns, now_ns, site = 0, None, 0, ""
    try:
        with LogWriter(temporary, {"replay": {"through": "hub"}}) as writer:

            def publish(final: bool = False) -> int:
                published = hub.tick((now_ns - (first_ns or 0)) / NANOSECONDS, final=final)
                for message in published:
                    writer.write(_TOPICS[message.DESCRIPTOR.name], agent, site, message, now_ns)
                return len(published)

            for logged in reader.messages([OBSERVATION, CAMERA_INFO, RIG_INFO]):
                first_ns = logged.log_time_ns if first_ns is None else first_ns
                now_ns, site = max(now_ns, logged.log_time_ns), logged.site
                hub.handle(logged.message)
                count += publish()
            if first_ns is None:
                raise InputError("no observation in this log", file=log, remedy="record cameras that see the marker")
            count += publish(final=True)
        temporary.replace(out)
    finally:
        temporary.unlink(missing_ok=True)
    return count
