"""Telemetry files with their own clock (.tlog, .mcap), aligned to a video by its image motion; a log's images."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from deploy.offline.track import TelemetryFile
from edge.devices.base import DeviceInfo, Frame
from edge.devices.playback.video_file import Playback, VideoPlayback
from edge.uav.base import Telemetry
from edge.uav.estimator import decode_image
from edge.uav.timing.ground_motion import GroundMotion, RelativeRotations, compare_ways
from edge.uav.timing.telemetry_offset import (
    OffsetEstimate,
    OffsetSearch,
    accepted_offset,
    find_offset,
    search_offset,
    turned_about_axis,
)
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, TELEMETRY, UAV_INFO

_FPS = 30.0  # where the log does not tell
_MAX_ALIGNMENT_FRAMES = 3600  # two minutes at 30 Hz are enough to estimate the offset
_MOST_STD_S = 0.1  # of the offset of a telemetry.csv: a third of what is known of it before
_MAX_OTHERS = 8  # vehicles and boots of a log that are tried, each at the cost of tracking corners in the video
_MARGIN_S = 3.0  # duration of samples kept before and after the video

_Reading = tuple[Sequence[Telemetry], Floats]
"""Samples and body_from_camera, as they are or by another convention."""


class Footage(NamedTuple):
    """A video with its lens and mounting. progress: called with the index of each frame that is read."""

    video: Path
    fps: float | None
    lens: Intrinsics
    body_from_camera: Floats
    progress: Callable[[int], None]


def _each(convert: Callable[[Floats], Floats]) -> Callable[[Sequence[Telemetry], Floats], _Reading]:
    """A convention by which each ned_from_body is another matrix."""

    def read(samples: Sequence[Telemetry], body_from_camera: Floats) -> _Reading:
        return [replace(one, ned_from_body=convert(one.ned_from_body)) for one in samples], body_from_camera

    return read


def _last_first(rotation: Floats) -> Floats:
    """The rotation of quaternions x, y, z, w of which (3, 3) was made as if they were w, x, y, z."""
    return so3.from_quaternion(np.roll(so3.quaternion(rotation), 1))


def _from_ros(rotation: Floats) -> Floats:
    """ned_from_body of ROS's axes (REP 103): east, north, up from forward, left, up."""
    return np.asarray(rotation[[1, 0, 2]] * np.outer([1.0, 1.0, -1.0], [1.0, -1.0, -1.0]))


_CONVENTIONS: dict[str, Callable[[Sequence[Telemetry], Floats], _Reading]] = {
    "they were x,y,z,w": _each(_last_first),
    "they were body_from_ned": _each(lambda rotation: rotation.T),
    "they were ROS's enu_from_flu": _each(_from_ros),
    "they were ROS's enu_from_flu in x,y,z,w": _each(lambda rotation: _from_ros(_last_first(rotation))),
    "body_from_camera were transposed": lambda samples, mounting: (samples, mounting.T),
    "the camera were turned by 90 degrees": lambda samples, mounting: (samples, turned_about_axis(mounting, 1)),
    "the camera were turned by 180 degrees": lambda samples, mounting: (samples, turned_about_axis(mounting, 2)),
    "the camera were turned by 270 degrees": lambda samples, mounting: (samples, turned_about_axis(mounting, 3)),
}


def read_telemetry_log(file: Path, source: tuple[str, str] | None = None) -> TelemetryFile:
    """Read the samples of a .tlog or .mcap, on that file's own clock. Raises InputError.

    source: the agent and its boot in a .mcap whose samples are wanted; None: of those with the most.
    """
    if file.suffix.lower() == ".tlog":
        from edge.mavlink.link.tlog import read_tlog

        first, *more = read_tlog(file)
        return TelemetryFile(first.samples, first.left_out, others=tuple(log.samples for log in more))
    from edge.uav.navigation import rotation_from_quaternion
    from protocols.log.read.reader import LogReader

    found: dict[tuple[str, str], list[Telemetry]] = {}
    left_out = 0
    for logged in LogReader(file).messages([TELEMETRY]):
        message = logged.message
        assert isinstance(message, pb.VehicleTelemetry)
        name = message.agent, message.boot_id
        if source not in (None, name):
            continue
        samples = found.setdefault(name, [])
        turned = rotation_from_quaternion(list(message.ned_from_body))
        time = message.device_time_ns / NANOSECONDS
        if turned is None or (samples and time <= samples[-1].time):
            left_out += 1
            continue
        position = np.array(message.position) if message.position else None
        samples.append(Telemetry(time, turned, position, message.position_std))
    if not found:
        of = "" if source is None else f" of the run of {source[0]} that has the images"
        raise InputError(
            f"no telemetry{of} in this log", file=file, remedy="record a UAV agent, or give a telemetry.csv"
        )
    longest, *others = sorted(map(tuple, found.values()), key=len, reverse=True)
    return TelemetryFile(longest, left_out, others=tuple(others))


def align_to_video(recorded: TelemetryFile, file: Path, footage: Footage) -> tuple[tuple[Telemetry, ...], list[str]]:
    """The samples on the video's clock, 0 = its first frame, and warnings for the user.

    No samples if the offset can't be estimated; a warning gives the reason.
    Raises InputError where the positions are wrong.
    """
    offset: OffsetEstimate | str = ""
    # The images are read once more only for a log whose first series is not of this video.
    for series in ([recorded.samples], recorded.others[:_MAX_OTHERS]):
        readings: list[_Reading] = [(samples, footage.body_from_camera) for samples in series]
        rotations, time = _visual_rotations(footage, readings) if readings else ([], math.inf)
        found = [(find_offset(seen, *reading), reading[0]) for seen, reading in zip(rotations, readings, strict=True)]
        fits = [(one.agreement, k) for k, (one, _) in enumerate(found) if isinstance(one, OffsetEstimate)]
        if fits or not offset:
            offset, samples = found[max(fits)[1] if fits else 0]
        if fits:
            break
    if isinstance(offset, str):
        return (), [f"the telemetry is not used, its clock offset against the video's is not observable: {offset}"]
    # Where the video is longer than the frames used for alignment, all later samples are kept.
    end = offset.offset + time + _MARGIN_S
    shifted = tuple(
        replace(sample, time=sample.time - offset.offset)
        for sample in samples
        if offset.offset - _MARGIN_S <= sample.time <= end
    )
    return shifted, _check_motion(offset.motion, file)


def check_attitudes(
    recorded: TelemetryFile, file: Path, footage: Footage
) -> tuple[tuple[Telemetry, ...], list[str], bool]:
    """Samples on the video's clock where the offset is observable, else as they are; warnings where it is large or
    attitudes turn otherwise than the images; whether it is observable.

    Raises InputError where another convention of quaternions or mounting explains what the images show.
    """
    from edge.uav.timing.telemetry_track import MAX_OFFSET_S

    reading: _Reading = (recorded.samples, footage.body_from_camera)
    [seen], _ = _visual_rotations(footage, [reading])
    # None where its camera looks at the sky.
    given = _searched(search_offset(seen, *reading, (-MAX_OFFSET_S, MAX_OFFSET_S)))
    wider = _searched(search_offset(seen, *reading))
    correlated = given is not None and given.evidence >= given.threshold
    motion = compare_ways(seen, *reading, given.offset if given is not None and correlated else 0.0)
    offset, is_far = None if given is None else accepted_offset(given, None, _MOST_STD_S), False
    if wider is not None and (
        # A vehicle that sways shows a lower maximum each period.
        not isinstance(offset, OffsetEstimate) or given is None or wider.evidence > given.evidence + wider.threshold
    ):
        offset = accepted_offset(wider, None, _MOST_STD_S)
        is_far = wider.evidence >= wider.threshold and abs(wider.offset) > MAX_OFFSET_S
    # A wrong convention can fit somewhere, too. With each one's tilt the video is read once more: only where one may.
    least = max(one.evidence if one is not None else 0.0 for one in (given, wider))
    others = [read(*reading) for read in _CONVENTIONS.values()]
    if not correlated or is_far or _better_conventions([seen] * len(others), others, least):
        fits = _better_conventions(_visual_rotations(footage, others)[0], others, least)
        if fits:
            what = f"its attitudes do not turn as the video does, but would if {fits[max(fits)]}"
            remedy = "give qw,qx,qy,qz of ned_from_body and body_from_camera; body axes are forward, right, down"
            raise InputError(what, file=file, remedy=remedy)
    if isinstance(offset, OffsetEstimate):
        # The tracker finds small ones in flight, too, but its ground frame begins before.
        samples = tuple(replace(sample, time=sample.time - offset.offset) for sample in recorded.samples)
        notes = _check_motion(compare_ways(seen, *reading, offset.offset), file)
        if abs(offset.offset) > MAX_OFFSET_S:
            apart = f"{abs(offset.offset):.2f} s {'later' if offset.offset > 0.0 else 'earlier'}"
            what = f"by the rotation that both show its times are {apart} than the video's, and were corrected"
            notes = [f"{file}: {what}: 0 is the video's first frame", *notes]
        return samples, notes, True
    if is_far:
        notes = _check_motion(motion, file) if correlated else []
        what = f"its times do not seem to be the video's, and are used as they are: {offset}"
        return recorded.samples, [f"{file}: {what}: make time_s 0 at the video's first frame", *notes], False
    if correlated or given is None or not given.contradicts:
        return recorded.samples, _check_motion(motion, file), False
    turn = f"its attitudes turn by {math.degrees(given.telemetry_rms):.1f} degrees rms, but not as the video does"
    remedy = "check body_from_camera in --rig, and that both are of one flight and on one clock"
    return recorded.samples, [f"{file}: {turn}: {remedy}"], False


def _searched(found: OffsetSearch | str) -> OffsetSearch | None:
    return None if isinstance(found, str) else found


def _better_conventions(
    rotations: Sequence[RelativeRotations], readings: Sequence[_Reading], least: float
) -> dict[float, str]:
    """By evidence, the conventions whose readings turn as the video does anywhere, by more than is by chance."""
    found = [_searched(search_offset(seen, *reading)) for seen, reading in zip(rotations, readings, strict=True)]
    return {
        one.evidence: name
        for name, one in zip(_CONVENTIONS, found, strict=True)
        if one is not None and one.evidence > least + one.threshold
    }


def _check_motion(motion: GroundMotion | None, file: Path) -> list[str]:
    """A warning where positions move along another way or at another height than the video shows. Raises InputError
    where they are wrong."""
    if motion is None:
        return []
    if motion.contradiction:
        raise InputError(f"its {motion.contradiction}", file=file, remedy="correct --rig or the telemetry")
    if motion.stands_still:
        what = f"its positions move by {motion.reported:.2g} m in a second, but the video by {motion.seen:.0f} m"
        remedy = "give north,east,down in metres, not latitude and longitude, or leave positions out"
        raise InputError(what, file=file, remedy=remedy)
    if motion.differs_in_shape:
        return [
            f"{file}: its positions move along another way than the images show: check that both are of one flight and "
            "on one clock, and that the columns are north, east, down"
        ]
    checks = {
        motion.wrong_heading: "check the compass, and body_from_camera in --rig",
        motion.wrong_height: "give positions in metres, with heights above the ground and not above sea level",
    }
    return [f"{file}: {what}: {remedy}" for what, remedy in checks.items() if what]


def _visual_rotations(footage: Footage, readings: list[_Reading]) -> tuple[list[RelativeRotations], float]:
    """The camera's rotations in the video by the tilt of each reading; the time of the last frame used, inf if cut."""
    from edge.uav.timing.visual_rotation import VisualRotationEstimator, median_tilt_rotation

    recording, _ = open_recording(footage.video, footage.fps, footage.lens)
    try:
        size = (recording.info.width, recording.info.height)
        estimators = [
            (VisualRotationEstimator(size, footage.lens), median_tilt_rotation(*reading)) for reading in readings
        ]
        first: float | None = None
        time = 0.0
        for index in range(_MAX_ALIGNMENT_FRAMES):
            frame = recording.read(0.0)
            if frame is None:
                break
            moment = frame.device_time_ns / NANOSECONDS
            first = moment if first is None else first
            time = moment - first
            for estimator, tilt in estimators:
                estimator.update(frame.image, time, tilt)
            footage.progress(index)
        else:
            time = math.inf
    finally:
        recording.close()
    return [estimator.relative_rotations() for estimator, _ in estimators], time


class LoggedFlightImages(Playback):
    """Images of the agent and boot with the most images. lens, body_from_camera: as known to that agent.

    source: that agent and boot. count: images in the log. first_s: camera time of the first image [s].
    Raises InputError if the log has no image that can be decoded.
    """

    def __init__(self, log: Path, *, fps: float | None = None, intrinsics: Intrinsics | None = None) -> None:
        super().__init__()
        if not log.exists():
            raise InputError("this log does not exist", file=log, remedy="check the path")
        self._reader = LogReader(log)
        names = Counter(_name(logged.message) for logged in self._reader.messages([FLIGHT_IMAGE]))
        if not names:
            what = "this log contains no flight images"
            raise InputError(what, file=log, remedy="give the video, or record a UAV agent with [images]")
        self.source, self.count = names.most_common(1)[0]
        known: pb.UavInfo | None = None
        for logged in self._reader.messages([UAV_INFO]):
            message: Any = logged.message
            if _name(message) == self.source:
                known = message
                break
        self.lens = intrinsics or (None if known is None else Intrinsics.of_message(known))
        self.body_from_camera = _mounting(known)
        self._left_out = 0
        self._frames = self._read()
        self._pending = first = next(self._frames, None)
        if first is None:
            raise InputError("no image of this log can be decoded", remedy="give the video itself")
        self.first_s = first.device_time_ns / NANOSECONDS
        height, width = first.image.shape[:2]
        rate = fps or (known.fps if known is not None and known.fps > 0.0 else _FPS)
        self._info = DeviceInfo(width, height, rate, "log", "stream", self.lens, unknown=("exposure",))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Problems of the log so far, one line each."""
        damage, left_out = self._reader.damage, self._left_out
        return (
            *((f"damaged: {damage}; only its intact part was tracked",) if damage else ()),
            *((f"{left_out} images cannot be decoded, or their times do not increase: left out",) if left_out else ()),
        )

    def _read(self) -> Iterator[Frame]:
        newest = -1
        shape: tuple[int, ...] | None = None
        for logged in self._reader.messages([FLIGHT_IMAGE]):
            message: Any = logged.message
            if _name(message) != self.source:
                continue
            image = decode_image(message)
            if image is None or message.device_time_ns <= newest or image.shape != (shape or image.shape):
                self._left_out += 1
                continue
            newest, shape = message.device_time_ns, image.shape
            yield Frame(image, message.device_time_ns, message.frame)


def open_recording(
    video: Path, fps: float | None, intrinsics: Intrinsics | None
) -> tuple[VideoPlayback | LoggedFlightImages, int | None]:
    """Open a video file, a folder of images or a log; returns it and, for a log, its number of images, else None."""
    if video.suffix.lower() != ".mcap":
        recording = VideoPlayback(video, fps=fps, intrinsics=intrinsics)
        recording.open()
        return recording, None
    logged = LoggedFlightImages(video, fps=fps, intrinsics=intrinsics)
    return logged, logged.count


def _name(message: Any) -> tuple[str, str]:
    return message.agent, message.boot_id


def _mounting(info: pb.UavInfo | None) -> Floats | None:
    return np.array(info.body_from_camera).reshape(3, 3) if info is not None and info.body_from_camera else None
