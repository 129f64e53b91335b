"""Calibrations in TOML: aniposelib, and the variants of caliscope, Pose2Sim and FreeMoCap.

All have a Rodrigues vector and a translation, camera from world, as rig.toml does. aniposelib has no units, caliscope
and Pose2Sim use metres, FreeMoCap millimetres. time_offset, clock_rate and units are written as additional keys,
which these four tools ignore.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from protocols.core.errors import InputError
from protocols.core.files import read_toml
from protocols.formats.cameras import ExportedFiles, ForeignCamera, ForeignRig, convert_units, parse_time_map
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.session.calibration import CameraCalibration
from protocols.session.rig import METRES_PER_UNIT, RigCamera, parse_camera_table

PROJECT_UNITS = {"aniposelib": None, "caliscope": "m", "pose2sim": "m", "freemocap": "mm"}
"""Units of a tool's lengths; None = the units of the calibration."""
_NO_CAMERAS = ("metadata", "capture_volume", "charuco", "checkerboard", "groundplane")


def detect_format(values: Mapping[str, Any]) -> str | None:
    """The tool whose format a TOML file's content has; None = unknown."""
    if isinstance(values.get("cameras"), dict):
        return "caliscope"
    tables = [table for key, table in values.items() if isinstance(table, dict) and key not in _NO_CAMERAS]
    if any("world_position" in table or "world_orientation" in table for table in tables):
        return "freemocap"
    return "aniposelib" if any("matrix" in table for table in tables) else None


def read(file: Path, project: str) -> ForeignRig:
    """A calibration of ``project``. Raises InputError: file, line, what, remedy."""
    values, text = read_toml(file, "calibration")
    metadata = values.get("metadata", {})
    given_metadata = metadata if isinstance(metadata, dict) else {}
    tables = values.get("cameras", {}) if project == "caliscope" else values
    cameras: dict[str, ForeignCamera] = {}
    warnings = []
    for key, table in tables.items() if isinstance(tables, dict) else ():
        if not isinstance(table, dict) or (project != "caliscope" and key in _NO_CAMERAS):
            continue
        where = f"cameras.{key}" if project == "caliscope" else key
        given = _as_ours(dict(table), key, project)
        if "matrix" not in given or given.get("ignore", False) is not False:
            warnings.append(f"{where} has no matrix, or is marked to be ignored: left out")
            continue
        camera = parse_camera_table(given, given["name"], file, text.replace(f"[{where}]", f"[{given['name']}]"))
        if camera.name in cameras:
            raise InputError(f"two cameras are named {camera.name!r}", file=file, remedy="give each its own name")
        cameras[camera.name] = _foreign(camera, table, file, where)
    if not cameras:
        remedy = "give a calibration, or say what it is with --format"
        raise InputError(f"no camera of {project} in it", file=file, remedy=remedy)
    units = given_metadata.get("units")
    if units is not None and (not isinstance(units, str) or units not in METRES_PER_UNIT):
        raise InputError(f"[metadata] units = {units!r}", file=file, remedy='use "m", "cm" or "mm"')
    scale = given_metadata.get("scale")
    return ForeignRig(
        cameras,
        units or PROJECT_UNITS.get(project),
        scale if scale in ("metric", "arbitrary") else None,
        tuple(warnings),
    )


def write(
    project: str, cameras: Mapping[str, CameraCalibration], units: str, scale: str, name: str = "calibration.toml"
) -> ExportedFiles:
    """A calibration for ``project`` as one file ``name``, in that project's units."""
    wanted = PROJECT_UNITS[project] or units
    converted, warnings = convert_units(cameras, units, wanted, scale)
    numbers, note = caliscope_numbers(converted)
    tables = {key: _table(project, numbers[key], camera) for key, camera in converted.items()}
    metadata = {"adjusted": False, "error": 0.0, "units": wanted, "scale": scale}
    if project == "caliscope":
        document: dict[str, Any] = {
            "metadata": metadata,
            "cameras": {str(table["cam_id"]): table for table in tables.values()},
        }
        warnings += note
    elif project == "pose2sim":
        document = {**tables, "metadata": metadata}
    else:
        document = {f"cam_{number}": table for number, table in enumerate(tables.values())} | {"metadata": metadata}
    bent = [key for key, camera in cameras.items() if camera.intrinsics.fisheye]
    if bent and project in ("pose2sim", "freemocap"):
        warnings += (f"{project} has pinhole lenses only: {', '.join(bent)} will be wrong away from the centre",)
    return ExportedFiles({name: tomli_w.dumps(document)}, warnings)


def caliscope_numbers(names: Iterable[str]) -> tuple[dict[str, int], tuple[str, ...]]:
    """Numbers of cameras for caliscope: those in names like cam_3 or cam3; others are counted, and a note says how."""
    given = {name: re.fullmatch(r"cam_?(0|[1-9]\d{0,8})", name) for name in names}
    found = {name: int(match[1]) for name, match in given.items() if match}
    if len(found) == len(given) == len(set(found.values())):
        return found, ()
    counted = {name: number for number, name in enumerate(given)}
    listed = ", ".join(f"cam_{number} is {name}" for name, number in counted.items())
    return counted, (f"caliscope numbers its cameras: {listed}",)


def _as_ours(table: dict[str, Any], key: str, project: str) -> dict[str, Any]:
    """A tool's camera table with rig.toml's keys and value types."""
    table = {key: value for key, value in table.items() if value != "null"}  # caliscope's older word for nothing
    table.setdefault("name", f"cam_{key}" if project == "caliscope" else key)
    if not isinstance(table["name"], str):
        table["name"] = str(table["name"])
    # These keys have another meaning there (rotated for display, another std): not used.
    for unused in ("position", "position_std", "rotation_std", "fps", "body_from_camera"):
        table.pop(unused, None)
    for flat in ("distortions", "translation"):
        if isinstance(table.get(flat), list) and all(isinstance(part, list) for part in table[flat]):
            table[flat] = [value for part in table[flat] for value in part]
    rotation = table.get("rotation")
    if isinstance(rotation, list) and len(rotation) == 3 and all(isinstance(row, list) for row in rotation):
        flat_rotation = [value for row in rotation for value in row]
        # Rodrigues as a column, or a rotation matrix as older versions of caliscope wrote it.
        if len(flat_rotation) == 3:
            table["rotation"] = flat_rotation
        elif all(isinstance(value, int | float) for value in flat_rotation) and len(flat_rotation) == 9:
            table["rotation"] = so3.log(so3.nearest(np.array(rotation, dtype=np.float64))).tolist()
    return table


def _foreign(camera: RigCamera, table: Mapping[str, Any], file: Path, where: str) -> ForeignCamera:
    assert camera.intrinsics is not None
    pose = None
    if camera.rotation is not None and camera.position is not None:
        pose = Pose(camera.rotation, camera.position)
    time_map = parse_time_map(table, f"[{where}] ", file, None)
    return ForeignCamera(camera.name, camera.intrinsics, pose, time_map)


def _table(project: str, number: int, camera: CameraCalibration) -> dict[str, Any]:
    lens, pose = camera.intrinsics, camera.pose
    table: dict[str, Any] = {
        "name": camera.name,
        **lens.table(),
        "rotation": pose.rodrigues.tolist(),
        "translation": pose.translation.tolist(),
    }
    if project in ("pose2sim", "caliscope"):
        table["fisheye"] = lens.fisheye
    if project == "caliscope":
        table |= {"cam_id": number, "rotation_count": 0, "error": camera.rms_px, "grid_count": 0}
    if project == "freemocap":
        table |= {"world_orientation": pose.rotation.T.tolist(), "world_position": pose.position.tolist()}
    return table | {"time_offset": camera.time_map.time_offset, "clock_rate": camera.time_map.clock_rate}
