"""The observations of a session: pixel tracks of moving points with capture times on each camera's own clock."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from protocols.core.errors import InputError
from protocols.core.files import read_text
from protocols.core.ranges import MAX_COUNT, MAX_PIXEL, MAX_TIME_S
from protocols.geometry.types import Bools, Floats, Ints

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

    camera, label: n names. frame: (n,). time: (n,) [s]. pixels: (n, 2). size: (n,) [px], NaN where not measured. line:
    (n,) line numbers. cells: n rows of text. column: index of each column by its name.
    """

    file: Path
    camera: list[str]
    label: list[str]
    frame: Ints
    time: Floats
    pixels: Floats
    size: Floats
    line: list[int]
    cells: list[list[str]]
    column: dict[str, int]

    def numbers(self, name: str, limit: float = MAX_PIXEL) -> Floats:
        """An optional column (n,); NaN where the cell is empty. Raises InputError beyond ±limit."""
        if name not in self.column:
            return np.full(len(self.cells), np.nan)
        values = _column(self.cells, self.line, self.column[name], name, self.file, empty=np.nan)
        empty = np.array([not cells[self.column[name]].strip() for cells in self.cells])
        self.refuse(np.isnan(values) & ~empty, lambda row: f"{name} is nan", "leave a cell that was not seen empty")
        self.refuse(np.abs(values) > limit, lambda row: f"{name} {values[row]:g} is beyond ±{limit:g}")
        return values

    def refuse(
        self, bad: Bools | np.bool_, what: Callable[[int], str], remedy: str = "correct or remove the row"
    ) -> None:
        """Raise InputError with the line of the first row (n,) that is ``bad``."""
        which = np.flatnonzero(bad)
        if len(which):
            row = int(which[0])
            raise InputError(what(row), file=self.file, line=self.line[row], remedy=remedy)


def read_observations(file: Path, cameras: Iterable[str]) -> Observations:
    """Read observations.csv: camera,frame,time,u,v[,size][,label] in any row order.

    cameras: the names that the rig knows. Raises InputError: file, line, what, remedy.
    """
    known = list(cameras)
    rows = read_rows(file, known)
    return gather_tracks(
        rows.camera,
        rows.label,
        rows.frame,
        rows.time,
        rows.pixels,
        rows.size,
        stds=_stds(rows),
        order=known,
        file=file,
        lines=rows.line,
    )


def _stds(rows: ObservationRows) -> Floats | None:
    """Stds (n,) [px] of one coordinate from the columns cov_uu and cov_vv; None without them."""
    if not {"cov_uu", "cov_vv"} <= rows.column.keys():
        return None
    variance = 0.5 * (rows.numbers("cov_uu", MAX_PIXEL**2) + rows.numbers("cov_vv", MAX_PIXEL**2))
    rows.refuse(variance < 0.0, lambda row: "cov_uu, cov_vv are no covariance")
    return np.sqrt(variance)


def read_rows(file: Path, cameras: Iterable[str], optional: Sequence[str] = ()) -> ObservationRows:
    """Read the rows of observations.csv as they stand, also several of one camera, label and time.

    optional: names of further columns, which every row must then have. Raises InputError: file, line, what, remedy.
    """
    reader = csv.reader(io.StringIO(read_text(file, "observations file")), strict=True)
    try:
        header = [cell.strip() for cell in next(reader, [])]
    except csv.Error as error:
        raise InputError(f"not CSV: {error}", file=file, line=1, remedy="save it as CSV") from None
    columns = {name: index for index, name in reversed(list(enumerate(header)))}
    used = (*REQUIRED, "size", "label", *optional)
    twice = [name for name in used if header.count(name) > 1]
    if twice:
        raise InputError(f"column {twice[0]} is named twice", file=file, line=1, remedy="keep one")
    check_columns(header, REQUIRED, file, "[,size][,label]")
    rows: list[list[str]] = []
    lines: list[int] = []
    try:
        for row in reader:
            if "".join(row).strip():
                rows.append(row)
                lines.append(reader.line_num)
    except csv.Error as error:
        raise InputError(f"not CSV: {error}", file=file, line=reader.line_num, remedy="correct this row") from None
    if not rows:
        raise InputError("no rows", file=file, line=1, remedy="record some observations first")
    last = max(columns[name] for name in columns if name in used)
    for row, line in zip(rows, lines, strict=True):
        check_width(row, line, len(header), last, file)
    numbers = {name: _column(rows, lines, columns[name], name, file) for name in ("time", "u", "v")}
    far = np.flatnonzero(np.abs(numbers["time"]) > MAX_TIME_S)
    if len(far):
        what = f"time {numbers['time'][far[0]]:g} is no time in seconds"
        raise InputError(what, file=file, line=lines[far[0]], remedy="give seconds; Unix time is about 1.8e9")
    for name in ("u", "v"):
        far = np.flatnonzero(np.abs(numbers[name]) > MAX_PIXEL)
        if len(far):
            what = f"{name} {numbers[name][far[0]]:g} is no pixel"
            raise InputError(what, file=file, line=lines[far[0]], remedy="correct or remove the row")
    frame = _frames(rows, lines, columns["frame"], file)
    size = np.full(len(rows), np.nan)
    if "size" in columns:
        size = _column(rows, lines, columns["size"], "size", file, empty=np.nan)
        bad = np.flatnonzero(size < 0)
        if len(bad):
            raise InputError(f"size {size[bad[0]]:g} is negative", file=file, line=lines[bad[0]], remedy="remove it")
        size = np.where(size > 0, size, np.nan)
    names = [row[columns["camera"]].strip() for row in rows]
    labels = [row[columns["label"]].strip() or DEFAULT_LABEL for row in rows] if "label" in columns else None
    for label, line in zip(labels or (), lines, strict=False):
        if not label.isprintable():
            what = f"label {label[:80]!a} has a character that cannot be printed"
            raise InputError(what, file=file, line=line, remedy="rename the point")
    _check_cameras(names, lines, list(cameras), file)
    return ObservationRows(
        file,
        names,
        labels or [DEFAULT_LABEL] * len(rows),
        frame,
        numbers["time"],
        np.column_stack([numbers["u"], numbers["v"]]),
        size,
        lines,
        rows,
        columns,
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


def check_columns(header: Sequence[str], required: Sequence[str], file: Path, optional: str = "") -> None:
    """Raise InputError if a required column is missing in the first line of a CSV file."""
    missing = [name for name in required if name not in header]
    if missing:
        remedy = f"the first line must name {','.join(required)}{optional}"
        if len(header) == 1 and (found := [sign for sign in (";", "\t", "|") if sign in header[0]]):
            remedy = f"its columns are separated by {found[0]!r}: separate them by commas, and decimals by points"
        raise InputError(f"column {', '.join(missing)} is missing", file=file, line=1, remedy=remedy)


def check_width(row: Sequence[str], line: int, width: int, last: int, file: Path) -> None:
    """Raise InputError for a row without its column ``last``, or with cells beyond the ``width`` of the first line."""
    if len(row) <= last or (len(row) > width and any(cell.strip() for cell in row[width:])):
        remedy = "complete the row" if len(row) <= last else "name every column; quote text with commas; decimal points"
        raise InputError(f"{len(row)} columns where the first line has {width}", file=file, line=line, remedy=remedy)


def _column(
    rows: list[list[str]], lines: list[int], index: int, name: str, file: Path, empty: float | None = None
) -> Floats:
    cells = [row[index] for row in rows]
    if empty is not None:
        cells = [cell if cell.strip() else str(empty) for cell in cells]
    try:
        values = np.array(cells, dtype=np.float64)
    except ValueError:
        for cell, line in zip(cells, lines, strict=True):
            try:
                float(cell)
            except ValueError:
                what = f"{name} {cell!r} is not a number"
                raise InputError(what, file=file, line=line, remedy="correct or remove the row") from None
        raise
    finite = np.isfinite(values) if empty is None else np.isfinite(values) | np.isnan(values)
    bad = np.flatnonzero(~finite)
    if len(bad):
        what = f"{name} is {values[bad[0]]}"
        raise InputError(what, file=file, line=lines[bad[0]], remedy="remove the row: a point not seen has none")
    return values


def _frames(rows: list[list[str]], lines: list[int], index: int, file: Path) -> Ints:
    values = _column(rows, lines, index, "frame", file)
    bad = np.flatnonzero((values != np.round(values)) | (np.abs(values) > MAX_COUNT))
    if len(bad):
        raise InputError(
            f"frame {rows[bad[0]][index].strip()} is not a whole number",
            file=file,
            line=lines[bad[0]],
            remedy="correct it",
        )
    return values.astype(np.int64)


def _check_cameras(names: list[str], lines: list[int], known: list[str], file: Path) -> None:
    allowed = set(known)
    for name, line in zip(names, lines, strict=True):
        if name not in allowed:
            raise InputError(
                f"camera {name!r} is not in the rig ({', '.join(known)})",
                file=file,
                line=line,
                remedy=f"add [{name}] to rig.toml or correct the name",
            )
