"""A calibration result, and its files calibration.toml and trajectory.csv."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from protocols.core.acceptance import AcceptanceTest, PairReport
from protocols.core.clocks import TimeMap
from protocols.core.errors import InputError
from protocols.core.files import read_text, read_toml
from protocols.core.version import VERSION
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.geometry.types import Floats
from protocols.session.observations import DEFAULT_LABEL
from protocols.session.rig import Rig, parse_rig

_REPLACED_METADATA = (
    "distances", "wand", "bodies", "bodies_scale", "in_step", "target", "refused", "scale", "solver", "version",
    "reference",
)  # fmt: skip
"""Metadata keys of rig.toml that the result replaces."""
_LAG_KEYS = ("lag_time", "lag_std", "clock_rate_std")
"""What says where a lag's std holds: without them a hub that goes on from the file has a lag of no std."""

_COLUMNS = ("time", "x", "y", "z", "std")


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """What an error of one std of a given value would do to the answer, at the solution (linear).

    given: "position", "rotation" or "lens". std: that error: of the worst axis [rig units, rad], or relative of the
    focal length. position: the largest displacement of a camera's centre [rig units], that of ``camera``. lag: the
    largest change of a lag [s].
    """

    given: str
    std: float
    position: float
    camera: str
    lag: float


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """One calibrated camera.

    time_map: reference clock from camera clock. time_offset_std: std [s] of that map in the middle of the camera's
    observed span; 0 = not known. lag_time: camera time [s] in the middle of the span that the camera shares with the
    reference camera; lag_std: std [s] of `lag`, the map there. clock_rate_std: of its rate. position_std: (3,)
    [rig units]. rms_px: root mean square reprojection error. focal_std: relative std of a focal length estimated by
    self-calibration; 0 = the lens was given. readout: seconds from the image's first row to its last; 0 = not known.
    readout_std: its std where it was estimated, else 0. clock_steps: camera time, size and std [s] of each step of its
    clock; the map holds on the side of ``lag_time``. sensitivities: to the references and the lens given for it.
    detector_z: robust rms of its residuals over the stds that its detector states; 0 = it states none.
    """

    name: str
    intrinsics: Intrinsics
    pose: Pose
    time_map: TimeMap
    time_offset_std: float
    position_std: Floats
    rms_px: float
    focal_std: float = 0.0
    readout: float = 0.0
    readout_std: float = 0.0
    lag_time: float = 0.0
    lag_std: float = 0.0
    clock_rate_std: float = 0.0
    clock_steps: tuple[tuple[float, float, float], ...] = ()
    sensitivities: tuple[Sensitivity, ...] = ()
    detector_z: float = 0.0

    @property
    def lag(self) -> float:
        """Reference time less camera time [s] at camera time ``lag_time``."""
        return (self.time_map.clock_rate - 1.0) * self.lag_time + self.time_map.time_offset


@dataclass(frozen=True, slots=True, eq=False)
class FixedCalibration:
    """A calibration whose intrinsics and poses are held fixed. scale: "metric" or "arbitrary", as its file says."""

    cameras: dict[str, CameraCalibration]
    scale: str


@dataclass(frozen=True, slots=True)
class AdjustmentStep:
    """One iteration of the bundle adjustment, or the start of a round.

    stage: "first poses" (cameras are added), "robust", "fitting rows" or "free lenses". residual_px: the cost
    per pixel coordinate, in pixels: the root mean square of the weighted residuals, times the noise std by which they
    were weighted.
    """

    stage: str
    residual_px: float


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryTable:
    """The 3-D path of one label. time: (n,) reference clock [s]; position: (n, 3); std: (n,) of one axis."""

    label: str
    time: Floats
    position: Floats
    std: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """The complete calibration result that `calibrate` writes.

    reference: camera on whose clock the reference is, or was until that was restarted. scale: "metric" or "arbitrary"
    (then the first camera is the world and the first baseline is 1). refused: reasons by camera. cpu_seconds: of the
    solver. residuals: per camera (n, 5): camera time, u, v, and the residual du, dv [px] of the rows used (inliers).
    convergence: the iterations of the last adjustment, in order. acceptance: tests by camera, refused ones included.
    """

    cameras: dict[str, CameraCalibration]
    reference: str
    scale: str
    units: str
    solver: str
    version: str
    refused: dict[str, str] = field(default_factory=dict)
    trajectories: tuple[TrajectoryTable, ...] = ()
    pairs: tuple[PairReport, ...] = ()
    warnings: tuple[str, ...] = ()
    cpu_seconds: float = 0.0
    residuals: dict[str, Floats] = field(default_factory=dict)
    convergence: tuple[AdjustmentStep, ...] = ()
    acceptance: Mapping[str, Sequence[AcceptanceTest]] = field(default_factory=dict)


def stated_calibration(rig: Rig, cameras: dict[str, CameraCalibration]) -> Calibration:
    """The result that a calibration.toml states, as ``read_calibration`` gives it: without trajectories and tests."""
    metadata, refused = rig.metadata, rig.metadata.get("refused")
    return Calibration(
        cameras,
        str(metadata.get("reference") or next(iter(cameras), "")),
        str(metadata.get("scale", "metric")),
        rig.units,
        str(metadata.get("solver", "")),
        str(metadata.get("version", VERSION)),
        {str(name): str(why) for name, why in refused.items()} if isinstance(refused, dict) else {},
    )


def on_present_clock(calibration: Calibration) -> Calibration:
    """The calibration on the clock of one of its cameras, where the reference clock is none of theirs any more.

    A hub holds its reference clock when that camera has gone or was restarted; a file's has to be one of its cameras'.
    The new one is the camera whose lag is known best, as of which the others' stds are.
    """
    cameras, reference = calibration.cameras, calibration.cameras.get(calibration.reference)
    if not cameras or (reference is not None and reference.time_map == TimeMap(clock_rate=1.0, time_offset=0.0)):
        return calibration
    name = min(cameras, key=lambda one: cameras[one].time_offset_std)
    base, std = cameras[name].time_map, cameras[name].time_offset_std
    moved = {
        one: replace(
            camera,
            time_map=TimeMap(
                camera.time_map.clock_rate / base.clock_rate,
                (camera.time_map.time_offset - base.time_offset) / base.clock_rate,
            ),
            time_offset_std=float(np.hypot(camera.time_offset_std, std)) if one != name else 0.0,
            lag_std=float(np.hypot(camera.lag_std, std)) if one != name else 0.0,
        )
        for one, camera in cameras.items()
    }
    paths = (replace(path, time=(path.time - base.time_offset) / base.clock_rate) for path in calibration.trajectories)
    return replace(calibration, cameras=moved, reference=name, trajectories=tuple(paths))


def calibration_tables(calibration: Calibration, rig: Rig) -> dict[str, Any]:
    """The content of calibration.toml: rig.toml's tables with the estimates added."""
    tables: dict[str, Any] = {}
    # distances are in the scale now, and aniposelib's TOML reader breaks on lists of names and numbers.
    kept = {key: value for key, value in rig.metadata.items() if key not in _REPLACED_METADATA}
    metadata = {
        **kept,
        "units": calibration.units,
        "reference": calibration.reference,
        "scale": calibration.scale,
        "solver": calibration.solver,
        "version": calibration.version,
    }
    for name, camera in calibration.cameras.items():
        table = dict(rig.cameras[name].table) if name in rig.cameras else {}
        # A surveyed position is an input: the estimate is the translation, and two values that differ by the
        # survey's error would contradict each other.
        for key in ("position", "position_std", "rotation_std", "focal_std", "ball_outline", *_LAG_KEYS):
            table.pop(key, None)
        table |= {
            "name": name,
            **camera.intrinsics.table(),
            "rotation": camera.pose.rodrigues.tolist(),
            "translation": camera.pose.translation.tolist(),
            "time_offset": camera.time_map.time_offset,
            "clock_rate": camera.time_map.clock_rate,
            "time_offset_std": camera.time_offset_std,
            "position_std": camera.position_std.tolist(),
            "rms_px": camera.rms_px,
        }
        if camera.lag_time != 0.0:
            table |= {key: getattr(camera, key) for key in _LAG_KEYS}
        if camera.focal_std > 0.0:
            table["focal_std"] = camera.focal_std
        if camera.readout != 0.0:
            table["readout"] = camera.readout
        if camera.readout_std > 0.0:
            table["readout_std"] = camera.readout_std
        tables[name] = table
    if calibration.refused:
        metadata["refused"] = dict(calibration.refused)
    tables["metadata"] = metadata
    return tables


def calibration_text(calibration: Calibration, rig: Rig) -> str:
    """The text of calibration.toml, which aniposelib loads unchanged."""
    return tomli_w.dumps(_plain(calibration_tables(on_present_clock(calibration), rig)))


def trajectory_text(tables: Sequence[TrajectoryTable], labelled: bool) -> str:
    """trajectory.csv: time,x,y,z,std[,label] on the reference clock."""
    lines = ["time,x,y,z,std,label" if labelled else "time,x,y,z,std"]
    for table in tables:
        tail = f",{csv_cell(table.label)}" if labelled else ""
        rows = zip(table.time.tolist(), table.position.tolist(), table.std.tolist(), strict=True)
        for t, (x, y, z), std in rows:  # Python's own floats are written three times as fast as numpy's
            lines.append(f"{t:.17g},{x:.17g},{y:.17g},{z:.17g},{std:.17g}{tail}")
    return "\n".join(lines) + "\n"


def csv_cell(text: str) -> str:
    """A label as a CSV cell."""
    return f'"{text.replace(chr(34), chr(34) * 2)}"' if any(c in text for c in ',"\n\r') else text


def read_calibration(file: Path) -> tuple[Rig, dict[str, CameraCalibration]]:
    """Read calibration.toml (also aniposelib's, without clock maps): its rig and its calibrated cameras.

    Raises InputError where intrinsics, rotation or translation are missing.
    """
    values, text = read_toml(file, "calibration")
    rig = parse_rig(values, file, text)
    cameras: dict[str, CameraCalibration] = {}
    tables = {table.get("name", key): table for key, table in values.items() if isinstance(table, dict)}
    for name, camera in rig.cameras.items():
        table = tables[name]
        if camera.intrinsics is None or camera.rotation is None or camera.position is None:
            raise InputError(
                f"[{name}] has no matrix, rotation or translation",
                file=file,
                remedy="use a complete calibration",
            )
        rate, offset = table.get("clock_rate", 1.0), table.get("time_offset", 0.0)
        if not all(isinstance(v, int | float) and np.isfinite(v) for v in (rate, offset)) or rate <= 0:
            what = f"[{name}] time_offset {offset!r} and clock_rate {rate!r} are no clock"
            raise InputError(what, file=file, remedy="give a number of seconds, and a rate near 1")
        std = camera.position_std
        figures = {key: table.get(key, 0.0) for key in ("time_offset_std", "rms_px", *_LAG_KEYS)}
        for key, value in figures.items():
            least = -np.inf if key == "lag_time" else 0.0
            if not isinstance(value, int | float) or isinstance(value, bool) or not least <= value < np.inf:
                what = "a number" if key == "lag_time" else "a number >= 0"
                raise InputError(f"[{name}] {key} is not {what}", file=file, remedy="correct it")
        cameras[name] = CameraCalibration(
            name=name,
            intrinsics=camera.intrinsics,
            pose=Pose(so3.nearest(camera.rotation), camera.position),
            time_map=TimeMap(float(rate), float(offset)),
            time_offset_std=float(figures["time_offset_std"]),
            position_std=np.zeros(3) if std is None else std,
            rms_px=float(figures["rms_px"]),
            readout=camera.readout or 0.0,
            lag_time=float(figures["lag_time"]),
            lag_std=float(figures["lag_std"]),
            clock_rate_std=float(figures["clock_rate_std"]),
        )
    return rig, cameras


def stated_up(rig: Rig, cameras: Mapping[str, CameraCalibration]) -> Floats | None:
    """Up (3,), a unit vector in the world of a calibration that was read; None where it is not stated."""
    up = rig.up
    if isinstance(up, str):
        up = cameras[up].pose.rotation.T @ rig.up_in_camera(up) if up in cameras else None
    return None if up is None else np.asarray(up / np.linalg.norm(up))


def _plain(value: Any) -> Any:
    """Convert to what TOML can hold: numpy numbers become Python's; -0.0 becomes 0.0."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value + 0.0
    return value


def read_trajectory(file: Path) -> tuple[TrajectoryTable, ...]:
    """The trajectories in a trajectory.csv, by label in order of appearance. Raises InputError."""
    tables = []
    for label, rows in read_labelled_rows(file, _COLUMNS, "calibrate again").items():
        table = rows[np.lexsort(rows.T[::-1])]
        tables.append(TrajectoryTable(label, table[:, 0], table[:, 1:4], table[:, 4]))
    return tuple(tables)


def read_labelled_rows(file: Path, columns: Sequence[str], remedy: str) -> dict[str, Floats]:
    """The numbers (n, columns) of each label of a trajectory, or of each track (person1) of `follow`'s tracks.csv.

    Raises InputError: file, line, what, remedy.
    """
    reader = csv.DictReader(io.StringIO(read_text(file, "trajectory")))
    rows: dict[str, list[list[float]]] = {}
    try:
        missing = [key for key in columns if key not in (reader.fieldnames or [])]
        if missing:
            raise InputError(f"column {', '.join(missing)} is missing", file=file, line=1, remedy=remedy)
        for row in reader:
            try:
                values = [float(row[key]) for key in columns]
            except (TypeError, ValueError):
                what = f"{', '.join(columns)} are not all numbers"
                raise InputError(what, file=file, line=reader.line_num, remedy=remedy) from None
            if not np.isfinite(values).all():
                raise InputError("a number is not finite", file=file, line=reader.line_num, remedy=remedy)
            track = f"{row.get('kind') or ''}{row.get('id') or ''}"
            rows.setdefault(row.get("label") or track or DEFAULT_LABEL, []).append(values)
    except csv.Error as error:
        raise InputError(f"cannot be read: {error}", file=file, remedy=remedy) from None
    return {label: np.array(listed) for label, listed in rows.items()}
