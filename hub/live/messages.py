"""Calibrations, trajectories and solver events as messages for the bus and the log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hub.live.solver import SolverAnswer, SolverJob
from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.core.version import VERSION
from protocols.geometry.camera import Intrinsics
from protocols.geometry.pose import Pose
from protocols.messages import syncline_pb2 as pb
from protocols.session.builder import rig_camera_from_info
from protocols.session.calibration import Calibration, CameraCalibration, TrajectoryTable
from protocols.session.rig import Rig
from protocols.validation.codec import MAX_PAYLOAD
from protocols.validation.rules import MAX_TEXT, SCHEMA_VERSION


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
        message.cameras.append(
            pb.CameraCalibration(
                camera=name,
                rotation=camera.pose.rodrigues.tolist(),
                translation=camera.pose.translation.tolist(),
                time_offset=camera.time_map.time_offset,
                clock_rate=camera.time_map.clock_rate,
                time_offset_std=camera.lag_std,
                position_std=camera.position_std.tolist(),
                rms_px=camera.rms_px,
                **camera.intrinsics.message_fields(),
                boot_id=boot_ids.get(name, ""),
                lag_time_s=camera.lag_time,
                clock_rate_std=camera.clock_rate_std,
            )
        )
    message.refused.extend(_refusals(calibration.refused))
    return message


def calibration_from_message(message: pb.Calibration, infos: Mapping[str, pb.CameraInfo]) -> Calibration:
    """The calibration in a message, of the cameras that have introduced themselves: with them are the image sizes."""
    cameras = {}
    for found in message.cameras:
        info = infos.get(found.camera)
        lens = None if info is None else Intrinsics.of_message(found, (info.width, info.height))
        if info is not None and lens is not None:
            cameras[found.camera] = CameraCalibration(
                name=found.camera,
                intrinsics=lens,
                pose=Pose.from_rodrigues(np.array(found.rotation), np.array(found.translation)),
                time_map=TimeMap(found.clock_rate, found.time_offset),
                time_offset_std=found.time_offset_std,
                position_std=np.array(found.position_std) if found.position_std else np.zeros(3),
                rms_px=found.rms_px,
                readout=rig_camera_from_info(info).readout or 0.0,
                lag_time=found.lag_time_s,
                lag_std=found.time_offset_std,
                clock_rate_std=found.clock_rate_std,
            )
    refused = {entry.camera: entry.reason for entry in message.refused}
    return Calibration(
        cameras, message.reference_camera, message.scale, message.units, message.solver, VERSION, refused
    )


def refusal_message(reason: str, cameras: dict[str, str], revision: int, status: str) -> pb.Calibration:
    """The message of no calibration. status: "refused" or "collecting"; reason: what is missing."""
    message = pb.Calibration(schema_version=SCHEMA_VERSION, revision=revision, status=status, reason=reason[:MAX_TEXT])
    message.refused.extend(_refusals(cameras))
    return message


def _refusals(reasons: Mapping[str, str]) -> list[pb.Refusal]:
    """Of a thousand cameras, each with a dozen pairs that failed, the beginning of each reason."""
    room = min(MAX_TEXT, MAX_PAYLOAD // 3 // max(len(reasons), 1))
    return [pb.Refusal(camera=name, reason=reason[:room]) for name, reason in reasons.items()]


def solver_event(
    job: SolverJob, kind: str, ranges: Sequence[tuple[str, str, int, int, int]], answer: SolverAnswer | None = None
) -> pb.SolverEvent:
    """What a job was given, or that its answer took effect, for the log. ranges: of sequence numbers, by camera."""
    message = pb.SolverEvent(schema_version=SCHEMA_VERSION, job=job.number, kind=kind)
    message.rows.extend(
        pb.SolverEvent.Rows(camera=camera, boot_id=boot, first_sequence=first, last_sequence=last, count=count)
        for camera, boot, first, last, count in ranges
    )
    if kind == "submitted":
        message.search, message.full, message.verify = job.search, job.full, job.verify
        message.refine_lenses = job.refine_lenses
        for field, priors in ((message.clock_priors, job.clock_priors), (message.arrivals, job.arrivals)):
            field.extend(
                pb.SolverEvent.ClockPrior(
                    camera=name, unix_minus_camera=prior.unix_minus_camera, error_bound=prior.error_bound
                )
                for name, prior in priors.items()
            )
    if answer is not None:
        message.reason, message.cpu_s = answer.reason[:MAX_TEXT], answer.cpu_s
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


def rig_message(rig: Rig) -> pb.RigInfo:
    """The message with the rig's gauge and scale information, for the log."""
    message = pb.RigInfo(schema_version=SCHEMA_VERSION, units=rig.units, clock=rig.clock)
    for a, b, distance in rig.distances:
        message.distances.append(pb.RigInfo.Distance(camera_a=a, camera_b=b, distance=distance))
    if isinstance(rig.up, str):
        message.up_camera = rig.up
    elif rig.up is not None:
        message.up.extend(rig.up.tolist())
    reference = rig.metadata.get("reference")
    if isinstance(reference, str):
        message.reference_camera = reference
    return message
