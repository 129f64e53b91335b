"""What `syncline follow` reads: a session folder, a table of boxes, a log or a folder of videos, with a calibration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from deploy.offline.follow.calibration import GivenCalibration, read_given_calibration
from deploy.offline.follow.objects import (
    Kind,
    followed_detections,
    object_messages,
    read_objects,
    without_clock_steps,
)
from deploy.offline.follow.units import check_units
from deploy.offline.progress import Progress
from hub.tracking.detections import TrackingCamera
from hub.trajectory.image_tracks import MAX_PAUSE_S
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError, Refused
from protocols.core.ranges import MAX_CLOCK_RATE, MAX_TIME_NS, MIN_CLOCK_RATE
from protocols.log.read.reader import LogReader
from protocols.log.read.session import is_log
from protocols.messages import syncline_pb2 as pb
from protocols.session.folder import BOXES_FILE, OBSERVATIONS_FILE, RIG_FILE
from protocols.session.rig import read_rig
from protocols.topics import OBSERVATION

LOG_OF_VIDEOS = "detections.mcap"
_SAME_TIME_NS = NANOSECONDS
"""Cameras at 1 Hz need not have their frames at one time."""
_MAX_ROWS = 2_000_000
"""Reference times at which tracks are wanted: 18 h at 30 Hz."""


@dataclass(frozen=True, slots=True, eq=False)
class FollowInput:
    """Detections of one kind and the reference times [ns] at which tracks are wanted.

    videos: the video of each camera, where there are any. log: the log that was read, where it was one.
    """

    name: str
    observations: list[pb.Observation]
    times_ns: list[int]
    warnings: tuple[str, ...]
    videos: dict[str, Path]
    log: Path | None = None

    def frame_times(self, known: GivenCalibration) -> dict[int, float]:
        """Reference times [s] of the reference camera's frames, and of frames that only others have, by number."""
        out: dict[int, float] = {}
        for name in (known.calibration.reference, *known.sizes):
            camera = TrackingCamera.from_calibration(known.calibration.cameras[name])
            for message in self.observations:
                if message.camera == name and message.sequence not in out:
                    out[message.sequence] = camera.reference_ns(message.device_time_ns) / NANOSECONDS
        return out


def read_follow_input(
    session: Path,
    known: GivenCalibration,
    kind: Kind,
    out: Path,
    *,
    observations: Path | None = None,
    detector: str | None = None,
    fps: float | None = None,
    seed: int = 0,
    progress: Progress = lambda text, share: None,
) -> FollowInput:
    """Read the detections of any kind of session; videos are detected in first, into a log in ``out``.

    observations: a file of detections in place of the session's own, or of what a detector would find in a folder of
    videos. detector: see ``detect_videos``; where it is given, a folder's videos are used in place of its observations.
    Raises InputError (file, line, what, remedy), and Refused where there is nothing to follow.
    """
    from deploy.offline.follow.video_detection import detect_videos
    from deploy.offline.video_folder import has_videos, is_video_folder, list_videos

    shared, log = known.rig.shared_clock, None
    videos: dict[str, Path] = {}
    warnings: tuple[str, ...] = ()
    more: tuple[str, ...] = ()
    file = observations or (None if detector is not None else _rows_file(session))
    if file is None and (is_video_folder(session) or (detector is not None and session.is_dir())):
        log = out / LOG_OF_VIDEOS
        videos, warnings = detect_videos(session, known, kind, log, detector=detector, seed=seed, progress=progress)
        messages, more = read_log(log)
    elif detector is not None:
        raise InputError("--detector goes with a folder of videos", file=session, remedy="leave it out")
    elif file is None and is_log(session):
        log = session
        messages, more = read_log(session)
    elif file is None:
        remedy = f"give a folder with {OBSERVATIONS_FILE} or {BOXES_FILE}, a .mcap log, or a folder of videos"
        what = "nothing to follow in it" if session.exists() else "this session does not exist"
        raise InputError(what, file=session, remedy=remedy)
    else:
        messages = object_messages(read_objects(file, known.file_sizes))
        if has_videos(session):
            videos = {video.camera: video.path for video in list_videos(session)[0]}
        if session.is_dir() and (session / RIG_FILE).exists():
            shared |= read_rig(session / RIG_FILE).shared_clock
    messages, steps = without_clock_steps(messages, file or session)
    found, left_out = followed_detections(messages, kind, known.sizes)
    warnings = (*warnings, *more, *steps, *left_out.warnings)
    unused = sorted({message.camera for message in messages} - known.sizes.keys())
    warnings += tuple(f"{name}: not followed in, the calibration refused it" for name in unused if name in known.names)
    absent = known.sizes.keys() - {message.camera for message in messages}
    warnings += tuple(f"{name}: calibrated, but no frame of it is here" for name in sorted(absent))
    strange = [name for name in unused if name not in known.names]
    if strange:
        what = f"camera {strange[0]!r} is not in the calibration ({', '.join(known.names)})"
        raise InputError(what, file=session, remedy="take the calibration of these cameras")
    if not any(message.detections for message in found):
        raise Refused(f"{session}: no {kind} in any frame" + "".join(f"; {warning}" for warning in left_out.warnings))
    warnings += check_units(found, known, kind, session)
    by_camera, apart = _at_one_time(_reference_times(found, known))
    found = [message for message in found if message.camera in by_camera]
    times_ns, also = _wanted_times(by_camera, known, shared, fps)
    return FollowInput(session.stem, found, times_ns, warnings + apart + also, videos, log)


def _rows_file(session: Path) -> Path | None:
    """The CSV file of a session, or None for a log or videos."""
    if session.suffix.lower() == ".csv" and not session.is_dir():
        return session
    return next((session / name for name in (OBSERVATIONS_FILE, BOXES_FILE) if (session / name).exists()), None)


def read_log(file: Path) -> tuple[list[pb.Observation], tuple[str, ...]]:
    """The observations of a log, of each camera those of the boot with the most detections, and warnings."""
    reader = LogReader(file)
    messages: list[pb.Observation] = []
    counts: dict[str, Counter[str]] = {}
    for logged in reader.messages([OBSERVATION]):
        message = logged.message
        assert isinstance(message, pb.Observation)
        messages.append(message)
        counts.setdefault(message.camera, Counter())[message.boot_id] += 1 + len(message.detections)
    if not messages:
        raise InputError("no observation in this log", file=file, remedy="record cameras that detect something")
    boots = {camera: count.most_common(1)[0][0] for camera, count in counts.items()}
    damage = (f"the log is damaged: {reader.damage}",) if reader.damage else ()
    restarts = tuple(
        f"{camera}: it was restarted; only the part with the most detections is on the calibrated clock"
        for camera, count in counts.items()
        if len(count) > 1
    )
    return [message for message in messages if message.boot_id == boots[message.camera]], damage + restarts


def check_log(file: Path, calibration: Path) -> tuple[str, ...]:
    """Warnings about the people in a log as `follow` gives them. Raises InputError where they contradict the units,
    pictures, poses or vertical of a calibration.toml."""
    known = read_given_calibration(calibration)
    found, _ = followed_detections(without_clock_steps(read_log(file)[0], file)[0], "person", known.sizes)
    return check_units(found, known, "person", file) if any(message.detections for message in found) else ()


def _reference_times(messages: list[pb.Observation], known: GivenCalibration) -> dict[str, set[int]]:
    """The reference times [ns] of each camera's frames. Raises InputError for a clock that is none."""
    by_camera: dict[str, set[int]] = {}
    for name, camera in known.calibration.cameras.items():
        clock = camera.time_map
        if (
            abs(clock.time_offset) * NANOSECONDS > MAX_TIME_NS
            or not MIN_CLOCK_RATE <= clock.clock_rate <= MAX_CLOCK_RATE
        ):
            what = f"[{name}] time_offset or clock_rate is beyond any clock"
            raise InputError(what, file=known.file, remedy="give seconds, and a rate near 1")
        tracked = TrackingCamera.from_calibration(camera)
        times = {tracked.reference_ns(message.device_time_ns) for message in messages if message.camera == name}
        if times:
            by_camera[name] = times
    return by_camera


def _at_one_time(by_camera: dict[str, set[int]]) -> tuple[dict[str, set[int]], tuple[str, ...]]:
    """The cameras less those a longer pause than a recording's away from most frames; warnings.

    Nobody is followed for so long.
    """
    begun = sorted(by_camera, key=lambda name: min(by_camera[name]))
    groups: list[list[str]] = []
    for name in begun:
        if groups and min(by_camera[name]) - max(max(by_camera[one]) for one in groups[-1]) < MAX_PAUSE_S * NANOSECONDS:
            groups[-1].append(name)
        else:
            groups.append([name])
    kept = max(groups, key=lambda group: sum(len(by_camera[name]) for name in group))
    first = min(min(by_camera[name]) for name in kept)
    left = (
        f"{name}: left out, its frames are {abs(min(by_camera[name]) - first) / NANOSECONDS:.0f} s from the others' by "
        "the calibration's time offsets"
        for name in by_camera
        if name not in kept
    )
    if len(kept) < 2 <= len(by_camera):
        raise Refused(f"no two cameras have a time in common: {next(left)}; is the calibration of this recording?")
    return {name: times for name, times in by_camera.items() if name in kept}, tuple(left)


def _wanted_times(
    by_camera: Mapping[str, set[int]], known: GivenCalibration, shared: bool, fps: float | None
) -> tuple[list[int], tuple[str, ...]]:
    """Reference times [ns] of rows: --fps, all times of a shared clock, or the reference camera's frames; warnings.

    by_camera: reference times [ns] of the frames.
    """
    every = set().union(*by_camera.values())
    alone = _without_common_time({name: (min(times), max(times)) for name, times in by_camera.items()})
    if len(alone) == len(by_camera) > 1:
        raise Refused(f"no two cameras have a time in common: {alone[0]}; is the calibration of this recording?")
    if max(map(abs, every)) > MAX_TIME_NS:
        raise InputError("its times are beyond 146 years", file=known.file, remedy="check time_offset and the session")
    if fps is not None:
        count = round((max(every) - min(every)) * fps / NANOSECONDS) + 1
        if count > _MAX_ROWS:
            raise InputError(f"--fps {fps:g} asks for {count} times", remedy=f"give no more than {_MAX_ROWS}")
        return [min(every) + round(index * NANOSECONDS / fps) for index in range(count)], alone
    if shared and all(
        known.calibration.cameras[name].time_map.time_offset == 0.0
        and known.calibration.cameras[name].time_map.clock_rate == 1.0
        for name in by_camera
    ):
        return sorted(every), alone
    reference = known.calibration.reference
    if reference in by_camera:
        return sorted(by_camera[reference]), alone
    name = max(by_camera, key=lambda one: len(by_camera[one]))
    warning = f"{reference}, the reference camera, has no frame here: tracks are given at the frames of {name}"
    return sorted(by_camera[name]), (*alone, warning)


def _without_common_time(spans: Mapping[str, tuple[int, int]]) -> tuple[str, ...]:
    """A line for each camera during whose reference times [ns] no other has any, where there are several."""
    lines = []
    for name, (first, last) in spans.items():
        others = [span for other, span in spans.items() if other != name]
        if others and not any(a <= last + _SAME_TIME_NS and first <= b + _SAME_TIME_NS for a, b in others):
            own, rest = (first, last), (min(a for a, _ in others), max(b for _, b in others))
            here, there = (f"{a / NANOSECONDS:.1f} to {b / NANOSECONDS:.1f} s" for a, b in (own, rest))
            lines.append(f"{name} has frames from {here} of the reference clock, all others from {there}")
    return tuple(lines)
