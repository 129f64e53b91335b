"""Calibration and trajectories as messages for the bus and the log."""

from __future__ import annotations

import numpy as np

from protocols.core.clocks import NANOSECONDS
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import Calibration, TrajectoryTable

SCHEMA_VERSION = 1


def calibration_message(calibration: Calibration, revision: int, boot_ids: dict[str, str]) -> pb.Calibration:
    """The message of a solved calibration. boot_ids: by camera, the boot id of the clock its time map refers to."""
    message = pb.Calibration(
        schema_version=SCHEMA_VERSION,
        revision=revision,
        status="solved",
        reference_camera=calibration.reference,
        scale=calibration.scale,
        units=calibration.units,
        solver=calibration.solver,
    )
    for name, camera in calibration.cameras.items():
        lens = camera.intrinsics
        message.cameras.append(
            pb.CameraCalibration(
                camera=name,
                rotation=camera.pose.rodrigues.tolist(),
                translation=camera.pose.translation.tolist(),
                time_offset=camera.time_map.time_offset,
                clock_rate=camera.time_map.clock_rate,
                time_offset_std=camera.time_offset_std,
                position_std=camera.position_std.tolist(),
                rms_px=camera.rms_px,
                matrix=lens.matrix.ravel().tolist(),
                distortions=lens.distortions.tolist(),
                fisheye=lens.fisheye,
                boot_id=boot_ids.get(name, ""),
            )
        )
    message.refused.extend(pb.Refusal(camera=name, reason=reason) for name, reason in calibration.refused.items())
    return message


def refusal_message(reason: str, cameras: dict[str, str], revision: int, status: str) -> pb.Calibration:
    """The message of no calibration. status: "refused" or "collecting"; reason: what is missing."""
    message = pb.Calibration(schema_version=SCHEMA_VERSION, revision=revision, status=status, reason=reason)
    message.refused.extend(pb.Refusal(camera=name, reason=why) for name, why in cameras.items())
    return message


def track_messages(table: TrajectoryTable, after: float, sequence: int) -> list[pb.Track]:
    """The part of a trajectory after a reference time [s], one message per sample. sequence: of the first message."""
    out: list[pb.Track] = []
    for index in np.flatnonzero(table.time > after):
        variance = float(table.std[index]) ** 2
        out.append(
            pb.Track(
                schema_version=SCHEMA_VERSION,
                sequence=sequence + len(out),
                label=table.label,
                state="confirmed",
                reference_time_ns=round(float(table.time[index]) * NANOSECONDS),
                position=table.position[index].tolist(),
                position_covariance=(variance * np.eye(3)).ravel().tolist(),
            )
        )
    return out
