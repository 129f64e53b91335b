"""What `calibrate` writes, as single files; and the rig of a simulated scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edge.scenes.common.base import SimulatedScene
from protocols.core.files import write_atomically
from protocols.session.calibration import Calibration, calibration_text, trajectory_text
from protocols.session.result import result_text
from protocols.session.rig import Rig, RigCamera


def write_calibration(file: Path, calibration: Calibration, rig: Rig) -> None:
    """Write calibration.toml."""
    write_atomically(file, calibration_text(calibration, rig))


def write_trajectory(file: Path, calibration: Calibration) -> None:
    """Write trajectory.csv."""
    write_atomically(file, trajectory_text(calibration.trajectories, len(calibration.trajectories) > 1))


def write_result(file: Path, document: dict[str, Any]) -> None:
    """Write result.json."""
    write_atomically(file, result_text(document))


def rig_of_scene(scene: SimulatedScene) -> Rig:
    """The rig of a simulated scene, with intrinsics but without poses."""
    return Rig(
        {
            camera.name: RigCamera(
                camera.name, (camera.intrinsics.width, camera.intrinsics.height), camera.fps, camera.intrinsics
            )
            for camera in scene.cameras
        }
    )
