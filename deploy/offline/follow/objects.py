"""Detected people and vehicles without identities, from a session's rows or a log, as observation messages.

A person is followed by head, foot and representative point. A box stands for an upright body: the head is in the middle
of its top, the foot in the middle of its bottom. Two rows of labels ``NAME-head`` and ``NAME-foot`` in one frame are
one person; the name is not used.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from edge.detectors.base import CUT_VEHICLE_STD
from hub.trajectory.image_tracks import MAX_PAUSE_S
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.core.ranges import MAX_PIXEL
from protocols.geometry.types import Floats, Ints
from protocols.messages import syncline_pb2 as pb
from protocols.session.csv_table import CsvTable, read_csv_header, read_csv_table
from protocols.session.folder import BOXES_FILE
from protocols.session.observations import DetectionRows, read_detections, read_kinds, swapped_ends
from protocols.validation.rules import SCHEMA_VERSION

Kind = Literal["person", "vehicle"]
_BOX_COLUMNS = ("camera", "frame", "time", "x", "y", "width", "height")
_MAX_TIME_S = 9e9
"""Beyond it a time [s] does not fit into 64 bits of nanoseconds."""
_MIN_CORNERS, _MIN_OVERLAP = 20, 0.25
"""Boxes, all larger than their distance from the picture's corner, and the share of them that leaves the picture: with
a width that is the right edge it is that of the people beyond the middle."""
_MIN_BEYOND, _CENTRED, _CUT_PX = 10, 0.998, 1.5
"""Boxes that end right of the picture by more than rounding, and as many that end there if x and y are their centres,
as cut ones do; the share of boxes that are then within the picture."""
_MAX_ROUNDED = 1.1
"""Frames with one time, on average: a clock's stamps may repeat now and then."""
_STD_PX, _CUT_ACROSS, _CUT_ALONG = 1.5, 0.1, 0.5
"""Of the middle of a box that the border cuts: as of any detection without a covariance, and over its height, across
a body of whom half the width may be out of the picture, and along one of whom a third to all is in it."""
_MAX_INTERVAL_S = 10.0
"""Between frames. Nobody is followed over so long; 60 frames a second in milliseconds seem 16.7 s apart."""
_MAX_SET_BACK = 0.1  # of the frames at which a clock is set back; of numbers in another order than time it is half
_MAX_EMPTY_PER_FRAME = 20
"""Frames without a row that are added for one with rows. Rarer numbers are labels, not a numbering of the frames."""


@dataclass(slots=True, eq=False)
class LeftOut:
    """Counts of rows that are not followed, by reason."""

    counts: Counter[str] = field(default_factory=Counter)

    @property
    def warnings(self) -> tuple[str, ...]:
        """One line a reason."""
        return tuple(f"{count} rows left out: {reason}" for reason, count in self.counts.items())


def is_boxes_file(file: Path) -> bool:
    """Whether a CSV file has boxes by x,y in place of points u,v, or should have by its name. Raises InputError."""
    header = set(read_csv_header(file, "observations"))
    return not {"u", "v"} <= header and ({"x", "y"} <= header or file.name == BOXES_FILE)


def read_objects(file: Path, sizes: Mapping[str, tuple[int, int]]) -> DetectionRows:
    """Read boxes (camera,frame,time,x,y,width,height; x, y the top left) or the rows of an observations.csv.

    sizes: (width, height) of the image [px] of all cameras that the calibration knows. Raises InputError (file, line,
    what, remedy), also for boxes outside the image, swapped heads and feet, and cameras that are not in ``sizes``.
    """
    boxes = is_boxes_file(file)
    table = read_csv_table(file, "observations", _BOX_COLUMNS if boxes else ("camera", "time"), ("kind",))
    names = table.text("camera")
    table.refuse(
        np.array([name not in sizes for name in names]),
        lambda row: f"camera {names[row][:63]!r} is not in the calibration ({', '.join(sizes)})",
        "calibrate this camera too, or remove its rows",
    )
    table.numbers("time", _MAX_TIME_S)
    if boxes:
        return _box_rows(table, sizes)
    rows = read_detections(file, sizes)
    limit = np.array([sizes[name] for name in names], dtype=np.float64)
    for what, point in (("u, v", rows.pixels), ("the head", rows.head), ("the foot", rows.foot)):
        # The end of somebody whom the border cuts may be estimated beyond it.
        outside = np.asarray(((point < -limit) | (point > 2.0 * limit)).any(axis=1))
        table.refuse(outside, partial(_outside, what, limit))
    _check_pairs(rows, file)
    return rows


def _outside(what: str, limit: Floats, row: int) -> str:
    return f"{what} lies outside the {limit[row, 0]:g}x{limit[row, 1]:g} picture"


def _flat(box: Floats, wrong: str, row: int) -> str:
    return f"the box is {box[row, 2]:g} x {box[row, 3]:g} px: {wrong}"


def _box_rows(table: CsvTable, sizes: Mapping[str, tuple[int, int]]) -> DetectionRows:
    box = np.column_stack([table.numbers(name, MAX_PIXEL) for name in ("x", "y", "width", "height")])
    for side, wrong in ((3, "its foot is not below its head"), (2, "its right side is not right of its left")):
        table.refuse(box[:, side] <= 0.0, partial(_flat, box, wrong))
    limit = np.array([sizes[name] for name in table.text("camera")], dtype=np.float64)
    _refuse_other_boxes(table, box, limit)
    # Annotations of people at the border, drawn from the ground up, may just miss the picture.
    outside = ((box[:, :2] >= limit + box[:, 2:]) | (box[:, :2] + 2.0 * box[:, 2:] <= 0.0)).any(axis=1)
    table.refuse(
        np.asarray(outside),
        partial(_outside, "the box", limit),
        "correct or remove the row, or take the calibration of this picture size",
    )
    _refuse_rounded_times(table)
    count = len(table)
    nothing = np.full((count, 4), np.nan)
    return DetectionRows(
        table,
        camera=table.text("camera"),
        label=[""] * count,
        kind=read_kinds(table),
        frame=table.whole("frame"),
        time=table.numbers("time", _MAX_TIME_S),
        pixels=box[:, :2] + 0.5 * box[:, 2:],
        size=nothing[:, 0],
        score=nothing[:, 0],
        covariance=nothing[:, :3],
        head=nothing[:, :2],
        foot=nothing[:, :2],
        box=box,
    )


def _refuse_other_boxes(table: CsvTable, box: Floats, limit: Floats) -> None:
    """Refuse boxes, of all cameras or of one, that are given in another way than by top left, width and height."""
    names = np.array(table.text("camera"))
    groups = {"": np.ones(len(box), dtype=np.bool_)} | {f"{name}: ": names == name for name in dict.fromkeys(names)}
    for name, mine in groups.items():
        corner, size = box[mine, :2], box[mine, 2:]
        beyond = corner + size > limit[mine] + _CUT_PX
        past = corner + 0.5 * size - limit[mine]
        centred = ((corner >= 0.5 * size - _CUT_PX) & (past <= _CUT_PX)).all(axis=1)
        cut = int((np.abs(past[:, 0]) <= _CUT_PX).sum())
        if (box[mine] <= 1.0).all():
            what = "all boxes are within 0 to 1: fractions of the picture"
            remedy = "multiply x and width by the picture's width, y and height by its height"
        elif (
            not name
            and len(size) >= _MIN_CORNERS
            and (size > corner).all()
            and beyond.any(axis=1).mean() > _MIN_OVERLAP
        ):
            what, remedy = "width and height look like the right and the lower edge of the boxes", "subtract x and y"
        elif min(beyond[:, 0].sum(), cut) >= _MIN_BEYOND and centred.mean() >= _CENTRED:
            what, remedy = "x and y look like the middle of the boxes", "subtract half the width and half the height"
        else:
            continue
        raise InputError(name + what, file=table.file, line=table.line[int(np.argmax(mine))], remedy=remedy)


def _refuse_rounded_times(table: CsvTable) -> None:
    """Refuse times of which several frames of one camera have the same."""
    names, times, frames = np.array(table.text("camera")), table.numbers("time", _MAX_TIME_S), table.whole("frame")
    for name in dict.fromkeys(names):
        mine = np.flatnonzero(names == name)
        pairs = np.unique(np.column_stack([times[mine], frames[mine]]), axis=0)
        stamps = np.unique(pairs[:, 0])
        if len(pairs) < len(mine) and len(pairs) > _MAX_ROUNDED * len(stamps):
            shared = stamps[np.bincount(np.searchsorted(stamps, pairs[:, 0])) > 1]
            same = (times == shared[0]) & (names == name)
            what = f"{len(pairs)} frames of {name} have {len(stamps)} different times: they are rounded"
            raise InputError(
                what,
                file=table.file,
                line=table.line[int(np.flatnonzero(same)[-1])],
                remedy="give each frame's own time",
            )


def _check_pairs(rows: DetectionRows, file: Path) -> None:
    """Refuse rows NAME-head and NAME-foot that are swapped: InputError with the later line of the first pair."""
    ends: dict[tuple[str, float, str], dict[str, int]] = {}
    for row, label in enumerate(rows.label):
        name, _, end = label.rpartition("-")
        if name and end in ("head", "foot"):
            ends.setdefault((rows.camera[row], float(rows.time[row]), name), {}).setdefault(end, row)
    names = [name for (_, _, name), one in ends.items() if len(one) == 2]
    pairs = [[one["head"], one["foot"]] for one in ends.values() if len(one) == 2]
    head, foot = rows.pixels[np.array(pairs, dtype=np.int64).reshape(-1, 2).T]
    for index in np.flatnonzero(swapped_ends(head, foot, [rows.camera[row] for row, _ in pairs]))[:1].tolist():
        what = f"{names[index]}: the head is not above the foot"
        line = max(rows.table.line[row] for row in pairs[index])
        raise InputError(what, file=file, line=line, remedy="swap the labels")


def object_messages(rows: DetectionRows, interval_ns: int = 0) -> list[pb.Observation]:
    """The rows as observation messages with all that is known of each detection, by camera and time.

    interval_ns: between the frames of a camera that are taken, at least.

    ``sequence`` is the frame number where a camera's frames are numbered, otherwise it counts. Where they are
    numbered, frames without a row between two with rows have a message too: nobody was detected.
    """
    out: list[pb.Observation] = []
    names = np.array(rows.camera)
    time_ns = np.array([round(time * NANOSECONDS) for time in rows.time.tolist()], dtype=np.int64)
    for name in dict.fromkeys(rows.camera):
        mine = np.flatnonzero(names == name)
        mine = mine[np.lexsort((mine, time_ns[mine]))]
        stamps, first, counts = np.unique(time_ns[mine], return_index=True, return_counts=True)
        frames = rows.frame[mine[first]]
        numbered = bool((np.diff(frames) > 0).all()) and frames[0] >= 0
        empty_stamps, empty_frames = _empty_frames(stamps, frames) if numbered else (stamps[:0], frames[:0])
        order = np.argsort(np.concatenate([stamps, empty_stamps]), kind="stable").tolist()
        every_stamp = np.concatenate([stamps, empty_stamps]).tolist()
        every_frame = np.concatenate([frames, empty_frames]).tolist()
        last = -math.inf
        for index, at in enumerate(order):
            if every_stamp[at] - last < interval_ns:
                continue
            last = every_stamp[at]
            message = pb.Observation(
                schema_version=SCHEMA_VERSION, camera=name, boot_id="session", device_time_ns=every_stamp[at],
                sequence=every_frame[at] if numbered else index, frame=max(every_frame[at], 0),
            )  # fmt: skip
            if at < len(stamps):
                begin = int(first[at])
                message.detections.extend(_detection(rows, int(row)) for row in mine[begin : begin + int(counts[at])])
            out.append(message)
    return out


def _detection(rows: DetectionRows, row: int) -> pb.Detection:
    def given(values: Floats) -> list[float]:
        return values[row].tolist() if np.isfinite(values[row]).all() else []

    size, score = float(rows.size[row]), float(rows.score[row])
    return pb.Detection(
        u=rows.pixels[row, 0], v=rows.pixels[row, 1], size=size if size > 0.0 else 0.0,
        score=score if math.isfinite(score) else 1.0, label=rows.label[row], kind=rows.kind[row],
        covariance=given(rows.covariance), head=given(rows.head), foot=given(rows.foot), box=given(rows.box),
    )  # fmt: skip


def _empty_frames(stamps: Ints, frames: Ints) -> tuple[Ints, Ints]:
    """Times [ns] and numbers of the frames that are missing between the given ones."""
    missing = np.diff(frames) - 1
    if len(frames) < 2 or missing.sum() > _MAX_EMPTY_PER_FRAME * len(frames):
        return stamps[:0], frames[:0]
    step = int(np.gcd.reduce(np.diff(frames)))  # every second frame was looked at: the others are not empty
    numbers = [np.arange(a + step, b, step, dtype=np.int64) for a, b in pairwise(frames.tolist())]
    wanted = np.concatenate(numbers)
    whole, part = np.interp(wanted, frames, stamps - stamps[0]), stamps[0]
    return np.rint(whole).astype(np.int64) + part, wanted


def without_clock_steps(messages: list[pb.Observation], file: Path) -> tuple[list[pb.Observation], tuple[str, ...]]:
    """The messages on the longer side of a step of their camera's clock, as `calibrate` takes it; and warnings.

    A clock that was set back shows in the frames' numbers, if these increase.

    Raises InputError where the frames of all cameras are too far apart.
    """
    kept = set[int]()
    intervals: list[float] = []
    warnings = []
    for camera in dict.fromkeys(message.camera for message in messages):
        mine = sorted((m for m in messages if m.camera == camera), key=lambda one: (one.frame, one.device_time_ns))
        times = np.array([message.device_time_ns for message in mine]) / NANOSECONDS
        back = np.flatnonzero(np.diff(times) < 0.0)
        if len(back) > _MAX_SET_BACK * len(times):  # no clock that was set, but numbers in another order
            back, mine, times = back[:0], sorted(mine, key=lambda one: one.device_time_ns), np.sort(times)
        gaps = np.diff(times)
        intervals += [float(np.median(gaps))] if len(gaps) else []
        steps = np.union1d(back, np.flatnonzero(gaps > MAX_PAUSE_S))
        part = max(np.split(np.arange(len(mine)), steps + 1), key=len)
        kept |= {id(mine[i]) for i in part.tolist()}
        if len(part) < len(mine):
            left = f"{len(mine) - len(part)} of {len(mine)} frames on the other side are left out"
            warnings.append(f"{camera}: its clock steps by {max(gaps[steps], key=abs):+.1f} s; {left}")
    if min(intervals, default=0.0) > _MAX_INTERVAL_S:
        what = f"frames are {min(intervals):.4g} s apart, over which nobody is followed"
        raise InputError(what, file=file, remedy="give times in seconds, not in milliseconds or another unit")
    return [one for one in messages if id(one) in kept], tuple(warnings)


def followed_detections(
    messages: Iterable[pb.Observation], kind: Kind, sizes: Mapping[str, tuple[int, int]]
) -> tuple[list[pb.Observation], LeftOut]:
    """The messages with the detections of one kind only, each with all points that a tracker needs.

    sizes: (width, height) of each camera's image [px]. A detection without a kind is of this one if it has a box, a
    head or a foot. Where all boxes of a camera end at its image's border, a box that reaches it is cut: the end that
    is not seen is not given, at a side neither of both, and its middle is uncertain.
    """
    left = LeftOut()
    kept = [message for message in messages if message.camera in sizes]
    clipped = _clipped_cameras(kept, sizes)
    out = []
    for message in kept:
        copy = pb.Observation()
        copy.CopyFrom(message)
        del copy.detections[:]
        seen: set[bytes] = set()
        for detection in _paired(message.detections, left) if kind == "person" else message.detections:
            one = _of_kind(detection, kind, sizes[message.camera] if message.camera in clipped else None, left)
            if one is None:
                continue
            if (content := one.SerializeToString()) in seen:
                left.counts["the same as another of its frame"] += 1
                continue
            seen.add(content)
            copy.detections.append(one)
        out.append(copy)
    return out, left


def _clipped_cameras(messages: Iterable[pb.Observation], sizes: Mapping[str, tuple[int, int]]) -> set[str]:
    """Cameras whose boxes never reach more than a pixel beyond the image."""
    beyond = set()
    for message in messages:
        width, height = sizes[message.camera]
        for detection in message.detections:
            if len(detection.box) == 4:
                x, y, w, h = detection.box
                if x < -1.5 or y < -1.5 or x + w > width + 1.0 or y + h > height + 1.0:
                    beyond.add(message.camera)
                    break
    return set(sizes) - beyond


def _paired(detections: Sequence[pb.Detection], left: LeftOut) -> list[pb.Detection]:
    """Detections with those of the labels NAME-head and NAME-foot put together."""
    out: list[pb.Detection] = []
    ends: dict[str, dict[str, pb.Detection]] = {}
    for detection in detections:
        name, _, end = detection.label.rpartition("-")
        if name and end in ("head", "foot") and not (detection.kind or detection.box or detection.head):
            ends.setdefault(name, {})[end] = detection
        else:
            out.append(detection)
    for both in ends.values():
        if len(both) < 2:
            left.counts["only the head or only the foot was seen"] += 1
            continue
        head, foot = both["head"], both["foot"]
        out.append(
            pb.Detection(
                u=0.5 * (head.u + foot.u), v=0.5 * (head.v + foot.v), score=min(head.score, foot.score), kind="person",
                size=math.hypot(head.u - foot.u, head.v - foot.v), head=[head.u, head.v], foot=[foot.u, foot.v],
            )
        )  # fmt: skip
    return out


def _of_kind(detection: pb.Detection, kind: Kind, clip: tuple[int, int] | None, left: LeftOut) -> pb.Detection | None:
    """A complete detection of this kind, or None. clip: size of the image where boxes end at its border."""
    if detection.kind not in ("", kind):
        left.counts[f"of kind {detection.kind}"] += 1
        return None
    if not (detection.kind or detection.box or detection.head or detection.foot):
        left.counts["neither a box nor head and foot"] += 1
        return None
    one = pb.Detection()
    one.CopyFrom(detection)
    one.label = ""
    _complete(one, kind, clip)
    return one


def complete_detections(messages: Iterable[pb.Observation], kind: Kind, sizes: Mapping[str, tuple[int, int]]) -> None:
    """Give boxes and bodies without a kind this one, and people the ends and the size that their boxes have.

    sizes: as for ``followed_detections``.
    """
    every = list(messages)
    clipped = _clipped_cameras(every, sizes)
    for message in every:
        for detection in message.detections:
            if not detection.kind and (detection.box or detection.head or detection.foot):
                _complete(detection, kind, sizes[message.camera] if message.camera in clipped else None)


def _complete(one: pb.Detection, kind: Kind, clip: tuple[int, int] | None) -> None:
    one.kind = kind
    if len(one.box) == 4 and not (one.head or one.foot):
        x, y, width, height = one.box
        above, below = clip is not None and y <= 0.5, clip is not None and y + height >= clip[1] - 1.5
        across = clip is not None and (x <= 0.5 or x + width >= clip[0] - 1.5)
        u_std, v_std = CUT_VEHICLE_STD * height, CUT_VEHICLE_STD * width
        if kind == "person":
            u_std, v_std = _CUT_ACROSS * height, _CUT_ALONG * height
            if not (across or above):
                one.head.extend([x + 0.5 * width, y])
            if not (across or below):
                one.foot.extend([x + 0.5 * width, y + height])
        if (across or above or below) and not one.covariance:
            u_std, v_std = across * u_std, (above or below) * v_std
            one.covariance.extend([_STD_PX**2 + u_std**2, 0.0, _STD_PX**2 + v_std**2])
    if one.size <= 0.0 and one.head and one.foot:
        one.size = math.dist(one.head, one.foot)
