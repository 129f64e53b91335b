"""Import of other tools' calibrations and tracks: format detection and conversion."""

from __future__ import annotations

import unicodedata
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from protocols.core.errors import InputError
from protocols.core.files import read_text, read_toml
from protocols.formats import colmap, keypoints, opensfm, points, toml_rigs, xml_rigs, yaml_rigs
from protocols.formats.cameras import ForeignRig, rig_tables
from protocols.geometry.types import Floats, Ints
from protocols.session.csv_table import read_csv_header
from protocols.session.folder import BOXES_FILE, OBSERVATIONS_FILE, RIG_FILE, write_rig
from protocols.session.observations import Observations, gather_tracks
from protocols.session.rig import parse_camera_table

_TABLES = ("aniposelib", "caliscope", "pose2sim", "freemocap", "opencv", "kalibr", "colmap", "opensfm")
CALIBRATIONS = (*_TABLES, *xml_rigs.UNITS)
POINTS = ("caliscope-points", "deeplabcut", "mvus", *keypoints.FORMATS)
FORMATS = (*CALIBRATIONS, *POINTS, "session")
_CROWDED_SHARE = 0.1  # of the frames with more than one person: above it, they are different labels
# A score is the height of the network's peak. Under constant noise a peak's place is known to a std over its height
# (the Cramér-Rao bound of a blob's location); the std of a certain point is that of annotated images.
_KEYPOINT_STD, _LEAST_SCORE = 2.0, 0.05
_YAML = (".yml", ".yaml")
_KEYPOINTS = (".json", ".h5", ".hdf5", ".slp", ".npy")
_REMEDY = f"give the format with --format: {', '.join(FORMATS)}"


CameraTables = Callable[[str], dict[str, Any] | None]
"""Camera → its table of rig.toml, as far as it is known without a lens; None = not at all."""


@dataclass(frozen=True, slots=True, eq=False)
class ImportSource:
    """Files to import and their format; for a session or a COLMAP model the files are one folder."""

    kind: str
    files: list[Path]


def detect_source(sources: list[Path], wanted: str | None) -> ImportSource:
    """Detect the format of files or of one folder from the content, unless ``wanted`` gives it. Raises InputError."""
    for path in sources:
        if not path.exists():
            raise InputError("this file does not exist", file=path, remedy="check the path")
    files = sources
    if len(sources) == 1 and sources[0].is_dir():
        folder = sources[0]
        if wanted == "session" or (wanted is None and _is_session(folder)):
            return ImportSource("session", [folder])
        if wanted == "colmap" or (wanted is None and colmap.is_model(folder)):
            return ImportSource("colmap", [folder])
        volume = {"caliscope": folder / "camera_array.toml", "caliscope-points": folder / "image_points.csv"}
        if (wanted or "caliscope") in volume and all(file.exists() for file in volume.values()):
            return ImportSource(wanted or "caliscope", [volume[wanted or "caliscope"]])
        if wanted in (None, "openpose") and keypoints.detect_format(folder) == "openpose":
            return ImportSource("openpose", [folder])
        kinds = (".csv", ".txt", *_YAML, ".toml", *_KEYPOINTS)
        files = sorted(path for path in folder.iterdir() if path.is_file() and path.suffix.lower() in kinds)
        if not files:
            raise InputError("nothing in this folder can be imported", file=folder, remedy=_REMEDY)
    if all(path.is_dir() and keypoints.detect_format(path) == "openpose" for path in files):
        return ImportSource("openpose", files)
    if any(path.is_dir() for path in files):
        raise InputError("a folder among files", file=next(p for p in files if p.is_dir()), remedy="give one folder")
    if wanted in ("session", "colmap"):
        raise InputError(f"a {wanted} is a folder", file=files[0], remedy="give the folder")
    if wanted is not None:
        return ImportSource(wanted, files)
    found = {path: _kind_of(path) for path in files}
    unknown = next((path for path, kind in found.items() if kind is None), None)
    if unknown is not None:
        is_text = unknown.suffix.lower() in (".csv", ".txt", ".json", ".toml", *_YAML)
        nearest = points.nearest_layout(_beginning(unknown)) if is_text else ""
        raise InputError(f"unknown format{f': {nearest}' if nearest else ''}", file=unknown, line=1, remedy=_REMEDY)
    kinds_found = sorted({str(kind) for kind in found.values()})
    if len(kinds_found) > 1:
        raise InputError(f"files of different kinds ({', '.join(kinds_found)})", remedy="import each kind by itself")
    return ImportSource(kinds_found[0], files)


def read_foreign_calibration(source: ImportSource) -> ForeignRig:
    """Read a calibration of another tool. Raises InputError."""
    if source.kind == "opencv":
        return yaml_rigs.read_opencv(source.files)
    if len(source.files) > 1:
        raise InputError(f"{len(source.files)} files of one calibration", file=source.files[1], remedy="give one")
    file = source.files[0]
    if source.kind == "colmap":
        return colmap.read(file)
    if source.kind == "kalibr":
        return yaml_rigs.read_kalibr(file)
    if source.kind in xml_rigs.UNITS:
        return xml_rigs.read(file, source.kind)
    if source.kind == "opensfm":
        return opensfm.read(file)
    return toml_rigs.read(file, source.kind)


def calibration_text(rig: ForeignRig, units: str | None, file: Path) -> str:
    """The text of a rig.toml, with every table validated. Raises InputError."""
    tables = rig_tables(rig, units or rig.units or "m")
    for name, table in tables.items():
        if name != "metadata":
            parse_camera_table(table, name, file, "")
    return tomli_w.dumps(tables)


def frame_clock(fps: float | None, videos: Path | None) -> points.Times:
    """A function that gives frame times [s]: from the videos' own time stamps if given, else at a constant rate."""
    stamps: dict[str, Floats] = {}

    def times(camera: str, frames: Ints, file: Path) -> Floats:
        if videos is not None:
            if camera not in stamps:
                stamps[camera] = _stamps_of(camera, videos)
            known = stamps[camera]
            beyond = frames[(frames < 0) | (frames >= len(known))]
            if len(beyond):
                what = f"frame {beyond[0]}, and the video of {camera} has {len(known)}"
                raise InputError(what, file=file, remedy="give the same videos that were tracked")
            return known[frames]
        if fps is None:
            what = "its frames have no times"
            raise InputError(what, file=file, remedy="give --videos FOLDER (best) or --fps RATE")
        return np.asarray(frames / fps, dtype=np.float64)

    return times


def read_points(
    source: ImportSource,
    times: points.Times,
    likelihood: float,
    camera: str | None,
    tables: CameraTables | None = None,
) -> Observations:
    """Read the observations of another tracker. tables: what is known of each camera. Raises InputError."""
    if camera is not None and (len(source.files) > 1 or source.kind == "caliscope-points"):
        raise InputError("--camera names the camera of one file", remedy="leave it out: files are named after cameras")
    if source.kind in keypoints.FORMATS:
        return _keypoint_observations(keypoints.read(source.kind, source.files, camera), times, likelihood, tables)
    return points.read(source.kind, source.files, times, likelihood, camera)


def _keypoint_observations(
    found: list[keypoints.CameraKeypoints],
    times: points.Times,
    likelihood: float,
    tables: CameraTables | None,
) -> Observations:
    """Observations of keypoints: joints are labels, of several people with the person's name before them."""
    several = any(_several_people(one.rows) for one in found)
    columns: list[tuple[str, str, int, float, float, float]] = []
    stamps: list[float] = []
    for one in found:
        table = tables(one.camera) if one.normalised and tables is not None else None
        size = table["size"] if table is not None else (1, 1)
        if one.normalised and table is None:
            what = f"its points are shares of the image, and the size of {one.camera}'s is not known"
            raise InputError(what, file=one.file, remedy="give --videos FOLDER or --size 1920x1080")
        rows = [row for row in one.rows if row.score >= likelihood]
        if not several:
            # A second person in a few frames is a false detection: the better one of each frame is kept.
            better = _best_person(rows)
            rows = [row for row in rows if better[row.frame] == row.person]
        shift = 0.5 if one.normalised else 0.0
        for row in rows:
            label = f"{row.person}.{row.joint}" if several else row.joint
            place = row.u * size[0] - shift, row.v * size[1] - shift
            columns.append((one.camera, label, row.frame, *place, _KEYPOINT_STD / max(row.score, _LEAST_SCORE)))
        stamps += times(one.camera, np.array([row.frame for row in rows], dtype=np.int64), one.file).tolist()
    if not columns:
        best = max(row.score for one in found for row in one.rows)
        what = f"no keypoint's likelihood reaches {likelihood:g}, the best is {best:.2g}"
        raise InputError(what, file=found[0].file, remedy="import with a smaller --likelihood")
    cameras, labels, frames, across, down, spread = (list(column) for column in zip(*columns, strict=True))
    nothing = np.full(len(columns), np.nan)
    pixels = np.column_stack([np.array(across, dtype=np.float64), np.array(down, dtype=np.float64)])
    stds = np.array(spread, dtype=np.float64)
    # Equal scores say nothing of a point.
    known = stds if np.ptp(stds) > 0.0 else None
    numbers = np.array(frames, dtype=np.int64)
    return gather_tracks(cameras, labels, numbers, np.array(stamps), pixels, nothing, stds=known)


def _several_people(rows: list[keypoints.Keypoint]) -> bool:
    """Whether a sizeable part of the frames shows more than one person."""
    people: dict[int, set[str]] = {}
    for row in rows:
        people.setdefault(row.frame, set()).add(row.person)
    return sum(len(one) > 1 for one in people.values()) > _CROWDED_SHARE * len(people)


def _best_person(rows: list[keypoints.Keypoint]) -> dict[int, str]:
    """The person with the largest sum of scores in each frame."""
    total: dict[int, Counter[str]] = {}
    for row in rows:
        total.setdefault(row.frame, Counter())[row.person] += row.score  # type: ignore[assignment]
    return {frame: max(sorted(scores), key=scores.__getitem__) for frame, scores in total.items()}


def camera_tables(videos: Path | None, size: tuple[int, int] | None, fps: float | None) -> CameraTables:
    """A function that gives what is known of a camera: image size and frame rate, of its video or as given."""

    def table(camera: str) -> dict[str, Any] | None:
        if videos is None:
            rate = {} if fps is None else {"fps": fps}
            return None if size is None else {"name": camera, "size": list(size), **rate}
        from edge.devices.playback.video_reader import VideoReader

        info = VideoReader(_video_of(camera, videos)).info
        return {"name": camera, "size": list(info.size), "fps": info.fps}

    return table


def write_missing_rig(folder: Path, cameras: Sequence[str], tables: CameraTables) -> Path | None:
    """Write a rig.toml without lenses beside observations, where there is none and all sizes are known."""
    file = folder / RIG_FILE
    found = {name: tables(name) for name in cameras}
    if file.exists() or any(table is None for table in found.values()):
        return None
    write_rig(file, {"metadata": {"units": "m"}, **found})
    return file


def _kind_of(file: Path) -> str | None:
    suffix = file.suffix.lower()
    if suffix == ".json" and opensfm.is_file(file):
        return "opensfm"
    if suffix in _KEYPOINTS:
        return keypoints.detect_format(file)
    if suffix == ".toml":
        return toml_rigs.detect_format(read_toml(file, "calibration")[0])
    if suffix in _YAML:
        return yaml_rigs.detect_format(yaml_rigs.load(file)[0])
    if suffix in (".xml", ".xcp", ".mcal") or _beginning(file).lstrip().startswith("<"):
        return xml_rigs.detect_format(file)
    return points.detect_format(_beginning(file))


def _is_session(folder: Path) -> bool:
    """Whether it has a rig, boxes or, beside no other tool's model, observations: of people they need no rig."""
    if (folder / RIG_FILE).exists() or (folder / BOXES_FILE).exists():
        return True
    file = folder / OBSERVATIONS_FILE
    columns = read_csv_header(file, "observations") if file.is_file() and not colmap.is_model(folder) else []
    return {"camera", "time"} <= set(columns)


def _beginning(file: Path) -> str:
    """The first 64 Ki characters of a text. Raises InputError."""
    return read_text(file)[: 1 << 16]


def _stamps_of(camera: str, videos: Path) -> Floats:
    """Times (n,) [s] of the frames of a camera's video, in presentation order."""
    from edge.devices.playback.video_reader import VideoReader

    return np.array([shot.time for shot in VideoReader(_video_of(camera, videos))])


def _video_of(camera: str, videos: Path) -> Path:
    from edge.devices.playback.video_reader import VIDEO_SUFFIXES

    found = sorted(
        path
        for path in videos.glob("*")
        if path.suffix.lower() in VIDEO_SUFFIXES and unicodedata.normalize("NFC", path.stem) == camera
    )
    if not found:
        raise InputError(f"no video of camera {camera!r}", file=videos, remedy=f"name it {camera}.mp4, or give --fps")
    return found[0]
