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
from hub.tracking.filter.kalman import POSITION
from hub.tracking.messages import face_regions, head_views
from hub.tracking.parameters import TrackerParameters
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.core.jpeg import decode_jpeg
from protocols.geometry.types import Floats, Image
from protocols.log.read.images import image_runs, read_images
from protocols.log.read.reader import LogReader
from protocols.messages import syncline_pb2 as pb
from protocols.session.rig import METRES_PER_UNIT

if TYPE_CHECKING:
    from deploy.offline.follow.calibration import GivenCalibration
    from deploy.offline.follow.source import FollowInput
    from hub.tracking.offline import FollowedTrack

_HEAD_MARGIN = 1.3
"""Sides of the head's picture over those of the region of head and face: hair, and a few per cent of error in the
height of a detection."""
_SHOULDERS, _HIPS, _SHOULDER_WIDTH = 0.18, 0.52, 0.30
"""Of a torso, in statures from the top of the head: Drillis and Contini (1966) have shoulders at 0.818 and hips at
0.530 of the stature, and 0.259 across the shoulders; the arms add to that."""
_MIN_SPEED_M_S = 0.25
"""Who walks more slowly may look anywhere."""
_REGIONS = "head", "face", "torso"
_MIN_SIDE_PX = 6  # a smaller crop shows nothing
_MIN_INSIDE = 0.7
"""Share of a region that must be in the picture."""


@dataclass(frozen=True, slots=True)
class _Wanted:
    """One person in one frame. head, foot: [px]. time: reference [s]. facing: whether the face may be seen."""

    track: int
    time: float
    head: tuple[float, float]
    foot: tuple[float, float]
    facing: bool


def check_pictures(source: FollowInput, session: Path) -> None:
    """Raise InputError where a session has no pictures."""
    if not source.videos and (source.log is None or not image_runs(LogReader(source.log))):
        remedy = "give the folder of videos, or a log with pictures; or leave out --crops"
        raise InputError("--crops needs pictures, and this session has none", file=session, remedy=remedy)


def write_crops(
    folder: Path,
    source: FollowInput,
    tracks: Sequence[FollowedTrack],
    known: GivenCalibration,
    progress: Progress = lambda text, share: None,
) -> int:
    """Write ``folder/ID/CAMERA_TIME_{head,face,torso}.jpg``, in place of those of an earlier run; returns their number.

    TIME: reference time [s]. One picture a region, track and camera between two of the wanted times. The region of the
    face only where the person walks towards the camera or across its view. Raises InputError, OSError.
    """
    for region in _REGIONS:
        for earlier in folder.glob(f"[0-9]*/*_*_{region}.jpg"):  # its numbers are of other people
            earlier.unlink()
    count = 0
    for index, (name, frames) in enumerate((plan := _wanted(source, tracks, known)).items()):
        for sequence, image, scale in _pictures(source, name, frames.keys()):
            for one in frames[sequence]:
                count += _cut(folder / str(one.track), name, one, image, scale)
        progress(name, (index + 1) / len(plan))
    return count


def _wanted(
    source: FollowInput, tracks: Sequence[FollowedTrack], known: GivenCalibration
) -> dict[str, dict[int, list[_Wanted]]]:
    """By camera and frame number, who is cut out."""
    frames = {(message.camera, message.sequence): message for message in source.observations}
    out: dict[str, dict[int, list[_Wanted]]] = {}
    for name, camera in known.calibration.cameras.items():
        tracked = TrackingCamera.from_calibration(camera)
        mine: dict[int, list[_Wanted]] = defaultdict(list)
        for track in tracks:
            rows: list[tuple[int, int, pb.Detection]] = []
            taken: set[int] = set()
            for seen_by, sequence, index in sorted(track.detections, key=lambda entry: entry[1]):
                if seen_by != name:
                    continue
                message = frames[name, sequence]
                time_ns = tracked.reference_ns(message.device_time_ns)
                interval = int(np.searchsorted(source.times_ns, time_ns))
                detection = message.detections[index]
                if interval not in taken and len(detection.head) == 2 and len(detection.foot) == 2:
                    taken.add(interval)
                    rows.append((sequence, time_ns, detection))
            times = np.array([time_ns for _, time_ns, _ in rows]) / NANOSECONDS
            facing = _facing(track, times, tracked, known)
            for (sequence, _, detection), time, towards in zip(rows, times.tolist(), facing, strict=True):
                head, foot = (detection.head[0], detection.head[1]), (detection.foot[0], detection.foot[1])
                mine[sequence].append(_Wanted(track.id, time, head, foot, towards))
        if mine:
            out[name] = mine
    return out


def _facing(track: FollowedTrack, times: Floats, camera: TrackingCamera, known: GivenCalibration) -> list[bool]:
    """Whether a face may be seen at times (n,), if people look where they walk."""
    if known.up is None or len(track.times) < 2 or not len(times):
        return [False] * len(times)
    velocity = np.gradient(track.position, track.times, axis=0)
    velocity -= np.outer(velocity @ known.up, known.up)
    mean, ahead = np.zeros((len(times), 7)), np.zeros((len(times), 3))
    for axis in range(3):
        mean[:, POSITION.start + axis] = np.interp(times, track.times, track.position[:, axis])
        ahead[:, axis] = np.interp(times, track.times, velocity[:, axis])
    speed = np.linalg.norm(ahead, axis=1, keepdims=True)
    slow = _MIN_SPEED_M_S / METRES_PER_UNIT[known.calibration.units]
    ahead /= np.where(speed < slow, np.nan, speed)
    views = head_views(mean, ahead, camera, TrackerParameters(up=known.up))
    return [view not in ("", "back") for view in views]


def _pictures(source: FollowInput, camera: str, wanted: Collection[int]) -> Iterator[tuple[int, Image, float]]:
    """Frame number, picture, and its size over that of the frame in which was detected."""
    missing = set(wanted)
    if camera in source.videos:
        from edge.devices.playback.video_reader import VideoReader

        for frame in VideoReader(source.videos[camera]):
            if frame.frame in missing:
                yield frame.frame, frame.image(), 1.0
        return
    if source.log is None:
        return
    reader = LogReader(source.log)
    mine = [message for message in source.observations if message.camera == camera]
    numbers = {(message.boot_id, message.device_time_ns): message.sequence for message in mine}
    for run in image_runs(reader):
        if run.camera != camera:
            continue
        for picture in read_images(reader, run):
            sequence = numbers.get((run.boot, picture.device_time_ns))
            if sequence not in missing:
                continue
            image = decode_jpeg(picture.jpeg)
            if image is not None and sequence is not None and picture.width > 0:
                yield sequence, image, image.shape[1] / picture.width


def _cut(folder: Path, camera: str, one: _Wanted, image: Image, scale: float) -> int:
    """Write the regions that are in the picture; returns their number."""
    head, foot = scale * np.array([one.head]), scale * np.array([one.foot])
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
