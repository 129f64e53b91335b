"""Errors of a calibration against ground truth, for runs on simulated scenes."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from edge import scenes
from protocols.core.clocks import CameraTime
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.session.calibration import read_calibration

MAX_OFFSET_ERROR_MS, MAX_ROTATION_ERROR_DEG, MAX_DIRECTION_ERROR_DEG = 1.0, 0.3, 0.5
"""Largest errors of clock offset [ms], rotation and direction [deg] with which the demo counts as passed."""


@dataclass(frozen=True, slots=True)
class CameraError:
    """Errors of one camera [ms, degrees]. Lags in the middle of the span that it shares with the reference [s].

    direction_error_deg: of the direction from the reference camera to this one; 0 for the reference itself.
    """

    camera: str
    true_offset: float
    recovered_offset: float
    offset_error_ms: float
    offset_std_ms: float
    rotation_error_deg: float
    direction_error_deg: float


@dataclass(frozen=True, slots=True)
class CalibrationComparison:
    """Errors of all cameras; missing: cameras without a calibration. first_calibration_s: when the first was there."""

    cameras: tuple[CameraError, ...]
    missing: tuple[str, ...]
    first_calibration_s: float | None

    @property
    def good(self) -> bool:
        """Whether every camera is within the limits of the demo."""
        return not self.missing and all(
            abs(c.offset_error_ms) < MAX_OFFSET_ERROR_MS
            and c.rotation_error_deg < MAX_ROTATION_ERROR_DEG
            and c.direction_error_deg < MAX_DIRECTION_ERROR_DEG
            for c in self.cameras
        )

    def as_json(self) -> str:
        """The comparison as one JSON object."""
        document = {
            "good": self.good,
            "missing": list(self.missing),
            "first_calibration_s": self.first_calibration_s,
            "cameras": [asdict(camera) for camera in self.cameras],
        }
        return json.dumps(document)

    def print(self, out: Path) -> None:
        """Print the comparison as a table."""
        from rich.table import Table

        from deploy.offline.outputs import wide_console

        console = wide_console()
        table = Table("camera", title="recovered against true", title_justify="left")
        for column in ("true lag [s]", "recovered [s]", "error [ms]", "std [ms]", "rotation [°]", "direction [°]"):
            table.add_column(column, justify="right")
        for c in self.cameras:
            table.add_row(
                c.camera,
                f"{c.true_offset:.6f}",
                f"{c.recovered_offset:.6f}",
                f"{c.offset_error_ms:+.3f}",
                f"{c.offset_std_ms:.3f}",
                f"{c.rotation_error_deg:.3f}",
                f"{c.direction_error_deg:.3f}",
            )
        console.print(table)
        for name in self.missing:
            console.print(f"{name}: not calibrated")
        limits = f"{MAX_OFFSET_ERROR_MS:g} ms, {MAX_ROTATION_ERROR_DEG:g}° and {MAX_DIRECTION_ERROR_DEG:g}°"
        console.print(f"every camera within {limits}" if self.good else f"NOT every camera is within {limits}")
        if self.first_calibration_s is not None:
            console.print(f"first calibration after {self.first_calibration_s:.1f} s")
        console.print(f"log {out / 'demo.mcap'}, report {out / 'report.html'}", soft_wrap=True)
        console.print(f"again from the log: syncline calibrate {out / 'demo.mcap'} --out again", soft_wrap=True)


def compare_with_truth(
    folder: Path, scene_name: str, seed: int, cameras: int, first_calibration_s: float | None
) -> CalibrationComparison:
    """Compare the outputs in a folder with the simulated scene.

    Poses are compared in the reference camera's frame, without a similarity alignment that could hide errors.
    """
    scene = scenes.get_marker_scene(scene_name, seed, cameras)
    rig, solved = read_calibration(folder / "calibration.toml")
    reference = str(rig.metadata.get("reference", next(iter(solved))))
    base, base_truth = solved[reference].pose, scene.camera(reference).pose
    # The time offset extrapolates the clock rate to the clock's epoch: lags are compared where their std holds.
    stated = json.loads((folder / "result.json").read_text(encoding="utf-8"))["cameras"]
    out = []
    for camera in scene.cameras:
        if camera.name not in solved:
            continue
        found, truth = solved[camera.name], scene.camera(camera.name).pose
        true_map = scene.true_time_map(camera.name, reference)
        middle = CameraTime(stated[camera.name]["lag_time_s"])
        true_offset = true_map.reference_from_camera(middle) - middle
        recovered = found.time_map.reference_from_camera(middle) - middle
        turn = so3.angle_between(found.pose.rotation @ base.rotation.T, truth.rotation @ base_truth.rotation.T)
        out.append(
            CameraError(
                camera=camera.name,
                true_offset=true_offset,
                recovered_offset=recovered,
                offset_error_ms=1e3 * (recovered - true_offset),
                offset_std_ms=1e3 * stated[camera.name]["lag_std_s"],
                rotation_error_deg=float(np.degrees(turn)),
                direction_error_deg=0.0
                if camera.name == reference
                else _direction(found.pose, base, truth, base_truth),
            )
        )
    missing = tuple(camera.name for camera in scene.cameras if camera.name not in solved)
    return CalibrationComparison(tuple(out), missing, first_calibration_s)


def _direction(found: Pose, base: Pose, truth: Pose, base_truth: Pose) -> float:
    """Angle [deg] between estimated and true direction from the reference camera, in that camera's frame."""
    a = base.rotation @ (found.position - base.position)
    b = base_truth.rotation @ (truth.position - base_truth.position)
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
