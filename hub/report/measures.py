"""Statistics for the report: row usage, image coverage, residual bins, and visibility over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.calibration import Calibration
from protocols.session.observations import Observations
from protocols.session.rig import Rig

COLUMNS, ROWS = 8, 5
"""The grid in which image coverage is counted."""
SEEN_WITHIN = 0.2
"""The point counts as visible within this time around a row [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class RowUsage:
    """Rows of one camera: total count, count used by the solution, and the frame interval [s]."""

    total: int
    used: int
    interval: float
    covered: Bools
    """(ROWS, COLUMNS): cells of the image that contain a used row."""

    @property
    def share(self) -> float:
        """Fraction of the rows that were used."""
        return self.used / self.total if self.total else 0.0

    @property
    def coverage(self) -> float:
        """Fraction of the image's cells that are covered."""
        return float(self.covered.mean())


def row_usage(calibration: Calibration, rig: Rig, observations: Observations) -> dict[str, RowUsage]:
    """Row statistics of every solved camera."""
    out = {}
    for name in calibration.cameras:
        residuals = calibration.residuals.get(name, np.zeros((0, 5)))
        times = camera_rows(observations, name)[:, 0]
        size = calibration.cameras[name].intrinsics
        out[name] = RowUsage(
            total=max(len(times), len(residuals)),
            used=len(residuals),
            interval=frame_interval(rig, observations, name),
            covered=covered_cells(residuals[:, 1:3], (size.width, size.height)),
        )
    return out


def camera_rows(observations: Observations, camera: str) -> Floats:
    """Camera time, u, v (n, 3) of all rows of a camera."""
    parts = [np.column_stack([track.time, track.pixels]) for track in observations.of_camera(camera)]
    return np.concatenate(parts) if parts else np.zeros((0, 3))


def frame_interval(rig: Rig, observations: Observations, camera: str) -> float:
    """Frame interval [s]: from the nominal rate, or the median between rows; 0 if unknown."""
    fps = rig.cameras[camera].fps if camera in rig.cameras else 0.0
    if fps > 0:
        return 1.0 / fps
    steps = [np.diff(track.time) for track in observations.of_camera(camera) if len(track) > 2]
    return float(np.median(np.concatenate(steps))) if steps else 0.0


def covered_cells(pixels: Floats, size: tuple[int, int]) -> Bools:
    """(ROWS, COLUMNS): which cells of the image contain at least one of the pixels (n, 2)."""
    out = np.zeros((ROWS, COLUMNS), dtype=np.bool_)
    column, row = _cell_indices(pixels, size, COLUMNS, ROWS)
    out[row, column] = True
    return out


def _cell_indices(pixels: Floats, size: tuple[int, int], columns: int, rows: int) -> tuple[Ints, Ints]:
    # OpenCV's pixel centres are whole numbers: the image reaches from -0.5 to size - 0.5.
    column = np.clip(np.floor((pixels[:, 0] + 0.5) / size[0] * columns), 0, columns - 1).astype(np.int64)
    row = np.clip(np.floor((pixels[:, 1] + 0.5) / size[1] * rows), 0, rows - 1).astype(np.int64)
    return column, row


def empty_regions(covered: Bools) -> list[str]:
    """Names of the ninths of the image without any covered cell."""
    out = []
    for down, name in zip(np.array_split(np.arange(ROWS), 3), ("top", "middle", "bottom"), strict=True):
        for across, side in zip(np.array_split(np.arange(COLUMNS), 3), ("left", "centre", "right"), strict=True):
            if not covered[np.ix_(down, across)].any():
                out.append("centre" if (name, side) == ("middle", "centre") else f"{name} {side}")
    return out


@dataclass(frozen=True, slots=True, eq=False)
class ResidualBins:
    """Residuals binned by image position: only bins with rows.

    centre: (n, 2) [px]. mean: (n, 2) mean residual [px]. rms: (n,) [px]. count: (n,).
    """

    centre: Floats
    mean: Floats
    rms: Floats
    count: Ints
    cell: tuple[float, float]

    @property
    def systematic(self) -> float:
        """Fraction of the squared residuals explained by the bins' means (0..1), for bins of 8 rows or more."""
        enough = self.count >= 8
        total = float((self.count[enough] * self.rms[enough] ** 2).sum())
        # The mean of n noisy rows is not zero: its expected square is subtracted.
        explained = (self.count[enough] * (self.mean[enough] ** 2).sum(axis=1) - self.rms[enough] ** 2).sum()
        return max(float(explained) / total, 0.0) if total > 0 else 0.0


def residual_bins(residuals: Floats, size: tuple[int, int], columns: int = 16) -> ResidualBins:
    """Bin residuals (n, 5: time, u, v, du, dv) over a grid of nearly square cells."""
    rows = max(1, round(columns * size[1] / size[0]))
    column, row = _cell_indices(residuals[:, 1:3], size, columns, rows)
    index, inverse = np.unique(row * columns + column, return_inverse=True)
    count = np.bincount(inverse, minlength=len(index))
    safe = np.maximum(count, 1)
    mean = np.column_stack([np.bincount(inverse, residuals[:, k], len(index)) / safe for k in (3, 4)])
    square = np.bincount(inverse, (residuals[:, 3:5] ** 2).sum(axis=1), len(index)) / safe
    cell = (size[0] / columns, size[1] / rows)
    centre = np.column_stack([(index % columns + 0.5) * cell[0] - 0.5, (index // columns + 0.5) * cell[1] - 0.5])
    return ResidualBins(centre, mean, np.sqrt(square), count.astype(np.int64), cell)


Span = tuple[float, float]


def spans(time: Floats, gap: float = 2 * SEEN_WITHIN) -> list[Span]:
    """Intervals of time [s] without a gap longer than ``gap``."""
    if not len(time):
        return []
    time = np.sort(time)
    breaks = np.flatnonzero(np.diff(time) > gap)
    begins = time[np.r_[0, breaks + 1]]
    ends = time[np.r_[breaks, len(time) - 1]]
    return [(float(a), float(b)) for a, b in zip(begins, ends, strict=True)]


def shared_spans(seen: list[list[Span]], reach: float = SEEN_WITHIN) -> list[Span]:
    """Intervals in which at least two cameras saw the point within ``reach`` seconds."""
    events: list[tuple[float, int]] = []
    for camera in seen:
        for begin, end in camera:
            events += [(begin - reach, 1), (end + reach, -1)]
    out: list[Span] = []
    count, begin = 0, 0.0
    for time, change in sorted(events, key=lambda event: (event[0], -event[1])):
        before, count = count, count + change
        if before < 2 <= count:
            begin = time
        elif before >= 2 > count and time > begin:
            out.append((begin, time))
    return out


def total_length(intervals: list[Span]) -> float:
    """Total duration [s]."""
    return sum(end - begin for begin, end in intervals)


def seen_on_reference(calibration: Calibration, observations: Observations) -> dict[str, list[Span]]:
    """Intervals in which each solved camera has detections, on the reference clock."""
    out = {}
    for name, camera in calibration.cameras.items():
        time = camera_rows(observations, name)[:, 0]
        clock = camera.time_map
        out[name] = spans(clock.clock_rate * time + clock.time_offset)
    return out


def trajectory_coverage(calibration: Calibration, observations: Observations) -> tuple[float, float]:
    """Fraction of the time in which two cameras saw a point that its trajectory covers, and that time [s]."""
    covered = wanted = 0.0
    tables = {table.label: table for table in calibration.trajectories}
    for label in observations.labels:
        seen = []
        for name, camera in calibration.cameras.items():
            track = observations.tracks.get((name, label))
            if track is not None:
                seen.append(spans(camera.time_map.clock_rate * track.time + camera.time_map.time_offset))
        both = shared_spans(seen)
        wanted += total_length(both)
        if label in tables:
            time = tables[label].time
            step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
            covered += total_length(shared_spans([both, spans(time, max(0.1, 2.5 * step))], reach=0.0))
    return (covered / wanted if wanted > 0 else 0.0), wanted


def estimate_up(calibration: Calibration, rig: Rig) -> Floats:
    """Up as a unit vector (3,) in the world frame: from the rig, else the mean up direction of the cameras."""
    levelled = np.array([0.0, -1.0, 0.0])
    poses = {name: camera.pose for name, camera in calibration.cameras.items()}
    if isinstance(rig.up, str) and rig.up in poses:
        return np.asarray(poses[rig.up].rotation.T @ rig.up_in_camera(rig.up))
    surveyed = any(camera.rotation is not None or camera.position is not None for camera in rig.cameras.values())
    if rig.up is not None and not isinstance(rig.up, str):
        return rig.up if surveyed else np.array([0.0, 0.0, 1.0])
    mean = np.sum([pose.rotation.T @ levelled for pose in poses.values()], axis=0)
    if np.linalg.norm(mean) < 0.2:
        return np.array([0.0, 0.0, 1.0])
    mean = mean / np.linalg.norm(mean)
    if surveyed and mean[2] > 0.5:  # the z axis of a surveyed world almost always points up
        return np.array([0.0, 0.0, 1.0])
    return np.asarray(mean)


def thinned_indices(count: int, limit: int) -> Ints:
    """At most ``limit`` evenly spread indices of ``count``, first and last among them."""
    if count <= limit:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, limit).round().astype(np.int64))
