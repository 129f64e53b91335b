"""Writes a simulated flight over the town: video, rig.toml and telemetry in user formats, and the ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from edge.devices.playback.video_writer import video_writer
from edge.uav.base import Telemetry
from edge.uav.world import scenarios
from edge.uav.world.flight_world import FlightWorld
from protocols.core.errors import InputError
from protocols.core.files import write_together
from protocols.core.jpeg import encode_jpeg
from protocols.geometry import so3
from protocols.session.folder import RIG_FILE

TOWN = "town"
VIDEO_FILE, FRAMES_FOLDER, TELEMETRY_FILE, TRUTH_FILE = "video.mp4", "frames", "telemetry.csv", "truth.csv"
_USUAL = "exit-bend"
_CAMERA = "drone"
_JPEG_QUALITY = 95  # as good cameras write


def write_simulated_flight(
    scene: str, out: Path, *, seed: int, frames: int | None, size: tuple[int, int], rate_hz: float
) -> dict[str, Any]:
    """Simulate a scenario and write its folder; returns counts, the target's first box and the true telemetry offset.

    scene: ``town`` or ``town:scenario``. frames: number out of view. rate_hz: of the telemetry. Raises InputError.
    """
    world = scenarios.get(scene.partition(":")[2] or _USUAL, seed, size, frames)
    out.mkdir(parents=True, exist_ok=True)
    video = _write_video(world, out)
    samples = world.telemetry(rate_hz, time_offset=None)
    write_together(
        {
            out / RIG_FILE: tomli_w.dumps(_rig(world)),
            out / TELEMETRY_FILE: _telemetry(samples),
            out / TRUTH_FILE: _truth(world),
        }
    )
    box = world.truth(0).box
    return {
        "scene": f"{TOWN}:{world.name}",
        "seed": seed,
        "video": str(video),
        "frames": world.length,
        "out_of_picture": list(world.out_of_view),
        "target": [round(value, 1) for value in (box.x, box.y, box.width, box.height)],
        "telemetry_offset": world.time_offset,
    }


def _write_video(world: FlightWorld, out: Path) -> Path:
    """Write the video or, if OpenCV cannot encode one, a folder of JPEGs."""
    try:
        with video_writer(out / VIDEO_FILE, world.fps, "") as write:
            for i in range(world.length):
                write(world.frame(i))
        return out / VIDEO_FILE
    except InputError:
        pass
    folder = out / FRAMES_FOLDER
    folder.mkdir(exist_ok=True)
    for i in range(world.length):
        (folder / f"{i:06d}.jpg").write_bytes(encode_jpeg(world.frame(i), _JPEG_QUALITY))
    return folder


def _rig(world: FlightWorld) -> dict[str, Any]:
    table = {
        "name": _CAMERA,
        "fps": world.fps,
        **world.lens.table(),
        "body_from_camera": world.body_from_camera.tolist(),
    }
    return {_CAMERA: table, "metadata": {"name": f"{TOWN}:{world.name}", "units": "m"}}


def _telemetry(samples: list[Telemetry]) -> str:
    """CSV text with time, quaternion ned_from_body, north, east, down; one row per sample."""
    lines = ["time,qw,qx,qy,qz,north,east,down"]
    for sample in samples:
        place = np.full(3, np.nan) if sample.position is None else sample.position
        lines.append(_row(sample.time, *so3.quaternion(sample.ned_from_body), *place))
    return "\n".join(lines) + "\n"


def _truth(world: FlightWorld) -> str:
    """CSV text with one row per frame; the camera pose as centre (NED) and Rodrigues vector, camera from NED."""
    lines = [
        "frame,time,x,y,width,height,heading,inside,visible,north,east,speed,course,"
        "camera_north,camera_east,camera_down,camera_rx,camera_ry,camera_rz"
    ]
    for i in range(world.length):
        t = world.truth(i)
        numbers = (t.time, t.x, t.y, t.width, t.height, t.heading, t.inside, t.visible)
        ground = (t.north, t.east, t.speed, t.course)
        lines.append(f"{i}," + _row(*numbers, *ground, *t.camera.position, *t.camera.rodrigues))
    return "\n".join(lines) + "\n"


def _row(*numbers: float) -> str:
    return ",".join(f"{number:.17g}" for number in numbers)
