"""What a hub makes of the messages of cameras: the observations to calibrate from, and what is known of their clocks.

Live, in a replay, and from a recorded log alike: marker and people apart, clock segments, changes of a clock's rate,
external clock priors and arrivals.
"""

from __future__ import annotations

import itertools
import math
from array import array
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from google.protobuf.message import Message

from hub.clocks.change_detector import MIN_STEP_S, ClockChange
from hub.clocks.external_prior import ArrivalPriors, ExternalClockPrior, ExternalClockPriors
from hub.clocks.segments import SEGMENT_MIN_ROWS, ClockSegments, RateChanges
from hub.tracking.calibration.people import MIN_INTERVAL_NS, PERSON, SEVERAL_SHARE, PeopleTracklets
from hub.tracking.detections import tracked_kind
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import Refused
from protocols.geometry.types import Bools, Floats, Ints
from protocols.messages import syncline_pb2 as pb
from protocols.session.builder import SessionBuilder, rig_camera_from_info
from protocols.session.folder import column_warnings
from protocols.session.observations import Observations
from protocols.session.rig import Rig

_WINDOW_S, _LEAST_FRAMES = 4.0, 5
"""What is compared on each side of a jump, as long as a hub waits for what comes after one; and how many frames of it:
as many as the detector needs to look for jumps"""
_QUANTILES = (0.5, 0.75)
"""Of the delays, all of which a step shifts; on the clock of a camera that lost frames, lower ones say nothing"""
_RATES = 0.5, 2.0  # of a clock, not of times that are all equal, or of a recording that was replayed fast
_MAX_NS = 2**63 - 1  # of a log time, which may be any of 64 bits, in a signed integer

FrameKey = tuple[str, str, int]
"""Camera, boot id and sequence number."""
LEAST_ROWS = 90
"""Detections of a marker that two cameras need to be calibrated by them: three seconds at 30 Hz."""
AMBIGUOUS_COLOURS = "the colours of the people are ambiguous, or no two cameras observed the same person"
_PEOPLE_WINDOW_S = 600.0
"""Of a recorded log: labels by colour of more tracklets take a minute and more."""
_LIVE_PEOPLE_S, _LIVE_CAMERAS = 60.0, 24
"""Of unlabelled people, who are followed anew in every job: 60 s of five people in five cameras take 25 s of CPU. And
the cameras of which they are held, 1 to 2 MB each: each is compared with each, in 0.4 to 1.2 s."""


class ObservationStream:
    """Collects the messages of cameras, in any order and with duplicates.

    window_s: what is kept, None = all, as of a log.
    """

    def __init__(self, window_s: float | None = None) -> None:
        self._window_s = window_s
        self.clocks = ClockSegments()
        self.clock_priors = ExternalClockPriors()
        self._rate_changes = RateChanges()
        self._arrivals = ArrivalPriors()
        self._infos: dict[str, pb.CameraInfo] = {}
        self.forget()

    def forget(self) -> None:
        """Forget the observations; what is known of the clocks is kept."""
        self.marker = SessionBuilder(self._window_s)
        self.people = PeopleTracklets(_PEOPLE_WINDOW_S if self._window_s is None else self._window_s)
        self._held: dict[tuple[str, str], deque[tuple[float, pb.Observation]]] = {}

    def release(self, camera: str) -> None:
        """Forget a camera; what is known of its clock is kept."""
        self.marker.forget(camera)
        self.people.forget(camera)
        self._held = {key: held for key, held in self._held.items() if key[0] != camera}
        self._infos.pop(camera, None)

    def assign(
        self, message: pb.Observation, arrival: float | None, *, backlog: bool = False
    ) -> tuple[pb.Observation, ClockChange | None]:
        """The observation with its clock segment as boot id, and the change of its clock that begins with it, if any.

        arrival: on the hub's clock [s], None = unknown. backlog: it waited, so that its arrival says little.
        """
        time = self.clock_priors.times[message.camera] = message.device_time_ns / NANOSECONDS
        message, change = self.clocks.assign(message, None if backlog else arrival, waited=backlog)
        if change is not None:
            self.marker.require_rows(change.segment, SEGMENT_MIN_ROWS)
            self._rate_changes.handle(change)
        if arrival is not None and not backlog:
            self._arrivals.handle(message.camera, message.boot_id, time, arrival)
        return message, change

    def store(
        self, message: Message, now: float = 0.0, admits_people: Callable[[pb.Observation], bool] | None = None
    ) -> Message:
        """Add a message; returns it without people and vehicles.

        now: of its arrival [s], any fixed clock. admits_people: whether an observation's people are stored.
        """
        if isinstance(message, pb.CameraInfo):
            self._infos[message.camera] = message
        if isinstance(message, pb.Observation) and any(map(tracked_kind, message.detections)):
            if admits_people is None or admits_people(message):
                self.people.handle(message)
                self._hold(message, now)
            message = without_tracked(message)
        self.marker.handle(message, now)
        if isinstance(message, pb.Observation) and self._rate_changes.cameras:
            self._extend_old_segment(message, now)
        return message

    def _hold(self, message: pb.Observation, arrival: float) -> None:
        """Keep a frame's people; live of the present clock only, of no more cameras than are compared."""
        people = [one for one in message.detections if one.kind == PERSON]
        key, live = (message.camera, message.boot_id), self._window_s is not None
        if not people:
            return
        if live and key not in self._held:
            recent = arrival - self.people_window_s
            self._held = {
                other: held for other, held in self._held.items() if other[0] != key[0] and held[-1][0] >= recent
            }
            if len(self._held) >= _LIVE_CAMERAS:
                return
        longest = round(self.people_window_s * NANOSECONDS / MIN_INTERVAL_NS) + 1
        mine = self._held.setdefault(key, deque(maxlen=longest if live else None))
        # One that waited, or of a stamp that was right after a wrong one, may be older than the last.
        if mine and 0 <= message.device_time_ns - mine[-1][1].device_time_ns < MIN_INTERVAL_NS:
            return
        plain = without_tracked(message)
        del plain.detections[:]
        plain.detections.extend(people)
        for one in plain.detections:
            one.ClearField("label")
        mine.append((arrival, plain))
        while not live and mine[0][1].device_time_ns < message.device_time_ns - self.people_window_s * NANOSECONDS:
            mine.popleft()

    @property
    def people_window_s(self) -> float:
        """How much of the past unlabelled people's frames are kept of [s]."""
        return _PEOPLE_WINDOW_S if self._window_s is None else min(_LIVE_PEOPLE_S, self._window_s)

    def several_people(self, now: float = 0.0) -> dict[str, tuple[pb.Observation, ...]]:
        """The frames with people by camera, of the boot id with most; empty where no two people are seen at once.

        now: of the arrivals; what came longer ago than the window, as from a camera that sees nobody any more, is not
        of the same film as the others'.
        """
        window_ns, found = self.people_window_s * NANOSECONDS, dict[str, tuple[pb.Observation, ...]]()
        for name, boot in sorted(self._held, key=lambda key: len(self._held[key])):
            mine = self._held[name, boot]
            last_ns, late = mine[-1][1].device_time_ns, [one for at, one in mine if at >= now - self.people_window_s]
            if recent := [one for one in late if abs(one.device_time_ns - last_ns) <= window_ns]:
                found[name] = tuple(sorted(recent, key=lambda one: one.device_time_ns))
        return found if are_several([*itertools.chain(*found.values())]) else {}

    def has_info(self, camera: str) -> bool:
        """Whether a camera has introduced itself: without its image size it is not calibrated."""
        return camera in self._infos

    def image_size(self, camera: str) -> tuple[int, int] | None:
        """Width and height [px] of the images that a camera has said it sends; None where it has not."""
        info = self._infos.get(camera)
        return None if info is None else (info.width, info.height)

    def arrivals(self, boots: Mapping[str, str]) -> dict[str, ExternalClockPrior]:
        """Clock priors by times of arrival, of the clocks with the given boot ids."""
        return {name: prior for name, prior in self._arrivals.priors().items() if prior.boot_id == boots.get(name)}

    def has_marker(self, least_rows: int) -> bool:
        """Whether to calibrate from markers: two cameras have enough detections of them, or nobody saw people."""
        rows = [self.marker.rows(name) for name in self.marker.cameras]
        return not self.people.cameras or sum(count >= least_rows for count in rows) >= 2

    def build(self, of_marker: bool, *, refusing: bool = True, newest_s: float = math.inf) -> tuple[Rig, Observations]:
        """The rig and the observations of the marker, or of people. Raises Refused where there are none, if asked.

        newest_s: only what was seen in the last so many seconds.
        """
        if of_marker:
            rig, observations = self.marker.build(newest_s)
            return rig, self._with_rate_changes_corrected(observations)
        cameras = {name: rig_camera_from_info(self._infos[name]) for name in sorted(self._infos)}
        rig = Rig(cameras, metadata={"target": PERSON})
        observations = self.people.observations().newest(newest_s)
        if refusing and not len(observations):
            raise Refused(AMBIGUOUS_COLOURS)
        return rig, observations

    def _extend_old_segment(self, message: pb.Observation, now: float) -> None:
        """Also add the frame to the clock segment before a rate change, with the time stamp of the old clock."""
        old = self._rate_changes.to_previous_clock(message.camera, message.boot_id, message.device_time_ns)
        if old is None or self._rate_changes.active(message.camera, self.marker.boot(message.camera)) is None:
            return
        copy = pb.Observation()
        copy.CopyFrom(message)
        copy.boot_id, copy.device_time_ns = old
        self.marker.handle(copy, now)

    def _with_rate_changes_corrected(self, observations: Observations) -> Observations:
        """The observations with corrected time stamps between a rate change of a clock and its detection."""
        active = {name: self._rate_changes.active(name, self.marker.boot(name)) for name in self._rate_changes.cameras}
        rate_changes = {
            name: change.refined(self.clocks.change_into(change.segment)) for name, change in active.items() if change
        }
        tracks = {
            key: track
            if (change := rate_changes.get(key[0])) is None
            else replace(track, time=change.corrected(track.time))
            for key, track in observations.tracks.items()
        }
        return replace(observations, tracks=tracks)


@dataclass(frozen=True, slots=True, eq=False)
class RecordedStream:
    """The session that a hub would have after the messages of a log. priors: external ones of its cameras' clocks.
    people: the detections of several unlabelled people; observations are then of those associated by colour.
    """

    rig: Rig
    observations: Observations
    priors: dict[str, ExternalClockPrior]
    people: tuple[pb.Observation, ...]
    warnings: tuple[str, ...]


def session_from_messages(read: Callable[[], Iterable[tuple[Message, int]]]) -> RecordedStream:
    """The session of a log's messages. read: these in the order of the log, each with its log time [ns].

    A log of other makers holds whatever times of arrival they wrote: they are used only to tell pauses from steps of a
    clock, for which the log is read once more. Raises Refused where there is nothing to calibrate from, and InputError
    for rows that are no pixels of their images.
    """
    stream, times = _streamed(read(), set())
    if pauses := times.pauses():
        stream, _ = _streamed(read(), pauses)
    of_marker = stream.has_marker(LEAST_ROWS)
    by_camera = {} if of_marker else stream.several_people()
    people = tuple(itertools.chain(*by_camera.values()))
    rig, observations = stream.build(of_marker, refusing=not people)
    source = stream.marker if of_marker else stream.people
    boots = {name: source.boot(name) for name in rig.cameras}
    if people:  # those associated by colour are of the last boot ids: a prior has to be of both
        boots = {name: boots[name] for name, held in by_camera.items() if held[0].boot_id == boots.get(name)}
    alarms = tuple(
        f"{text}: its rows on one side of that were left out"
        for text in stream.clocks.alarms.values()
        if of_marker or people
    )
    warnings = alarms + stream.marker.warnings(stream.clocks.first_segment) + column_warnings(rig, observations)
    return RecordedStream(rig, observations, stream.clock_priors.for_boots(boots), people, warnings)


def _streamed(
    messages: Iterable[tuple[Message, int]], pauses: Collection[FrameKey]
) -> tuple[ObservationStream, RecordedTimes]:
    """The stream after a log's messages, and their times. pauses: frames before which a clock did not jump."""
    stream, times = ObservationStream(), RecordedTimes()
    for message, log_time_ns in messages:
        if isinstance(message, pb.AgentStatus):
            stream.clock_priors.handle(message)
            continue
        if isinstance(message, pb.Observation):
            sent, waited = message, (message.camera, message.boot_id, message.sequence) in pauses
            message, change = stream.assign(sent, None, backlog=waited)
            times.handle(sent, log_time_ns, change)
        stream.store(message)
    return stream, times


def are_several(messages: Collection[pb.Observation]) -> bool:
    """Whether several people are in frames at once."""
    several = sum(sum(one.kind == PERSON for one in message.detections) > 1 for message in messages)
    return several > SEVERAL_SHARE * len(messages)


def without_tracked(message: pb.Observation) -> pb.Observation:
    """The observation without people, vehicles and unlabelled markers: they have no common label across cameras."""
    plain = pb.Observation()
    plain.CopyFrom(message)
    del plain.detections[:]
    plain.detections.extend(d for d in message.detections if not tracked_kind(d))
    return plain


class RecordedTimes:
    """The times of a log's frames, in the order in which they were written.

    After a pause a camera's times are as far behind the log's, and the other cameras', as they were before it. What
    both sides of the jump say is used, unlike in `hub.clocks.change_detector`, which has to decide at once.
    """

    def __init__(self) -> None:
        self._number = itertools.count()
        self._rows: defaultdict[tuple[str, str], array[int]] = defaultdict(lambda: array("q"))
        self._steps: defaultdict[tuple[str, str], list[tuple[int, int, float]]] = defaultdict(list)

    def handle(self, message: pb.Observation, log_time_ns: int, change: ClockChange | None) -> None:
        """Add a frame, as its camera sent it, and the change of its clock that seems to begin with it."""
        key = message.camera, message.boot_id
        if change is not None and change.kind == "step":
            self._steps[key].append((len(self._rows[key]) // 3, message.sequence, change.step_s))
        self._rows[key].extend((message.device_time_ns, min(log_time_ns, _MAX_NS), next(self._number)))

    def pauses(self) -> set[FrameKey]:
        """The frames before which a clock did not jump: those of lost frames, by every clock that can tell."""
        tables = {key: np.frombuffer(rows, np.int64).reshape(-1, 3) for key, rows in self._rows.items()}
        out = set[FrameKey]()
        for key, steps in self._steps.items():
            others = [table for other, table in tables.items() if other[0] != key[0]]
            parts = np.split(tables[key], [at for at, _, _ in steps])
            for (_, sequence, size), before, after in zip(steps, parts, parts[1:], strict=False):
                sides = _near(before, -1), _near(after, 0)
                enough = size > 0.0 and min(map(len, sides)) >= _LEAST_FRAMES
                if enough and _is_pause(sides, others, min(0.5 * size, MIN_STEP_S)):
                    out.add((*key, sequence))
        return out


def _near(rows: Ints, last: int) -> Ints:
    """The rows (n, 3) of a camera within the window beside one of them."""
    inside: Bools = np.abs(rows[:, 0] - rows[last, 0]) <= _WINDOW_S * NANOSECONDS
    return rows[inside]


def _is_pause(sides: tuple[Ints, Ints], others: list[Ints], most: float) -> bool:
    """Whether most of the other cameras and the log's times say so, as far as they are clocks. most: of a shift [s].

    Those of the log alone say nothing where they are the cameras' own, as other makers may write them.
    """
    by_log, others_say = _is_steady(sides, [rows[:, 1] for rows in sides], most), []
    for table in others:
        last = [np.searchsorted(table[:, 2], rows[:, 2]) - 1 for rows in sides]
        if min(map(np.min, last)) >= 0:
            others_say.append(_is_steady(sides, [table[at, 0] for at in last], most))
    every = [by_log, *others_say]
    return by_log is not False and True in others_say and every.count(True) > every.count(False)


def _is_steady(sides: tuple[Ints, Ints], clock: list[Ints], most: float) -> bool | None:
    """Whether the frames' delays on a clock, (n,) times [ns] a side, are the same on both; None where it is none."""
    found: list[Floats] = []
    for rows, times in zip(sides, clock, strict=True):
        elapsed, shown = (float(np.max(one) - np.min(one)) for one in (times, rows[:, 0]))
        if not _RATES[0] * shown < elapsed < _RATES[1] * shown:
            return None
        found.append(np.quantile((times - clock[0][0] - (rows[:, 0] - sides[0][0, 0])) / NANOSECONDS, _QUANTILES))
    return bool((np.abs(found[1] - found[0]) < most).all())
