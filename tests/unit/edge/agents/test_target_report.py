"""The camera's attitude and the ground point at the image centre, as CAMERA_FOV_STATUS reports them."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from deploy.agents.uav import gimbal_from_camera
from edge.agents.target_report import update_tracking_status
from edge.mavlink.dialect import mavlink
from edge.mavlink.link.connection import Link
from edge.mavlink.roles.camera import CameraComponent
from edge.mavlink.roles.vehicle import MountSample
from edge.uav.navigation import Origin, rotation_from_euler, rotation_from_quaternion
from protocols.geometry.camera import Intrinsics
from tests.support.pipe import Pipe

SIZE = (640, 480)
LENS = Intrinsics(*SIZE, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]))
ORIGIN = Origin(47.4, 8.5, 480.0)
CENTRE = np.array([10.0, -20.0, -60.0])
NOW = 1_000_000_000
UNKNOWN = 0x7FFFFFFF


def fov_status(
    gimbal: np.ndarray | None, position: np.ndarray | None = CENTRE, lens: Intrinsics | None = LENS, age_ns: int = 0
) -> Any:
    """CAMERA_FOV_STATUS of a camera on a gimbal with rotation ned_from_gimbal."""
    mount = None if gimbal is None else MountSample(NOW - age_ns, NOW, 0.01, gimbal, position)
    motion = None if position is None else (position, np.zeros(3))
    vehicle = SimpleNamespace(origin=ORIGIN, motion_at=lambda time_s: motion, mount=mount)
    ours, theirs = Pipe.pair()
    link = Link(None, system=1, component=100, allowed=(), transport=ours, vehicle=1)
    component = CameraComponent(link, SIZE, 30.0, lens, None, lambda command: True)
    update_tracking_status(component.status, None, vehicle, SIZE, lens, gimbal_from_camera(), NOW)  # type: ignore[arg-type]
    component.tick(0.0, frame=False)
    reader = mavlink.MAVLink(None)
    messages = [message for data, _ in theirs.receive() for message in reader.parse_buffer(data) or []]
    return next(message for message in messages if message.get_type() == "CAMERA_FOV_STATUS")


@pytest.mark.parametrize(("pitch_deg", "yaw_deg"), [(-62.0, 0.0), (-62.0, 130.0), (-90.0, 20.0)])
def test_the_attitude_is_the_cameras_and_the_image_centre_lies_on_its_axis(pitch_deg: float, yaw_deg: float) -> None:
    pitch, yaw = math.radians(pitch_deg), math.radians(yaw_deg)
    status = fov_status(rotation_from_euler(0.0, pitch, yaw))
    rotation = rotation_from_quaternion(status.q)
    assert rotation is not None
    np.testing.assert_allclose(rotation, rotation_from_euler(0.0, pitch, yaw), atol=1e-6)  # forward, right, down
    reach = 60.0 / math.tan(-pitch)
    north, east, down = ORIGIN.to_ned(1e-7 * status.lat_image, 1e-7 * status.lon_image, 1e-3 * status.alt_image)
    expected = (10.0 + reach * math.cos(yaw), -20.0 + reach * math.sin(yaw), 0.0)
    assert (north, east, down) == pytest.approx(expected, abs=0.05)
    assert ORIGIN.to_ned(1e-7 * status.lat_camera, 1e-7 * status.lon_camera, 1e-3 * status.alt_camera) == pytest.approx(
        CENTRE, abs=0.05
    )


@pytest.mark.parametrize("case", ["level", "on the ground", "no position"])
def test_without_height_or_a_ray_downwards_the_image_centre_is_unknown(case: str) -> None:
    pitch = 0.0 if case == "level" else -1.0
    position = {"on the ground": np.array([0.0, 0.0, -0.5]), "no position": None}.get(case, CENTRE)
    status = fov_status(rotation_from_euler(0.0, pitch, 0.0), position)
    assert (status.lat_image, status.lon_image, status.alt_image) == (UNKNOWN,) * 3
    assert np.isfinite(status.q).all()


def test_without_a_fresh_attitude_everything_of_it_is_unknown() -> None:
    for status in (fov_status(None), fov_status(np.eye(3), age_ns=1_500_000_000)):
        assert np.isnan(status.q).all()
        assert status.lat_image == UNKNOWN
    blind = fov_status(rotation_from_euler(0.0, -1.0, 0.0), lens=None)
    assert math.isnan(blind.hfov)
    assert math.isnan(blind.vfov)
