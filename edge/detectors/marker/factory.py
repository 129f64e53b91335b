"""Marker detectors by mode: ball, point of light, fiducial tags."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from edge.detectors.base import Detector
from edge.detectors.marker.ball import MarkerDetector, MarkerModel
from protocols.geometry.camera import Intrinsics


def ball_detector(model: MarkerModel, lens: Intrinsics | None, size: tuple[int, int]) -> MarkerDetector:
    """The ball detector of one camera; a lens given for an image size other than the video's is ignored."""
    fits = lens is not None and (lens.width, lens.height) == size
    return MarkerDetector(model, lens if fits else None)


def bright_or_tag_detector(
    mode: Literal["bright", "tag"],
    threshold: int = 200,
    dictionary: str = "apriltag_36h11",
    label: str = "marker",
    min_size: float | None = None,
    max_size: float | None = None,
) -> Detector:
    """The detector of a point of light or of fiducial tags; see ``MarkerConfig``. Raises InputError."""
    if mode == "tag":
        from edge.detectors.marker.tag import TagDetector, TagModel

        tags = TagModel(dictionary, "tag" if label == "marker" else label)
        return TagDetector(tags if min_size is None else replace(tags, min_size=min_size))
    from edge.detectors.marker.bright import BrightDetector, BrightModel

    light = BrightModel(threshold, min_size or 0.0, label=label)
    return BrightDetector(light if max_size is None else replace(light, max_size=max_size))
