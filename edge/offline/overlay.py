"""Draws detections into a copy of a video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from edge.detectors.base import Detection
from edge.devices.playback.video_reader import VideoReader
from edge.devices.playback.video_writer import video_writer
from protocols.geometry.types import Image

_HUES = 12  # that the eye can tell apart


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
