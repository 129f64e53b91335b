"""The target estimate as the operator gets it: tracking status for the camera component, and a line of text."""

from __future__ import annotations

import math

import numpy as np

from edge.mavlink.roles.camera_messages import TrackingStatus
from edge.mavlink.roles.vehicle import Vehicle
from edge.uav.base import Estimate, TrackState
from edge.uav.georeference import ground_point
from protocols.core.clocks import NANOSECONDS
from protocols.geometry import so3
from protocols.geometry.camera import Intrinsics
from protocols.geometry.types import Floats

_CAMERA_FROM_FRD = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""From a camera's axes forward, right, down, which MAVLink uses, to right, down, forward."""
_LEAST_DOWN = 0.1  # of the optical axis: 6 degrees below the horizon the tilt's error alone is half the height
_STALE_NS = NANOSECONDS  # age of an attitude that no longer is the camera's


def update_tracking_status(
    status: TrackingStatus,
    estimate: Estimate | None,
    vehicle: Vehicle,
    size: tuple[int, int],
    lens: Intrinsics | None,
    mounting: Floats | None,
    now_ns: int,
) -> None:
    """Fill ``status`` from the target estimate and the vehicle's pose.

    size: (width, height) of the image [px]. mounting: body_from_camera (3, 3). now_ns: the host's clock.
    """
    width, height = size
    origin, motion = vehicle.origin, vehicle.motion_at(now_ns / NANOSECONDS)
    position = None if motion is None else motion[0]
    status.camera = status.image_centre = status.quaternion = None
    if origin is not None and position is not None:
        status.camera = origin.to_geodetic(float(position[0]), float(position[1]), float(position[2]))
    mount = vehicle.mount
    if mount is not None and mounting is not None and now_ns - mount.host_ns < _STALE_NS:
        ned_from_camera = mount.ned_from_mount @ mounting
        status.quaternion = so3.quaternion(ned_from_camera @ _CAMERA_FROM_FRD).tolist()
        if origin is not None and mount.position is not None:
            middle = np.array([[0.5 * (width - 1), 0.5 * (height - 1)]])
            ray = np.array([0.0, 0.0, 1.0]) if lens is None else np.append(lens.unproject(middle)[0], 1.0)
            met = ground_point(ned_from_camera @ ray, mount.position, _LEAST_DOWN)
            if met is not None:
                status.image_centre = origin.to_geodetic(float(met[0]), float(met[1]), 0.0)
    status.centre = status.half_size = status.geo = status.velocity = None
    status.h_acc = status.distance = status.course = math.nan
    status.state = "idle" if estimate is None else estimate.state.value
    if estimate is None or estimate.state is TrackState.LOST:
        return
    if math.isfinite(estimate.x) and math.isfinite(estimate.width) and math.isfinite(estimate.height):
        status.centre = ((estimate.x + 0.5) / width, (estimate.y + 0.5) / height)
        status.half_size = (0.5 * estimate.width / width, 0.5 * estimate.height / height)
    if not (math.isfinite(estimate.north) and math.isfinite(estimate.east)):
        return
    status.h_acc = math.sqrt(2.0) * estimate.std_m  # radial; std_m is per coordinate
    if origin is not None:
        status.geo = origin.to_geodetic(estimate.north, estimate.east, 0.0)
    if math.isfinite(estimate.course):
        status.course = estimate.course
        north, east = estimate.speed * math.cos(estimate.course), estimate.speed * math.sin(estimate.course)
        status.velocity = (north, east)
    if position is not None:
        status.distance = float(np.linalg.norm(np.array([estimate.north, estimate.east, 0.0]) - position))


def status_line(estimate: Estimate | None) -> str:
    """The target's state, speed and position std as one line of text for the video overlay."""
    if estimate is None:
        return "no target"
    text = estimate.state.value
    if math.isfinite(estimate.speed) and estimate.state is not TrackState.LOST:
        text += f"  {3.6 * estimate.speed:.0f} km/h  +-{estimate.std_m:.1f} m"
    return text
