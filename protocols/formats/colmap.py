"""COLMAP's text model: cameras.txt, images.txt, an empty points3D.txt.

COLMAP counts pixels from the corner of the image: its pixel centres are at 0.5. Quaternions w, x, y, z and
translations are camera from world. It has no clock maps and no units.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath

import numpy as np

from protocols.core.errors import InputError
from protocols.core.files import read_text
from protocols.core.names import check_name, key_segment, name_of_segment
from protocols.formats.cameras import (
    ExportedFiles,
    ForeignCamera,
    ForeignRig,
    check_skew,
    parse_array,
    pinhole_matrix,
)
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.session.calibration import CameraCalibration

CAMERAS, IMAGES, POINTS = "cameras.txt", "images.txt", "points3D.txt"
# model: number of parameters, places of fx, fy, cx, cy, fisheye, places of the distortion coefficients
_MODELS: dict[str, tuple[int, tuple[int, int, int, int], bool, tuple[int, ...]]] = {
    "SIMPLE_PINHOLE": (3, (0, 0, 1, 2), False, ()),
    "PINHOLE": (4, (0, 1, 2, 3), False, ()),
    "SIMPLE_RADIAL": (4, (0, 0, 1, 2), False, (3,)),
    "RADIAL": (5, (0, 0, 1, 2), False, (3, 4)),
    "OPENCV": (8, (0, 1, 2, 3), False, (4, 5, 6, 7)),
    "FULL_OPENCV": (12, (0, 1, 2, 3), False, (4, 5, 6, 7, 8, 9, 10, 11)),
    "SIMPLE_RADIAL_FISHEYE": (4, (0, 0, 1, 2), True, (3,)),
    "RADIAL_FISHEYE": (5, (0, 0, 1, 2), True, (3, 4)),
    "OPENCV_FISHEYE": (8, (0, 1, 2, 3), True, (4, 5, 6, 7)),
}
_CENTRE = 0.5  # px: COLMAP's pixel centres lie there, ours at 0


def is_model(folder: Path) -> bool:
    """Whether a folder has a file of a model, as text or binary."""
    return any((folder / name).with_suffix(end).exists() for name in (CAMERAS, IMAGES) for end in (".txt", ".bin"))


def read(folder: Path) -> ForeignRig:
    """Read a text model with one image per camera; a camera is named after its image without the suffix.

    Raises InputError: file, line, what, remedy."""
    gone = next((name for name in (CAMERAS, IMAGES) if not (folder / name).exists()), None)
    if gone is not None:
        remedy = "save the model as text: colmap model_converter --output_type TXT"
        raise InputError(f"looks like a COLMAP model, but {gone} is missing", file=folder, remedy=remedy)
    lenses = _read_cameras(folder / CAMERAS)
    cameras: dict[str, ForeignCamera] = {}
    file = folder / IMAGES
    skip = False
    for number, words in _rows(file, keep_empty=True):
        if skip:  # the second line of an image holds its points, and may be empty
            skip = False
            continue
        if not words:
            continue
        if len(words) < 10:
            what = f"an image has {len(words)} values"
            raise InputError(what, file=file, line=number, remedy="10 are needed: ID, quaternion, T, CAMERA_ID, NAME")
        skip = True
        name = check_name(_name(" ".join(words[9:]), cameras), file=file, line=number)
        if words[8] not in lenses:
            raise InputError(f"camera {words[8]} is not in {CAMERAS}", file=file, line=number, remedy="correct the id")
        values = parse_array(words[1:8], (7,), "the pose", file, number)
        size = float(np.linalg.norm(values[:4]))
        if not 0.5 < size < 2.0:
            raise InputError("the quaternion has no direction", file=file, line=number, remedy="correct it")
        rotation = so3.from_quaternion(values[:4] / size)
        cameras[name] = ForeignCamera(name, lenses[words[8]], Pose(rotation, -rotation.T @ values[4:]))
    if not cameras:
        raise InputError("no image in it", file=file, line=1, remedy="give a model with its images")
    return ForeignRig(cameras)


def write(cameras: Mapping[str, CameraCalibration]) -> ExportedFiles:
    """The three files of a text model."""
    lenses, images, warnings = [], [], []
    for number, (name, camera) in enumerate(cameras.items(), 1):
        check_skew(camera, "COLMAP")
        lens = camera.intrinsics
        (fx, _, cx), (_, fy, cy), _ = lens.matrix.tolist()
        if lens.fisheye:
            model, values = "OPENCV_FISHEYE", lens.distortions.tolist()
        else:
            k1, k2, p1, p2, k3 = lens.distortions.tolist()
            model, values = ("OPENCV", [k1, k2, p1, p2]) if k3 == 0 else ("FULL_OPENCV", [k1, k2, p1, p2, k3, 0, 0, 0])
        parameters = _numbers([fx, fy, cx + _CENTRE, cy + _CENTRE, *values])
        lenses.append(f"{number} {model} {lens.width} {lens.height} {parameters}")
        quaternion = so3.quaternion(camera.pose.rotation).tolist()
        # COLMAP reads an image's name up to the first space: such a name is percent-encoded.
        image = f"{key_segment(name) if ' ' in name else name}.png"
        images.append(f"{number} {_numbers([*quaternion, *camera.pose.translation])} {number} {image}\n")
        if camera.time_map.time_offset != 0.0 or camera.time_map.clock_rate != 1.0:
            warnings.append(name)
    text = (f"COLMAP has no clock maps: those of {', '.join(warnings)} are left out",) if warnings else ()
    files = {
        CAMERAS: "\n".join(["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", *lenses]) + "\n",
        IMAGES: "\n".join(["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", *images]) + "\n",
        POINTS: "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n",
    }
    return ExportedFiles(files, text)


def _read_cameras(file: Path) -> dict[str, Intrinsics]:
    lenses: dict[str, Intrinsics] = {}
    for number, words in _rows(file):
        if len(words) < 5:
            what = f"a camera has {len(words)} values"
            raise InputError(what, file=file, line=number, remedy="give CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
        if words[1] not in _MODELS:
            remedy = f"convert it to one of {', '.join(_MODELS)}"
            raise InputError(f"the model {words[1]} is not known here", file=file, line=number, remedy=remedy)
        count, places, fisheye, bent = _MODELS[words[1]]
        width, height = parse_array(words[2:4], (2,), "the size", file, number)
        values = parse_array(words[4:], (count,), f"{words[1]}'s parameters", file, number)
        fx, fy, cx, cy = values[list(places)]
        if not (fx > 0 and fy > 0 and width > 0 and height > 0):
            raise InputError("a focal length or size <= 0", file=file, line=number, remedy="correct it")
        if len(bent) > 5 and np.any(values[list(bent[5:])]):
            remedy = "convert it to OPENCV"
            raise InputError("k4 to k6 of the rational model are not 0", file=file, line=number, remedy=remedy)
        distortions = np.zeros(4 if fisheye else 5)
        used = bent[:5]
        distortions[: len(used)] = values[list(used)]
        matrix = pinhole_matrix(float(fx), float(fy), float(cx) - _CENTRE, float(cy) - _CENTRE)
        lenses[words[0]] = Intrinsics(int(width), int(height), matrix, distortions, fisheye)
    if not lenses:
        raise InputError("no camera in it", file=file, line=1, remedy="give a model with its cameras")
    return lenses


def _rows(file: Path, keep_empty: bool = False) -> list[tuple[int, list[str]]]:
    """Line numbers and words of all lines that are no comments."""
    text = read_text(file, "file of a COLMAP model saved as text")
    rows = [(number, row.split()) for number, row in enumerate(text.splitlines(), 1) if not row.startswith("#")]
    return rows if keep_empty else [(number, words) for number, words in rows if words]


def _name(image: str, taken: Mapping[str, ForeignCamera]) -> str:
    path = PurePosixPath(image.replace("\\", "/"))
    name = name_of_segment(path.stem) or path.stem
    return name if name not in taken else "_".join(path.with_suffix("").parts)


def _numbers(values: list[float]) -> str:
    return " ".join(f"{value:.17g}" for value in values)
