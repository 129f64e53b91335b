"""Scores of a single-target image track against ground truth, for `track --csv-truth`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from deploy.offline.csv_table import read_csv_table
from deploy.offline.track import TrackedFrame
from edge.uav.base import TrackState
from protocols.core.errors import InputError
from protocols.geometry.types import Bools, Floats

NEAR_PX = 20.0  # of a track that is on its target
_REACQUIRED_FRAMES = 5  # in a row within the limit: one alone may be chance
_SEARCH_FRAMES = 60  # 2 s at 30 Hz after it is half visible again: later counts as never
_EXIT_GRACE_FRAMES = 2  # frames after an exit in which the target may still be reported visible


def read_truth(file: Path) -> dict[int, dict[str, float]]:
    """Rows by frame of a CSV with frame,x,y (the target's centre) and optionally width,height,inside,visible.

    inside: fraction of the target within the image; visible: fraction that is visible. Raises InputError.
    """
    table = read_csv_table(file, "truth", ("frame", "x", "y"), ("width", "height", "inside", "visible"))
    values = {name: table.numbers_or_gaps(name).tolist() for name in table.columns}
    absent = dict.fromkeys(("width", "height", "inside", "visible"), math.nan)
    rows = [absent | dict(zip(values, row, strict=True)) for row in zip(*values.values(), strict=True)]
    return {int(row["frame"]): row for row in rows if math.isfinite(row["frame"])}


def score(
    rows: Sequence[TrackedFrame], truth: dict[int, dict[str, float]], size: tuple[int, int]
) -> dict[str, float | int]:
    """Scores as fractions (0 to 1) and counts; scores without any frame are omitted.

    in_frame_20px; out_20px, out_one_length; visible_while_out (from the third frame of an exit); visible_while_in;
    exits, reacquired, frames_to_reacquire (mean). size: (width, height) of the image [px].
    """
    known = [row for row in rows if row.frame in truth and math.isfinite(truth[row.frame]["x"])]
    if not known:
        raise InputError("the truth has none of the tracked frames", remedy="give the truth of this video")
    true_rows = [truth[row.frame] for row in known]
    error = np.array(
        [
            math.hypot(row.estimate.x - true_row["x"], row.estimate.y - true_row["y"])
            for row, true_row in zip(known, true_rows, strict=True)
        ]
    )
    error = np.where(np.isfinite(error), error, np.inf)
    length = np.array([np.nanmax([true_row["width"], true_row["height"], 0.0]) for true_row in true_rows])
    length = np.where(length > 0, length, np.nanmax([known[0].estimate.width, known[0].estimate.height]))
    inside = np.array([_fraction_in_image(true_row, size) for true_row in true_rows])
    seen = np.array(
        [
            true_row["visible"] if math.isfinite(true_row["visible"]) else _fraction_in_image(true_row, size)
            for true_row in true_rows
        ]
    )
    reported_visible = np.array([row.estimate.state is TrackState.VISIBLE for row in known])
    out, half = inside <= 0.0, seen >= 0.5
    established_exit = out.copy()
    for back in range(1, _EXIT_GRACE_FRAMES + 1):
        established_exit[back:] &= out[:-back]
        established_exit[:back] = False
    scores: dict[str, float | int] = {"frames": len(known)}
    shares = (
        ("in_frame_20px", error <= NEAR_PX, half),
        ("out_20px", error <= NEAR_PX, out),
        ("out_one_length", error <= length, out),
        ("visible_while_out", reported_visible, established_exit),
        ("visible_while_in", reported_visible, half),
    )
    for name, good, where in shares:
        if where.any():
            scores[name] = float(good[where].mean())
    ends = (int(last) for last in np.flatnonzero(out[:-1] & ~out[1:]))
    waits = [wait for last in ends if (wait := _frames_to_reacquire(last, half, error)) is not None]
    if waits:
        found = [wait for wait in waits if math.isfinite(wait)]
        scores |= {"exits": len(waits), "reacquired": len(found)}
        if found:
            scores["frames_to_reacquire"] = float(np.mean(found))
    return scores


def _frames_to_reacquire(last_out: int, half: Bools, error: Floats) -> float | None:
    """Frames from half visible to the first of five consecutive frames within 20 px.

    inf if that is not reached within 60 frames; None if the target is never half visible again.
    """
    again = np.flatnonzero(half[last_out:])
    if not len(again):
        return None
    begin = last_out + int(again[0])
    for frame in range(begin, min(begin + _SEARCH_FRAMES, len(error) - _REACQUIRED_FRAMES + 1)):
        if (error[frame : frame + _REACQUIRED_FRAMES] <= NEAR_PX).all():
            return float(frame - begin)
    return math.inf


def _fraction_in_image(true_row: dict[str, float], size: tuple[int, int]) -> float:
    if math.isfinite(true_row["inside"]):
        return true_row["inside"]
    return float(0.0 <= true_row["x"] <= size[0] - 1 and 0.0 <= true_row["y"] <= size[1] - 1)
