"""Sessions and detected objects as logs, and the rig of a log as tables of rig.toml."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deploy.offline.follow.objects import complete_detections, is_boxes_file, object_messages, read_objects
from hub.live.messages import rig_message
from protocols.core.clocks import NANOSECONDS, CameraTime
from protocols.core.errors import InputError
from protocols.core.files import completed_file
from protocols.geometry.types import Floats
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import CameraCalibration, read_calibration
from protocols.session.csv_table import read_csv_header
from protocols.session.folder import BOXES_FILE, OBSERVATIONS_FILE, RIG_FILE
from protocols.session.observations import Observations
from protocols.session.rig import Rig, read_rig
from protocols.validation.rules import SCHEMA_VERSION

if TYPE_CHECKING:
    from google.protobuf.message import Message

    from protocols.topics import Topic


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


def session_to_log(rig: Rig, observations: Observations, out: Path, arrivals: Arrivals | None = None) -> int:
    """Write a session as a log, atomically; returns the number of messages. Raises InputError.

    arrivals: the log times; by default every camera's first frame is at the log's beginning. A camera's information
    comes with its first frame.
    """
    infos = [camera_info(rig, name) for name in rig.cameras]
    return _write_log(out, infos, rig, _with_log_times(_observation_messages(rig, observations), arrivals))


def objects_to_log(
    folder: Path, calibration: Path | None, out: Path, arrivals: Arrivals | None
) -> tuple[Rig, int, int]:
    """Write a session of detected objects as a log with all that is known of each detection; see `session_to_log`.

    Boxes of no kind become people.

    calibration: gives cameras and lenses in place of the folder's rig.toml. Returns the rig, and the numbers of
    detections and messages. Raises InputError.
    """
    file = objects_file(folder)
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


def objects_file(folder: Path) -> Path | None:
    file = folder / OBSERVATIONS_FILE
    if not file.exists():
        boxes = folder / BOXES_FILE
        return boxes if boxes.exists() else None
    if (folder / RIG_FILE).exists() and read_rig(folder / RIG_FILE).bodies:
        return None  # corners of a board: labelled points
    objects = is_boxes_file(file) or not {"kind", "box_x", "head_u"}.isdisjoint(read_csv_header(file, "observations"))
    return file if objects else None


def write_observation_log(
    out: Path,
    infos: Sequence[pb.CameraInfo],
    rig: Rig,
    observations: Iterable[pb.Observation],
    clocks: dict[str, CameraCalibration],
) -> int:
    """Write observations as a log in the order of their exposures on the reference clock; as `session_to_log`.

    clocks: calibrations of all cameras whose frames are written; those of others are left out.
    """
    known = [message for message in observations if message.camera in clocks]
    return _write_log(out, infos, rig, _with_log_times(known, Arrivals(clocks)))


def _write_log(out: Path, infos: Sequence[pb.CameraInfo], rig: Rig, frames: list[tuple[int, pb.Observation]]) -> int:
    from protocols.log.write.writer import LogWriter
    from protocols.topics import CAMERA_INFO, OBSERVATION, RIG_INFO

    if out.exists():
        raise InputError("this file exists already", file=out, remedy="choose another --out: logs are not replaced")
    begins = {message.camera: at for at, message in reversed(frames)}
    boots = {message.camera: message.boot_id for _, message in frames}
    messages: list[tuple[int, Topic, str, Message]] = [(0, RIG_INFO, "import", rig_message(rig))]
    for info in infos:
        info.boot_id = boots.get(info.camera, info.boot_id)
        messages.append((begins.get(info.camera, 0), CAMERA_INFO, info.camera, info))
    messages += [(at, OBSERVATION, message.camera, message) for at, message in frames]
    with completed_file(out) as part, LogWriter(part, views=True) as writer:
        for at, topic, name, message in sorted(messages, key=lambda entry: entry[0]):
            writer.write(topic, name, "import", message, at)
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
        table: dict[str, Any] = {"name": name, "size": list(camera.size)}
        if camera.fps:
            table["fps"] = camera.fps
        if camera.readout is not None:
            table["readout"] = camera.readout
        if camera.focal_std:
            table["focal_std"] = camera.focal_std
        lens = {} if camera.intrinsics is None else camera.intrinsics.table()
        tables[name] = table | lens | camera.pose_table()
    return tables


def camera_info(rig: Rig, name: str) -> pb.CameraInfo:
    """The information message of a rig's camera."""
    camera = rig.cameras[name]
    known = camera.pose_table() | ({} if camera.intrinsics is None else camera.intrinsics.message_fields())
    info = pb.CameraInfo(
        schema_version=SCHEMA_VERSION, camera=name, boot_id="import", driver="import", clock="device", **known
    )
    info.target = str(rig.metadata.get("target", ""))
    info.width, info.height, info.fps = camera.size[0], camera.size[1], camera.fps
    info.readout_s, info.focal_std = camera.readout or 0.0, camera.focal_std
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
                schema_version=SCHEMA_VERSION,
                camera=name,
                boot_id="import",
                sequence=sequence,
                frame=frame,
                device_time_ns=time_ns,
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
