"""Results in the formats of other tools: OpenCV YAML, COLMAP text, TRC; aniposelib reads calibration.toml as it is."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from protocols.errors import InputError
from protocols.geometry.types import Floats, Ints
from protocols.session.calibration import CameraCalibration

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}


def opencv_yaml(camera: CameraCalibration, units: str) -> str:
    """One camera for cv2.FileStorage: matrix, distortions, camera-from-world R and T, and the time map."""
    lens, pose = camera.intrinsics, camera.pose
    storage = cv2.FileStorage(".yml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY | cv2.FileStorage_FORMAT_YAML)
    storage.write("camera_name", camera.name)
    storage.write("image_width", lens.width)
    storage.write("image_height", lens.height)
    storage.write("distortion_model", "fisheye" if lens.fisheye else "plumb_bob")
    storage.write("camera_matrix", lens.matrix)
    storage.write("distortion_coefficients", lens.distortions.reshape(1, -1))
    storage.write("R", pose.rotation)
    storage.write("T", pose.translation.reshape(3, 1))
    storage.write("units", units)
    storage.write("time_offset", camera.time_map.time_offset)
    storage.write("clock_rate", camera.time_map.clock_rate)
    return str(storage.releaseAndGetString())


def colmap_text(cameras: Mapping[str, CameraCalibration]) -> dict[str, str]:
    """cameras.txt, images.txt (one a camera, named after it) and an empty points3D.txt.

    COLMAP counts pixels from the corner of the picture: its centres of pixels are at 0.5.
    """
    lenses, images = [], []
    for number, (name, camera) in enumerate(cameras.items(), 1):
        lens = camera.intrinsics
        (fx, _, cx), (_, fy, cy), _ = lens.matrix.tolist()
        if lens.fisheye:
            model, values = "OPENCV_FISHEYE", lens.distortions.tolist()
        else:
            k1, k2, p1, p2, k3 = lens.distortions.tolist()
            model, values = ("OPENCV", [k1, k2, p1, p2]) if k3 == 0 else ("FULL_OPENCV", [k1, k2, p1, p2, k3, 0, 0, 0])
        numbers = _numbers([fx, fy, cx + 0.5, cy + 0.5, *values])
        lenses.append(f"{number} {model} {lens.width} {lens.height} {numbers}")
        quaternion = _quaternion(camera.pose.rotation)
        images.append(f"{number} {_numbers([*quaternion, *camera.pose.translation])} {number} {name}.png\n")
    return {
        "cameras.txt": "\n".join(["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", *lenses]) + "\n",
        "images.txt": "\n".join(["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", *images]) + "\n",
        "points3D.txt": "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n",
    }


def trc_text(file: Path, name: str, units: str) -> str:
    """A trajectory.csv or track.csv as TRC (OpenSim): constant rate, empty where a label is not known, m or mm.

    Time 0 is the first row. Raises InputError: file, line, what, remedy.
    """
    paths = _read_paths(file)
    times, frames = _frames(paths)
    count = int(frames[-1]) + 1
    rate = (count - 1) / float(times[-1] - times[0]) if count > 1 else 1.0
    scale, told = (_METRES[units], "m") if units == "cm" else (1.0, units)
    cells = np.full((count, 3 * len(paths)), math.nan)
    for column, path in enumerate(paths.values()):
        at = frames[np.clip(np.searchsorted(times, path[:, 0] - 1e-6), 0, len(times) - 1)]
        cells[at, 3 * column : 3 * column + 3] = scale * path[:, 1:4]
    keys = "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames"
    axes = "\t".join(f"{axis}{i}" for i in range(1, len(paths) + 1) for axis in "XYZ")
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        keys,
        f"{rate:.9g}\t{rate:.9g}\t{count}\t{len(paths)}\t{told}\t{rate:.9g}\t1\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(label.replace("\t", " ") for label in paths) + "\t\t",
        "\t\t" + axes,
        "",
    ]
    for index, row in enumerate(cells):
        shown = "\t".join("" if math.isnan(value) else f"{value:.9g}" for value in row)
        lines.append(f"{index + 1}\t{index / rate:.9g}\t{shown}")
    return "\n".join(lines) + "\n"


def _frames(paths: Mapping[str, Floats]) -> tuple[Floats, Ints]:
    """All instants (n,) [s] of some paths and the frame (n,) of each on one grid of a constant rate.

    The grid's step is what most steps of single paths are; gaps are whole numbers of it.
    """
    joined = np.unique(np.concatenate([path[:, 0] for path in paths.values()]))
    times = joined[np.r_[True, np.diff(joined) > 1e-6]]
    steps = np.concatenate([np.diff(np.sort(path[:, 0])) for path in paths.values()])
    steps = steps[steps > 1e-6]
    if not len(steps):
        return times, np.arange(len(times), dtype=np.int64)
    step = float(np.quantile(steps, 0.1, method="lower"))
    ahead = np.maximum(np.rint(np.diff(times) / step), 1).astype(np.int64)
    return times, np.r_[np.zeros(1, dtype=np.int64), np.cumsum(ahead)]


def _read_paths(file: Path) -> dict[str, Floats]:
    """time, x, y, z (n, 4) by label."""
    remedy = "give the trajectory.csv of `calibrate` or the track.csv of `triangulate`"
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError):
        raise InputError("cannot be read", file=file, remedy=remedy) from None
    reader = csv.DictReader(io.StringIO(text))
    missing = [key for key in ("time", "x", "y", "z") if key not in (reader.fieldnames or [])]
    if missing:
        raise InputError(f"column {', '.join(missing)} is missing", file=file, line=1, remedy=remedy)
    rows: dict[str, list[list[float]]] = {}
    for row in reader:
        try:
            values = [float(row[key]) for key in ("time", "x", "y", "z")]
        except (TypeError, ValueError):
            what = "time, x, y, z are not four numbers"
            raise InputError(what, file=file, line=reader.line_num, remedy="correct or remove the row") from None
        if not np.isfinite(values).all():
            raise InputError("a value is not finite", file=file, line=reader.line_num, remedy="remove the row")
        rows.setdefault(row.get("label") or "marker", []).append(values)
    if not rows:
        raise InputError("no rows", file=file, line=1, remedy=remedy)
    return {label: np.array(values) for label, values in rows.items()}


def _quaternion(rotation: Floats) -> list[float]:
    """w, x, y, z of a rotation matrix (3, 3), w >= 0."""
    from protocols.geometry import so3

    turn = so3.log(rotation)
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle > 1e-12 else np.zeros(3)
    return [math.cos(0.5 * angle), *(math.sin(0.5 * angle) * axis).tolist()]


def _numbers(values: list[float]) -> str:
    return " ".join(f"{value:.17g}" for value in values)
