"""A recorded log as a session: its cameras and what they saw."""

from __future__ import annotations

from pathlib import Path

from protocols.core.errors import InputError, Refused
from protocols.log.read.reader import LogReader
from protocols.session.builder import SessionBuilder
from protocols.session.observations import Observations
from protocols.session.rig import Rig
from protocols.topics import CAMERA_INFO, OBSERVATION, RIG_INFO


def session_from_log(file: Path) -> tuple[Rig, Observations, tuple[str, ...]]:
    """The rig and the observations of a log, and warnings (a damaged end). Raises InputError, Refused."""
    builder = SessionBuilder()
    reader = LogReader(file)
    for logged in reader.messages([OBSERVATION, CAMERA_INFO, RIG_INFO]):
        builder.handle(logged.message)
    try:
        rig, observations = builder.build()
    except Refused as refusal:
        raise InputError(
            f"no session in this log: {refusal.reason}", file=file, remedy="record cameras that see the marker"
        ) from None
    damage = (f"the log is damaged: {reader.damage}",) if reader.damage else ()
    return rig, observations, damage + builder.warnings
