"""Calibrations in TOML: aniposelib's, and the dialects of caliscope, Pose2Sim and FreeMoCap.

All hold Rodrigues vector and translation, camera from world, as rig.toml does. aniposelib knows no units, caliscope and
Pose2Sim mean metres, FreeMoCap millimetres. time_offset, clock_rate and units stand beside as further keys, which
the four readers pass over.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from protocols.core.clocks import TimeMap
from protocols.core.errors import InputError
from protocols.formats.cameras import ForeignCamera, ForeignRig, Written, in_units, numbers
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.session.calibration import CameraCalibration
from protocols.session.rig import UNITS, RigCamera, camera_of_table, read_toml

UNITS_OF = {"aniposelib": None, "caliscope": "m", "pose2sim": "m", "freemocap": "mm"}
"""Units of a project's lengths; None = whatever the user had."""
_NO_CAMERAS = ("metadata", "capture_volume", "charuco", "checkerboard", "groundplane")


def kind_of(values: Mapping[str, Any]) -> str | None:
    """Which project a TOML file's content looks like; None = none of them."""
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
    told = metadata if isinstance(metadata, dict) else {}
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
        camera = camera_of_table(given, given["name"], file, text.replace(f"[{where}]", f"[{given['name']}]"))
        if camera.name in cameras:
            raise InputError(f"two cameras are named {camera.name!r}", file=file, remedy="give each its own name")
        cameras[camera.name] = _foreign(camera, table, file, where)
    if not cameras:
        remedy = "give a calibration, or say what it is with --format"
        raise InputError(f"no camera of {project} in it", file=file, remedy=remedy)
    units = told.get("units")
    if units is not None and (not isinstance(units, str) or units not in UNITS):
        raise InputError(f"[metadata] units = {units!r}", file=file, remedy='use "m", "cm" or "mm"')
    scale = told.get("scale")
    return ForeignRig(
        cameras, units or UNITS_OF.get(project), scale if scale in ("metric", "arbitrary") else None, tuple(warnings)
    )


def write(
    project: str, cameras: Mapping[str, CameraCalibration], units: str, scale: str, name: str = "calibration.toml"
) -> Written:
    """A calibration for ``project`` as one file ``name``, in that project's units."""
    wanted = UNITS_OF[project] or units
    converted, warnings = in_units(cameras, units, wanted, scale)
    tables = {key: _table(project, number, camera) for number, (key, camera) in enumerate(converted.items())}
    metadata = {"adjusted": False, "error": 0.0, "units": wanted, "scale": scale}
    if project == "caliscope":
        document: dict[str, Any] = {
            "metadata": metadata,
            "cameras": {str(table["cam_id"]): table for table in tables.values()},
        }
    elif project == "pose2sim":
        document = {**tables, "metadata": metadata}
    else:
        document = {f"cam_{number}": table for number, table in enumerate(tables.values())} | {"metadata": metadata}
    bent = [key for key, camera in cameras.items() if camera.intrinsics.fisheye]
    if bent and project in ("pose2sim", "freemocap"):
        warnings += (f"{project} takes every lens for a pinhole's: {', '.join(bent)} will be wrong off its middle",)
    return Written({name: tomli_w.dumps(document)}, warnings)


def _as_ours(table: dict[str, Any], key: str, project: str) -> dict[str, Any]:
    """A project's camera table with rig.toml's keys and kinds of values."""
    table.setdefault("name", f"cam_{key}" if project == "caliscope" else key)
    if not isinstance(table["name"], str):
        table["name"] = str(table["name"])
    # Turned by 90 degrees for display only, a std of another meaning: no business of ours.
    for unused in ("position", "position_std", "rotation_std", "fps", "body_from_camera"):
        table.pop(unused, None)
    for flat in ("distortions", "translation"):
        if isinstance(table.get(flat), list) and all(isinstance(part, list) for part in table[flat]):
            table[flat] = [value for part in table[flat] for value in part]
    rotation = table.get("rotation")
    if isinstance(rotation, list) and len(rotation) == 3 and all(isinstance(row, list) for row in rotation):
        flat_rotation = [value for row in rotation for value in row]
        # Rodrigues as a column, or a whole matrix as caliscope once wrote it.
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
    time_map = None
    if "time_offset" in table:
        pair = [table.get("clock_rate", 1.0), table["time_offset"]]
        rate, offset = numbers(pair, (2,), f"[{where}] clock_rate, time_offset", file, None)
        if rate <= 0:
            raise InputError(f"[{where}] clock_rate = {rate:g}", file=file, remedy="give a rate above 0")
        time_map = TimeMap(float(rate), float(offset))
    return ForeignCamera(camera.name, camera.intrinsics, pose, time_map)


def _table(project: str, number: int, camera: CameraCalibration) -> dict[str, Any]:
    lens, pose = camera.intrinsics, camera.pose
    table: dict[str, Any] = {
        "name": camera.name,
        "size": [lens.width, lens.height],
        "matrix": lens.matrix.tolist(),
        "distortions": lens.distortions.tolist(),
        "rotation": pose.rodrigues.tolist(),
        "translation": pose.translation.tolist(),
    }
    if lens.fisheye or project in ("pose2sim", "caliscope"):
        table["fisheye"] = lens.fisheye
    if project == "caliscope":
        table |= {"cam_id": number, "rotation_count": 0, "error": camera.rms_px, "grid_count": 0}
    if project == "freemocap":
        table |= {"world_orientation": pose.rotation.T.tolist(), "world_position": pose.position.tolist()}
    return table | {"time_offset": camera.time_map.time_offset, "clock_rate": camera.time_map.clock_rate}
