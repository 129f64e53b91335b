"""Import of observations of other trackers: caliscope's point tables, DeepLabCut's CSV, mvus' text.

DeepLabCut and mvus have frame numbers without times, caliscope may have times: ``times`` converts a camera's frame
numbers to seconds. In all of them pixel (0, 0) is the centre of the top-left pixel, as in OpenCV.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from protocols.core.errors import InputError
from protocols.core.files import read_text
from protocols.core.names import check_name, name_from_file
from protocols.geometry.types import Floats, Ints
from protocols.session.observations import Observations, gather_tracks

Times = Callable[[str, Ints, Path], Floats]
"""Camera, its frames (n,), the file → seconds (n,). May raise InputError."""
_FARTHEST = 1e6  # px
_CALISCOPE = ("sync_index", "img_loc_x", "img_loc_y")
_CALISCOPE_POINTS, _CALISCOPE_CAMERAS = ("keypoint_id", "point_id"), ("cam_id", "port")  # today's names first
_LAYOUTS = {
    "caliscope's xy.csv of 2025": "sync_index cam_id frame_index frame_time object_id keypoint_id img_loc_x img_loc_y",
    "caliscope's older xy.csv": "sync_index port frame_index frame_time point_id img_loc_x img_loc_y",
    "Syncline's observations.csv": "camera frame time u v",
    "Syncline's boxes.csv": "camera frame time x y width height",
    "DeepLabCut's CSV": "scorer bodyparts coords",
    "SLEAP's CSV, of which the .h5 or .slp file is read": "track frame_idx instance.score",
    "ROS' camera_info": "image_width image_height camera_name camera_matrix distortion_model distortion_coefficients",
    "OpenCV's calibration": "camera_matrix distortion_coefficients image_width image_height",
    "Kalibr's camchain": "camera_model intrinsics distortion_model distortion_coeffs resolution",
    "caliscope's camera_array.toml": "cameras. cam_id size matrix distortions",
    "aniposelib's calibration": "name size matrix distortions rotation translation",
    "OpenSfM's reconstruction.json": "cameras shots rotation translation projection_type",
    "MMPose's JSON": "instances keypoints keypoint_scores",
    "COCO keypoints": "images annotations image_id keypoints",
    "MediaPipe's export": "landmarks x y visibility",
}
"""Columns of tables by name, or rows or keys, for what is nearly one of them."""
_KEY = re.compile(r'[{,]\s*"(\w+)"\s*:|^\s*-?\s*"?(\w+)"?\s*[:=]|^\s*\[(cameras\.)', re.MULTILINE)
"""Keys in JSON, YAML and TOML."""


@dataclass(slots=True)
class _Rows:
    """Rows of the files in reading order, by column."""

    camera: list[str] = field(default_factory=list)
    label: list[str] = field(default_factory=list)
    frame: list[int] = field(default_factory=list)
    time: list[float] = field(default_factory=list)
    pixels: list[tuple[float, float]] = field(default_factory=list)
    line: list[int] = field(default_factory=list)


def detect_format(text: str) -> str | None:
    """The format of a point table, from the beginning of its text; None = unknown."""
    lines = [line for line in text.splitlines()[:6] if line.strip()]
    if not lines:
        return None
    parted = _delimiter(text)
    header = [cell.strip() for cell in lines[0].split(parted)]
    if all(name in header for name in _CALISCOPE) and any(name in header for name in _CALISCOPE_POINTS):
        return "caliscope-points"
    if {"bodyparts", "coords"} <= {line.split(parted)[0].strip() for line in lines}:
        return "deeplabcut"  # its first row, scorer, is not needed
    try:
        first = [float(word) for word in lines[0].replace(",", " ").split()]
    except ValueError:
        return None
    return "mvus" if len(first) >= 3 and first[2] == round(first[2]) and first[2] >= 0 else None


def nearest_layout(text: str) -> str:
    """Which known table the beginning of a text is nearest to, and what it lacks; "" where it resembles none."""
    lines = text.splitlines() or [""]
    columns_found, rows = re.split("[,;]", lines[0]), [line.split(",")[0] for line in lines]
    keys = {"".join(found).lower() for found in _KEY.findall(text)}
    header = keys or {cell.strip().lower() for cell in [*columns_found, *rows]}
    found = []
    for name, columns in _LAYOUTS.items():
        wanted = columns.split()
        missing = [column for column in wanted if column not in header]
        found.append((len(missing) / len(wanted), name, missing))
    share, name, missing = min(found)
    if share > 0.5:
        return ""
    if not missing:
        return f"looks like {name}{', but its columns are parted by semicolons' * (';' in lines[0])}"
    part = "key" if keys else "row" if name == "DeepLabCut's CSV" else "column"
    return f"looks like {name}, but {part} {', '.join(missing).rstrip('.')} is missing"


def read(kind: str, files: list[Path], times: Times, likelihood: float, camera: str | None) -> Observations:
    """The observations of some files of one kind.

    likelihood: lower limit for DeepLabCut's points. camera: name for a single file; default: from the file's name.
    Raises InputError: file, line, what, remedy.
    """
    rows = _Rows()
    for file in files:
        before = len(rows.camera)
        if kind == "caliscope-points":
            _caliscope(file, rows, times)
        else:
            name = camera_from_file_name(file) if camera is None else check_name(camera, file=file)
            if name in rows.camera:
                raise InputError(f"a second file of camera {name!r}", file=file, remedy="rename it after its camera")
            _deeplabcut(file, name, rows, likelihood) if kind == "deeplabcut" else _mvus(file, name, rows)
            mine = np.array(rows.frame[before:], dtype=np.int64)
            rows.time += times(name, mine, file).tolist()
        if len(rows.camera) == before:
            raise InputError("no point in it", file=file, remedy="give a file in which something was seen")
    return gather_tracks(
        rows.camera,
        rows.label,
        np.array(rows.frame, dtype=np.int64),
        np.array(rows.time),
        np.array(rows.pixels),
        np.full(len(rows.camera), np.nan),
        file=files[0] if len(files) == 1 else None,
        lines=rows.line if len(files) == 1 else None,
    )


def camera_from_file_name(file: Path) -> str:
    """The camera's name in a file's name, without the suffixes that trackers append. Raises InputError."""
    stem = re.split(r"DLC_|_detections?$|_filtered$", file.stem)[0].rstrip("_-. ") or file.stem
    return name_from_file(stem, file)


def _caliscope(file: Path, rows: _Rows, times: Times) -> None:
    table = _table(file)
    header = [cell.strip() for cell in table[0][1]] if table else []
    place = {name: number for number, name in reversed(list(enumerate(header)))}
    ids = next((name for name in _CALISCOPE_CAMERAS if name in place), None)
    of_point = next((name for name in _CALISCOPE_POINTS if name in place), None)
    missing = [name for name in _CALISCOPE if name not in place]
    missing += ([] if ids else ["cam_id"]) + ([] if of_point else ["keypoint_id"])
    if missing or ids is None or of_point is None:
        remedy = "give caliscope's xy_….csv or image_points.csv"
        raise InputError(f"column {', '.join(missing)} is missing", file=file, line=1, remedy=remedy)
    at = place["img_loc_x"], place["img_loc_y"]
    whole = [row for _, row in table[1:] if len(row) == len(header) and not _is_missing(row[at[0]], row[at[1]])]
    timed = "frame_time" in place and all(cells[place["frame_time"]].strip() for cells in whole)
    objects = len({cells[place["object_id"]] for cells in whole}) if "object_id" in place else 1
    begin = len(rows.camera)
    counted = "frame_index" if "frame_index" in place else "sync_index"
    for line, cells in table[1:]:
        if len(cells) < len(header):
            raise InputError(f"{len(cells)} columns of {len(header)}", file=file, line=line, remedy="complete the row")
        if _is_missing(cells[at[0]], cells[at[1]]):
            continue
        port = _whole(cells[place[ids]], ids, file, line)
        u, v = (_pixel(cells[place[name]], name, file, line) for name in ("img_loc_x", "img_loc_y"))
        rows.camera.append(f"cam_{port}")
        label = str(_whole(cells[place[of_point]], of_point, file, line))
        if objects > 1:
            label = f"{_whole(cells[place['object_id']], 'object_id', file, line)}.{label}"
        rows.label.append(label)
        rows.frame.append(_whole(cells[place[counted]], counted, file, line))
        rows.pixels.append((u, v))
        rows.line.append(line)
        if timed:
            rows.time.append(_number(cells[place["frame_time"]], "frame_time", file, line))
    if not timed:
        names = np.array(rows.camera[begin:])
        frames = np.array(rows.frame[begin:], dtype=np.int64)
        made = np.zeros(len(frames))
        for name in dict.fromkeys(rows.camera[begin:]):
            made[names == name] = times(name, frames[names == name], file)
        rows.time += made.tolist()


def _deeplabcut(file: Path, camera: str, rows: _Rows, least: float) -> None:
    table = _table(file)
    levels = {cells[0].strip(): cells for _, cells in table[:4]}
    if not all(name in levels for name in ("bodyparts", "coords")):
        remedy = "give the CSV that DeepLabCut's analyze_videos writes"
        raise InputError("the rows scorer, bodyparts, coords are not there", file=file, line=1, remedy=remedy)
    head = next(number for number, (_, cells) in enumerate(table) if cells[0].strip() == "coords") + 1
    parts, coords = levels["bodyparts"], [cell.strip() for cell in levels["coords"]]
    people = levels.get("individuals")
    width = len(coords)
    starts = [column for column in range(1, width) if coords[column] == "x"]
    if not starts or any(coords[column : column + 2] != ["x", "y"] for column in starts):
        raise InputError("coords are not x, y, likelihood", file=file, line=head, remedy="export it again")
    if len(parts) != width or (people is not None and len(people) != width):
        raise InputError("header rows of different lengths", file=file, line=head, remedy="export it again")
    begin, best = len(rows.camera), -1.0
    for line, cells in table[head:]:
        if len(cells) != width:
            raise InputError(f"{len(cells)} columns of {width}", file=file, line=line, remedy="complete the row")
        frame = _frame(cells[starts[0] - 1], file, line)  # of labelled images, folder and file are two columns
        for column in starts:
            if _is_missing(cells[column], cells[column + 1]):
                continue
            has_likelihood = column + 2 < width and coords[column + 2] == "likelihood"
            likelihood = cells[column + 2].strip() if has_likelihood else ""
            unknown = 0.0 if likelihood else 1.0  # NaN is of a point that was not found
            score = unknown if _is_missing(likelihood) else _number(likelihood, "likelihood", file, line)
            best = max(best, score)
            if not score >= least:
                continue
            part = parts[column].strip()
            rows.camera.append(camera)
            rows.label.append(part if people is None else f"{people[column].strip()}.{part}")
            rows.frame.append(frame)
            rows.pixels.append((_pixel(cells[column], "x", file, line), _pixel(cells[column + 1], "y", file, line)))
            rows.line.append(line)
    if len(rows.camera) == begin and best >= 0.0:
        remedy = "import with a smaller --likelihood, or train the tracker on such images"
        raise InputError(f"no point's likelihood reaches {least:g}, the best is {best:g}", file=file, remedy=remedy)


def _mvus(file: Path, camera: str, rows: _Rows) -> None:
    """One camera's mvus file: columns x, y, frame (mvus itself reads them as columns 3, 1, 2)."""
    for line, row in enumerate(read_text(file).splitlines(), 1):
        words = row.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        if len(words) < 3:
            raise InputError(f"{len(words)} numbers", file=file, line=line, remedy="give x y frame")
        u, v = _pixel(words[0], "x", file, line), _pixel(words[1], "y", file, line)
        if u == 0.0 and v == 0.0:
            continue  # mvus' trackers write (0, 0) for a frame without a detection
        rows.camera.append(camera)
        rows.label.append("marker")
        rows.frame.append(_whole(words[2], "frame", file, line))
        rows.pixels.append((u, v))
        rows.line.append(line)


def _is_missing(*cells: str) -> bool:
    """Whether one of some cells is empty, or NaN as numpy and MATLAB write it."""
    return any(cell.strip().lower() in ("", "nan") for cell in cells)


def _delimiter(text: str) -> str:
    """What parts the columns of a table: spreadsheets of many countries write semicolons, and decimal commas."""
    first = text.lstrip().partition("\n")[0]
    return ";" if first.count(";") > first.count(",") else ","


def _table(file: Path) -> list[tuple[int, list[str]]]:
    text = read_text(file)
    parted = _delimiter(text)
    text = text.replace(",", ".") if parted == ";" else text
    reader = csv.reader(io.StringIO(text), strict=True, delimiter=parted)
    out: list[tuple[int, list[str]]] = []
    try:
        for cells in reader:
            if any(cell.strip() for cell in cells):
                out.append((reader.line_num, cells))
    except csv.Error as error:
        raise InputError(f"not CSV: {error}", file=file, line=reader.line_num, remedy="correct this row") from None
    if len(out) < 2:
        raise InputError("no rows", file=file, line=1, remedy="give a file in which something was seen")
    return out


def _number(cell: str, what: str, file: Path, line: int) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputError(f"{what} {cell.strip()!r} is not a number", file=file, line=line, remedy="correct the row")
    return value


def _pixel(cell: str, what: str, file: Path, line: int) -> float:
    value = _number(cell, what, file, line)
    if abs(value) > _FARTHEST:
        raise InputError(f"{what} {value:g} is no pixel", file=file, line=line, remedy="correct or remove the row")
    return value


def _whole(cell: str, what: str, file: Path, line: int) -> int:
    value = _number(cell, what, file, line)
    if value != round(value) or abs(value) > 2**53:
        raise InputError(f"{what} {cell.strip()} is not whole", file=file, line=line, remedy="correct the row")
    return int(value)


def _frame(cell: str, file: Path, line: int) -> int:
    """A frame's index, or the last number in the file name of an image."""
    numbers = re.findall(r"\d+", Path(cell.strip()).stem)
    if not re.fullmatch(r"\s*-?\d+(\.0*)?\s*", cell) and numbers:
        return int(numbers[-1])
    return _whole(cell, "the frame", file, line)
