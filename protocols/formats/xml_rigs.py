"""Calibrations of motion capture systems in XML: Qualisys (.qca.txt), Vicon (.xcp), OptiTrack (Motive 3.2, .mcal).

Qualisys and Vicon give camera centres in millimetres and rotations, camera from world; the conversion is that of
Pose2Sim's reader. Qualisys' pixels are in 64ths. OptiTrack gives centres in metres and rotations, world from camera,
row by row; ``IntrinsicStandardCameraModel`` is OpenCV's, ``Intrinsic`` is Motive's own and is not read. The cameras of
Qualisys and OptiTrack look along -z with y up. Layout: docs.optitrack.com, ".mcal XML Calibration Files".
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from protocols.core.errors import InputError
from protocols.core.files import read_bytes
from protocols.core.names import check_name
from protocols.formats.cameras import ForeignCamera, ForeignRig, parse_array, pinhole_matrix
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats

FORMATS = ("qualisys", "vicon", "optitrack")
_MAX_FILE = 1 << 24  # bytes: of a thousand cameras
QUALISYS_UNIT = 64.0  # of a pixel: Qualisys counts in 64ths
FROM_Y_UP = np.diag([1.0, -1.0, -1.0])  # the axes of a camera that looks along -z with y up, to OpenCV's


def detect_format(file: Path) -> str | None:
    """``qualisys``, ``vicon`` or ``optitrack``; None = another XML file. Raises InputError."""
    root = _root(file)
    if root.find("cameras/camera/intrinsic") is not None:
        return "qualisys"
    if root.find("Calibration/Cameras/Camera/Extrinsic") is not None:
        return "optitrack"
    return "vicon" if root.find("Camera/KeyFrames/KeyFrame") is not None else None


def read(file: Path, kind: str) -> ForeignRig:
    """The video cameras of a file, in its own unit. Raises InputError."""
    reader = {"qualisys": _qualisys, "vicon": _vicon, "optitrack": _optitrack}[kind]
    cameras: dict[str, ForeignCamera] = {}
    left_out = []
    for name, is_video, camera in reader(_root(file), file):
        if name in cameras:
            raise InputError(f"two cameras are named {name!r}", file=file, remedy="give each its own name")
        if is_video:
            cameras[name] = camera
        else:
            left_out.append(name)
    if not cameras:
        raise InputError("no video camera in it", file=file, remedy="calibrate the video cameras too")
    warnings = (f"marker cameras without video were left out: {', '.join(left_out)}",) if left_out else ()
    return ForeignRig(cameras, "m" if kind == "optitrack" else "mm", "metric", warnings)


def _root(file: Path) -> ElementTree.Element:
    remedy = "give QTM's calibration, Vicon's .xcp or Motive's .mcal"
    data = read_bytes(file, "calibration", _MAX_FILE)
    # Entities could make a small file expand without bound. Motive writes UTF-16.
    if any(word in data.replace(b"\0", b"") for word in (b"<!ENTITY", b"<!DOCTYPE")):
        raise InputError("has a document type of its own", file=file, remedy=remedy)
    try:
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        line = getattr(error, "position", (None,))[0]
        raise InputError(f"not XML: {error}", file=file, line=line, remedy=remedy) from None


def _qualisys(root: ElementTree.Element, file: Path) -> Iterator[tuple[str, bool, ForeignCamera]]:
    for tag in root.findall("cameras/camera"):
        name = check_name(tag.get("serial") or tag.get("id") or "", file=file)
        view, lens, place = (_child(tag, key, file, name) for key in ("fov_video", "intrinsic", "transform"))
        left, top, right, bottom = _numbers(view, ("left", "top", "right", "bottom"), file, name)
        keys = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
        fu, fv, cu, cv = _numbers(lens, keys, file, name) / QUALISYS_UNIT
        bent = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2")
        distortions = np.r_[_numbers(lens, bent, file, name) / QUALISYS_UNIT, 0.0]
        intrinsics = _intrinsics(right - left + 1, bottom - top + 1, (fu, fv, cu - left, cv - top), distortions, file)
        centre = _numbers(place, ("x", "y", "z"), file, name)
        cells = [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
        rotation = so3.nearest(_numbers(place, cells, file, name).reshape(3, 3))
        pose = Pose(FROM_Y_UP @ rotation, centre)
        model = tag.get("model", "").lower()
        yield name, "video" in model or "none" in model or not model, ForeignCamera(name, intrinsics, pose)


def _vicon(root: ElementTree.Element, file: Path) -> Iterator[tuple[str, bool, ForeignCamera]]:
    for tag in root.findall("Camera"):
        name = check_name(tag.get("DEVICEID") or "", file=file)
        frame = _child(tag, "KeyFrames/KeyFrame", file, name)
        width, height = _words(tag, "SENSOR_SIZE", 2, file, name)
        (focal,) = _words(frame, "FOCAL_LENGTH", 1, file, name)
        (aspect,) = _words(tag, "PIXEL_ASPECT_RATIO", 1, file, name)
        centre = _words(frame, "PRINCIPAL_POINT", 2, file, name)
        words = (frame.get("VICON_RADIAL2") or "").split()[3:5] or (frame.get("VICON_RADIAL") or "0 0").split()[:2]
        radial = parse_array(words, (2,), f"{name}'s distortion", file, None)
        if not aspect > 0:
            raise InputError(f"{name}: PIXEL_ASPECT_RATIO is not above 0", file=file, remedy="correct it")
        lens = (focal, focal / aspect, float(centre[0]), float(centre[1]))
        intrinsics = _intrinsics(width, height, lens, np.r_[radial, 0.0, 0.0, 0.0], file)
        turn = so3.from_quaternion(np.roll(_words(frame, "ORIENTATION", 4, file, name), 1))
        pose = Pose(turn, _words(frame, "POSITION", 3, file, name))
        yield name, "video" in tag.get("TYPE", "video").lower(), ForeignCamera(name, intrinsics, pose)


def _optitrack(root: ElementTree.Element, file: Path) -> Iterator[tuple[str, bool, ForeignCamera]]:
    for tag in root.findall("Calibration/Cameras/Camera"):
        name = check_name(tag.get("Serial") or "", file=file)
        parts = ("Attributes", "IntrinsicStandardCameraModel", "Extrinsic")
        view, lens, place = (_child(tag, part, file, name) for part in parts)
        width, height = _numbers(view, ("ImagerPixelWidth", "ImagerPixelHeight"), file, name)
        keys = ("HorizontalFocalLength", "VerticalFocalLength", "LensCenterX", "LensCenterY")
        fu, fv, cu, cv = _numbers(lens, keys, file, name).tolist()
        distortions = _numbers(lens, ("k1", "k2", "TangentialX", "TangentialY", "k3"), file, name)
        intrinsics = _intrinsics(width, height, (fu, fv, cu, cv), distortions, file)
        turn = so3.nearest(_numbers(place, [f"OrientMatrix{i}" for i in range(9)], file, name).reshape(3, 3))
        pose = Pose(FROM_Y_UP @ turn.T, _numbers(place, ("X", "Y", "Z"), file, name))
        yield name, True, ForeignCamera(name, intrinsics, pose)


def _intrinsics(
    width: float, height: float, lens: tuple[float, float, float, float], distortions: Floats, file: Path
) -> Intrinsics:
    if not (1 <= width <= 1e5 and 1 <= height <= 1e5 and min(lens[:2]) > 0):
        raise InputError("an image size or a focal length <= 0", file=file, remedy="export it again")
    return Intrinsics(round(width), round(height), pinhole_matrix(*lens), distortions)


def _child(tag: ElementTree.Element, path: str, file: Path, name: str) -> ElementTree.Element:
    found = tag.find(path)
    if found is None:
        raise InputError(f"camera {name} has no {path}", file=file, remedy="export a complete calibration")
    return found


def _numbers(tag: ElementTree.Element, keys: list[str] | tuple[str, ...], file: Path, name: str) -> Floats:
    return parse_array([tag.get(key) for key in keys], (len(keys),), f"{name}'s {', '.join(keys)}", file, None)


def _words(tag: ElementTree.Element, key: str, count: int, file: Path, name: str) -> Floats:
    return parse_array((tag.get(key) or "").split(), (count,), f"{name}'s {key}", file, None)
