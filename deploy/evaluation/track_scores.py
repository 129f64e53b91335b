"""Scores of a single-target image track against ground truth, for `track --csv-truth`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from deploy.offline.track import TrackedFrame
from edge.uav.base import TrackState
from protocols.core.errors import InputError
from protocols.geometry.types import Bools, Floats
from protocols.session.csv_table import read_csv_table

NEAR_PX = 20.0  # of a track that is on its target
_MIN_NEAR_SHARE, _OTHER_NEAR_SHARE = 0.5, 0.8  # of visible frames near a truth as it is, and in another convention
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
    exits, reacquired, frames_to_reacquire (mean). size: (width, height) of the image [px]. Raises InputError where no
    frame is common, or the truth is in another convention.
    """
    known = [row for row in rows if row.frame in truth and math.isfinite(truth[row.frame]["x"])]
    if not known:
        raise InputError("the truth has none of the tracked frames", remedy="give the truth of this video")
    true_rows = [truth[row.frame] for row in known]
    if convention := other_convention(known, true_rows, size):
        raise InputError(
            f"the truth fits the track if its {convention}",
            remedy="give the target's centre in the video's pixels, from the top left",
        )
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


def other_convention(rows: Sequence[TrackedFrame], true_rows: Sequence[dict[str, float]], size: tuple[int, int]) -> str:
    """What the truth's x and y are, where the visible target is at few of them as they are, and at most as that."""
    visible = [k for k, row in enumerate(rows) if row.estimate.state is TrackState.VISIBLE]
    found = np.array([(rows[k].estimate.x, rows[k].estimate.y) for k in visible]).reshape(-1, 2)
    given = np.array([(true_rows[k]["x"], true_rows[k]["y"]) for k in visible]).reshape(-1, 2)
    sides = np.array([(rows[k].estimate.width, rows[k].estimate.height) for k in visible]).reshape(-1, 2)

    def share(places: Floats) -> float:
        return float((np.linalg.norm(places - found, axis=1) <= NEAR_PX).mean()) if len(found) else 1.0

    factor = float(np.median(np.linalg.norm(found, axis=1)) / max(np.median(np.linalg.norm(given, axis=1)), 1e-9))
    others = {
        "x, y are the top left corner": given + 0.5 * sides,
        "x and y are swapped": given[:, ::-1],
        "x, y are fractions of width and height": given * size,
        "y counts from the bottom": [0.0, size[1] - 1.0] + given * [1.0, -1.0],
        f"pixels are of pictures {1.0 / factor:.2g} times as large": factor * given,
    }
    if share(given) >= _MIN_NEAR_SHARE:
        return ""
    best = max(others, key=lambda name: share(others[name]))
    return best if share(others[best]) >= _OTHER_NEAR_SHARE else ""


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
