"""One detector over one video: rows of observations.csv, and what could not be read."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tomli_w

from edge.detectors.base import Detection, Detector
from edge.detectors.marker.ball import MarkerDetector, MarkerModel, teach
from edge.devices.playback.video_reader import Film
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics
from protocols.session.calibration import csv_cell
from protocols.session.rig import read_toml

HEADER = "camera,frame,time,u,v,size,label,score"
MARKER_FILE = "marker.toml"
"""What the marker looks like, beside the videos: found there by `calibrate`."""
_TELL_EVERY = 10  # frames


@dataclass(frozen=True, slots=True)
class Found:
    """What a detector saw in one video.

    rows: lines of observations.csv without its header. frames: how many could be read. seen: in how many there was
    something. corrupt: could not be decoded. repaired: without a usable time. size: (width, height) [px]. fps: mean.
    span: times [s] of the first and last frame.
    """

    rows: tuple[str, ...]
    frames: int
    seen: int
    corrupt: int
    repaired: int
    size: tuple[int, int]
    fps: float
    span: tuple[float, float]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know of the file."""
        told = []
        if self.corrupt:
            told.append(f"{self.corrupt} frames could not be decoded and were skipped")
        if self.repaired:
            told.append(f"{self.repaired} frames have no usable time stamp")
        return tuple(told)


def detect_in(
    film: Film,
    camera: str,
    detector: Detector,
    tell: Callable[[int], None] = lambda frame: None,
    stop: Callable[[], bool] = lambda: False,
    seen: dict[int, list[tuple[str, Detection]]] | None = None,
) -> Found:
    """Run a detector over all frames. tell: called with the frame's index now and then. stop: ends it early.

    seen: is filled with each frame's rows and detections; the rows have ``{label}`` where the label belongs.
    """
    rows: list[str] = []
    name = csv_cell(camera)
    frames = frames_with = 0
    first = last = math.nan
    for shot in film:
        if stop():
            break
        first = shot.time if frames == 0 else first
        last = shot.time
        frames += 1
        labels: set[str] = set()
        for one in detector.detect(shot.image(), shot.time):
            # One row a label and frame: detections come best first.
            if one.label in labels or not (math.isfinite(one.u) and math.isfinite(one.v)):
                continue
            labels.add(one.label)
            size = f"{one.size:.17g}" if one.size > 0 else ""
            place = f"{shot.frame},{shot.time:.17g},{one.u:.17g},{one.v:.17g}"
            if seen is not None:
                template = name.replace("{", "{{").replace("}", "}}")
                row = f"{template},{place},{size},{{label}},{one.score:.6g}"
                seen.setdefault(shot.frame, []).append((row, one))
            else:
                rows.append(f"{name},{place},{size},{csv_cell(one.label)},{one.score:.6g}")
        frames_with += bool(labels)
        if frames % _TELL_EVERY == 0:
            tell(frames)
    if not frames:
        raise InputError("no frame can be read from this file", file=film.path, remedy="replace it")
    # A mean rate that the container only guesses is better measured.
    fps = (frames - 1) / (last - first) if frames > 1 and last > first else film.info.fps
    return Found(tuple(rows), frames, frames_with, film.corrupt, film.repaired, film.info.size, fps, (first, last))


def with_overlay(film: Film, found: Found, seen: dict[int, list[tuple[str, Detection]]], overlay: Path) -> Found:
    """Draw what was seen into a copy of the film; ``found`` with its rows. Raises InputError."""
    from deploy.offline.detect_overlay import draw_overlay

    draw_overlay(film, overlay, {frame: [(one.label, one) for _, one in shown] for frame, shown in seen.items()})
    rows = [row.format(label=csv_cell(one.label)) for shown in seen.values() for row, one in shown]
    return replace(found, rows=tuple(rows))


def observations_text(rows: tuple[str, ...] | list[str], extra: str = "") -> str:
    """observations.csv. extra: names of further columns."""
    return "\n".join([HEADER + (f",{extra}" if extra else ""), *rows]) + "\n"


def marker_detector(model: MarkerModel, lens: Intrinsics | None, size: tuple[int, int]) -> MarkerDetector:
    """The detector of one camera; a lens of another image size than the video's says nothing of it."""
    fits = lens is not None and (lens.width, lens.height) == size
    return MarkerDetector(model, lens if fits else None)


def other_marker(
    mode: Literal["bright", "tag"],
    threshold: int = 200,
    dictionary: str = "apriltag_36h11",
    label: str = "marker",
    min_size: float | None = None,
    max_size: float | None = None,
) -> Detector:
    """The detector of a marker that is no coloured ball; see ``MarkerConfig``. Raises InputError."""
    if mode == "tag":
        from edge.detectors.marker.tag import TagDetector, TagModel

        tags = TagModel(dictionary, "tag" if label == "marker" else label)
        return TagDetector(tags if min_size is None else replace(tags, min_size=min_size))
    from edge.detectors.marker.bright import BrightDetector, BrightModel

    light = BrightModel(threshold, min_size or 0.0, label=label)
    return BrightDetector(light if max_size is None else replace(light, max_size=max_size))


def read_marker(file: Path) -> MarkerModel:
    """The marker that ``detect --teach`` wrote. Raises InputError."""
    values, _ = read_toml(file, "marker file")
    try:
        return MarkerModel.from_table(values)
    except InputError as error:
        raise InputError(error.what, file=file, remedy="make it again with `syncline detect marker --teach`") from None


def marker_text(model: MarkerModel) -> str:
    """A taught marker as TOML."""
    text = tomli_w.dumps(model.to_table())
    assert tomllib.loads(text)
    return text


def teach_from(film: Film, box: tuple[float, float, float, float], start: int) -> MarkerModel:
    """The marker inside a box x,y,w,h [px] of frame ``start``. Raises InputError."""
    for shot in film:
        if shot.frame == start:
            return teach(shot.image(), box)
    raise InputError(f"there is no frame {start}", file=film.path, remedy="give --start an index, 0 is the first")
