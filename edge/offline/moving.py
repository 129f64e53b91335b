"""People and vehicles in a whole video: detected in two passes, background first, and drawn into a copy."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from edge.detectors.base import Detection
from edge.detectors.moving.foreground import SubtractorName
from edge.detectors.moving.vehicle import VehicleDetector
from edge.detectors.people.person import PersonDetector
from edge.devices.playback.video_reader import VideoReader
from edge.devices.playback.video_writer import video_writer
from edge.offline.detections import Collected, VideoDetections, detection_rows, run_detector
from protocols.core.errors import Refused
from protocols.geometry.types import Image

MovingDetector = PersonDetector | VehicleDetector
_LEARN_S, _LEARN_IMAGES = 60.0, 48  # from the beginning of a video: in a minute everybody has moved
_HEIGHT_FRAMES = 400  # from which the height model is learned first
_MIN_FRAMES = 5  # of a track: fewer are flicker
MAX_MOVING_SHARE = 0.3
"""Share of the time: where a camera moves for longer, people are not detected."""

_HUES = 12  # that the eye can tell apart


def moving_detector(what: str, model: SubtractorName, fps: float) -> MovingDetector:
    """A detector that also reports tentative tracks: in a recording they are confirmed or dropped at the end."""
    if what == "person":
        return PersonDetector(model, fps, confirmed_only=False)
    return VehicleDetector(model, fps, confirmed_only=False)


def detect_moving(
    video: VideoReader,
    camera: str,
    detector: MovingDetector,
    progress: Callable[[str, float], None] = lambda text, fraction: None,
    overlay: Path | None = None,
) -> VideoDetections:
    """Read a video twice: its first minute to learn the background and people's heights, then all of it.

    progress: called with a text and the fraction done. Labels hold within the video: p0, p1, … of people (``person``
    where there is never more than one at a time), t0, t1, … of vehicles. overlay: video file to write with the
    detections drawn into it. Raises InputError.
    """
    total = max(video.info.frames, 1)
    learn_background(video, detector, progress)
    shown: Collected = {}

    def on_frame(frame: int) -> None:
        progress(f"frame {frame} of {total}", frame / total)

    found = run_detector(video, camera, detector, on_frame, collected=shown)
    return named_detections(video, camera, found, shown, confirmed_labels(shown, detector), overlay)


def named_detections(
    video: VideoReader,
    camera: str,
    found: VideoDetections,
    collected: Collected,
    names: dict[str, str],
    overlay: Path | None = None,
) -> VideoDetections:
    """The result with the rows of the labels in ``names``, and their new names. overlay: see ``detect_moving``."""
    kept = {
        frame: (time, [replace(one, label=names[one.label]) for one in seen if one.label in names])
        for frame, (time, seen) in collected.items()
    }
    if overlay is not None:
        write_overlay(video, overlay, {frame: [(one.label, one) for one in seen] for frame, (_, seen) in kept.items()})
    frames_with_detection = sum(bool(seen) for _, seen in kept.values())
    return replace(found, rows=tuple(detection_rows(camera, kept)), frames_with_detection=frames_with_detection)


def learn_background(
    video: VideoReader,
    detector: MovingDetector,
    progress: Callable[[str, float], None] = lambda text, fraction: None,
) -> None:
    """Learn the background from images spread over the first minute, then people's heights from its first frames."""
    fps = video.info.fps
    span = min(video.info.frames or 10**9, round(_LEARN_S * fps))
    every = max(span // _LEARN_IMAGES, 1)
    images: list[Image] = []
    progress("learning the background", 0.0)
    for frame in video:
        if frame.frame >= span or len(images) > 2 * _LEARN_IMAGES:
            break
        if frame.frame % every == 0:
            images.append(frame.image())
    if len(images) > 4:
        detector.initialise(images)
    del images
    for frame in video:
        if frame.frame >= min(_HEIGHT_FRAMES, span):
            break
        detector.detect(frame.image(), frame.time)
    if isinstance(detector, PersonDetector) and detector.moving_share > MAX_MOVING_SHARE:
        raise Refused(
            f"{video.path}: the camera moves in {100 * detector.moving_share:.0f} % of the time, and people are "
            "detected before a fixed camera only: use a detector network"
        )
    detector.rewind()


def confirmed_labels(collected: Collected, detector: MovingDetector) -> dict[str, str]:
    """Output labels of the confirmed tracks, numbered in order of appearance."""
    names: dict[str, str] = {}
    at_once = 0
    stationary = _stationary_labels(collected) if isinstance(detector, VehicleDetector) else set()
    for _, shown in collected.values():
        confirmed = [one for one in shown if detector.is_confirmed(one.label) and one.label not in stationary]
        at_once = max(at_once, len(confirmed))
        for one in sorted(confirmed, key=lambda each: int(each.label[1:])):
            names.setdefault(one.label, f"{one.label[0]}{len(names)}")
    if isinstance(detector, PersonDetector) and at_once == 1:
        return dict.fromkeys(names, "person")
    return names


def _stationary_labels(collected: Collected) -> set[str]:
    """Labels of tracks of few frames or of a displacement below their own length: paint, shadows, swaying trees."""
    seen: dict[str, list[Detection]] = {}
    for _, shown in collected.values():
        for one in shown:
            seen.setdefault(one.label, []).append(one)
    stationary = set()
    for label, ones in seen.items():
        # A box that grows after its first frame moves its centre: compare with the longest side it ever had.
        length = max(max(one.box[2:]) if one.box else one.size for one in ones)
        displacement = max(math.hypot(one.u - ones[0].u, one.v - ones[0].v) for one in ones)
        if len(ones) < _MIN_FRAMES or displacement < length:
            stationary.add(label)
    return stationary


def write_overlay(video: VideoReader, out: Path, found: Mapping[int, Sequence[tuple[str, Detection]]]) -> None:
    """Write ``out`` with boxes, heads (white), feet (black), representative points and labels. Raises InputError."""
    with video_writer(out, video.info.fps, "give --overlay a name that ends in .mp4") as write:
        for frame in video:
            write(draw_detections(frame.image(), found.get(frame.frame, ())))


def draw_detections(image: Image, found: Sequence[tuple[str, Detection]]) -> Image:
    """A copy of an image (H, W, 3) BGR with labelled detections drawn into it."""
    drawn = image.copy()
    for label, one in found:
        colour = _colour(label)
        if one.box is not None:
            x, y, w, h = (round(value) for value in one.box)
            cv2.rectangle(drawn, (x, y), (x + w, y + h), colour, 2)
            cv2.putText(drawn, label, (x, max(y - 4, 10)), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
        for place, shade in ((one.head, (255, 255, 255)), (one.foot, (0, 0, 0))):
            if place is not None:
                cv2.circle(drawn, (round(place[0]), round(place[1])), 3, shade, -1, cv2.LINE_AA)
        cv2.circle(drawn, (round(one.u), round(one.v)), 3, colour, -1, cv2.LINE_AA)
    return drawn


def _colour(label: str) -> tuple[int, int, int]:
    number = sum(ord(letter) * (index + 1) for index, letter in enumerate(label)) * 5
    hue = np.array([[[number % _HUES * (180 // _HUES), 220, 240]]], dtype=np.uint8)
    blue, green, red = (int(value) for value in cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0])
    return blue, green, red
