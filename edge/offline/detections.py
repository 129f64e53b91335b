"""The result of one detector in one video, and the loop that makes it."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from edge.detectors.base import BatchDetector, Detection, Detector
from edge.devices.playback.video_reader import VideoFrame, VideoReader
from protocols.core.errors import InputError
from protocols.core.files import write_together
from protocols.session.calibration import csv_cell
from protocols.session.csv_table import dataframe
from protocols.session.observations import COLUMNS

if TYPE_CHECKING:
    import pandas

    from protocols.messages import syncline_pb2 as pb

HEADER = ",".join(("camera", "frame", "time", "u", "v", "size", "label", *COLUMNS))
_PROGRESS_EVERY = 10  # frames

Collected = dict[int, tuple[float, list[Detection]]]
"""Of frames, by number: the time [s] and the detections."""


@dataclass(frozen=True, slots=True)
class VideoDetections:
    """All detections of one detector in one video.

    rows: lines of observations.csv without its header. frames: number of frames read. frames_with_detection: number
    of those with at least one row. corrupt: frames that could not be decoded. repaired: frames without a usable time
    stamp. size: (width, height) [px]. fps: mean frame rate [Hz]. span: times [s] of the first and last frame. warnings:
    problems of the video file, one line each.
    """

    rows: tuple[str, ...]
    frames: int
    frames_with_detection: int
    corrupt: int
    repaired: int
    size: tuple[int, int]
    fps: float
    span: tuple[float, float]
    warnings: tuple[str, ...] = ()

    def to_csv(self) -> str:
        """The text of observations.csv."""
        return observations_csv(self.rows)

    def save(self, path: str | Path) -> None:
        """Write observations.csv to ``path`` atomically, as `syncline detect` does. Raises InputError."""
        write_together({Path(path): self.to_csv()})

    def to_dataframe(self) -> pandas.DataFrame:
        """The columns of observations.csv, one row per detection. Needs pandas.

        camera, label and kind are text, frame is an integer, all others are floats (time in seconds, lengths in
        pixels); NaN = not measured. Raises InputError where pandas is not installed.
        """
        # Not by pandas.read_csv: a camera or a label may be called "NA".
        names, *rows = csv.reader(io.StringIO(self.to_csv()))
        kinds: dict[str, type] = {"camera": object, "label": object, "kind": object, "frame": np.int64}
        cells = np.array(rows, dtype=object).reshape(-1, len(names))
        texts = np.array([kinds.get(name) is object for name in names])
        cells[(cells == "") & ~texts] = "nan"
        return dataframe({name: cells[:, k].astype(kinds.get(name, np.float64)) for k, name in enumerate(names)})


def run_detector(
    video: VideoReader,
    camera: str,
    detector: Detector,
    on_frame: Callable[[int], None] = lambda frame: None,
    stop: Callable[[], bool] = lambda: False,
    collected: Collected | None = None,
) -> VideoDetections:
    """Run a detector over all frames of a video, at most one row per label and frame. Raises InputError.

    on_frame: called every ten frames with the number of frames done. stop: polled at each frame, ends the run early.
    collected: where given, is filled in place of the result's ``rows``; see ``detection_rows``.
    """
    found: Collected = {} if collected is None else collected
    rows: list[str] = []
    frames = frames_with = 0
    first = last = math.nan
    for frame, seen in detected_frames(video, detector, stop):
        first = frame.time if frames == 0 else first
        last = frame.time
        frames += 1
        by_label: dict[str, Detection] = {}
        for one in seen:
            # Detections come best first: the first one of each label is kept.
            if math.isfinite(one.u) and math.isfinite(one.v):
                by_label.setdefault(one.label, one)
        if by_label:
            frames_with += 1
            if collected is None:
                rows += detection_rows(camera, {frame.frame: (frame.time, list(by_label.values()))})
            else:
                found[frame.frame] = frame.time, list(by_label.values())
        if frames % _PROGRESS_EVERY == 0:
            on_frame(frames)
    if not frames:
        raise InputError("no frame can be read from this file", file=video.path, remedy="replace it")
    # The container's mean rate is often a guess: measure it.
    fps = (frames - 1) / (last - first) if frames > 1 and last > first else video.info.fps
    about = video.info.size, fps, (first, last), video.warnings
    return VideoDetections(tuple(rows), frames, frames_with, video.corrupt, video.repaired, *about)


def detected_frames(
    video: VideoReader, detector: Detector, stop: Callable[[], bool] = lambda: False
) -> Iterator[tuple[VideoFrame, Sequence[Detection]]]:
    """Each frame with its detections, best first, in batches where the detector takes them. stop: ends it early."""
    frames = iter(video)
    if not isinstance(detector, BatchDetector):
        for frame in frames:
            if stop():
                return
            yield frame, detector.detect(frame.image(), frame.time)
        return
    while (batch := list(islice(frames, detector.batch))) and not stop():
        seen = detector.detect_batch([frame.image() for frame in batch], [frame.time for frame in batch])
        yield from zip(batch, seen, strict=True)


def detection_rows(camera: str, collected: Collected) -> list[str]:
    """The lines of observations.csv, without its header."""
    cell = csv_cell(camera)
    return [
        ",".join((cell, str(number), f"{time:.17g}", cells_of(one)))
        for number, (time, seen) in collected.items()
        for one in seen
    ]


def cells_of(one: Detection | pb.Detection) -> str:
    """The cells from ``u`` on."""
    parts: list[float | None] = []
    for part, length in ((one.covariance, 3), (one.head, 2), (one.foot, 2), (one.box, 4)):
        parts += [None] * length if not part or not all(map(math.isfinite, part)) else list(part)
    size = one.size if one.size > 0 else None
    place = _numbers((one.u, one.v, size))
    return ",".join((place, csv_cell(one.label), f"{one.score:.6g}", one.kind, _numbers(parts)))


def _numbers(values: Iterable[float | None]) -> str:
    return ",".join("" if value is None else f"{value:.17g}" for value in values)


def observations_csv(rows: tuple[str, ...] | list[str]) -> str:
    """The text of observations.csv."""
    return "\n".join([HEADER, *rows]) + "\n"
