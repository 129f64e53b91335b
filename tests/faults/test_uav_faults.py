"""Noise, silences, and other components' clocks on the UAV agent's link."""

from __future__ import annotations

import random

import numpy as np
import pytest

from edge.mavlink.dialect import mavlink
from edge.uav.navigation import rotation_from_quaternion
from edge.uav.world.patrol import patrol_world
from protocols.messages import syncline_pb2 as pb
from tests.faults.matrix import measured
from tests.support.uav_flights import Flight

SIZE = (320, 240)


def flown(noise: bool) -> Flight:
    """Three seconds with a target; with noise, 10^6 random bytes come over the same wire meanwhile."""
    flight = Flight(patrol_world(3, 10.0, SIZE), jpeg_quality=90)
    flight.run(1.5)
    assert flight.select()
    rng = random.Random(1)
    wire = flight.agent_pipe.other
    assert wire is not None
    while flight.time < 3.0:
        if noise:
            wire.send(rng.randbytes(7000), None)
        flight.run(flight.time + 0.01)
    return flight


def test_a_million_garbled_bytes_change_nothing() -> None:
    quiet, noisy = flown(False), flown(True)
    assert noisy.link.counters["garbled_bytes"] > 900_000
    assert noisy.link.vehicle == quiet.link.vehicle
    assert noisy.agent.counters == quiet.agent.counters
    kinds = (pb.TargetState, pb.VehicleTelemetry, pb.TargetCommand)
    said = [
        [m.SerializeToString(deterministic=True) for m in flight.published if isinstance(m, kinds)]
        for flight in (quiet, noisy)
    ]
    assert said[0] == said[1]


def test_a_silent_vehicle_and_a_dark_camera_are_reported_and_recovered_from() -> None:
    flight = Flight(patrol_world(3, 20.0, SIZE))
    flight.run(1.5)
    assert flight.select()
    flight.run(2.0)
    step, flight.autopilot.step = flight.autopilot.step, lambda time: None  # type: ignore[method-assign]
    flight.run(5.0)
    status = flight.agent.status(0)
    assert status.state == "degraded"
    assert "silent" in status.message
    flight.autopilot.step = step  # type: ignore[method-assign]
    flight.frames_lost = lambda frame: 5.1 < frame / 30.0 < 5.4
    flight.run(5.95)
    assert flight.agent.status(1).state == "running"
    last = flight.messages(pb.TargetState)[-1]
    truth = flight.world.truth(last.frame)
    assert last.centre
    assert np.hypot(last.centre[0] - truth.x, last.centre[1] - truth.y) < 20.0


def test_an_attitude_of_nan_is_refused_and_the_flight_goes_on() -> None:
    flight = Flight(patrol_world(3, 10.0, SIZE))
    flight.run(1.5)
    assert flight.select()
    codec = mavlink.MAVLink(None, 1, 1)
    wire = flight.agent_pipe.other
    assert wire is not None
    nan = float("nan")
    for _ in range(50):
        boot = (flight.autopilot.boot_ns(flight.time) // 1_000_000) & 0xFFFFFFFF
        for bad in (
            mavlink.MAVLink_attitude_quaternion_message(boot, nan, 0, 0, 0, 0, 0, 0),
            mavlink.MAVLink_attitude_quaternion_message(boot, 0, 0, 0, 0, 0, 0, 0),
            mavlink.MAVLink_local_position_ned_message(boot, nan, 0, 0, 0, 0, 0),
        ):
            wire.send(bytes(bad.pack(codec)), None)
        flight.run(flight.time + 0.02)
    assert flight.link.counters["refused.not_finite"] == 100
    last = flight.messages(pb.TargetState)[-1]
    truth = flight.world.truth(last.frame)
    assert np.hypot(last.centre[0] - truth.x, last.centre[1] - truth.y) < 10.0


@pytest.mark.parametrize("ahead_s", [86_400.0, 40.0])
def test_a_companions_attitude_with_a_clock_of_its_own_does_not_touch_the_target(ahead_s: float) -> None:
    flight = Flight(patrol_world(3, 10.0, SIZE))
    flight.run(1.5)
    assert flight.select()
    companion = mavlink.MAVLink(None, 1, 191)
    wire = flight.agent_pipe.other
    assert wire is not None
    for _ in range(10):
        boot_ms = round(flight.autopilot.boot_ns(flight.time) * 1e-6 + 1e3 * ahead_s) & 0xFFFFFFFF
        message = mavlink.MAVLink_attitude_quaternion_message(boot_ms, 0.7, 0.7, 0.1, 0.1, 0, 0, 0)
        wire.send(bytes(message.pack(companion)), None)
        flight.run(flight.time + 0.15)
    last = flight.messages(pb.TargetState)[-1]
    truth = flight.world.truth(last.frame)
    assert np.hypot(last.centre[0] - truth.x, last.centre[1] - truth.y) < 10.0
    other = mavlink.MAVLink(None, 2, 1)
    wire.send(bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(other)), None)
    flight.run(flight.time + 0.15)
    status = flight.agent.status(0)
    assert status.counters["telemetry.refused.component"] == 10
    assert "ATTITUDE_QUATERNION of component 191 refused" in status.message
    assert "; system 2 is on this link too" in status.message
    measured(f"attitude of a companion computer, {ahead_s:.0f} s ahead", "refused, target kept", "10 of 10 refused")


@pytest.mark.parametrize("back_s", [3.0, 0.8, -3.0])
def test_a_cameras_clock_that_is_set_does_not_touch_the_target(back_s: float) -> None:
    flight = Flight(patrol_world(3, 10.0, SIZE))
    stamped = flight.device.device_time_ns
    flight.device.device_time_ns = lambda index: stamped(index) - (round(1e9 * back_s) if index >= 70 else 0)  # type: ignore[method-assign]
    flight.run(1.5)
    assert flight.select()
    flight.run(3.8)
    errors = [
        np.hypot(state.centre[0] - truth.x, state.centre[1] - truth.y)
        for state in flight.messages(pb.TargetState)
        for truth in [flight.world.truth(state.frame)]
    ]
    assert max(errors) < 10.0
    assert flight.agent.status(0).counters["camera.clock_steps"] == 1
    measured(f"the camera's clock is set back by {back_s:.1f} s", "target kept", f"at most {max(errors):.1f} px")


def test_a_gimbal_with_its_own_boot_clock_gives_places_and_the_cameras_attitude() -> None:
    world = patrol_world(3, 10.0, SIZE)
    ground, yaw = world.target.ground[0], float(world.target.course[0])
    flight = Flight(
        world, flies="follow", gimbal=(-1.2, yaw), gimbal_ahead_s=45.0, start=np.array([*ground, -62.0]), yaw=yaw
    )
    flight.run(3.0)
    assert flight.agent.status(0).state == "running"
    camera_from_ned, centre = flight.aircraft.camera_from_ned(flight.time - 0.05, world.body_from_camera)
    fov = flight.station.last("CAMERA_FOV_STATUS")
    forward = rotation_from_quaternion(fov.q)[:, 0]
    assert np.degrees(np.arccos(np.clip(forward @ camera_from_ned[2], -1.0, 1.0))) < 3.0
    north, east, _ = flight.autopilot.origin.to_ned(1e-7 * fov.lat_image, 1e-7 * fov.lon_image, 0.0)
    axis = camera_from_ned[2]
    expected = centre[:2] - centre[2] / axis[2] * axis[:2]
    assert np.hypot(north - expected[0], east - expected[1]) < 4.0
    flight.station.command(mavlink.MAV_CMD_CAMERA_TRACK_POINT, 0.5, 0.5)
    flight.run(4.0)
    geo = flight.station.last("CAMERA_TRACKING_GEO_STATUS")
    assert geo.lat != 0x7FFFFFFF
    assert np.isfinite(geo.h_acc)
    measured("gimbal whose clock is 45 s ahead", "places are given", f"h_acc {geo.h_acc:.1f} m")
