"""Export to the XML calibrations of Qualisys (.qca.txt), Vicon (.xcp) and OptiTrack (.mcal), as of ``xml_rigs``.

Marker cameras and what else such a system keeps (focus, gain, the wand) are not in these files: they carry lenses and
poses of video cameras to tools that read them, such as Pose2Sim.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np

from protocols.core.errors import Refused
from protocols.formats.cameras import ExportedFiles, check_skew, convert_units, fit_without_k3
from protocols.formats.xml_rigs import FROM_Y_UP, QUALISYS_UNIT
from protocols.geometry import so3
from protocols.geometry.types import Floats
from protocols.session.calibration import CameraCalibration

UNITS = {"qualisys": "mm", "vicon": "mm", "optitrack": "m"}
_MAX_LOST_PX = 1.0  # px: of tangential distortion that Vicon does not hold


def write(kind: str, cameras: Mapping[str, CameraCalibration], units: str, scale: str, name: str) -> ExportedFiles:
    """One file ``name``. Raises Refused for fisheye lenses, skew, and distortion that the format cannot hold."""
    converted, warnings = convert_units(cameras, units, UNITS[kind], scale)
    project = {"qualisys": "Qualisys", "vicon": "Vicon", "optitrack": "OptiTrack"}[kind]
    for camera in converted.values():
        check_skew(camera, project)
        if camera.intrinsics.fisheye:
            raise Refused(f"{project} holds no fisheye lens, and {camera.name} has one")
    lost = ["their clocks are not in it"] if any(one.time_map.time_offset for one in cameras.values()) else []
    writer = {"qualisys": _qualisys, "vicon": _vicon, "optitrack": _optitrack}[kind]
    root = writer(converted, lost)
    ElementTree.indent(root)
    text = '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
    return ExportedFiles({name: text}, (*warnings, *(f"{project}: {one}" for one in lost)))


def _qualisys(cameras: Mapping[str, CameraCalibration], lost: list[str]) -> ElementTree.Element:
    root = ElementTree.Element("calibration")
    group = ElementTree.SubElement(root, "cameras")
    for number, (name, camera) in enumerate(cameras.items(), 1):
        lens, turn = camera.intrinsics, FROM_Y_UP.T @ camera.pose.rotation
        bent, warning = fit_without_k3(lens, name, "Qualisys")
        lost += [warning] if warning else []
        tag = ElementTree.SubElement(group, "camera", id=str(number), serial=name, model="Video", active="1")
        tag.set("avg-residual", "0.0")  # Pose2Sim's reader wants one [mm]
        right, bottom = str(lens.width - 1), str(lens.height - 1)
        for view in ("fov_marker", "fov_marker_max", "fov_video", "fov_video_max"):
            ElementTree.SubElement(tag, view, left="0", top="0", right=right, bottom=bottom)
        cells = {f"r{i + 1}{j + 1}": turn[i, j] for i in range(3) for j in range(3)}
        _add(tag, "transform", dict(zip("xyz", camera.pose.position, strict=True)) | cells)
        m, unit = lens.matrix, QUALISYS_UNIT
        values = {"focalLengthU": m[0, 0], "focalLengthV": m[1, 1], "centerPointU": m[0, 2], "centerPointV": m[1, 2]}
        keys = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2")
        scaled = {key: unit * value for key, value in (values | dict(zip(keys, bent, strict=True))).items()}
        _add(tag, "intrinsic", {"focallength": 1.0, "skew": 0.0} | scaled)
    return root


def _vicon(cameras: Mapping[str, CameraCalibration], lost: list[str]) -> ElementTree.Element:
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


def _optitrack(cameras: Mapping[str, CameraCalibration], lost: list[str]) -> ElementTree.Element:
    root = ElementTree.Element("calibrationProfile", version="1")
    group = ElementTree.SubElement(ElementTree.SubElement(root, "Calibration"), "Cameras", Count=str(len(cameras)))
    for name, camera in cameras.items():
        lens, m, d = camera.intrinsics, camera.intrinsics.matrix, camera.intrinsics.distortions
        tag = ElementTree.SubElement(group, "Camera", Serial=name)
        ElementTree.SubElement(tag, "Attributes", ImagerPixelWidth=str(lens.width), ImagerPixelHeight=str(lens.height))
        values = {"LensCenterX": m[0, 2], "LensCenterY": m[1, 2]}
        values |= {"HorizontalFocalLength": m[0, 0], "VerticalFocalLength": m[1, 1]}
        values |= dict(zip(("k1", "k2", "TangentialX", "TangentialY", "k3"), d, strict=True))
        _add(tag, "IntrinsicStandardCameraModel", values)
        turn = (FROM_Y_UP.T @ camera.pose.rotation).T
        cells = {f"OrientMatrix{i}": value for i, value in enumerate(turn.ravel())}
        _add(tag, "Extrinsic", dict(zip("XYZ", camera.pose.position, strict=True)) | cells)
    return root


def _add(parent: ElementTree.Element, name: str, values: Mapping[str, float]) -> None:
    ElementTree.SubElement(parent, name, {key: _number(value) for key, value in values.items()})


def _number(value: float) -> str:
    return repr(float(value))


def _row(values: Floats) -> str:
    return " ".join(map(_number, values))
