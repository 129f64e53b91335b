"""Heads, faces and torsos of followed people, cut out of the pictures in which they were detected."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from deploy.offline.progress import Progress
from hub.tracking.detections import TrackingCamera
from hub.tracking.filter.kalman import LOG_SIZE, STATE_DIM
from hub.tracking.filter.measurement import FOOT, HEAD, predict_measurement
from hub.tracking.filter.target_models import KIND_INDEX
from hub.tracking.messages import face_regions, head_views
from hub.tracking.parameters import TrackerParameters
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.core.jpeg import decode_jpeg
from protocols.geometry.types import Floats, Image
from protocols.log.read.images import image_runs, read_images
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb

if TYPE_CHECKING:
    from deploy.offline.follow.calibration import GivenCalibration
    from deploy.offline.follow.source import FollowInput
    from hub.tracking.offline import FollowedTrack, FollowResult

_HEAD_MARGIN = 1.3
"""Sides of the head's picture over those of the region of head and face: hair, and a few per cent of error in the
height of a detection."""
_SHOULDERS, _HIPS, _SHOULDER_WIDTH = 0.18, 0.52, 0.30
"""Of a torso, in statures from the top of the head: Drillis and Contini (1966) have shoulders at 0.818 and hips at
0.530 of the stature, and 0.259 across the shoulders; the arms add to that."""
_HEAD_OFF, _FOOT_OFF = 0.04, 0.15
"""Of the stature; 0.04 are a quarter of a head. Where a detection's head or foot is farther from the track's, the
track's are taken: who is hidden in part, or cut by the border, has the head elsewhere."""
_MIN_SPEED = 0.15
"""Statures a second, whatever the scale: 0.25 m/s. Who walks more slowly may look anywhere."""
_REGIONS = "head", "face", "torso"
_MIN_SIDE_PX = 6  # a smaller crop shows nothing
_MIN_INSIDE = 0.7
"""Share of a region that must be in the picture."""


@dataclass(frozen=True, slots=True)
class _Wanted:
    """One person in one frame. head, foot: (2,) [px]. time: reference [s]. facing: whether the face may be seen."""

    track: int
    time: float
    head: Floats
    foot: Floats
    facing: bool


def check_pictures(source: FollowInput, session: Path) -> None:
    """Raise InputError where a session has no pictures."""
    if not source.videos and (source.log is None or not image_runs(LogReader(source.log))):
        remedy = "give the folder of videos, or a log with pictures; or leave out --crops"
        raise InputError("--crops needs pictures, and this session has none", file=session, remedy=remedy)


def write_crops(
    folder: Path,
    source: FollowInput,
    result: FollowResult,
    known: GivenCalibration,
    progress: Progress = lambda text, share: None,
) -> tuple[int, list[str]]:
    """Write ``folder/ID/CAMERA_TIME_{head,face,torso}.jpg``, in place of those of an earlier run; their number, and
    warnings.

    TIME: reference time [s]. One picture a region, track and camera between two of the wanted times. The region of the
    face only where the person walks towards the camera or across its view. Raises InputError, OSError.
    """
    for region in _REGIONS:
        for earlier in folder.glob(f"[0-9]*/*_*_{region}.jpg"):  # its numbers are of other people
            earlier.unlink()
    count, warnings = 0, []
    for index, (name, frames) in enumerate((plan := _wanted(source, result, known)).items()):
        shown = 0
        for sequence, image, scale in _pictures(source, name, known.sizes[name][0], frames.keys()):
            shown += 1
            progress(name, (index + shown / len(frames)) / len(plan))
            for one in frames[sequence]:
                count += _cut(folder / str(one.track), name, one, image, scale)
        if source.videos and shown < len(frames):  # a log need not have a picture of every frame
            lacking = f"{len(frames) - shown} of {len(frames)} frames with people are in no video"
            warnings.append(f"{name}: {lacking}: nothing is cut out of them")
    return count, warnings


def _wanted(source: FollowInput, result: FollowResult, known: GivenCalibration) -> dict[str, dict[int, list[_Wanted]]]:
    """By camera and frame number, who is cut out."""
    frames = {(message.camera, message.sequence): message for message in source.observations}
    out: dict[str, dict[int, list[_Wanted]]] = {}
    for name, camera in known.calibration.cameras.items():
        tracked = TrackingCamera.from_calibration(camera)
        mine: dict[int, list[_Wanted]] = defaultdict(list)
        for track in result.tracks:
            rows: list[tuple[int, int, pb.Detection]] = []
            taken: set[int] = set()
            for seen_by, sequence, index in sorted(track.detections, key=lambda entry: entry[1]):
                if seen_by != name:
                    continue
                message = frames[name, sequence]
                time_ns = tracked.reference_ns(message.device_time_ns)
                interval = int(np.searchsorted(source.times_ns, time_ns))
                if interval not in taken:
                    taken.add(interval)
                    rows.append((sequence, time_ns, message.detections[index]))
            times = np.array([time_ns for _, time_ns, _ in rows]) / NANOSECONDS
            states = _states(track, times, result.up)
            facing = _facing(track, times, states, tracked, result.up)
            ends = _ends([detection for _, _, detection in rows], states, tracked, result.up)
            for (sequence, _, _), time, towards, (head, foot) in zip(rows, times.tolist(), facing, ends, strict=True):
                if np.isfinite([head, foot]).all():
                    mine[sequence].append(_Wanted(track.id, time, head, foot, towards))
        if mine:
            out[name] = mine
    return out


def _states(track: FollowedTrack, times: Floats, up: Floats | None) -> Floats:
    """The filter's states (n, 7), without velocities, of a track at times (n,); NaN where up is not known."""
    mean = np.zeros((len(times), STATE_DIM))
    if up is None:
        return np.full_like(mean, np.nan)
    height = np.interp(times, track.times, track.height)
    for axis in range(3):
        mean[:, axis] = np.interp(times, track.times, track.position[:, axis]) + 0.5 * height * up[axis]
    mean[:, LOG_SIZE] = np.log(height)
    return mean


def _ends(
    detections: Sequence[pb.Detection], states: Floats, camera: TrackingCamera, up: Floats | None
) -> list[tuple[Floats, Floats]]:
    """Head and foot (2,) [px] of each detection of a track, or of its states (n, 7); NaN where neither has them."""
    kind = np.full(len(states), KIND_INDEX["person"])
    value = predict_measurement(camera, states, kind, up).value
    out = []
    for detection, *track in zip(
        detections, *(camera.intrinsics.project_normalised(value[:, rows]) for rows in (HEAD, FOOT)), strict=True
    ):
        found = [np.array(end) if len(end) == 2 else np.full(2, np.nan) for end in (detection.head, detection.foot)]
        off = np.linalg.norm(np.subtract(found, track), axis=1)
        near = off <= np.array([_HEAD_OFF, _FOOT_OFF]) * np.linalg.norm(track[0] - track[1])
        head, foot = found if near.all() or not np.isfinite(track).all() else track
        out.append((head, foot))
    return out


def _facing(
    track: FollowedTrack, times: Floats, states: Floats, camera: TrackingCamera, up: Floats | None
) -> list[bool]:
    """Whether a face may be seen at times (n,) with states (n, 7), if people look where they walk."""
    if up is None or len(track.times) < 2 or not len(times):
        return [False] * len(times)
    velocity = np.gradient(track.position, track.times, axis=0)
    velocity -= np.outer(velocity @ up, up)
    ahead = np.column_stack([np.interp(times, track.times, velocity[:, axis]) for axis in range(3)])
    speed = np.linalg.norm(ahead, axis=1, keepdims=True)
    ahead /= np.where(speed < _MIN_SPEED * np.exp(states[:, LOG_SIZE, None]), np.nan, speed)
    views = head_views(states, ahead, camera, TrackerParameters(up=up))
    return [view not in ("", "back") for view in views]


def _pictures(
    source: FollowInput, camera: str, width: int, wanted: Collection[int]
) -> Iterator[tuple[int, Image, float]]:
    """Frame number, picture, and its size over that of the frame in which was detected. width: of that frame [px].

    A video's frames are those of the same number, counted from 0, or from 1 where the times of all detections say so,
    and where the detections are not numbered, of the same time.
    """
    missing = set(wanted)
    mine = [message for message in source.observations if message.camera == camera]
    if camera in source.videos:
        from edge.devices.playback.video_reader import VideoReader

        video = VideoReader(source.videos[camera])
        scale, near_s = video.info.size[0] / width, 0.5 / video.info.fps
        numbered = all(message.frame == message.sequence for message in mine)
        times = np.array([message.device_time_ns / NANOSECONDS for message in mine])
        counted = np.array([message.sequence for message in mine])
        from_one = counted.min() > 0 and (np.abs(times - (counted - 1) / video.info.fps) < near_s).all()
        for frame in video:
            sequence = frame.frame + int(from_one)
            if not numbered:
                nearest = int(np.argmin(np.abs(times - frame.time)))
                sequence = mine[nearest].sequence if abs(times[nearest] - frame.time) <= near_s else -1
            if sequence in missing:
                missing.discard(sequence)
                yield sequence, frame.image(), scale
        return
    if source.log is None:
        return
    reader = LogReader(source.log)
    numbers = {(message.boot_id, message.device_time_ns): message.sequence for message in mine}
    for run in image_runs(reader):
        if run.camera != camera:
            continue
        for picture in read_images(reader, run):
            sequence = numbers.get((run.boot, picture.device_time_ns), -1)
            if sequence not in missing:
                continue
            image = decode_jpeg(picture.jpeg)
            if image is not None and picture.width > 0:
                yield sequence, image, image.shape[1] / picture.width


def _cut(folder: Path, camera: str, one: _Wanted, image: Image, scale: float) -> int:
    """Write the regions that are in the picture; returns their number."""
    head, foot = scale * one.head[None], scale * one.foot[None]
    face = face_regions(head, foot)[0]
    grown = np.r_[face[:2] - 0.5 * (_HEAD_MARGIN - 1.0) * face[2:], _HEAD_MARGIN * face[2:]]
    regions = {"head": grown, **({"face": face} if one.facing else {}), "torso": _torso(head[0], foot[0])}
    count = 0
    for region, (x, y, width, height) in regions.items():
        left, top = max(round(x), 0), max(round(y), 0)
        right, bottom = min(round(x + width), image.shape[1]), min(round(y + height), image.shape[0])
        inside = max(right - left, 0) * max(bottom - top, 0)
        if inside < _MIN_INSIDE * width * height or min(right - left, bottom - top) < _MIN_SIDE_PX:
            continue
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / f"{camera}_{one.time:.3f}_{region}.jpg"
        part = file.with_name(f".{file.name}")
        part.write_bytes(cv2.imencode(".jpg", image[top:bottom, left:right])[1].tobytes())
        part.replace(file)
        count += 1
    return count


def _torso(head: Floats, foot: Floats) -> Floats:
    """Upright box x, y, w, h around shoulders and hips of a body whose head and foot are at pixels (2,)."""
    along = foot - head
    aside = 0.5 * _SHOULDER_WIDTH * np.array([-along[1], along[0]])
    corners = np.array([head + share * along + sign * aside for share in (_SHOULDERS, _HIPS) for sign in (-1.0, 1.0)])
    low = corners.min(axis=0)
    return np.asarray(np.r_[low, corners.max(axis=0) - low])
