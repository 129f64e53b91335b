"""Import of other tools' calibrations and tracks: format detection and conversion; sessions to and from logs."""

from __future__ import annotations

import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from deploy.offline.csv_table import read_csv_header
from deploy.offline.follow.objects import BOXES_FILE, complete_detections, is_boxes_file, object_messages, read_objects
from protocols.core.clocks import NANOSECONDS, CameraTime
from protocols.core.errors import InputError
from protocols.core.files import read_text, read_toml
from protocols.formats import colmap, keypoints, opensfm, points, toml_rigs, xml_rigs, yaml_rigs
from protocols.formats.cameras import ForeignRig, rig_tables
from protocols.geometry.types import Floats, Ints
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import CameraCalibration, read_calibration
from protocols.session.folder import OBSERVATIONS_FILE, RIG_FILE, write_rig
from protocols.session.observations import Observations, gather_tracks
from protocols.session.rig import Rig, parse_camera_table, read_rig

if TYPE_CHECKING:
    from google.protobuf.message import Message

    from protocols.topics import Topic

CALIBRATIONS = (
    "aniposelib",
    "caliscope",
    "pose2sim",
    "freemocap",
    "opencv",
    "kalibr",
    "colmap",
    "opensfm",
    "qualisys",
    "vicon",
)
POINTS = ("caliscope-points", "deeplabcut", "mvus", *keypoints.FORMATS)
FORMATS = (*CALIBRATIONS, *POINTS, "session")
_CROWDED_SHARE = 0.1  # of the frames with more than one person: above it, they are different labels
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


@dataclass(frozen=True, slots=True, eq=False)
class Arrivals:
    """When frames arrive at the recorder: ``delay`` + |N(0, ``jitter``)| [s] after their exposure, a camera's in order.

    clocks: calibrations whose time maps give the exposures, by camera.
    """

    clocks: dict[str, CameraCalibration]
    delay: float = 0.0
    jitter: float = 0.0
    seed: int = 0

    def of(self, camera: str, times: Floats) -> Floats:
        """Reference times (n,) [s] at which frames (n,) of increasing camera times [s] arrive."""
        clock = self.clocks[camera].time_map
        rng = np.random.default_rng([self.seed, *camera.encode()])
        late = self.delay + np.abs(rng.normal(0.0, self.jitter, len(times)))
        return np.asarray(np.maximum.accumulate(clock.clock_rate * times + clock.time_offset + late))


def detect_source(sources: list[Path], wanted: str | None) -> ImportSource:
    """Detect the format of files or of one folder from the content, unless ``wanted`` gives it. Raises InputError."""
    for path in sources:
        if not path.exists():
            raise InputError("this file does not exist", file=path, remedy="check the path")
    files = sources
    if len(sources) == 1 and sources[0].is_dir():
        folder = sources[0]
        if wanted == "session" or (wanted is None and ((folder / RIG_FILE).exists() or (folder / BOXES_FILE).exists())):
            return ImportSource("session", [folder])
        if wanted == "colmap" or (wanted is None and (folder / colmap.IMAGES).exists()):
            return ImportSource("colmap", [folder])
        volume = folder / "camera_array.toml"
        if wanted in (None, "caliscope") and volume.exists() and (folder / "image_points.csv").exists():
            return ImportSource("caliscope", [volume])  # a capture volume
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
        nearest = points.nearest_layout(_beginning(unknown)) if unknown.suffix.lower() in (".csv", ".txt") else ""
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
    if source.kind in ("qualisys", "vicon"):
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
    columns: list[tuple[str, str, int, float, float]] = []
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
            best = _best_person(rows)
            rows = [row for row in rows if best[row.frame] == row.person]
        shift = 0.5 if one.normalised else 0.0
        for row in rows:
            label = f"{row.person}.{row.joint}" if several else row.joint
            columns.append((one.camera, label, row.frame, row.u * size[0] - shift, row.v * size[1] - shift))
        stamps += times(one.camera, np.array([row.frame for row in rows], dtype=np.int64), one.file).tolist()
    if not columns:
        raise InputError("no keypoint is above --likelihood", file=found[0].file, remedy="give a lower one")
    cameras, labels, frames, across, down = (list(column) for column in zip(*columns, strict=True))
    nothing = np.full(len(columns), np.nan)
    pixels = np.column_stack([np.array(across, dtype=np.float64), np.array(down, dtype=np.float64)])
    return gather_tracks(cameras, labels, np.array(frames, dtype=np.int64), np.array(stamps), pixels, nothing)


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


def session_to_log(rig: Rig, observations: Observations, out: Path, arrivals: Arrivals | None = None) -> int:
    """Write a session as a log, atomically; returns the number of messages. Raises InputError.

    arrivals: the log times; by default every camera's first frame is at the log's beginning. A camera's information
    comes with its first frame.
    """
    infos = [camera_info(rig, name) for name in rig.cameras]
    return _write_log(out, infos, rig, _with_log_times(_observation_messages(rig, observations), arrivals))


def has_objects(folder: Path) -> bool:
    """Whether a session folder holds detections of objects, several of one label in a frame, or boxes."""
    return _objects_file(folder) is not None


def objects_to_log(
    folder: Path, calibration: Path | None, out: Path, arrivals: Arrivals | None
) -> tuple[Rig, int, int]:
    """Write a session of detected objects as a log with all that is known of each detection; see `session_to_log`.

    Boxes of no kind become people.

    calibration: gives cameras and lenses in place of the folder's rig.toml. Returns the rig, and the numbers of
    detections and messages. Raises InputError.
    """
    file = _objects_file(folder)
    assert file is not None
    if calibration is None and not (folder / RIG_FILE).exists():
        raise InputError(f"no {RIG_FILE} in this folder", file=folder, remedy="give --calibration CALIB.toml")
    rig = read_rig(calibration or folder / RIG_FILE)
    sizes = {name: camera.size for name, camera in rig.cameras.items()}
    rows = read_objects(file, sizes)
    messages = object_messages(rows)
    complete_detections(messages, "person", sizes)
    infos = [camera_info(rig, name) for name in rig.cameras]
    return rig, len(rows), _write_log(out, infos, rig, _with_log_times(messages, arrivals))


def _objects_file(folder: Path) -> Path | None:
    file = folder / OBSERVATIONS_FILE
    if not file.exists():
        boxes = folder / BOXES_FILE
        return boxes if boxes.exists() else None
    objects = is_boxes_file(file) or not {"kind", "box_x", "head_u"}.isdisjoint(read_csv_header(file, "observations"))
    return file if objects else None


def write_observation_log(
    out: Path,
    infos: Sequence[pb.CameraInfo],
    rig: Rig,
    observations: Iterable[pb.Observation],
    clocks: dict[str, CameraCalibration],
    arrivals: Arrivals | None = None,
) -> int:
    """Write observations as a log in the order of their exposures on the reference clock; as `session_to_log`.

    clocks: calibrations of all cameras whose frames are written; those of others are left out. arrivals: of the frames,
    in place of the exposures.
    """
    known = [message for message in observations if message.camera in clocks]
    return _write_log(out, infos, rig, _with_log_times(known, arrivals or Arrivals(clocks)))


def _write_log(out: Path, infos: Sequence[pb.CameraInfo], rig: Rig, frames: list[tuple[int, pb.Observation]]) -> int:
    from protocols.log.write.writer import LogWriter
    from protocols.topics import CAMERA_INFO, OBSERVATION, RIG_INFO

    if out.exists():
        raise InputError("this file exists already", file=out, remedy="choose another --out: logs are not replaced")
    part = out.with_name(f".{out.stem}.part.mcap")
    part.unlink(missing_ok=True)
    begins = {message.camera: at for at, message in reversed(frames)}
    boots = {message.camera: message.boot_id for _, message in frames}
    messages: list[tuple[int, Topic, str, Message]] = [(0, RIG_INFO, "import", _rig_info(rig))]
    for info in infos:
        info.boot_id = boots.get(info.camera, info.boot_id)
        messages.append((begins.get(info.camera, 0), CAMERA_INFO, info.camera, info))
    messages += [(at, OBSERVATION, message.camera, message) for at, message in frames]
    try:
        with LogWriter(part, views=True) as writer:
            for at, topic, name, message in sorted(messages, key=lambda entry: entry[0]):
                writer.write(topic, name, "import", message, at)
        part.replace(out)
    finally:
        part.unlink(missing_ok=True)
    return len(messages)


def read_arrivals(calibration: Path, rig: Rig, delay: float, jitter: float, seed: int) -> Arrivals:
    """Arrivals at the times that a calibration.toml gives; it must have all cameras. Raises InputError."""
    _, clocks = read_calibration(calibration)
    missing = [name for name in rig.cameras if name not in clocks]
    if missing:
        what = f"no clock of {', '.join(missing)}: the arrival of its frames is not known"
        raise InputError(what, file=calibration, remedy="take a calibration of all cameras, or remove it from rig.toml")
    return Arrivals(clocks, delay, jitter, seed)


def rig_tables_of_log(rig: Rig) -> dict[str, Any]:
    """The tables of rig.toml for the rig of a log."""
    metadata: dict[str, Any] = {**rig.metadata, "units": rig.units, "clock": rig.clock}
    if rig.distances:
        metadata["distances"] = [list(row) for row in rig.distances]
    if rig.up is not None:
        metadata["up"] = rig.up if isinstance(rig.up, str) else rig.up.tolist()
    tables: dict[str, Any] = {"metadata": metadata}
    for name, camera in rig.cameras.items():
        from protocols.geometry import so3

        table: dict[str, Any] = {"name": name, "size": list(camera.size)}
        if camera.fps:
            table["fps"] = camera.fps
        lens = camera.intrinsics
        if lens is not None:
            table |= {"matrix": lens.matrix.tolist(), "distortions": lens.distortions.tolist()}
            table |= {"fisheye": True} if lens.fisheye else {}
        if camera.rotation is not None:
            table["rotation"] = so3.log(camera.rotation).tolist()
        for key in ("position", "position_std", "rotation_std"):
            value = getattr(camera, key)
            if value is not None:
                table[key] = value.tolist()
        tables[name] = table
    return tables


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
    begin = _beginning(file)
    if suffix in (".xml", ".xcp") or begin.lstrip().startswith("<"):
        return xml_rigs.detect_format(file)
    return points.detect_format(begin)


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


def camera_info(rig: Rig, name: str) -> pb.CameraInfo:
    """The information message of a rig's camera."""
    from protocols.geometry import so3

    camera = rig.cameras[name]
    info = pb.CameraInfo(schema_version=1, camera=name, boot_id="import", driver="import", clock="device")
    info.width, info.height, info.fps = camera.size[0], camera.size[1], camera.fps
    if camera.intrinsics is not None:
        info.matrix.extend(camera.intrinsics.matrix.ravel().tolist())
        info.distortions.extend(camera.intrinsics.distortions.tolist())
        info.fisheye = camera.intrinsics.fisheye
    for key in ("position", "position_std", "rotation_std"):
        value = getattr(camera, key)
        if value is not None:
            getattr(info, key).extend(value.tolist())
    if camera.rotation is not None:
        info.rotation.extend(so3.log(camera.rotation).tolist())
    return info


def _rig_info(rig: Rig) -> pb.RigInfo:
    info = pb.RigInfo(schema_version=1, units=rig.units, clock=rig.clock)
    info.reference_camera = str(rig.metadata.get("reference", ""))
    for a, b, length in rig.distances:
        info.distances.add(camera_a=a, camera_b=b, distance=length)
    if isinstance(rig.up, str):
        info.up_camera = rig.up
    elif rig.up is not None:
        info.up.extend(rig.up.tolist())
    return info


def _observation_messages(rig: Rig, observations: Observations) -> list[pb.Observation]:
    """The frames with rows, by camera and time."""
    out = []
    for name in rig.cameras:
        frames: dict[tuple[int, int], list[tuple[str, float, float, float]]] = {}
        for track in observations.of_camera(name):
            for frame, time, (u, v), size in zip(track.frame, track.time, track.pixels, track.size, strict=True):
                seen = frames.setdefault((round(float(time) * NANOSECONDS), int(frame)), [])
                seen.append((track.label, float(u), float(v), float(size) if np.isfinite(size) else 0.0))
        for sequence, ((time_ns, frame), seen) in enumerate(sorted(frames.items())):
            message = pb.Observation(
                schema_version=1, camera=name, boot_id="import", sequence=sequence, frame=frame, device_time_ns=time_ns
            )
            for label, u, v, size in seen:
                message.detections.add(u=u, v=v, size=size, score=1.0, label=label)
            out.append(message)
    return out


def _with_log_times(messages: list[pb.Observation], arrivals: Arrivals | None) -> list[tuple[int, pb.Observation]]:
    """Messages, which are in order of time for each camera, with log times [ns], in order of these.

    Log time 0 is the first exposure of all cameras, or of each camera where ``arrivals`` are not given.
    """
    out: list[tuple[int, pb.Observation]] = []
    exposures: list[float] = []
    for name in dict.fromkeys(message.camera for message in messages):
        mine = [message for message in messages if message.camera == name]
        stamps = [message.device_time_ns for message in mine]
        if arrivals is None:
            log_times = [stamp - stamps[0] for stamp in stamps]
        else:
            times = np.array(stamps) / NANOSECONDS
            exposures.append(float(arrivals.clocks[name].time_map.reference_from_camera(CameraTime(times[0]))))
            log_times = [round(at * NANOSECONDS) for at in arrivals.of(name, times).tolist()]
        out += zip(log_times, mine, strict=True)
    first = round(min(exposures) * NANOSECONDS) if exposures else 0
    return sorted(((at - first, message) for at, message in out), key=lambda item: (item[0], item[1].camera))


__all__ = [
    "CALIBRATIONS",
    "FORMATS",
    "OBSERVATIONS_FILE",
    "POINTS",
    "Arrivals",
    "ImportSource",
    "calibration_text",
    "camera_info",
    "detect_source",
    "frame_clock",
    "has_objects",
    "objects_to_log",
    "read_arrivals",
    "read_foreign_calibration",
    "read_points",
    "rig_tables_of_log",
    "session_to_log",
    "write_observation_log",
]
