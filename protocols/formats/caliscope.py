"""Export of points as caliscope's tables of 2025: image_points.csv, which is its xy.csv, and world_points.csv."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from protocols.core.clocks import TimeMap
from protocols.formats.trc import grid_frames
from protocols.session.calibration import TrajectoryTable
from protocols.session.observations import Observations

_BRIDGED = 1.5  # frame intervals between the observations of one interpolation: none where a frame between is missing
_IMAGE = (
    "sync_index,cam_id,frame_index,frame_time,object_id,keypoint_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y,obj_loc_z"
)
_WORLD = "sync_index,object_id,keypoint_id,x_coord,y_coord,z_coord,frame_time"


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
