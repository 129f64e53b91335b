"""A recording as the view sees it: a state that can be moved along time."""

from __future__ import annotations

import bisect
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Protocol

import numpy as np
from google.protobuf.message import Message

from hub.live.messages import calibration_message, track_messages
from hub.view.state import ViewState
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration, read_calibration
from protocols.session.trajectory import read_trajectory
from protocols.topics import (
    CALIBRATION,
    CAMERA_INFO,
    FLIGHT_IMAGE,
    OBSERVATION,
    PICTURE,
    ROAD_MAP,
    STATUS,
    TARGET,
    TARGET_CLOUD,
    TRACK,
    UAV_INFO,
)

BEFORE_S = 20.0
"""A jump shows what was seen in the so many seconds before it; what is told once is known from the beginning."""

Timed = tuple[float, Message]
"""Seconds since the recording began, and a message."""


_KEPT = (CAMERA_INFO, CALIBRATION, STATUS, UAV_INFO)
_TOPICS = [*_KEPT, OBSERVATION, TRACK, TARGET]
_DRAWN = [PICTURE, FLIGHT_IMAGE, TARGET_CLOUD, ROAD_MAP]


class Recording(Protocol):
    """What can be played. duration: [s]. still: it holds no frames, only a calibration and paths."""

    duration: float
    still: bool

    def told(self, before: float) -> Iterable[Timed]:
        """What stays valid until it is told anew, of the time before ``before``."""

    def messages(self, start: float) -> Iterator[Timed]:
        """Everything from ``start`` on, in order."""


class LogRecording:
    """A log that Syncline recorded. Raises InputError."""

    still = False

    def __init__(self, path: Path) -> None:
        self._reader = LogReader(path)
        self._kept: list[Timed] = []
        first: int | None = None
        last = 0
        for logged in self._reader.messages(_TOPICS):
            first = logged.log_time_ns if first is None else first
            last = max(last, logged.log_time_ns)
            if logged.topic in _KEPT:
                self._kept.append(((logged.log_time_ns - first) / NANOSECONDS, logged.message))
        if first is None:
            raise InputError("nothing in this log to look at", file=path, remedy="record cameras or a hub")
        self._first = first
        self.duration = (last - first) / NANOSECONDS
        self._kept.sort(key=lambda timed: timed[0])
        self._times = [time for time, _ in self._kept]

    def told(self, before: float) -> Iterable[Timed]:
        """The last word of each camera, hub and agent before that time."""
        last: dict[tuple[str, str], Timed] = {}
        solved: Timed | None = None
        for timed in self._kept[: bisect.bisect_left(self._times, before)]:
            message = timed[1]
            if isinstance(message, pb.Calibration) and message.status == "solved":
                solved = timed
            name = getattr(message, "camera", "") or getattr(message, "agent", "")
            last[message.DESCRIPTOR.name, name] = timed
        # A refusal after a solution does not take the poses away.
        return sorted([*([solved] if solved else []), *last.values()], key=lambda timed: timed[0])

    def messages(self, start: float) -> Iterator[Timed]:
        """Everything from ``start`` on."""
        begin = self._first + round(start * NANOSECONDS)
        for logged in self._reader.messages([*_TOPICS, *_DRAWN], begin):
            yield (logged.log_time_ns - self._first) / NANOSECONDS, logged.message


class CalibrationRecording:
    """The folder that `calibrate` wrote: cameras that stand still, and the path. Raises InputError."""

    still = True

    def __init__(self, folder: Path) -> None:
        file = folder / "calibration.toml" if folder.is_dir() else folder
        rig, cameras = read_calibration(file)
        metadata = rig.metadata
        reference = str(metadata.get("reference") or next(iter(cameras), ""))
        refused = metadata.get("refused")
        calibration = Calibration(
            cameras,
            reference,
            str(metadata.get("scale", "arbitrary")),
            rig.units,
            str(metadata.get("solver", "")),
            str(metadata.get("version", "")),
            {str(name): str(why) for name, why in refused.items()} if isinstance(refused, dict) else {},
        )
        path = file.parent / "trajectory.csv"
        tables = read_trajectory(path) if path.exists() else ()
        self._told: list[Timed] = [(0.0, _info(calibration, name)) for name in cameras]
        self._told.append((0.0, calibration_message(calibration, 1, {})))
        begin = min((float(table.time[0]) for table in tables if len(table.time)), default=0.0)
        timed: list[Timed] = []
        for table in tables:
            for track in track_messages(table, -np.inf, 0):
                timed.append((track.reference_time_ns / NANOSECONDS - begin, track))
        self._tracks = sorted(timed, key=lambda one: one[0])
        self.duration = self._tracks[-1][0] if self._tracks else 0.0

    def told(self, before: float) -> Iterable[Timed]:
        """The calibration."""
        return self._told

    def messages(self, start: float) -> Iterator[Timed]:
        """The path from ``start`` on."""
        return (timed for timed in self._tracks if timed[0] >= start)


class Player:
    """Moves a state along a recording.

    position: where it is [s]; wanted: where a person wants it, None = go on. playing, speed: as the page sets them.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.duration = recording.duration
        self.position = 0.0
        self.wanted: float | None = None
        self.playing = True
        self.speed = 1.0
        self.state = ViewState(recording.still)
        self._next: Timed | None = None
        self._rest: Iterator[Timed] = iter(())
        self.seek(0.0)

    def seek(self, position: float) -> None:
        """Jump: a new state, as it was at ``position`` [s]."""
        self.position = min(max(position, 0.0), self.duration)
        self.state = ViewState(self._recording.still)
        start = max(0.0, self.position - BEFORE_S)
        for moment, message in self._recording.told(start if start > 0.0 else 1e-9):
            self.state.handle(message, moment)
        self._rest = self._recording.messages(start)
        self._next = next(self._rest, None)
        self._feed()

    def advance(self, elapsed: float) -> bool:
        """Go on by ``elapsed`` seconds of a viewer's time; True if the state is a new one, after a jump."""
        wanted, self.wanted = self.wanted, None
        if wanted is not None and abs(wanted - self.position) > 1e-6:
            if 0.0 <= wanted - self.position < 1.0:
                self.position = wanted
                self._feed()
                return False
            self.seek(wanted)
            return True
        if self.playing:
            self.position = min(self.position + elapsed * self.speed, self.duration)
            self._feed()
            self.playing = self.position < self.duration
        return False

    def _feed(self) -> None:
        while self._next is not None and self._next[0] <= self.position:
            self.state.handle(self._next[1], self._next[0])
            self._next = next(self._rest, None)


def _info(calibration: Calibration, name: str) -> pb.CameraInfo:
    lens = calibration.cameras[name].intrinsics
    return pb.CameraInfo(
        schema_version=1,
        camera=name,
        width=lens.width,
        height=lens.height,
        driver="calibration.toml",
        matrix=lens.matrix.ravel().tolist(),
        distortions=lens.distortions.tolist(),
        fisheye=lens.fisheye,
    )
