"""Guidance commands: none unless allowed, and never beyond the limits."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from edge.agents.uav_guidance import GuidanceControl
from edge.mavlink.dialect import mavlink
from edge.mavlink.link.connection import Link, ReceivedMessage
from edge.mavlink.roles.guidance import Guidance, GuidanceTarget
from edge.mavlink.settings import GuidanceLimits
from edge.uav.base import Estimate, TrackState
from edge.uav.navigation import Origin
from tests.support.pipe import Pipe

ORIGIN = Origin(47.4, 8.5, 480.0)
VEHICLE, STILL = np.array([0.0, 0.0, -50.0]), np.zeros(3)
TARGET = GuidanceTarget(0.0, np.array([30.0, 40.0]), np.array([8.0, 0.0]), 1.0, 0.0)


class GuidanceUnderTest:
    """A control on a link, and what an autopilot hears of it."""

    def __init__(self, system: int = 1, **limits: Any) -> None:
        ours, self._pipe = Pipe.pair()
        self._link = Link(None, system=system, component=100, allowed=("HEARTBEAT",), transport=ours, now_ns=lambda: 0)
        vehicle = mavlink.MAVLink(None, 1, 1)
        self._pipe.send(bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(vehicle)), None)
        self._link.poll()
        self.guidance = Guidance(self._link, GuidanceLimits(**limits))
        self.guidance.begin(VEHICLE)
        self.guidance.arm(255)
        self._pipe.receive()

    def tick(self, now_s: float, target: GuidanceTarget = TARGET, vehicle: np.ndarray = VEHICLE) -> list[Any]:
        """All messages sent at a time."""
        self.guidance.tick(now_s, target, vehicle, STILL, ORIGIN)
        reader = mavlink.MAVLink(None)
        return [m for data, _ in self._pipe.receive() for m in reader.parse_buffer(data) or []]


def kinds(messages: list[Any]) -> set[str]:
    return {message.get_type() for message in messages}


def test_nothing_is_sent_unless_enabled() -> None:
    under_test = GuidanceUnderTest()
    assert under_test.tick(0.0) == []
    assert under_test.guidance.hold_reason == "commands are off"
    assert kinds(GuidanceUnderTest(follow=True).tick(0.0)) == {"FOLLOW_TARGET"}
    assert kinds(GuidanceUnderTest(gimbal=True).tick(0.0)) == {"COMMAND_LONG", "GIMBAL_MANAGER_SET_PITCHYAW"}


@pytest.mark.parametrize(
    ("target", "vehicle", "reason"),
    [
        (replace(TARGET, unseen_s=8.1), VEHICLE, "not seen"),
        (replace(TARGET, std_m=15.1), VEHICLE, "known only to"),
        (replace(TARGET, std_m=math.nan), VEHICLE, "known only to"),
        (replace(TARGET, position=np.array([301.0, 0.0])), VEHICLE, "farther"),
        (replace(TARGET, position=np.array([math.nan, 0.0])), VEHICLE, "farther"),
        (TARGET, np.array([0.0, 0.0, -0.5]), "on the ground"),
    ],
)
def test_beyond_the_limits_nothing_is_sent_and_the_reason_is_given(
    target: GuidanceTarget, vehicle: np.ndarray, reason: str
) -> None:
    under_test = GuidanceUnderTest(gimbal=True, follow=True)
    assert under_test.tick(0.0) != []
    assert under_test.tick(1.0, target, vehicle) == []
    assert reason in under_test.guidance.hold_reason
    assert under_test.tick(2.0) != []  # and it resumes within the limits


def test_the_vehicle_follows_only_once_it_is_armed_and_for_one_target() -> None:
    under_test = GuidanceUnderTest(follow=True)
    assert kinds(under_test.tick(0.0)) == {"FOLLOW_TARGET"}
    under_test.guidance.begin(VEHICLE)  # another target
    assert under_test.tick(1.0) == []
    assert under_test.guidance.hold_reason == "follow is not armed"
    assert under_test.guidance.arm(255)
    assert kinds(under_test.tick(2.0)) == {"FOLLOW_TARGET"}
    under_test.guidance.disarm()
    assert under_test.tick(3.0) == []
    assert not GuidanceUnderTest(gimbal=True).guidance.arm(255)
    pointing = GuidanceUnderTest(gimbal=True, follow=True)
    pointing.guidance.disarm()
    assert "FOLLOW_TARGET" not in kinds(pointing.tick(0.0))


@pytest.mark.parametrize(
    ("target", "vehicle", "reason"),
    [
        (replace(TARGET, position=np.array([30.0, 96.0])), VEHICLE, "fence: 100 m"),
        (TARGET, np.array([80.0, 70.0, -50.0]), "fence: 100 m"),
        (TARGET, np.array([0.0, 0.0, -121.0]), "height 121 m"),
        (TARGET, np.array([0.0, 0.0, -4.0]), "height 4 m"),
    ],
)
def test_at_the_fence_and_beyond_its_heights_following_ends_until_it_is_armed_again(
    target: GuidanceTarget, vehicle: np.ndarray, reason: str
) -> None:
    under_test = GuidanceUnderTest(follow=True, fence_m=100.0)
    assert under_test.tick(0.0) != []
    assert under_test.tick(1.0, target, vehicle) == []
    assert reason in under_test.guidance.hold_reason
    assert under_test.tick(2.0) == []
    under_test.guidance.arm(255)
    assert under_test.tick(3.0) != []


def test_follow_target_has_the_extrapolated_position_and_a_limited_speed() -> None:
    under_test = GuidanceUnderTest(follow=True, speed=5.0)
    (follow_target,) = under_test.tick(0.5)
    north, east, _ = ORIGIN.to_ned(1e-7 * follow_target.lat, 1e-7 * follow_target.lon, follow_target.alt)
    assert (north, east) == pytest.approx((34.0, 40.0), abs=0.05)  # half a second on, at 8 m/s
    assert follow_target.vel[:2] == pytest.approx([5.0, 0.0])
    assert follow_target.est_capabilities == 0b11
    # ArduPilot, AP_Follow::should_handle_message: its own system id is nobody to follow.
    assert follow_target.get_srcSystem() == 200
    assert GuidanceUnderTest(follow=True, beacon=1).tick(0.5) == []


def test_the_gimbal_is_claimed_for_the_camera_s_own_system_id() -> None:
    claim, pointing = GuidanceUnderTest(system=7, gimbal=True).tick(0.0)
    assert (claim.target_system, claim.param1, claim.param2) == (1, 7, 100)
    assert (pointing.target_system, pointing.get_srcSystem()) == (1, 7)


def gimbal_status(system: int, component: int, device: int = 1, flags: int = 0) -> Any:
    return mavlink.MAVLink_gimbal_manager_status_message(0, flags, device, system, component, 0, 0)


def claims(messages: list[Any]) -> int:
    return sum(m.get_type() == "COMMAND_LONG" for m in messages)


@pytest.mark.parametrize("by_hand", [gimbal_status(255, 190), gimbal_status(1, 1), gimbal_status(7, 100, flags=256)])
def test_a_gimbal_that_an_operator_has_taken_is_left_to_them_until_it_is_free_or_a_target_is_selected(
    by_hand: Any,
) -> None:
    under_test = GuidanceUnderTest(system=7, gimbal=True)
    assert claims(under_test.tick(0.0)) == 1
    under_test.guidance.handle_gimbal_status(gimbal_status(255, 190), 0.1)  # sent before the claim was heard
    under_test.guidance.handle_gimbal_status(gimbal_status(7, 100), 0.6)
    assert kinds(under_test.tick(6.0)) == {"GIMBAL_MANAGER_SET_PITCHYAW"}  # what it has, it need not claim
    under_test.guidance.handle_gimbal_status(by_hand, 6.1)
    assert under_test.tick(12.0) == []
    assert under_test.guidance.hold_reason.endswith("controls the gimbal")
    under_test.guidance.handle_gimbal_status(gimbal_status(0, 0), 13.0)
    assert claims(under_test.tick(13.1)) == 1
    under_test.guidance.handle_gimbal_status(by_hand, 16.0)  # the claim was refused
    assert under_test.tick(17.0) == []
    under_test.guidance.begin(VEHICLE)
    assert claims(under_test.tick(18.0)) == 1


def test_a_vehicle_follows_on_while_the_gimbal_is_left_to_an_operator() -> None:
    under_test = GuidanceUnderTest(gimbal=True, follow=True)
    under_test.tick(0.0)
    under_test.guidance.handle_gimbal_status(gimbal_status(255, 190), 3.0)
    assert kinds(under_test.tick(4.0)) == {"FOLLOW_TARGET"}


def test_stations_are_told_to_whom_the_gimbal_is_left() -> None:
    under_test, said = GuidanceUnderTest(gimbal=True), list[str]()
    control = GuidanceControl(under_test.guidance, *[SimpleNamespace(say=said.append)] * 3)  # type: ignore[arg-type]
    under_test.tick(0.0)
    for system, component in ((1, 100), (255, 1), (255, 1), (0, 0)):
        status = gimbal_status(system, component)
        control.handle(ReceivedMessage(status, status.get_type(), 1, 154, 0), 1.0)  # not the autopilot's manager
        control.handle(ReceivedMessage(status, status.get_type(), 1, 1, 0), 1.0)
    assert said == ["Syncline: gimbal left to system 255", "Syncline: gimbal is free again"]


def test_a_second_gimbal_that_nobody_controls_is_not_claimed_again_and_again() -> None:
    under_test = GuidanceUnderTest(gimbal=True)
    under_test.tick(0.0)
    for k in range(1, 20):
        under_test.guidance.handle_gimbal_status(gimbal_status(1, 100) if k % 2 else gimbal_status(0, 0, 2), 0.5 * k)
        assert claims(under_test.tick(0.5 * k)) == 0


def test_a_stale_estimate_is_extrapolated_for_at_most_a_second() -> None:
    (follow_target,) = GuidanceUnderTest(follow=True).tick(60.0)
    assert ORIGIN.to_ned(1e-7 * follow_target.lat, 1e-7 * follow_target.lon, follow_target.alt)[0] == pytest.approx(
        38.0, abs=0.05
    )


def test_the_gimbal_points_at_the_target_with_a_limited_rate() -> None:
    under_test = GuidanceUnderTest(gimbal=True, rate_deg_s=30.0)
    first = under_test.tick(0.0, replace(TARGET, velocity=np.zeros(2)))[-1]
    assert first.yaw == pytest.approx(math.atan2(40.0, 30.0), abs=1e-5)
    assert first.pitch == pytest.approx(-math.atan2(49.3, 50.0), abs=1e-5)
    behind = replace(TARGET, position=np.array([-30.0, -40.0]), velocity=np.zeros(2))
    second = under_test.tick(0.1, behind)[-1]
    turned = (second.yaw - first.yaw + math.pi) % (2.0 * math.pi) - math.pi
    assert abs(turned) == pytest.approx(math.radians(3.0), rel=0.01)
    assert second.flags & mavlink.GIMBAL_MANAGER_FLAGS_YAW_IN_EARTH_FRAME


def test_commands_come_ten_times_a_second_at_most() -> None:
    under_test = GuidanceUnderTest(follow=True)
    assert sum(len(under_test.tick(k / 100)) for k in range(100)) == pytest.approx(10, abs=1)


def test_a_vehicle_whose_position_is_no_longer_reported_is_not_commanded() -> None:
    under_test = GuidanceUnderTest(gimbal=True)
    seen = Estimate(1.0, TrackState.VISIBLE, *([0.0] * 6), north=30.0, east=40.0, std_m=1.0)
    known: list[tuple[np.ndarray, np.ndarray] | None] = [(VEHICLE, STILL)]
    vehicle: Any = SimpleNamespace(motion_at=lambda time_s: known[0], origin=ORIGIN, armed=True)
    link: Any = SimpleNamespace(last_received_ns=10**9)
    control = GuidanceControl(under_test.guidance, link, vehicle, SimpleNamespace(is_present=lambda *_: True))  # type: ignore[arg-type]
    control.begin(1.0)
    control.update(10**9, seen, 1.0, 1.0)
    assert under_test.guidance.counters["pointed"] == 1
    known[0] = None
    control.update(2 * 10**9, seen, 2.0, 2.0)
    assert under_test.guidance.counters["pointed"] == 1
    assert under_test.guidance.hold_reason == "the vehicle's position is not known"
