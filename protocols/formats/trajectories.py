"""Export of trajectories: TRC of OpenSim and Pose2Sim, C3D of motion capture, caliscope's tables of points of 2025."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from protocols.core.clocks import TimeMap
from protocols.core.errors import InputError
from protocols.core.files import completed_file
from protocols.geometry.types import Floats, Ints
from protocols.session.calibration import TrajectoryTable, read_labelled_rows
from protocols.session.observations import Observations
from protocols.session.rig import METRES_PER_UNIT

_BRIDGED = 1.5  # frame intervals between the observations of one interpolation: none where a frame between is missing
_IMAGE = (
    "sync_index,cam_id,frame_index,frame_time,object_id,keypoint_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y,obj_loc_z"
)
_WORLD = "sync_index,object_id,keypoint_id,x_coord,y_coord,z_coord,frame_time"


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryGrid:
    """Trajectories on one grid of constant rate [Hz]. cells: (n, 3 labels) x, y, z of each label; NaN = a gap.
    begin: reference time of the first row [s]."""

    labels: tuple[str, ...]
    begin: float
    rate: float
    cells: Floats


def read_grid(file: Path, units: str, wanted: str) -> TrajectoryGrid:
    """A trajectory.csv or track.csv in ``wanted`` units on a grid. Raises InputError: file, line, what, remedy."""
    remedy = "give the trajectory.csv of `calibrate`, the track.csv of `triangulate` or the tracks.csv of `follow`"
    paths = read_labelled_rows(file, ("time", "x", "y", "z"), remedy)
    if not paths:
        raise InputError("no rows", file=file, line=1, remedy=remedy)
    for label, path in paths.items():
        if len(np.unique(path[:, 0])) < len(path):
            raise InputError(f"{label} has several rows of one time", file=file, remedy=f"name what moves; {remedy}")
    times, frames = grid_frames(paths)
    count = int(frames[-1]) + 1
    rate = (count - 1) / float(times[-1] - times[0]) if count > 1 else 1.0
    scale = METRES_PER_UNIT[units] / METRES_PER_UNIT[wanted]
    cells = np.full((count, 3 * len(paths)), math.nan)
    for column, path in enumerate(paths.values()):
        at = frames[np.clip(np.searchsorted(times, path[:, 0] - 1e-6), 0, len(times) - 1)]
        cells[at, 3 * column : 3 * column + 3] = scale * path[:, 1:4]
    return TrajectoryGrid(tuple(paths), float(times[0]), rate, cells)


def trc_text(file: Path, name: str, units: str) -> tuple[str, float]:
    """A trajectory as TRC (OpenSim): constant rate, empty where a label has no position, m or mm.

    Time 0 is the first row, whose reference time [s] is returned too. Raises InputError: file, line, what, remedy.
    """
    written_units = "m" if units == "cm" else units
    grid = read_grid(file, units, written_units)
    paths, rate, cells, count = grid.labels, grid.rate, grid.cells, len(grid.cells)
    keys = "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames"
    axes = "\t".join(f"{axis}{i}" for i in range(1, len(paths) + 1) for axis in "XYZ")
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        keys,
        f"{rate:.9g}\t{rate:.9g}\t{count}\t{len(paths)}\t{written_units}\t{rate:.9g}\t1\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(label.replace("\t", " ") for label in paths) + "\t\t",
        "\t\t" + axes,
        "",
    ]
    for index, row in enumerate(cells):
        shown = "\t".join("" if math.isnan(value) else f"{value:.9g}" for value in row)
        lines.append(f"{index + 1}\t{index / rate:.9g}\t{shown}")
    return "\n".join(lines) + "\n", grid.begin


def write_c3d(source: Path, out: Path, units: str) -> float:
    """Write a trajectory as a C3D file at its constant rate, through ezc3d; gaps have residual -1.

    units: of the trajectory; C3D files are in millimetres. Returns the first row's reference time [s]. Raises
    InputError.
    """
    try:
        import ezc3d
    except ImportError:
        raise InputError("C3D files need ezc3d, which is not installed", remedy="pip install 'syncline[c3d]'") from None
    grid = read_grid(source, units, "mm")
    count, labels = len(grid.cells), len(grid.labels)
    points = np.full((4, labels, count), np.nan)
    points[:3] = grid.cells.reshape(count, labels, 3).transpose(2, 1, 0)
    missing = np.isnan(points[0])
    points[3] = np.where(missing, -1.0, 1.0)
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [grid.rate]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["LABELS"]["value"] = list(grid.labels)
    file["data"]["points"] = points
    file["data"]["meta_points"]["residuals"] = np.where(missing, -1.0, 0.0)[None]
    try:
        with completed_file(out) as part:
            file.write(str(part))
    except (OSError, RuntimeError) as error:
        raise InputError(f"cannot be written: {error}", file=out, remedy="choose another --out") from None
    return grid.begin


def grid_frames(paths: Mapping[str, Floats]) -> tuple[Floats, Ints]:
    """All times (n,) [s] of some trajectories and the frame (n,) of each on one grid of constant rate.

    The grid's step is the 10 % quantile of the trajectories' own steps; gaps are multiples of it.
    """
    joined = np.unique(np.concatenate([path[:, 0] for path in paths.values()]))
    times = joined[np.r_[True, np.diff(joined) > 1e-6]]
    steps = np.concatenate([np.diff(np.sort(path[:, 0])) for path in paths.values()])
    steps = steps[steps > 1e-6]
    if not len(steps):
        return times, np.arange(len(times), dtype=np.int64)
    step = float(np.quantile(steps, 0.1, method="lower"))
    ahead = np.maximum(np.rint(np.diff(times) / step), 1).astype(np.int64)
    return times, np.r_[np.zeros(1, dtype=np.int64), np.cumsum(ahead)]


def point_tables(
    seen: Observations,
    clocks: Mapping[str, TimeMap],
    numbers: Mapping[str, int],
    paths: Sequence[TrajectoryTable],
    factor: float,
) -> tuple[dict[str, str], tuple[str, ...]]:
    """The texts of both tables by file name, and a note on how points are numbered where their labels are no numbers.

    One sync_index of caliscope is one instant: an instant of ``paths``, to which the pixels are interpolated linearly.
    clocks, numbers: by camera; others are left out. factor: from the lengths of ``paths`` to metres.
    """
    ids, note = _point_ids(seen.labels)
    instants, frames = grid_frames({path.label: path.time[:, None] for path in paths})
    world, image = [_WORLD], [_IMAGE]
    for path in paths:
        at = frames[np.clip(np.searchsorted(instants, path.time - 1e-6), 0, len(instants) - 1)]
        for frame, (x, y, z), time in zip(at.tolist(), (factor * path.position).tolist(), path.time, strict=True):
            world.append(f"{frame},{ids[path.label]},{x:.9g},{y:.9g},{z:.9g},{time:.9f}")
    for (camera, label), track in seen.tracks.items():
        if camera not in clocks or len(track) < 2:
            continue
        time = clocks[camera].clock_rate * track.time + clocks[camera].time_offset
        after = np.clip(np.searchsorted(time, instants), 1, len(time) - 1)
        step, share = time[after] - time[after - 1], instants - time[after - 1]
        held = (share >= 0.0) & (share <= step) & (step <= _BRIDGED * np.median(np.diff(time)))
        pixels = track.pixels[after - 1] + (share / step)[:, None] * (track.pixels[after] - track.pixels[after - 1])
        nearest = track.frame[np.where(2.0 * share < step, after - 1, after)]
        for k in np.flatnonzero(held).tolist():
            where = f"{frames[k]},{numbers[camera]},{nearest[k]},{instants[k]:.9f}"
            image.append(f"{where},{ids[label]},{pixels[k, 0]:.9g},{pixels[k, 1]:.9g},,,")
    return {"image_points.csv": "\n".join(image) + "\n", "world_points.csv": "\n".join(world) + "\n"}, note


def _point_ids(labels: Sequence[str]) -> tuple[dict[str, str], tuple[str, ...]]:
    """``object_id,keypoint_id`` by label: 3 and 2.3 are points 0,3 and 2,3, as the import names them."""
    if all(re.fullmatch(r"(\d{1,9}\.)?\d{1,9}", label) for label in labels):
        given = {label: (label if "." in label else f"0.{label}").replace(".", ",") for label in labels}
        if len(set(given.values())) == len(given):
            return given, ()
    listed = ", ".join(f"{number} is {label}" for number, label in enumerate(labels))
    return {label: f"0,{number}" for number, label in enumerate(labels)}, (f"caliscope numbers its points: {listed}",)
