"""A track against the truth: what `track --csv-truth` prints."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from deploy.offline.track import Tracked
from edge.uav.tracker import State
from protocols.core.errors import InputError
from protocols.geometry.types import Bools, Floats

NEAR_PX = 20.0
_FOUND_FRAMES = 5
_SEARCH_FRAMES = 60
_SETTLE_FRAMES = 2  # of an exit, in which the target may still be called visible


def read_truth(file: Path) -> dict[int, dict[str, float]]:
    """Rows by frame of a CSV with frame,x,y (the target's centre) and, if there, width,height,inside,visible.

    inside: share of the target in the picture; visible: share that is seen. Raises InputError.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError("this truth file does not exist", file=file, remedy="check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read: {error}", file=file, remedy="save it as UTF-8 CSV") from None
    reader = csv.DictReader(io.StringIO(text))
    missing = [name for name in ("frame", "x", "y") if name not in (reader.fieldnames or ())]
    if missing:
        remedy = "the first line must name frame,x,y[,width,height][,inside][,visible]"
        raise InputError(f"column {', '.join(missing)} is missing", file=file, line=1, remedy=remedy)
    rows: dict[int, dict[str, float]] = {}
    for row in reader:
        values: dict[str, float] = {}
        for name in ("frame", "x", "y", "width", "height", "inside", "visible"):
            try:
                values[name] = float(row.get(name) or "nan")
            except ValueError:
                what = f"{name} {row.get(name)!r} is not a number"
                raise InputError(what, file=file, line=reader.line_num, remedy="correct this row") from None
        if math.isfinite(values["frame"]):
            rows[int(values["frame"])] = values
    if not rows:
        raise InputError("no rows", file=file, line=1, remedy="give the truth of at least one frame")
    return rows


def score(rows: Sequence[Tracked], truth: dict[int, dict[str, float]], size: tuple[int, int]) -> dict[str, float | int]:
    """Shares (0 to 1) and counts, those of which there is no frame left out.

    in_frame_20px; out_20px, out_one_length; visible_while_out (from the third frame of an exit); visible_while_in;
    exits, reacquired, frames_to_reacquire (mean). size: (width, height) of the picture [px].
    """
    known = [row for row in rows if row.frame in truth and math.isfinite(truth[row.frame]["x"])]
    if not known:
        raise InputError("the truth has none of the tracked frames", remedy="give the truth of this video")
    facts = [truth[row.frame] for row in known]
    error = np.array(
        [
            math.hypot(row.estimate.x - fact["x"], row.estimate.y - fact["y"])
            for row, fact in zip(known, facts, strict=True)
        ]
    )
    error = np.where(np.isfinite(error), error, np.inf)
    length = np.array([np.nanmax([fact["width"], fact["height"], 0.0]) for fact in facts])
    length = np.where(length > 0, length, np.nanmax([known[0].estimate.width, known[0].estimate.height]))
    inside = np.array([_inside(fact, size) for fact in facts])
    seen = np.array([fact["visible"] if math.isfinite(fact["visible"]) else _inside(fact, size) for fact in facts])
    claimed = np.array([row.estimate.state is State.VISIBLE for row in known])
    out, half = inside <= 0.0, seen >= 0.5
    settled = out.copy()
    for back in range(1, _SETTLE_FRAMES + 1):
        settled[back:] &= out[:-back]
        settled[:back] = False
    scores: dict[str, float | int] = {"frames": len(known)}
    shares = (
        ("in_frame_20px", error <= NEAR_PX, half),
        ("out_20px", error <= NEAR_PX, out),
        ("out_one_length", error <= length, out),
        ("visible_while_out", claimed, settled),
        ("visible_while_in", claimed, half),
    )
    for name, good, where in shares:
        if where.any():
            scores[name] = float(good[where].mean())
    ends = (int(last) for last in np.flatnonzero(out[:-1] & ~out[1:]))
    waits = [wait for last in ends if (wait := _frames_to_find(last, half, error)) is not None]
    if waits:
        found = [wait for wait in waits if math.isfinite(wait)]
        scores |= {"exits": len(waits), "reacquired": len(found)}
        if found:
            scores["frames_to_reacquire"] = float(np.mean(found))
    return scores


def _frames_to_find(last_out: int, half: Bools, error: Floats) -> float | None:
    """Frames from half visible to five running within 20 px; inf if never within 60; None if never half visible."""
    again = np.flatnonzero(half[last_out:])
    if not len(again):
        return None
    begin = last_out + int(again[0])
    for frame in range(begin, min(begin + _SEARCH_FRAMES, len(error) - _FOUND_FRAMES + 1)):
        if (error[frame : frame + _FOUND_FRAMES] <= NEAR_PX).all():
            return float(frame - begin)
    return math.inf


def _inside(fact: dict[str, float], size: tuple[int, int]) -> float:
    if math.isfinite(fact["inside"]):
        return fact["inside"]
    return float(0.0 <= fact["x"] <= size[0] - 1 and 0.0 <= fact["y"] <= size[1] - 1)
