"""The target estimate as the operator gets it: tracking status for the camera component, and a line of text."""

from __future__ import annotations

import math

import numpy as np

from edge.mavlink.roles.camera import TrackingStatus
from edge.mavlink.roles.vehicle import Vehicle
from edge.uav.base import Estimate, TrackState
from edge.uav.navigation import quaternion_from_rotation


def update_tracking_status(
    status: TrackingStatus, estimate: Estimate | None, vehicle: Vehicle, size: tuple[int, int]
) -> None:
    """Fill ``status`` from the target estimate and the vehicle's pose. size: (width, height) of the image [px]."""
    width, height = size
    origin, position = vehicle.origin, vehicle.position
    status.camera = None
    if origin is not None and position is not None:
        status.camera = origin.to_geodetic(float(position[0]), float(position[1]), float(position[2]))
    if vehicle.attitude is not None:
        status.quaternion = quaternion_from_rotation(vehicle.attitude.ned_from_body)
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
