"""What the UAV agent tells an operator of its target: for the camera component, and as a line on the picture."""

from __future__ import annotations

import math

import numpy as np

from edge.mavlink.roles.camera import Shown
from edge.mavlink.roles.vehicle import Vehicle
from edge.uav.navigation import to_quaternion
from edge.uav.tracker import Estimate, State


def show(shown: Shown, estimate: Estimate | None, vehicle: Vehicle, size: tuple[int, int]) -> None:
    """Put what is known of target and vehicle where the camera component tells it. size: (width, height) [px]."""
    width, height = size
    origin, place = vehicle.origin, vehicle.position
    shown.camera = None
    if origin is not None and place is not None:
        shown.camera = origin.world(float(place[0]), float(place[1]), float(place[2]))
    if vehicle.attitude is not None:
        shown.quaternion = to_quaternion(vehicle.attitude.ned_from_body)
    shown.centre = shown.half = shown.geo = shown.velocity = None
    shown.h_acc = shown.distance = shown.course = math.nan
    shown.state = "idle" if estimate is None else estimate.state.value
    if estimate is None or estimate.state is State.LOST:
        return
    if math.isfinite(estimate.x) and math.isfinite(estimate.width) and math.isfinite(estimate.height):
        shown.centre = ((estimate.x + 0.5) / width, (estimate.y + 0.5) / height)
        shown.half = (0.5 * estimate.width / width, 0.5 * estimate.height / height)
    if not (math.isfinite(estimate.north) and math.isfinite(estimate.east)):
        return
    shown.h_acc = math.sqrt(2.0) * estimate.std_m  # of the distance; std_m is of one coordinate
    if origin is not None:
        shown.geo = origin.world(estimate.north, estimate.east, 0.0)
    if math.isfinite(estimate.course):
        shown.course = estimate.course
        north, east = estimate.speed * math.cos(estimate.course), estimate.speed * math.sin(estimate.course)
        shown.velocity = (north, east)
    if place is not None:
        shown.distance = float(np.linalg.norm(np.array([estimate.north, estimate.east, 0.0]) - place))


def line(estimate: Estimate | None) -> str:
    """One line for the operator's picture."""
    if estimate is None:
        return "no target"
    text = estimate.state.value
    if math.isfinite(estimate.speed) and estimate.state is not State.LOST:
        text += f"  {3.6 * estimate.speed:.0f} km/h  +-{estimate.std_m:.1f} m"
    return text
