"""The observations of a session: pixel tracks of moving points with capture times on each camera's own clock.

Where identities are not known, several rows of one camera, time and label are several objects: tracking reads these
as ``DetectionRows``, with all columns that `syncline detect` writes; synchronisation and calibration read tracks.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from protocols.core.errors import InputError
from protocols.core.ranges import MAX_COUNT, MAX_PIXEL, MAX_TIME_S
from protocols.geometry.types import Bools, Floats, Ints
from protocols.session.csv_table import CsvTable, read_csv_table

COLUMNS = (
    "score", "kind", "cov_uu", "cov_uv", "cov_vv", "head_u", "head_v", "foot_u", "foot_v",
    "box_x", "box_y", "box_w", "box_h",
)  # fmt: skip
"""The optional columns after ``camera,frame,time,u,v,size,label``; an empty cell = not measured."""
KINDS = ("", "marker", "person", "vehicle", "corner")
_MAX_VARIANCE = 1e12
"""[px²]: of a standard deviation of the largest pixel that is accepted."""
_SWAPPED = 0.9
"""Share of the heads below their feet in a table where the two are swapped; below a ceiling camera it is half."""
REQUIRED = ("camera", "frame", "time", "u", "v")
DEFAULT_LABEL = "marker"
_MAX_REPEATED_SHARE = 0.1  # share of repeated frame numbers above which the column is not a frame numbering


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The detections of one label in one camera, sorted by time.

    frame: (n,) frame numbers. time: (n,) [s] on the camera's clock, strictly increasing.
    pixels: (n, 2) distorted pixels. size: (n,) [px], NaN where not measured. std: (n,) of one pixel coordinate [px] by
    the detector's own covariance, NaN where it states none; None = nowhere.
    """

    camera: str
    label: str
    frame: Ints
    time: Floats
    pixels: Floats
    size: Floats
    std: Floats | None = None

    def __len__(self) -> int:
        return len(self.time)

    def select(self, rows: Bools) -> Track:
        """The rows of a mask (n,)."""
        std = None if self.std is None else self.std[rows]
        return Track(
            self.camera, self.label, self.frame[rows], self.time[rows], self.pixels[rows], self.size[rows], std
        )


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """All tracks by (camera, label), in the order of the rig and then of the labels' names."""

    tracks: dict[tuple[str, str], Track]
    warnings: tuple[str, ...] = ()

    def newest(self, seconds: float) -> Observations:
        """The rows of the last so many seconds of each camera."""
        last = {camera: max(track.time[-1] for track in self.of_camera(camera)) for camera in self.cameras}
        tracks = {key: track.select(track.time > last[key[0]] - seconds) for key, track in self.tracks.items()}
        return replace(self, tracks={key: track for key, track in tracks.items() if len(track)})

    def of_camera(self, camera: str) -> list[Track]:
        """The camera's tracks, one a label."""
        return [track for (name, _), track in self.tracks.items() if name == camera]

    def by_label(self, camera: str) -> dict[str, Track]:
        """The camera's tracks by label."""
        return {track.label: track for track in self.of_camera(camera)}

    @property
    def cameras(self) -> list[str]:
        """Cameras with at least one row."""
        return list(dict.fromkeys(camera for camera, _ in self.tracks))

    @property
    def labels(self) -> list[str]:
        """All labels."""
        return list(dict.fromkeys(label for _, label in self.tracks))

    def __len__(self) -> int:
        return sum(len(track) for track in self.tracks.values())


@dataclass(frozen=True, slots=True, eq=False)
class ObservationRows:
    """The columns of an observations.csv in the file's order, n rows.

    table: all that was asked for. camera, label: n names. frame: (n,). time: (n,) [s]. pixels: (n, 2). size: (n,) [px],
    NaN where not measured.
    """

    table: CsvTable
    camera: list[str]
    label: list[str]
    frame: Ints
    time: Floats
    pixels: Floats
    size: Floats

    def numbers(self, name: str, limit: float = MAX_PIXEL) -> Floats:
        """An optional column (n,); NaN where the cell is empty. Raises InputError beyond ±limit."""
        if name not in self.table.columns:
            return np.full(len(self.table), np.nan)
        values, refuse = self.table.numbers_or_gaps(name), self.table.refuse
        empty = np.array([not cell.strip() for cell in self.table.columns[name]])
        wrong = (np.isnan(values) & ~empty) | np.isinf(values)
        refuse(wrong, lambda row: f"{name} is {values[row]:g}", "leave a cell that was not seen empty")
        refuse(np.abs(values) > limit, lambda row: f"{name} {values[row]:g} is beyond ±{limit:g}")
        return values


def read_observations(file: Path, cameras: Iterable[str]) -> Observations:
    """Read observations.csv: camera,frame,time,u,v[,size][,label] in any row order.

    cameras: the names that the rig knows. Raises InputError: file, line, what, remedy.
    """
    known = list(cameras)
    table = _read_table(file, ("kind", "cov_uu", "cov_vv"))
    rows = _parse_rows(table.select(kept := ~_are_unlabelled(table)), known)
    found = gather_tracks(
        rows.camera,
        rows.label,
        rows.frame,
        rows.time,
        rows.pixels,
        rows.size,
        stds=_stds(rows),
        order=known,
        file=file,
        lines=rows.table.line,
    )
    if kept.all():
        return found
    what = f"{len(table) - len(rows.time)} rows of people or vehicles left out: who is who is not known"
    return replace(found, warnings=(*found.warnings, what))


def _are_unlabelled(table: CsvTable) -> Bools:
    """Which rows (n,) are of people or vehicles, beside markers, where several in one frame have one label."""
    kinds = table.text("kind") if "kind" in table.columns else [""] * len(table)
    tracked = np.array([kind in ("person", "vehicle") for kind in kinds])
    names = [table.text(name) if name in table.columns else kinds for name in ("camera", "label", "time")]
    rows = [row for row, here in zip(zip(*names, strict=True), tracked, strict=True) if here]
    return tracked & (not tracked.all() and len(set(rows)) < len(rows))


def _stds(rows: ObservationRows) -> Floats | None:
    """Stds (n,) [px] of one coordinate from the columns cov_uu and cov_vv; None without them."""
    if not {"cov_uu", "cov_vv"} <= rows.table.columns.keys():
        return None
    variance = 0.5 * (rows.numbers("cov_uu", MAX_PIXEL**2) + rows.numbers("cov_vv", MAX_PIXEL**2))
    rows.table.refuse(variance < 0.0, lambda row: "cov_uu, cov_vv are no covariance")
    return np.sqrt(variance)


def read_rows(file: Path, cameras: Iterable[str], optional: Sequence[str] = ()) -> ObservationRows:
    """Read the rows of observations.csv as they stand, also several of one camera, label and time.

    optional: names of further columns, which every row must then have. Raises InputError: file, line, what, remedy.
    """
    return _parse_rows(_read_table(file, optional), cameras)


def _read_table(file: Path, optional: Sequence[str]) -> CsvTable:
    return read_csv_table(file, "observations", REQUIRED, ("size", "label", *optional), "[,size][,label]")


def _parse_rows(table: CsvTable, cameras: Iterable[str]) -> ObservationRows:
    time, u, v = (table.finite(name) for name in ("time", "u", "v"))
    remedy = "give seconds; Unix time is about 1.8e9"
    table.refuse(np.abs(time) > MAX_TIME_S, lambda row: f"time {time[row]:g} is no time in seconds", remedy)
    far = np.maximum(np.abs(u), np.abs(v)) > MAX_PIXEL
    table.refuse(far, lambda row: f"u, v {u[row]:g}, {v[row]:g} is no pixel")
    frame, frames = table.finite("frame"), table.text("frame")
    bad = (frame != np.round(frame)) | (np.abs(frame) > MAX_COUNT)
    table.refuse(bad, lambda row: f"frame {frames[row]} is not a whole number", "correct it")
    size = table.numbers_or_gaps("size") if "size" in table.columns else np.full(len(table), np.nan)
    table.refuse((size < 0) | np.isinf(size), lambda row: f"size {size[row]:g} is negative or infinite", "remove it")
    names = table.text("camera")
    labels = [label or DEFAULT_LABEL for label in table.text("label")] if "label" in table.columns else None
    unprintable = np.array([not label.isprintable() for label in labels or ()], dtype=np.bool_)
    what = "has a character that cannot be printed"
    table.refuse(unprintable, lambda row: f"label {(labels or names)[row][:80]!a} {what}", "rename the point")
    known = list(cameras)
    for name in dict.fromkeys(names):
        if name not in known:
            what = f"camera {name!r} is not in the rig ({', '.join(known)})"
            remedy = f"add [{name}] to rig.toml or correct the name"
            raise InputError(what, file=table.file, line=table.line[names.index(name)], remedy=remedy)
    return ObservationRows(
        table,
        names,
        labels or [DEFAULT_LABEL] * len(table),
        frame.astype(np.int64),
        time,
        np.column_stack([u, v]),
        np.where(size > 0, size, np.nan),
    )


def gather_tracks(
    cameras: list[str],
    labels: list[str],
    frame: Ints,
    time: Floats,
    pixels: Floats,
    size: Floats,
    *,
    stds: Floats | None = None,
    order: Iterable[str] = (),
    file: Path | None = None,
    lines: list[int] | None = None,
) -> Observations:
    """Sort rows into tracks. Raises InputError where two rows of one camera and label are of one time or frame."""
    camera_ids = {name: index for index, name in enumerate(dict.fromkeys([*order, *cameras]))}
    label_ids = {name: index for index, name in enumerate(sorted(set(labels)))}
    c = np.array([camera_ids[name] for name in cameras], dtype=np.int64)
    k = np.array([label_ids[name] for name in labels], dtype=np.int64)
    return gather_columns(
        list(camera_ids), list(label_ids), c, k, frame, time, pixels, size, stds=stds, file=file, lines=lines
    )


def gather_columns(
    camera_names: list[str],
    label_names: list[str],
    c: Ints,
    k: Ints,
    frame: Ints,
    time: Floats,
    pixels: Floats,
    size: Floats,
    *,
    stds: Floats | None = None,
    file: Path | None = None,
    lines: list[int] | None = None,
    frames_may_repeat: bool = False,
) -> Observations:
    """The same for rows (n,) with indices of their camera ``c`` and label ``k``; label_names: sorted.

    frames_may_repeat: repeated frame numbers are a warning, as from cameras that nobody can correct.
    """
    if not len(c):
        return Observations({})
    sorting = np.lexsort((frame, time, k, c))
    c, k, frame, time, pixels, size = (
        c[sorting],
        k[sorting],
        frame[sorting],
        time[sorting],
        pixels[sorting],
        size[sorting],
    )
    line = None if lines is None else np.array(lines)[sorting]
    std = None if stds is None or not np.isfinite(stds).any() else stds[sorting]
    begins = np.r_[True, (np.diff(c) != 0) | (np.diff(k) != 0)]
    starts = np.flatnonzero(begins)
    ends = np.r_[starts[1:], len(c)]
    # Tracks with two rows of one time or of one frame, of all at once: a hub has thousands of tracks.
    track = np.cumsum(begins) - 1
    by_frame = np.lexsort((frame, track))
    twice = np.r_[
        track[1:][(np.diff(time) == 0) & ~begins[1:]],
        track[by_frame][1:][(np.diff(frame[by_frame]) == 0) & (np.diff(track[by_frame]) == 0)],
    ]
    repeats = np.bincount(twice, minlength=len(starts)) > 0
    tracks: dict[tuple[str, str], Track] = {}
    warnings: list[str] = []
    for start, end, repeated in zip(starts, ends, repeats, strict=True):
        part = slice(start, end)
        camera, label = camera_names[c[start]], label_names[k[start]]
        one = Track(camera, label, frame[part], time[part], pixels[part], size[part])
        if repeated:
            _check_repeats(one, None if line is None else line[part], file, warnings, frames_may_repeat)
        tracks[camera, label] = one
        if std is not None:
            tracks[camera, label] = replace(tracks[camera, label], std=std[part])
    return Observations(tracks, tuple(warnings))


def _check_repeats(
    track: Track, line: Ints | None, file: Path | None, warnings: list[str], frames_may_repeat: bool
) -> None:
    time, frame = track.time, track.frame
    same_time = np.flatnonzero(np.diff(time) == 0)
    where = f"camera {track.camera}" + (f", label {track.label}" if track.label != DEFAULT_LABEL else "")
    if len(same_time):
        i = int(same_time[0])
        raise InputError(
            f"two rows of {where} at time {time[i]:.6f} (frames {frame[i]}, {frame[i + 1]})",
            file=file,
            line=None if line is None else int(line[i : i + 2].max()),
            remedy="keep one a frame, or give the points different labels",
        )
    unique, counts = np.unique(frame, return_counts=True)
    repeated = int((counts - 1).sum())
    if repeated <= max(1.0, _MAX_REPEATED_SHARE * len(frame)) and not frames_may_repeat:
        twice = unique[counts > 1][0]
        at = np.flatnonzero(frame == twice)
        raise InputError(
            f"two rows of {where} in frame {twice}",
            file=file,
            line=None if line is None else int(line[at].max()),
            remedy="keep one a frame, or give the points different labels",
        )
    repeats = f"{where}: frame numbers repeat ({repeated} of {len(frame)}); only its times are used"
    warnings.append(f"{repeats}; if it was started twice, name its second run as another camera")


@dataclass(frozen=True, slots=True, eq=False)
class DetectionRows(ObservationRows):
    """n detections in the file's order; NaN = not measured.

    kind: n texts, "" = not given. score: (n,) 0..1. covariance: (n, 3) uu, uv, vv [px²]. head, foot: (n, 2) [px]. box:
    (n, 4) x, y, w, h [px], x and y of the top left.
    """

    kind: list[str]
    score: Floats
    covariance: Floats
    head: Floats
    foot: Floats
    box: Floats

    def __len__(self) -> int:
        return len(self.time)


def read_detections(file: Path, sizes: Mapping[str, tuple[int, int]]) -> DetectionRows:
    """Read all detections of an observations.csv; the columns in ``COLUMNS`` may be absent, and their cells empty.

    sizes: (width, height) [px] of the images of each camera that the rig knows. Raises InputError (file, line, what,
    remedy) where a value is no number, out of range, or contradicts another one: a half-given point, box or covariance,
    a covariance that is not positive semi-definite, a box without area or outside the image, swapped heads and feet.
    """
    rows = read_rows(file, sizes, COLUMNS)
    score = rows.numbers("score", 1.0)
    rows.table.refuse(score < 0.0, lambda row: f"score {score[row]:g} is negative", "give 0 to 1")
    covariance = _together(rows, ("cov_uu", "cov_uv", "cov_vv"), _MAX_VARIANCE)
    uu, uv, vv = covariance.T
    # The tolerance lets a covariance of rank one pass after rounding, as on the bus.
    invalid = (uu < 0.0) | (vv < 0.0) | (uv * uv > uu * vv * (1.0 + 1e-9) + 1e-12)
    rows.table.refuse(invalid, lambda row: "cov_uu, cov_uv, cov_vv are no covariance")
    head, foot = _together(rows, ("head_u", "head_v")), _together(rows, ("foot_u", "foot_v"))
    remedy = "swap them, or turn the images upright"
    rows.table.refuse(swapped_ends(head, foot, rows.camera), lambda row: "the head is not above the foot", remedy)
    box = _together(rows, ("box_x", "box_y", "box_w", "box_h"))
    rows.table.refuse((box[:, 2:] <= 0.0).any(axis=1), lambda row: f"a box of {box[row, 2]:g} x {box[row, 3]:g} px")
    limit = np.array([sizes[name] for name in rows.camera], dtype=np.float64).reshape(-1, 2)
    outside = ((box[:, :2] >= limit) | (box[:, :2] + box[:, 2:] <= 0.0)).any(axis=1)
    rows.table.refuse(outside, lambda row: f"the box lies outside the {limit[row, 0]:g}x{limit[row, 1]:g} image")
    columns = [getattr(rows, name) for name in ObservationRows.__slots__]
    return DetectionRows(*[*columns, read_kinds(rows.table), score, covariance, head, foot, box])


def swapped_ends(head: Floats, foot: Floats, camera: Sequence[str]) -> Bools:
    """Which heads (n, 2) [px] are below their feet, in cameras (n,) in which nearly all are; in others none.

    From the ceiling, heads point away from below the camera, to all sides. In a camera on its side they are beside the
    feet.
    """
    across, down = (foot - head).T
    along = np.abs(across) <= np.abs(down)
    below = along & (down <= 0.0)
    _, index = np.unique(np.asarray(camera), return_inverse=True)
    share = np.bincount(index, below) > _SWAPPED * np.bincount(index, along)
    return np.asarray(below & share[index])


def _together(rows: ObservationRows, names: tuple[str, ...], limit: float = 1e6) -> Floats:
    """Columns (n, k) of which a row has all or none."""
    values = np.column_stack([rows.numbers(name, limit) for name in names])
    given = np.isfinite(values)
    half = given.any(axis=1) & ~given.all(axis=1)

    def what(row: int) -> str:
        return f"{', '.join(name for name, there in zip(names, given[row], strict=True) if not there)} is empty"

    rows.table.refuse(half, what, f"give all of {', '.join(names)}, or none")
    return values


def read_kinds(table: CsvTable) -> list[str]:
    """The kinds (n,) of a table's rows; "" = not given. Raises InputError for an unknown one."""
    if "kind" not in table.columns:
        return [""] * len(table)
    kinds = table.text("kind")
    unknown = np.array([kind not in KINDS for kind in kinds])
    remedy = f"use one of {', '.join(KINDS[1:])}, or leave it empty"
    table.refuse(unknown, lambda row: f"kind {kinds[row][:40]!r} is not known", remedy)
    return kinds
