"""Playback of recordings for the view: logs and calibration folders, with play, pause and seek."""

from __future__ import annotations

import bisect
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Protocol

import numpy as np
from google.protobuf.message import Message

from hub.live.messages import calibration_message, track_messages
from hub.view.lag_history import LAG_WINDOW_S
from hub.view.state import LATCHED, ON_IMAGES, TOPICS, ViewState
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration, read_calibration, read_trajectory, stated_calibration
from protocols.topics import FLIGHT_IMAGE, PICTURE
from protocols.validation.rules import SCHEMA_VERSION

CONTEXT_S = 20.0
"""After a seek, messages of this many seconds before are replayed; latched messages are known from the beginning."""

Timed = tuple[float, Message]
"""Seconds since the start of the recording, and a message."""


class Recording(Protocol):
    """A recording that can be played. duration: [s]. is_static: it holds only a calibration and trajectories."""

    duration: float
    is_static: bool

    def latched_messages(self, before: float) -> Iterable[Timed]:
        """The latched messages (valid until replaced) that are current at time ``before`` [s]."""

    def messages(self, start: float) -> Iterator[Timed]:
        """All messages from ``start`` [s] on, in order."""


class LogRecording:
    """A log that Syncline recorded. damage: what is wrong with it, or "". Raises InputError."""

    is_static = False

    def __init__(self, path: Path) -> None:
        self._reader = LogReader(path)
        self._latched: list[Timed] = []
        first: int | None = None
        last = 0
        for logged in self._reader.messages(TOPICS):
            first = logged.log_time_ns if first is None else first
            last = max(last, logged.log_time_ns)
            if logged.topic in LATCHED:
                self._latched.append(((logged.log_time_ns - first) / NANOSECONDS, logged.message))
        if first is None:
            raise InputError("this log holds nothing to show", file=path, remedy="record cameras or a hub")
        self._first = first
        self.damage = self._reader.damage
        self.duration = (last - first) / NANOSECONDS
        self._latched.sort(key=lambda timed: timed[0])
        self._times = [time for time, _ in self._latched]

    def latched_messages(self, before: float) -> Iterable[Timed]:
        """The last message of each camera, hub and agent before that time; solutions of the lag chart's window."""
        last: dict[tuple[str, str], Timed] = {}
        solved: list[Timed] = []
        for timed in self._latched[: bisect.bisect_left(self._times, before)]:
            message = timed[1]
            if isinstance(message, pb.Calibration) and message.status == "solved":
                solved.append(timed)
            name = getattr(message, "camera", "") or getattr(message, "agent", "")
            last[message.DESCRIPTOR.name, name] = timed
        # A refusal after a solution does not remove the poses, and the lag chart shows differences to the first one.
        recent = [timed for timed in solved[1:-1] if timed[0] > before - LAG_WINDOW_S]
        return sorted([*solved[:1], *recent, *solved[-1:], *last.values()], key=lambda timed: timed[0])

    def messages(self, start: float) -> Iterator[Timed]:
        begin = self._first + round(start * NANOSECONDS)
        for logged in self._reader.messages([*TOPICS, *ON_IMAGES, PICTURE, FLIGHT_IMAGE], begin):
            yield (logged.log_time_ns - self._first) / NANOSECONDS, logged.message


class CalibrationRecording:
    """The folder that `calibrate` wrote: static cameras and the trajectory. Raises InputError."""

    is_static = True

    def __init__(self, folder: Path) -> None:
        file = folder / "calibration.toml" if folder.is_dir() else folder
        rig, cameras = read_calibration(file)
        calibration = stated_calibration(rig, cameras)
        path = file.parent / "trajectory.csv"
        tables = read_trajectory(path) if path.exists() else ()
        self._messages: list[Timed] = [(0.0, _info(calibration, name)) for name in cameras]
        self._messages.append((0.0, calibration_message(calibration, 1, {})))
        begin = min((float(table.time[0]) for table in tables if len(table.time)), default=0.0)
        timed: list[Timed] = []
        for table in tables:
            for track in track_messages(table, -np.inf, 0):
                timed.append((track.reference_time_ns / NANOSECONDS - begin, track))
        self._tracks = sorted(timed, key=lambda one: one[0])
        self.duration = self._tracks[-1][0] if self._tracks else 0.0

    def latched_messages(self, before: float) -> Iterable[Timed]:
        """The calibration."""
        return self._messages

    def messages(self, start: float) -> Iterator[Timed]:
        """The trajectory from ``start`` [s] on."""
        return (timed for timed in self._tracks if timed[0] >= start)


class Player:
    """Plays a recording into a view state.

    position: playback time [s]; seek_to: requested time [s], None = continue. playing, speed: set by the page.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.duration = recording.duration
        self.position = 0.0
        self.seek_to: float | None = None
        self.playing = True
        self.speed = 1.0
        self.state = ViewState(recording.is_static, is_live=False)
        self._next: Timed | None = None
        self._rest: Iterator[Timed] = iter(())
        self.seek(0.0)

    def seek(self, position: float) -> None:
        """Seek: a new state, as it was at ``position`` [s]."""
        self.position = min(max(position, 0.0), self.duration)
        self.state = ViewState(self._recording.is_static, is_live=False)
        start = max(0.0, self.position - CONTEXT_S)
        for moment, message in self._recording.latched_messages(start if start > 0.0 else 1e-9):
            self.state.handle(message, moment)
        self._rest = self._recording.messages(start)
        self._next = next(self._rest, None)
        self._feed()

    def advance(self, elapsed: float) -> bool:
        """Advance by ``elapsed`` seconds of real time; True if the state was replaced, after a seek."""
        seek_to, self.seek_to = self.seek_to, None
        if seek_to is not None and abs(seek_to - self.position) > 1e-6:
            if 0.0 <= seek_to - self.position < 1.0:
                self.position = seek_to
                self._feed()
                return False
            self.seek(seek_to)
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
        schema_version=SCHEMA_VERSION,
        camera=name,
        width=lens.width,
        height=lens.height,
        driver="calibration.toml",
        **lens.message_fields(),
    )
