"""A small made-up crowd: people who walk before calibrated cameras, their boxes, and the calibration's file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tomli_w

from edge.scenes.common.base import look_at_pose
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats

HEIGHT = 1.75
SIZE = (960, 720)
_FOCAL = 700.0
_STANDS = ((-7.0, -6.0, 3.0), (7.0, -6.5, 3.2), (0.5, 8.0, 2.8))
NAMES = ("left", "right", "back")


def lens() -> Intrinsics:
    """The lens of every camera."""
    matrix = np.array([[_FOCAL, 0.0, SIZE[0] / 2], [0.0, _FOCAL, SIZE[1] / 2], [0.0, 0.0, 1.0]])
    return Intrinsics(*SIZE, matrix)


def poses() -> dict[str, Pose]:
    """Three cameras around a square of 6 m, at 3 m."""
    return {
        name: look_at_pose(np.array(stand), np.array([0.0, 0.0, 0.8]))
        for name, stand in zip(NAMES, _STANDS, strict=True)
    }


def write_calibration(file: Path, *, scale: float = 1.0, offsets: dict[str, float] | None = None) -> Path:
    """The calibration.toml, in metres. scale: factor of all positions. offsets: of the cameras' clocks [s]."""
    metadata = {"units": "m", "scale": "metric", "reference": NAMES[0], "up": [0.0, 0.0, 1.0]}
    tables: dict[str, dict[str, object]] = {"metadata": metadata}
    for name, pose in poses().items():
        tables[name] = {
            "name": name,
            "size": list(SIZE),
            "matrix": lens().matrix.tolist(),
            "distortions": [0.0] * 5,
            "rotation": pose.rodrigues.tolist(),
            "translation": (scale * pose.translation).tolist(),
            "time_offset": (offsets or {}).get(name, 0.0),
            "clock_rate": 1.0,
        }
    file.write_text(tomli_w.dumps(tables), encoding="utf-8")
    return file


def places(time: float) -> Floats:
    """Feet (3, 2) [m] of three people who walk in circles of different centres at 0.8 to 1.2 m/s."""
    centre = np.array([[-1.6, -1.2], [1.6, -0.8], [0.0, 1.7]])
    angle = time * np.array([1.0, -0.9, 0.8]) + np.array([0.0, 2.0, 4.0])
    return centre + 1.1 * np.column_stack([np.cos(angle), np.sin(angle)])


def ends(name: str, time: float) -> tuple[Floats, Floats]:
    """Pixels (3, 2) of the heads and of the feet of all people."""
    feet = np.hstack([places(time), np.zeros((3, 1))])
    pose = poses()[name]
    head, foot = (lens().project(pose.camera_from_world(feet + up)) for up in ([0.0, 0.0, HEIGHT], [0.0, 0.0, 0.0]))
    return head, foot


def boxes_csv(
    seconds: float = 8.0, fps: float = 5.0, offsets: dict[str, float] | None = None, noise: float = 1.0
) -> str:
    """boxes.csv of all cameras, each on a clock behind the reference by its offset; noise: std of a corner [px]."""
    rng = np.random.default_rng(7)
    lines = ["camera,frame,time,x,y,width,height"]
    for index, name in enumerate(NAMES):
        offset = (offsets or {}).get(name, 0.0)
        for frame in range(round(seconds * fps)):
            time = (frame + 0.25 * index * bool(offsets)) / fps
            for head, foot in zip(*ends(name, time), strict=True):
                tall = float(foot[1] - head[1])
                x, y = (head[0] + foot[0]) / 2 - 0.2 * tall, head[1]
                dx, dy, dh = rng.normal(0.0, noise, 3)
                lines.append(
                    f"{name},{frame},{time - offset:.9f},{x + dx:.3f},{y + dy:.3f},{0.4 * tall:.3f},{tall + dh:.3f}"
                )
    return "\n".join(lines) + "\n"


def truth_csv(seconds: float = 8.0, fps: float = 5.0) -> str:
    """truth.csv: frame, time, person, x, y."""
    lines = ["frame,time,person,x,y"]
    for frame in range(round(seconds * fps)):
        for person, (x, y) in enumerate(places(frame / fps)):
            lines.append(f"{frame},{frame / fps!r},p{person},{x:.6f},{y:.6f}")
    return "\n".join(lines) + "\n"
