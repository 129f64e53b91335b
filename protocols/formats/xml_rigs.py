"""Calibrations of motion capture systems in XML: Qualisys (.qca.txt), Vicon (.xcp), OptiTrack (Motive 3.2, .mcal).

Qualisys and Vicon give camera centres in millimetres and rotations, camera from world; the conversion is that of
Pose2Sim's reader. Qualisys' pixels are in 64ths. OptiTrack gives centres in metres and rotations, world from camera,
row by row; ``IntrinsicStandardCameraModel`` is OpenCV's, ``Intrinsic`` is Motive's own and is not read. The cameras of
Qualisys and OptiTrack look along -z with y up. Layout: docs.optitrack.com, ".mcal XML Calibration Files".

What else such a system keeps (marker cameras, focus, gain, the wand) is not written: the files carry lenses and poses
of video cameras to tools that read them, such as Pose2Sim.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from protocols.core.errors import InputError, Refused
from protocols.core.files import read_bytes
from protocols.core.names import check_name
from protocols.formats.cameras import (
    ExportedFiles,
    ForeignCamera,
    ForeignRig,
    check_skew,
    convert_units,
    fit_without_k3,
    parse_array,
    pinhole_matrix,
)
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.calibration import CameraCalibration

UNITS = {"qualisys": "mm", "vicon": "mm", "optitrack": "m"}
"""Units of lengths by format."""
_MAX_FILE = 1 << 24  # bytes: of a thousand cameras
_QUALISYS_UNIT = 64.0  # of a pixel: Qualisys counts in 64ths
_QUALISYS_LENS = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
_QUALISYS_BENT = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2")
_OPTITRACK_MODEL = "IntrinsicStandardCameraModel"
_OPTITRACK_LENS = ("HorizontalFocalLength", "VerticalFocalLength", "LensCenterX", "LensCenterY")
_OPTITRACK_BENT = ("k1", "k2", "TangentialX", "TangentialY", "k3")
_MAX_LOST_PX = 1.0  # px: of tangential distortion that Vicon does not hold
_FROM_Y_UP = np.diag([1.0, -1.0, -1.0])  # the axes of a camera that looks along -z with y up, to OpenCV's


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
    return ForeignRig(cameras, UNITS[kind], "metric", warnings)


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
        fu, fv, cu, cv = _numbers(lens, _QUALISYS_LENS, file, name) / _QUALISYS_UNIT
        distortions = np.r_[_numbers(lens, _QUALISYS_BENT, file, name) / _QUALISYS_UNIT, 0.0]
        intrinsics = _intrinsics(right - left + 1, bottom - top + 1, (fu, fv, cu - left, cv - top), distortions, file)
        centre = _numbers(place, ("x", "y", "z"), file, name)
        cells = [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
        rotation = so3.nearest(_numbers(place, cells, file, name).reshape(3, 3))
        pose = Pose(_FROM_Y_UP @ rotation, centre)
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
        view, lens, place = (_child(tag, part, file, name) for part in ("Attributes", _OPTITRACK_MODEL, "Extrinsic"))
        width, height = _numbers(view, ("ImagerPixelWidth", "ImagerPixelHeight"), file, name)
        fu, fv, cu, cv = _numbers(lens, _OPTITRACK_LENS, file, name).tolist()
        distortions = _numbers(lens, _OPTITRACK_BENT, file, name)
        intrinsics = _intrinsics(width, height, (fu, fv, cu, cv), distortions, file)
        turn = so3.nearest(_numbers(place, [f"OrientMatrix{i}" for i in range(9)], file, name).reshape(3, 3))
        pose = Pose(_FROM_Y_UP @ turn.T, _numbers(place, ("X", "Y", "Z"), file, name))
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


def _numbers(tag: ElementTree.Element, keys: Sequence[str], file: Path, name: str) -> Floats:
    return parse_array([tag.get(key) for key in keys], (len(keys),), f"{name}'s {', '.join(keys)}", file, None)


def _words(tag: ElementTree.Element, key: str, count: int, file: Path, name: str) -> Floats:
    return parse_array((tag.get(key) or "").split(), (count,), f"{name}'s {key}", file, None)


def write(kind: str, cameras: Mapping[str, CameraCalibration], units: str, scale: str, name: str) -> ExportedFiles:
    """One file ``name``. Raises Refused for fisheye lenses, skew, and distortion that the format cannot hold."""
    converted, warnings = convert_units(cameras, units, UNITS[kind], scale)
    project = {"qualisys": "Qualisys", "vicon": "Vicon", "optitrack": "OptiTrack"}[kind]
    for camera in converted.values():
        check_skew(camera, project)
        if camera.intrinsics.fisheye:
            raise Refused(f"{project} holds no fisheye lens, and {camera.name} has one")
    lost = ["their clocks are not in it"] if any(one.time_map.time_offset for one in cameras.values()) else []
    writer = {"qualisys": _qualisys_tree, "vicon": _vicon_tree, "optitrack": _optitrack_tree}[kind]
    root = writer(converted, lost)
    ElementTree.indent(root)
    text = '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
    return ExportedFiles({name: text}, (*warnings, *(f"{project}: {one}" for one in lost)))


def _qualisys_tree(cameras: Mapping[str, CameraCalibration], lost: list[str]) -> ElementTree.Element:
    root = ElementTree.Element("calibration")
    group = ElementTree.SubElement(root, "cameras")
    for number, (name, camera) in enumerate(cameras.items(), 1):
        lens, turn = camera.intrinsics, _FROM_Y_UP.T @ camera.pose.rotation
        bent, warning = fit_without_k3(lens, name, "Qualisys")
        lost += [warning] if warning else []
        tag = ElementTree.SubElement(group, "camera", id=str(number), serial=name, model="Video", active="1")
        tag.set("avg-residual", "0.0")  # Pose2Sim's reader wants one [mm]
        right, bottom = str(lens.width - 1), str(lens.height - 1)
        for view in ("fov_marker", "fov_marker_max", "fov_video", "fov_video_max"):
            ElementTree.SubElement(tag, view, left="0", top="0", right=right, bottom=bottom)
        cells = {f"r{i + 1}{j + 1}": turn[i, j] for i in range(3) for j in range(3)}
        _add(tag, "transform", dict(zip("xyz", camera.pose.position, strict=True)) | cells)
        m, unit = lens.matrix, _QUALISYS_UNIT
        values = (m[0, 0], m[1, 1], m[0, 2], m[1, 2], *bent)
        scaled = {key: unit * value for key, value in zip((*_QUALISYS_LENS, *_QUALISYS_BENT), values, strict=True)}
        _add(tag, "intrinsic", {"focallength": 1.0, "skew": 0.0} | scaled)
    return root


def _vicon_tree(cameras: Mapping[str, CameraCalibration], lost: list[str]) -> ElementTree.Element:
    root = ElementTree.Element("Cameras", VERSION="1.0")
    for number, (name, camera) in enumerate(cameras.items(), 1):
        lens, m = camera.intrinsics, camera.intrinsics.matrix
        bent, warning = fit_without_k3(lens, name, "Vicon")
        lost += [warning] if warning else []
        straight = replace(lens, distortions=np.r_[bent[:2], 0.0, 0.0, 0.0])
        corners = np.array([[u, v] for u in (0.0, lens.width - 1.0) for v in (0.0, lens.height - 1.0)])
        rays = np.column_stack([lens.unproject(corners), np.ones(4)])
        off = float(np.nanmax(np.linalg.norm(straight.project(rays) - corners, axis=1)))
        if off > _MAX_LOST_PX:
            raise Refused(f"Vicon holds no tangential distortion, and {name} without it is up to {off:.1f} px off")
        if np.any(bent[2:]):
            lost.append(f"{name}'s tangential distortion is not in it, up to {off:.2g} px")
        tag = ElementTree.SubElement(root, "Camera", DEVICEID=name, USERID=str(number), TYPE="VideoInputDevice")
        tag.set("SENSOR_SIZE", f"{lens.width} {lens.height}")
        tag.set("PIXEL_ASPECT_RATIO", _number(m[0, 0] / m[1, 1]))
        frame = ElementTree.SubElement(
            ElementTree.SubElement(tag, "KeyFrames"), "KeyFrame", FRAME="0", WORLD_ERROR="0.0"
        )
        frame.set("FOCAL_LENGTH", _number(m[0, 0]))
        frame.set("PRINCIPAL_POINT", _row(m[:2, 2]))
        frame.set("POSITION", _row(camera.pose.position))
        frame.set("ORIENTATION", _row(np.roll(so3.quaternion(camera.pose.rotation), -1)))
        frame.set("VICON_RADIAL", _row(bent[:2]))
        frame.set("VICON_RADIAL2", f"ViconRadial2 {_row(m[:2, 2])} {_row(bent[:2])} 0")
    return root


def _optitrack_tree(cameras: Mapping[str, CameraCalibration], lost: list[str]) -> ElementTree.Element:
    root = ElementTree.Element("calibrationProfile", version="1")
    group = ElementTree.SubElement(ElementTree.SubElement(root, "Calibration"), "Cameras", Count=str(len(cameras)))
    for name, camera in cameras.items():
        lens, m, d = camera.intrinsics, camera.intrinsics.matrix, camera.intrinsics.distortions
        tag = ElementTree.SubElement(group, "Camera", Serial=name)
        ElementTree.SubElement(tag, "Attributes", ImagerPixelWidth=str(lens.width), ImagerPixelHeight=str(lens.height))
        values = (m[0, 0], m[1, 1], m[0, 2], m[1, 2], *d)
        _add(tag, _OPTITRACK_MODEL, dict(zip((*_OPTITRACK_LENS, *_OPTITRACK_BENT), values, strict=True)))
        turn = (_FROM_Y_UP.T @ camera.pose.rotation).T
        cells = {f"OrientMatrix{i}": value for i, value in enumerate(turn.ravel())}
        _add(tag, "Extrinsic", dict(zip("XYZ", camera.pose.position, strict=True)) | cells)
    return root


def _add(parent: ElementTree.Element, name: str, values: Mapping[str, float]) -> None:
    ElementTree.SubElement(parent, name, {key: _number(value) for key, value in values.items()})


def _number(value: float) -> str:
    return repr(float(value))


def _row(values: Floats) -> str:
    return " ".join(map(_number, values))
