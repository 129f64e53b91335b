"""The UAV agent in simulated time: replay, faults of the link, and what it commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deploy.demo.flight_outcome import compare_log_with_world, write_report
from deploy.logs.replay_uav import replay_through_uav
from edge.agents.uav import TOPICS
from edge.devices.simulated.aircraft import Disturbance
from edge.mavlink.roles.autopilot import LinkFaults
from edge.mavlink.settings import GuidanceLimits
from edge.uav.base import TrackState
from edge.uav.world.flight_world import FlightWorld
from edge.uav.world.patrol import patrol_world
from protocols.core.errors import InputError
from protocols.log.read.reader import LogReader
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from tests.faults.matrix import measured
from tests.support.uav_flights import Flight, mavlink

SIZE = (320, 240)
SHOWN = (pb.TargetState, pb.TargetCloud, pb.RoadMap)


@pytest.fixture(scope="module")
def world() -> FlightWorld:
    return patrol_world(3, 20.0, SIZE)


def recorded(flight: Flight, log: Path, keep: Callable[[object], bool] = lambda message: True) -> Path:
    with LogWriter(log) as writer:
        for k, message in enumerate(flight.published):
            if keep(message):
                writer.write(TOPICS[message.DESCRIPTOR.name], "drone", "local", message, 10**18 + k)
    return log


def test_a_replay_gives_the_agents_messages_to_the_byte(world: FlightWorld, tmp_path: Path) -> None:
    flight = Flight(world, jpeg_quality=90)
    flight.run(1.5)
    assert flight.select()
    flight.run(3.0)
    log = recorded(flight, tmp_path / "flight.mcap")
    count, missing = replay_through_uav(log, tmp_path / "again.mcap")
    assert missing == 0
    again = [
        logged.message.SerializeToString(deterministic=True) for logged in LogReader(tmp_path / "again.mcap").messages()
    ]
    said = [m.SerializeToString(deterministic=True) for m in flight.published if isinstance(m, SHOWN)]
    assert again == said
    assert count == len(said) > 40
    partial = recorded(
        flight, tmp_path / "partial.mcap", lambda m: getattr(m, "frame", 0) != 50 or not isinstance(m, pb.FlightImage)
    )
    _, missing = replay_through_uav(partial, tmp_path / "partial-again.mcap")
    assert missing == 1
    with pytest.raises(InputError, match="exists already"):
        replay_through_uav(log, tmp_path / "again.mcap")
    with pytest.raises(InputError, match="record from the agent's start"):
        replay_through_uav(
            recorded(flight, tmp_path / "blind.mcap", lambda m: not isinstance(m, pb.UavInfo)), tmp_path / "none.mcap"
        )


def test_a_link_that_drops_delays_doubles_and_garbles_costs_little(world: FlightWorld) -> None:
    faults = LinkFaults(drop=0.2, duplicate=0.2, garble=0.1, delay_s=0.05, jitter_s=0.05)
    flight = Flight(world, faults=faults)
    flight.run(1.5)
    assert any(flight.select(0.4) for _ in range(5))  # an order may be lost on the way
    flight.run(4.5)
    states = flight.messages(pb.TargetState)
    errors = [np.hypot(s.centre[0] - world.truth(s.frame).x, s.centre[1] - world.truth(s.frame).y) for s in states]
    assert np.median(errors) < 4.0
    assert flight.link.counters["garbled_bytes"] > 0


def test_an_autopilot_restart_and_a_clock_step_are_detected(world: FlightWorld) -> None:
    flight = Flight(world, faults=LinkFaults(reboot_at=(2.0,), steps=((5.0, 30.0),)))
    flight.run(8.0)
    clock = flight.agent._vehicle.clock
    assert (clock.reboots, clock.steps) == (1, 1)
    newest = flight.messages(pb.VehicleTelemetry)[-1]
    # The vehicle has been up for 6 s, and its clock is 30 s ahead of that; the camera's clock is its own.
    assert newest.vehicle_time_ns / 1e9 == pytest.approx(8.0 - 2.0 + 30.0, abs=0.3)
    assert newest.device_time_ns / 1e9 == pytest.approx(8.0 + flight.camera_ahead_s, abs=0.3)
    # The rates are asked for again.
    assert (
        len([m for m in flight.messages(pb.VehicleTelemetry) if m.device_time_ns / 1e9 - flight.camera_ahead_s > 7.0])
        > 20
    )


def test_nothing_is_commanded_unless_it_is_allowed(world: FlightWorld) -> None:
    flight = Flight(world)
    flight.run(1.5)
    assert flight.select()
    flight.run(2.5)
    assert flight.autopilot.counters["follow_targets"] == flight.autopilot.counters["pointed"] == 0


def test_an_aircraft_with_permission_is_commanded_to_follow_and_stops_on_the_operators_order(
    world: FlightWorld,
) -> None:
    start = np.array([*world.target.ground[0], -62.0])
    flight = Flight(
        world, control=GuidanceLimits(follow=True), flies="follow", start=start, yaw=float(world.target.course[0])
    )
    flight.run(1.5)
    assert flight.select()
    assert not flight.autopilot.counters["follow_targets"]
    assert flight.arm_follow()
    flight.run(3.1)
    sent = flight.autopilot.counters["follow_targets"]
    assert sent > 10
    geo_status = flight.station.last("CAMERA_TRACKING_GEO_STATUS")
    north, east, _ = flight.autopilot.origin.to_ned(1e-7 * geo_status.lat, 1e-7 * geo_status.lon, 0.0)
    lately = world.target.ground[flight.frame - 10 : flight.frame + 1]  # it is reported five times a second
    assert np.hypot(*(lately - [north, east]).T).min() < min(max(3.0 * geo_status.h_acc, 0.5), 3.0)
    moment, place, _ = flight.aircraft._target  # type: ignore[misc]
    assert np.hypot(*(place[:2] - world.target_at(moment)[0])) < 2.0
    car = world.target.ground[flight.frame] - world.target.ground[flight.frame - 30]
    moving = flight.aircraft.pose(flight.time).velocity[:2]
    assert float(moving @ car) / float(np.linalg.norm(car)) > 2.0  # from a standstill, after the car
    present, flight.agent.camera.is_present = flight.agent.camera.is_present, lambda system, now_s: False  # type: ignore[method-assign]
    flight.run(3.2)
    assert flight.agent.status(0).message == "station 255 is silent"
    assert flight.station.received["STATUSTEXT"][-1].text == "Syncline: follow ended, station 255 is silent"
    flight.agent.camera.is_present = present  # type: ignore[method-assign]
    assert flight.arm_follow()
    flight.station.command(mavlink.MAV_CMD_CAMERA_STOP_TRACKING)
    flight.run(3.5)
    sent = flight.autopilot.counters["follow_targets"]
    flight.run(4.0)
    assert flight.autopilot.counters["follow_targets"] == sent
    assert flight.agent.status(0).message == "stopped by the operator"


def test_a_vehicle_that_follows_in_wind_stops_at_the_fence(world: FlightWorld) -> None:
    """Gusts of 8 m/s. The car comes to 46 m from the take-off place, and crosses the fence on its way out again."""
    radius = np.hypot(*world.target.ground.T[:2])
    crossing = 7.5
    fence = float(radius[round(crossing * world.fps)])
    start = np.array([*world.target.ground[60], -62.0])
    assert float(np.hypot(*start[:2])) < fence
    gusts = tuple(
        Disturbance(begin, 1.0, velocity=(8.0 * float(np.cos(begin)), 8.0 * float(np.sin(begin))))
        for begin in (3.0, 4.5, 6.0)
    )
    flight = Flight(
        world,
        control=GuidanceLimits(follow=True, fence_m=fence),
        flies="follow",
        start=start,
        gimbal=(-0.5 * np.pi, 0.0),
        disturbances=gusts,
    )
    flight.run(1.8)
    assert not flight.arm_follow()  # there is no target yet
    assert flight.select()
    assert flight.arm_follow()
    assert flight.station.received["STATUSTEXT"][-1].text == f"Syncline: follow by 255, fence {fence:.0f} m, 5-120 m"
    flight.run(4.0)
    assert flight.autopilot.counters["follow_targets"] > 5
    flight.run(crossing + 1.5)
    sent = flight.autopilot.counters["follow_targets"]
    texts = [message.text for message in flight.station.received["STATUSTEXT"]]
    assert f"Syncline: follow ended, fence: {fence:.0f} m from take-off"[:50] in texts, texts
    flight.run(flight.time + 3.0)
    assert flight.autopilot.counters["follow_targets"] == sent
    pose = flight.aircraft.pose(flight.time)
    assert np.hypot(*pose.position[:2]) < fence + 30.0  # its way to stop, and the wind
    assert np.hypot(*pose.velocity[:2]) < 1.0
    measured("follow in gusts of 8 m/s, fence", "stops there", f"{np.hypot(*pose.position[:2]) - fence:+.0f} m")


def test_the_demos_report_shows_map_and_images_of_what_was_recorded(world: FlightWorld, tmp_path: Path) -> None:
    flight = Flight(world, jpeg_quality=80, camera_ahead_s=0.0)
    flight.run(1.5)
    assert flight.select()
    flight.run(16.0)
    log = recorded(flight, tmp_path / "demo.mcap")
    outcome = compare_log_with_world(log, world, flight.boot_s)
    assert outcome.out_frames > 10, "the flight loses the car every 12 s"
    write_report(tmp_path / "report.html", log, outcome, world)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/jpeg;base64,") == 4
    assert "reacquired" in page
    assert page.count("<circle") > 0.9 * outcome.frames  # every position that was reported
    assert f"out of view ({outcome.out_frames} frames)" in page
    assert "://" not in page.replace("http://www.w3.org", "")  # one file that needs nothing else


def test_commands_stop_while_the_link_is_silent_or_no_frames_come_and_when_the_target_is_lost(
    world: FlightWorld,
) -> None:
    start = np.array([*world.target.ground[0], -62.0])
    flight = Flight(
        world, control=GuidanceLimits(follow=True), flies="follow", start=start, yaw=float(world.target.course[0])
    )
    control = flight.agent._guidance

    def sent(seconds: float) -> int:
        before = control.counters["follow_targets"]
        flight.run(flight.time + seconds)
        return control.counters["follow_targets"] - before

    flight.run(1.5)
    assert flight.select()
    assert flight.arm_follow()
    flight.run(2.5)
    step, flight.autopilot.step = flight.autopilot.step, lambda time: None  # type: ignore[method-assign]
    flight.run(4.1)
    assert sent(0.5) == 0
    assert control.hold_reason == "the link is stale"
    flight.autopilot.step = step  # type: ignore[method-assign]
    flight.run(5.0)
    assert sent(0.5) > 0
    estimate = flight.agent.estimator.estimate
    assert estimate is not None
    flight.frames_lost = lambda frame: True
    flight.agent.estimator.estimate = replace(estimate, state=TrackState.LOST)
    assert sent(0.5) == 0
    assert control.hold_reason == "the target is lost"
    flight.agent.estimator.estimate = estimate
    assert sent(0.3) == 0  # to follow it again needs the operator again
    assert flight.arm_follow()
    assert sent(0.5) > 0
    flight.run(flight.time + 1.2)  # more than two seconds without a frame
    assert sent(0.5) == 0
    assert control.hold_reason == "no frames"
