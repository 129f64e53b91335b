"""Export of a recording to a .rrd file for the rerun viewer; needs the optional package rerun-sdk."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from hub.view.player import Recording
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.core.files import check_folder, completed_file
from protocols.core.jpeg import ThumbnailScale, thumbnail_scale
from protocols.geometry import so3
from protocols.messages import syncline_pb2 as pb

_TIME = "recording"


def write_rrd(recording: Recording, out: Path) -> int:
    """Write what a view would show; returns the number of messages. ``out`` is written atomically.

    Cameras are below world/cameras as transforms with a pinhole model, thumbnails and detections below these,
    trajectories below world/paths; a drone's images as used by its tracker, particles and target below drones. rerun
    requires the pinhole model to be in pixels of the displayed image: from the first thumbnail on, which is smaller
    than the camera's image, intrinsics and detections are scaled to it. Raises InputError without rerun-sdk or if
    ``out`` cannot be written.
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
    stream = rr.RecordingStream("syncline")
    count = 0
    with completed_file(out) as temporary:
        stream.save(str(temporary))
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        # Static messages of a calibration folder are not in the list of messages; a log repeats them.
        first = recording.latched_messages(1e-9) if recording.is_static else ()
        scales: dict[str, ThumbnailScale] = {}
        drones: set[str] = set()
        for moment, message in itertools.chain(first, recording.messages(0.0)):
            if isinstance(message, (pb.UavInfo, pb.TargetState, pb.FlightImage)):
                drones.add(message.agent)
            elif isinstance(message, pb.Picture) and message.camera in drones:
                continue  # the tracker's image is larger than the thumbnail
            stream.set_time(_TIME, duration=moment)
            count += _log(rr, stream, message, scales)
        stream.flush()
        stream.disconnect()
    return count


def _log(rr: Any, stream: Any, message: Any, scales: dict[str, ThumbnailScale]) -> int:
    """Log one message; returns 1 if it has something to show, else 0."""
    if isinstance(message, pb.Calibration) and message.status == "solved":
        for camera in message.cameras:
            _camera(rr, stream, camera)
    elif isinstance(message, pb.Calibration):
        stream.log("status", rr.TextLog(f"{message.status}: {message.reason}"))
    elif isinstance(message, pb.Observation):
        scale = scales.get(message.camera, _FULL_SCALE)
        pixels = [scale.place(one.u, one.v) for one in message.detections]
        stream.log(f"world/cameras/{_name(rr, message.camera)}/detections", rr.Points2D(pixels, radii=4.0))
    elif isinstance(message, pb.Track):
        # A part of an entity's path has no special characters.
        label = "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in message.label) or "point"
        stream.set_time("reference", duration=message.reference_time_ns / NANOSECONDS)
        stream.log(f"world/paths/{label}", rr.Points3D([list(message.position)], radii=0.02))
    elif isinstance(message, pb.CameraInfo):
        if len(message.matrix) == 9:
            scale = scales.get(message.camera, ThumbnailScale(1.0, 1.0, message.width, message.height))
            size = (scale.width, scale.height)
            lens = scale.matrix() @ np.array(message.matrix).reshape(3, 3)
            stream.log(
                f"world/cameras/{_name(rr, message.camera)}", rr.Pinhole(image_from_camera=lens, resolution=size)
            )
    elif isinstance(message, pb.Picture):
        found = thumbnail_scale(message)
        if found is None:
            return 0
        scales[message.camera] = found
        image = rr.EncodedImage(contents=message.jpeg, media_type="image/jpeg")
        stream.log(f"world/cameras/{_name(rr, message.camera)}/picture", image)
    elif isinstance(message, pb.FlightImage):
        image = rr.EncodedImage(contents=message.jpeg, media_type="image/jpeg")
        stream.log(f"drones/{_name(rr, message.agent)}/picture", image)
    elif isinstance(message, pb.TargetState):
        _target(rr, stream, message)
    elif isinstance(message, pb.TargetCloud):
        stream.log(f"drones/{_name(rr, message.agent)}/particles", rr.Points2D(np.array(message.pixels).reshape(-1, 2)))
    else:
        return 0
    return 1


def _target(rr: Any, stream: Any, target: pb.TargetState) -> None:
    """Log the tracked car's box in the drone's image, also outside its borders; none while the track is lost."""
    where = f"drones/{_name(rr, target.agent)}/target"
    if len(target.centre) != 2 or len(target.size) != 2:
        stream.log(where, rr.Clear(recursive=False))
        return
    half = [0.5 * side for side in target.size]
    stream.log(where, rr.Boxes2D(centers=[list(target.centre)], half_sizes=[half], labels=[target.state]))


_FULL_SCALE = ThumbnailScale(1.0, 1.0, 0, 0)


def _camera(rr: Any, stream: Any, camera: pb.CameraCalibration) -> None:
    rotation = so3.exp(np.array(camera.rotation))
    centre = -rotation.T @ np.array(camera.translation)
    place = rr.Transform3D(translation=centre, mat3x3=rotation.T)  # world from camera
    stream.log(f"world/cameras/{_name(rr, camera.camera)}", place)
    stream.log(f"clocks/{_name(rr, camera.camera)}/time_offset_std", rr.Scalars(camera.time_offset_std))
    stream.log(f"clocks/{_name(rr, camera.camera)}/time_offset", rr.Scalars(camera.time_offset))


def _name(rr: Any, name: str) -> str:
    """An agent's name, escaped as one part of an entity path."""
    return str(rr.escape_entity_path_part(name))
