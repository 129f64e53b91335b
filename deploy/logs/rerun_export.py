"""A recording as a .rrd file for the rerun viewer, through rerun's own package, which is not a dependency."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import Any

import numpy as np

from hub.view.player import Recording
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.core.files import check_folder
from protocols.geometry import so3
from protocols.log.write.thumbnails import Scale, scale_of
from protocols.messages import syncline_pb2 as pb

_TIME = "recording"


def write_rrd(recording: Recording, out: Path) -> int:
    """Write what a view would show; returns how many messages. ``out`` is whole or not there.

    Cameras are below world/cameras as transforms with their lens, pictures and detections below these, paths below
    world/paths; a drone's pictures as its tracker saw them, particles and target below drones. rerun takes a lens's
    pixels for its picture's: from the first picture on, which is smaller than the camera's image, lens and detections
    are told in the picture's. Raises InputError without rerun-sdk or where ``out`` cannot be written.
    """
    try:
        import rerun as rr
    except ImportError:
        remedy = "pip install rerun-sdk (700 MB), or open the .mcap log itself in rerun or Foxglove"
        raise InputError("--rerun needs rerun-sdk", remedy=remedy) from None
    if out.suffix != ".rrd":
        raise InputError("a rerun recording is an .rrd file", file=out, remedy="name it so")
    check_folder(out.parent)
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.stem}.{os.getpid()}.rrd")
    stream = rr.RecordingStream("syncline")
    count = 0
    try:
        stream.save(str(temporary))
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        # What a calibration's folder tells once is in no list of messages; a log repeats it.
        told = recording.told(1e-9) if recording.still else ()
        scales: dict[str, Scale] = {}
        drones: set[str] = set()
        for moment, message in itertools.chain(told, recording.messages(0.0)):
            if isinstance(message, (pb.UavInfo, pb.TargetState, pb.FlightImage)):
                drones.add(message.agent)
            elif isinstance(message, pb.Picture) and message.camera in drones:
                continue  # what the tracker saw is larger
            stream.set_time(_TIME, duration=moment)
            count += _log(rr, stream, message, scales)
        stream.flush()
        stream.disconnect()
        temporary.replace(out)
    finally:
        temporary.unlink(missing_ok=True)
    return count


def _log(rr: Any, stream: Any, message: Any, scales: dict[str, Scale]) -> int:
    """One message; 1 if there was something to show."""
    if isinstance(message, pb.Calibration) and message.status == "solved":
        for camera in message.cameras:
            _camera(rr, stream, camera)
    elif isinstance(message, pb.Calibration):
        stream.log("status", rr.TextLog(f"{message.status}: {message.reason}"))
    elif isinstance(message, pb.Observation):
        scale = scales.get(message.camera, _FULL)
        pixels = [scale.place(one.u, one.v) for one in message.detections]
        stream.log(f"world/cameras/{message.camera}/detections", rr.Points2D(pixels, radii=4.0))
    elif isinstance(message, pb.Track):
        label = _part(message.label)
        stream.set_time("reference", duration=message.reference_time_ns / NANOSECONDS)
        stream.log(f"world/paths/{label}", rr.Points3D([list(message.position)], radii=0.02))
    elif isinstance(message, pb.CameraInfo):
        if len(message.matrix) == 9:
            scale = scales.get(message.camera, Scale(1.0, 1.0, message.width, message.height))
            size = (scale.width, scale.height)
            lens = scale.matrix() @ np.array(message.matrix).reshape(3, 3)
            stream.log(f"world/cameras/{message.camera}", rr.Pinhole(image_from_camera=lens, resolution=size))
    elif isinstance(message, pb.Picture):
        found = scale_of(message)
        if found is None:
            return 0
        scales[message.camera] = found
        image = rr.EncodedImage(contents=message.jpeg, media_type="image/jpeg")
        stream.log(f"world/cameras/{message.camera}/picture", image)
    elif isinstance(message, pb.FlightImage):
        image = rr.EncodedImage(contents=message.jpeg, media_type="image/jpeg")
        stream.log(f"drones/{message.agent}/picture", image)
    elif isinstance(message, pb.TargetState):
        _target(rr, stream, message)
    elif isinstance(message, pb.TargetCloud):
        stream.log(f"drones/{message.agent}/particles", rr.Points2D(np.array(message.pixels).reshape(-1, 2)))
    else:
        return 0
    return 1


def _target(rr: Any, stream: Any, target: pb.TargetState) -> None:
    """The followed car's box in its drone's picture, also outside it; nothing where it is lost."""
    where = f"drones/{target.agent}/target"
    if len(target.centre) != 2 or len(target.size) != 2:
        stream.log(where, rr.Clear(recursive=False))
        return
    half = [0.5 * side for side in target.size]
    stream.log(where, rr.Boxes2D(centers=[list(target.centre)], half_sizes=[half], labels=[target.state]))


_FULL = Scale(1.0, 1.0, 0, 0)


def _camera(rr: Any, stream: Any, camera: pb.CameraCalibration) -> None:
    rotation = so3.exp(np.array(camera.rotation))
    centre = -rotation.T @ np.array(camera.translation)
    place = rr.Transform3D(translation=centre, mat3x3=rotation.T)  # world from camera
    stream.log(f"world/cameras/{camera.camera}", place)
    stream.log(f"clocks/{camera.camera}/time_offset_std", rr.Scalars(camera.time_offset_std))
    stream.log(f"clocks/{camera.camera}/time_offset", rr.Scalars(camera.time_offset))


def _part(label: str) -> str:
    """A label as one part of an entity's path."""
    return "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in label) or "point"
