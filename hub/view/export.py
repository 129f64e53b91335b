"""calibration.toml from the messages of the bus, for download in the browser."""

from __future__ import annotations

import numpy as np

from hub.view.state import ViewState
from protocols.core.clocks import TimeMap
from protocols.core.version import VERSION
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.messages import syncline_pb2 as pb
from protocols.session.builder import rig_camera_from_info
from protocols.session.calibration import Calibration, CameraCalibration, calibration_text
from protocols.session.rig import Rig


def calibration_file(state: ViewState) -> str:
    """The text of calibration.toml; "" if nothing is solved yet."""
    solved = state.solved
    if solved is None:
        return ""
    infos = {name: camera.info for name, camera in state.cameras.items() if camera.info is not None}
    rig = Rig({name: rig_camera_from_info(info) for name, info in infos.items()}, solved.units)
    cameras = {}
    for found in solved.cameras:
        info = infos.get(found.camera)
        lens = None if info is None else Intrinsics.of_message(found, (info.width, info.height))
        if lens is not None:
            cameras[found.camera] = _camera(found, lens)
    return calibration_text(
        Calibration(
            cameras,
            solved.reference_camera,
            solved.scale,
            solved.units,
            solved.solver,
            VERSION,
            {entry.camera: entry.reason for entry in solved.refused},
        ),
        rig,
    )


def _camera(found: pb.CameraCalibration, lens: Intrinsics) -> CameraCalibration:
    return CameraCalibration(
        name=found.camera,
        intrinsics=lens,
        pose=Pose.from_rodrigues(np.array(found.rotation), np.array(found.translation)),
        time_map=TimeMap(found.clock_rate, found.time_offset),
        time_offset_std=found.time_offset_std,
        position_std=np.array(found.position_std) if found.position_std else np.zeros(3),
        rms_px=found.rms_px,
        lag_time=found.lag_time_s,
        lag_std=found.time_offset_std,
        clock_rate_std=found.clock_rate_std,
    )
