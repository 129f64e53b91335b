"""The result of one detector in one video, and the loop that makes it."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from edge.detectors.base import Detection, Detector
from edge.devices.playback.video_reader import VideoReader
from protocols.core.errors import InputError
from protocols.core.files import write_together
from protocols.core.tables import dataframe
from protocols.session.calibration import csv_cell

if TYPE_CHECKING:
    import pandas

HEADER = "camera,frame,time,u,v,size,label,score"
_PROGRESS_EVERY = 10  # frames


@dataclass(frozen=True, slots=True)
class VideoDetections:
    """All detections of one detector in one video.

    rows: lines of observations.csv without its header. frames: number of frames read. frames_with_detection: number
    of those with at least one row. corrupt: frames that could not be decoded. repaired: frames without a usable time
    stamp. size: (width, height) [px]. fps: mean frame rate [Hz]. span: times [s] of the first and last frame.
    extra_columns: names of the columns after ``score``, separated by commas.
    """

    rows: tuple[str, ...]
    frames: int
    frames_with_detection: int
    corrupt: int
    repaired: int
    size: tuple[int, int]
    fps: float
    span: tuple[float, float]
    extra_columns: str = ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Problems of the video file, one line each."""
        warnings = []
        if self.corrupt:
            warnings.append(f"{self.corrupt} frames could not be decoded and were skipped")
        if self.repaired:
            warnings.append(f"{self.repaired} frames have no usable time stamp")
        return tuple(warnings)

    def to_csv(self) -> str:
        """The text of observations.csv."""
        return observations_csv(self.rows, self.extra_columns)

    def save(self, path: str | Path) -> None:
        """Write observations.csv to ``path`` atomically, as `syncline detect` does. Raises InputError."""
        write_together({Path(path): self.to_csv()})

    def to_dataframe(self) -> pandas.DataFrame:
        """The columns of observations.csv, one row per detection. Needs pandas.

        camera and label are text, frame is an integer, all others are floats (time in seconds, u, v and size in
        pixels); NaN = not measured. Raises InputError where pandas is not installed.
        """
        # Not by pandas.read_csv: a camera or a label may be called "NA".
        names, *rows = csv.reader(io.StringIO(self.to_csv()))
        kinds: dict[str, type] = {"camera": object, "label": object, "frame": np.int64}
        cells = np.array(rows, dtype=object).reshape(-1, len(names))
        cells[cells == ""] = "nan"
        return dataframe({name: cells[:, k].astype(kinds.get(name, np.float64)) for k, name in enumerate(names)})


def run_detector(
    video: VideoReader,
    camera: str,
    detector: Detector,
    on_frame: Callable[[int], None] = lambda frame: None,
    stop: Callable[[], bool] = lambda: False,
    collected: dict[int, list[tuple[str, Detection]]] | None = None,
) -> VideoDetections:
    """Run a detector over all frames of a video, at most one row per label and frame. Raises InputError.

    on_frame: called every ten frames with the number of frames done. stop: polled at each frame, ends the run early.
    seen: where given, is filled with each frame's rows and detections in place of the result's ``rows``; its rows are
    format strings with ``{label}`` in place of the label.
    """
    rows: list[str] = []
    name = csv_cell(camera)
    frames = frames_with = 0
    first = last = math.nan
    for frame in video:
        if stop():
            break
        first = frame.time if frames == 0 else first
        last = frame.time
        frames += 1
        labels: set[str] = set()
        for one in detector.detect(frame.image(), frame.time):
            # Detections come best first: the first one of each label is kept.
            if one.label in labels or not (math.isfinite(one.u) and math.isfinite(one.v)):
                continue
            labels.add(one.label)
            size = f"{one.size:.17g}" if one.size > 0 else ""
            place = f"{frame.frame},{frame.time:.17g},{one.u:.17g},{one.v:.17g}"
            if collected is not None:
                template = name.replace("{", "{{").replace("}", "}}")
                row = f"{template},{place},{size},{{label}},{one.score:.6g}"
                collected.setdefault(frame.frame, []).append((row, one))
            else:
                rows.append(f"{name},{place},{size},{csv_cell(one.label)},{one.score:.6g}")
        frames_with += bool(labels)
        if frames % _PROGRESS_EVERY == 0:
            on_frame(frames)
    if not frames:
        raise InputError("no frame can be read from this file", file=video.path, remedy="replace it")
    # The container's mean rate is often a guess: measure it.
    fps = (frames - 1) / (last - first) if frames > 1 and last > first else video.info.fps
    return VideoDetections(
        tuple(rows), frames, frames_with, video.corrupt, video.repaired, video.info.size, fps, (first, last)
    )


def observations_csv(rows: tuple[str, ...] | list[str], extra: str = "") -> str:
    """The text of observations.csv. extra: names of the columns after ``score``, separated by commas."""
    return "\n".join([HEADER + (f",{extra}" if extra else ""), *rows]) + "\n"
