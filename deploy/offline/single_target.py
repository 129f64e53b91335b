"""The one target of a video: what a detector found beside it is removed, unless it is too much to be false."""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from collections.abc import Iterable, Sequence
from math import hypot

from edge.offline.detections import HEADER
from hub.tracking.calibration.people import END_STD, SEVERAL_SHARE

_CONFIRMED_ROWS = 3
"""As of a tracklet: below, a label in a gap of the target is a flicker, not the target seen again."""


def rows_of_one_target(rows: Sequence[str]) -> tuple[tuple[str, ...], int, int]:
    """The rows of a video's only target, how many others were removed, and how many targets there are.

    rows: of observations.csv. The target's track may have been lost in between: labels that are mostly seen while no
    other is (a track may go on for some frames beside its successor) are it, the longest first, and get the name of
    their kind. With more than one target no rows are left, and all labels count that are more than false detections.
    """
    labels: dict[str, dict[str, int]] = defaultdict(dict)
    cells = list(csv.reader(rows))
    frame, label, kind = (HEADER.split(",").index(name) for name in ("frame", "label", "kind"))
    for index, row in enumerate(cells):
        labels[row[label]][row[frame]] = index
    if len(labels) < 2:
        return tuple(rows), 0, len(labels)
    ordered = sorted(labels.values(), key=lambda one: (-len(one), min(one.values())))
    frames, beside = ordered[0], list[int]()
    for one in ordered[1:]:
        same = cells[min(frames.values())][kind] == cells[min(one.values())][kind]
        twice = frames.keys() & one.keys()
        if same and len(one) >= _CONFIRMED_ROWS and 2 * len(twice) < len(one) and _in_one_place(cells, frames, one):
            frames = one | frames
            beside.append(len(twice))
        else:
            beside.append(len(one))
    kept = sorted(frames.values())
    if sum(beside) > SEVERAL_SHARE * len(kept):
        return (), 0, 1 + max(sum(count >= _CONFIRMED_ROWS for count in beside), 1)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    for index in kept:
        row = cells[index]
        writer.writerow([*row[:label], row[kind] or cells[kept[0]][label], *row[label + 1 :]])
    return tuple(out.getvalue().splitlines()), sum(beside), 1


def _in_one_place(cells: list[list[str]], mine: dict[str, int], other: dict[str, int]) -> bool:
    """Whether two labels, by frame, are within a target's size of each other where both are seen, or never are."""
    u, v, size = (HEADER.split(",").index(name) for name in ("u", "v", "size"))
    near = [
        hypot(*(float(a[at]) - float(b[at]) for at in (u, v))) <= max(float(one[size] or 0.0) for one in (a, b))
        for a, b in ((cells[mine[frame]], cells[other[frame]]) for frame in mine.keys() & other.keys())
    ]
    return 2 * sum(near) >= len(near)


def rows_of_unlabelled_people(videos: Iterable[Sequence[str]]) -> list[str]:
    """All rows of several videos, without labels, where two or more have several people and all are people; else none.

    A detector's labels are of one video: who is who in two is not known.
    """
    label, kind = (HEADER.split(",").index(name) for name in ("label", "kind"))
    given = [tuple(rows) for rows in videos]
    cells = [row for rows in given for row in csv.reader(rows)]
    crowded = sum(rows_of_one_target(rows)[2] > 1 for rows in given)
    if crowded < 2 or any(row[kind] != "person" for row in cells):
        return []
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([*row[:label], "", *row[label + 1 :]] for row in cells)
    return out.getvalue().splitlines()


def rows_of_head_and_foot(rows: Sequence[str]) -> tuple[str, ...]:
    """The rows of one person as rows of two points, ``person-head`` and ``person-foot``.

    The representative point of a silhouette is off by a tenth of the person's height (std) from one frame to the next,
    the top of the head by a hundredth.
    """
    out = io.StringIO()
    writer = csv.DictWriter(out, HEADER.split(","), lineterminator="\n")
    for row in csv.DictReader([HEADER, *rows]):
        for end, share in END_STD.items():
            if row[f"{end}_u"]:
                variance = (share * float(row["size"])) ** 2
                point = {"u": row[f"{end}_u"], "v": row[f"{end}_v"], "label": f"person-{end}", "score": row["score"]}
                spread = {"cov_uu": variance, "cov_uv": 0.0, "cov_vv": variance}
                writer.writerow({name: row[name] for name in ("camera", "frame", "time")} | point | spread)
    return tuple(out.getvalue().splitlines())
