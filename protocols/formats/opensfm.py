"""OpenSfM's reconstruction.json: cameras (focal length over the larger side, k1, k2) and one shot a camera."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from protocols.core.errors import InputError
from protocols.core.files import read_text
from protocols.core.names import check_name
from protocols.formats.cameras import ExportedFiles, ForeignCamera, ForeignRig, check_skew, parse_array, pinhole_matrix
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.session.calibration import CameraCalibration


def is_file(file: Path) -> bool:
    """Whether a JSON file is a reconstruction.json."""
    try:
        document = json.loads(read_text(file))
    except (InputError, ValueError, RecursionError):
        return False
    return isinstance(document, list) and bool(document) and isinstance(document[0], dict) and "shots" in document[0]


def read(file: Path) -> ForeignRig:
    """The largest reconstruction of a file; a camera is named after its shot. Raises InputError."""
    document = json.loads(read_text(file))
    try:
        best = max(document, key=lambda one: len(one["shots"]))
        lenses = {key: _lens(key, table, file) for key, table in best["cameras"].items()}
        shots = [
            (shot, table["camera"], table["rotation"], table["translation"]) for shot, table in best["shots"].items()
        ]
    except (KeyError, TypeError, AttributeError):
        what = "not a list of reconstructions with cameras, and shots with camera, rotation and translation"
        raise InputError(what, file=file, remedy="export it with OpenSfM again") from None
    cameras: dict[str, ForeignCamera] = {}
    for shot, camera, turn, shift in shots:
        name = check_name(PurePosixPath(shot).stem, file=file)
        if name in cameras:
            raise InputError(f"a second shot {name!r}", file=file, remedy="keep one shot a camera")
        if camera not in lenses:
            raise InputError(f"shot {shot!r} names no camera", file=file, remedy="correct it")
        rotation = parse_array(turn, (3,), "rotation", file, None)
        translation = parse_array(shift, (3,), "translation", file, None)
        cameras[name] = ForeignCamera(name, lenses[camera], Pose.from_rodrigues(rotation, translation))
    if not cameras:
        raise InputError("no shot in it", file=file, remedy="give a reconstruction with its shots")
    return ForeignRig(cameras)


def write(cameras: Mapping[str, CameraCalibration], name: str) -> ExportedFiles:
    """One reconstruction with a camera (brown, or fisheye_opencv) and a shot each."""
    lenses: dict[str, Any] = {}
    shots: dict[str, Any] = {}
    for key, camera in cameras.items():
        check_skew(camera, "OpenSfM")
        lens = camera.intrinsics
        side = max(lens.width, lens.height)
        table: dict[str, Any] = {
            "projection_type": "fisheye_opencv" if lens.fisheye else "brown",
            "width": lens.width,
            "height": lens.height,
            "focal_x": lens.matrix[0, 0] / side,
            "focal_y": lens.matrix[1, 1] / side,
            # Normalised coordinates have their origin in the middle of the image.
            "c_x": (lens.matrix[0, 2] - 0.5 * (lens.width - 1)) / side,
            "c_y": (lens.matrix[1, 2] - 0.5 * (lens.height - 1)) / side,
        }
        names = ("k1", "k2", "k3", "k4") if lens.fisheye else ("k1", "k2", "p1", "p2", "k3")
        table |= dict(zip(names, lens.distortions.tolist(), strict=True))
        lenses[key] = table
        shots[f"{key}.png"] = {
            "camera": key,
            "rotation": camera.pose.rodrigues.tolist(),
            "translation": camera.pose.translation.tolist(),
        }
    text = json.dumps([{"cameras": lenses, "shots": shots, "points": {}}], indent=1)
    return ExportedFiles({name: text}, ("OpenSfM has no clock maps: they are left out",))


def _lens(key: str, table: Mapping[str, Any], file: Path) -> Intrinsics:
    kind = table.get("projection_type", "perspective")
    if kind not in ("perspective", "brown", "fisheye_opencv"):
        remedy = "convert it to perspective, brown or fisheye_opencv"
        raise InputError(f"camera {key!r}: projection_type {kind!r} is not known here", file=file, remedy=remedy)
    width, height = parse_array([table.get("width"), table.get("height")], (2,), "the size", file, None)
    focal = table.get("focal")
    fx, fy = table.get("focal_x", focal), table.get("focal_y", focal)
    numbers = [fx, fy, table.get("c_x", 0.0), table.get("c_y", 0.0)]
    fx, fy, cx, cy = parse_array(numbers, (4,), f"camera {key!r}", file, None) * max(width, height)
    if not (fx > 0 and fy > 0 and width >= 1 and height >= 1):
        raise InputError(f"camera {key!r}: a focal length or size <= 0", file=file, remedy="correct it")
    fisheye = kind == "fisheye_opencv"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    distortions = parse_array([table.get(one, 0.0) for one in names], (len(names),), f"camera {key!r}", file, None)
    matrix = pinhole_matrix(float(fx), float(fy), float(cx) + 0.5 * (width - 1), float(cy) + 0.5 * (height - 1))
    return Intrinsics(int(width), int(height), np.asarray(matrix), distortions, fisheye)
