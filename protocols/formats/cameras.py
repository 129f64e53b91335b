"""Format-independent representation of an imported or exported calibration, and its conversion to rig.toml."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from protocols.core.clocks import TimeMap
from protocols.core.errors import InputError, Refused
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.calibration import CameraCalibration
from protocols.session.rig import METRES_PER_UNIT

_MAX_REFIT_ERROR_PX = 1.0  # px: largest error of a refit with fewer distortion coefficients
_MAX_SKEW_PX = 1e-9  # px


@dataclass(frozen=True, slots=True, eq=False)
class ForeignCamera:
    """One camera as read from another tool's file; None for what the file does not contain.

    pose: camera from world. time_map: reference clock from camera clock.
    """

    name: str
    intrinsics: Intrinsics
    pose: Pose | None = None
    time_map: TimeMap | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ForeignRig:
    """All cameras of a file. units: of its lengths, None where not given. scale: "metric" or "arbitrary"."""

    cameras: dict[str, ForeignCamera]
    units: str | None = None
    scale: str | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class ExportedFiles:
    """The texts of an export by file name, and warnings about what the format cannot represent."""

    files: dict[str, str]
    warnings: tuple[str, ...] = ()


def rig_tables(rig: ForeignRig, units: str) -> dict[str, Any]:
    """The tables of a rig.toml, which is a valid calibration.toml too if all cameras have poses."""
    metadata: dict[str, Any] = {"units": units}
    if any(camera.time_map is not None for camera in rig.cameras.values()):
        metadata["reference"] = next(iter(rig.cameras))
    if rig.scale is not None:
        metadata["scale"] = rig.scale
    tables: dict[str, Any] = {"metadata": metadata}
    for name, camera in rig.cameras.items():
        table: dict[str, Any] = {"name": name, **camera.intrinsics.table()}
        if camera.pose is not None:
            table["rotation"] = camera.pose.rodrigues.tolist()
            table["translation"] = camera.pose.translation.tolist()
        if camera.time_map is not None:
            table["time_offset"] = camera.time_map.time_offset
            table["clock_rate"] = camera.time_map.clock_rate
        tables[name] = table
    return tables


def convert_units(
    cameras: Mapping[str, CameraCalibration], units: str, wanted: str, scale: str
) -> tuple[dict[str, CameraCalibration], tuple[str, ...]]:
    """The cameras with their lengths in ``wanted`` units, and a warning where there is no scale to convert."""
    if scale == "arbitrary":
        return dict(cameras), (f"the calibration has no scale: its lengths are baselines, not {wanted}",)
    factor = METRES_PER_UNIT[units] / METRES_PER_UNIT[wanted]
    if factor == 1.0:
        return dict(cameras), ()
    return {
        name: replace(camera, pose=Pose(camera.pose.rotation, factor * camera.pose.position))
        for name, camera in cameras.items()
    }, ()


def check_skew(camera: CameraCalibration, project: str) -> None:
    """Raise Refused for a camera matrix with skew, which most formats cannot represent."""
    if abs(camera.intrinsics.matrix[0, 1]) > _MAX_SKEW_PX:
        raise Refused(f"{project} holds no skew, and {camera.name} has {camera.intrinsics.matrix[0, 1]:.3g} px of it")


def fit_without_k3(lens: Intrinsics, name: str, project: str) -> tuple[Floats, str]:
    """The best fit k1, k2, p1, p2 (4,) of a pinhole lens without k3 over its image, and a warning ("" = exact).

    Linear least squares over a grid of pixels, since distortion is linear in its coefficients. Raises Refused where
    the largest error exceeds 1 px.
    """
    if lens.distortions[4] == 0.0:
        return lens.distortions[:4].copy(), ""
    across, down = np.meshgrid(np.linspace(0, lens.width - 1, 33), np.linspace(0, lens.height - 1, 25))
    flat = lens.unproject(np.column_stack([across.ravel(), down.ravel()]))
    flat = flat[np.isfinite(flat).all(axis=1)]
    x, y = flat.T
    r2 = x * x + y * y
    columns = np.empty((len(flat), 2, 4))
    columns[:, 0] = np.column_stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x])
    columns[:, 1] = np.column_stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y])
    bent = (lens.distort(flat)[0] - flat).reshape(-1)
    found = np.linalg.lstsq(columns.reshape(-1, 4), bent, rcond=None)[0]
    left = (columns.reshape(-1, 4) @ found - bent).reshape(-1, 2) @ lens.matrix[:2, :2].T
    worst = float(np.linalg.norm(left, axis=1).max(initial=0.0))
    if worst > _MAX_REFIT_ERROR_PX:
        raise Refused(f"{project} holds no k3, and {name} without it is up to {worst:.1f} px off")
    return np.asarray(found), f"{project} holds no k3: {name}'s others are refitted, largest error {worst:.2g} px"


def parse_array(value: Any, shape: tuple[int, ...], what: str, file: Path, line: int | None) -> Floats:
    """An array of finite numbers of this shape. Raises InputError."""
    remedy = f"give {'x'.join(map(str, shape))} numbers"
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} is not numbers", file=file, line=line, remedy=remedy) from None
    if array.shape != shape:
        found = "x".join(map(str, array.shape)) or "1"
        raise InputError(f"{what} has {found} numbers", file=file, line=line, remedy=remedy)
    if not np.isfinite(array).all() or np.abs(array).max(initial=0.0) > 1e12:
        raise InputError(f"{what} is not finite, or far too large", file=file, line=line, remedy="correct it")
    return array


def parse_time_map(table: Mapping[str, Any], what: str, file: Path, line: int | None) -> TimeMap | None:
    """A table's time_offset and clock_rate, which Syncline's exports add; None without. Raises InputError."""
    if "time_offset" not in table:
        return None
    pair = [table.get("clock_rate", 1.0), table["time_offset"]]
    rate, offset = parse_array(pair, (2,), f"{what}clock_rate, time_offset", file, line)
    if rate <= 0:
        raise InputError(f"{what}clock_rate = {rate:g}", file=file, line=line, remedy="give a rate above 0")
    return TimeMap(float(rate), float(offset))


def pinhole_matrix(fx: float, fy: float, cx: float, cy: float) -> Floats:
    """(3, 3) camera matrix."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
